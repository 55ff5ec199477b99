"""Result of a calibration: constants with their acceptance tests, noise, cross-validation, and lines of the verdict."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from graphslam.calibrate.corrections import Corrections
from graphslam.core.config import options_dict
from graphslam.core.findings import Finding

SIGNIFICANT = 3.0
"""A constant is applied if it differs from its neutral value by more than this many σ,"""
GAIN = 5.0
"""… increases the log-likelihood by more than this over a fit without it [nats],
and the whole estimate increases it by more than this on withheld data, compared with the noise of the log."""
AGREE = 2.0
"""… and its estimates from the two window lengths differ by at most this many σ."""
VAGUE = 0.05
"""A scale with a larger σ is not corrected: uncalibrated wheels and rangefinders have smaller scale errors."""
LASTS = 1.5
"""If σ in long windows exceeds σ in short ones by more than this factor, the noise is time-correlated."""
ALIKE = 0.3
"""… and also if the autocorrelation of whitened residuals exceeds this."""


LARGEST = {"distance_scale": 0.15, "turn_scale": 0.5, "range_scale": 0.15}
"""Wear, load and slip of wheels cause smaller errors than these. A larger one means a wrong unit, sign or mounting, or
a faulty sensor; scan matches cannot identify which stream is wrong."""
LARGEST_NOISE = {"along_metre": 0.3, "heading_metre": 0.5}
"""Larger odometry noise means that the streams contradict each other [m/√m, rad/√m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """Estimate of one constant.

    Parameters
    ----------
    name : str
        As in :class:`~graphslam.calibrate.corrections.Corrections`; here distance_scale is ln, other scales factor - 1.
    gain : float
        Log-likelihood with it minus that without it [nats]; NaN if not significant and therefore not fitted.
    other, other_sigma : float
        Value and σ from windows of another length; NaN if there are none.
    why_not : str
        Why it is not applied; empty if it is applied.
    """

    name: str
    value: float
    sigma: float
    gain: float = math.nan
    other: float = math.nan
    other_sigma: float = math.nan
    why_not: str = ""

    @property
    def applied(self) -> bool:
        """Is the log corrected by this estimate?"""
        return not self.why_not

    @property
    def contradiction(self) -> bool:
        """Is it significantly larger than the plausible limit in :data:`LARGEST`?"""
        if self.name.endswith("_scale") and self.sigma > VAGUE:
            return False
        return abs(self.value) - SIGNIFICANT * self.sigma > LARGEST.get(self.name, math.inf)

    def gated(self) -> Estimate:
        """Copy with ``why_not`` set by the acceptance tests."""
        why = ""
        if not abs(self.value) > SIGNIFICANT * self.sigma:
            why = "not significant"
        elif self.name.endswith("_scale") and self.sigma > VAGUE:
            why = f"an uncertainty of ± {100 * self.sigma:.0f} % is too large for a scale"
        elif not self.gain > GAIN:
            why = f"log-likelihood +{max(self.gain, 0.0):.1f} nats, more than {GAIN:g} needed"
        elif abs(self.value - self.other) > AGREE * math.hypot(self.sigma, self.other_sigma):
            why = f"windows of another length give {estimate_text(self.name, self.other, self.other_sigma)}"
        return replace(self, why_not=why)


@dataclass(frozen=True, slots=True, kw_only=True)
class Prediction:
    """Cross-validation: log-likelihood of withheld data under an estimate, relative to the noise of the log.

    Parameters
    ----------
    what : str
        Kind of withheld data.
    count : int
        Number of withheld data.
    gains : mapping of str to float
        Increase of the log-likelihood [nats]: with ``all`` of the estimate, and with its ``noise`` without its
        constants, if it has any.
    timed : Corrections
        Clock offset above half the time between observations, and wheel slip, unless the data contradict them.
    """

    what: str
    count: int
    gains: dict[str, float]
    timed: Corrections = field(default_factory=Corrections)

    @property
    def supported(self) -> str:
        """Part of the estimate that the held-out data support and that is used: ``all``, ``noise`` or ``nothing``."""
        best = max(self.gains, key=lambda k: self.gains[k])
        return best if self.gains[best] > GAIN else "nothing"

    def text(self) -> str:
        """The result of the cross-validation, for a line of the verdict."""
        test = f"cross-validation on {self.count} {self.what} [+{GAIN:g} nats needed]: log-likelihood"
        gain = self.gains["all"]
        if self.supported == "all":
            return f"{test} +{gain:.0f} nats with the estimated noise and calibration"
        if self.supported == "noise":
            less = self.gains["noise"] - gain
            return f"{test} +{less:.0f} nats with the estimated noise alone, without the systematic errors"
        return f"{test} {gain:+.0f} nats with the estimated noise and calibration"


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """Noise and systematic errors estimated from a log.

    Parameters
    ----------
    kind : str
        Data used: ``observations``, ``ranges``, ``scans`` or ``clouds``.
    corrections : Corrections
        Corrections to apply.
    noise : mapping of str to float
        Fitted standard deviations.
    notes : tuple of Finding
        Further findings.
    data : str
        Part of the log that was used.
    prediction : Prediction or None
        Cross-validation; estimates that fail it are not applied. None: not done.
    """

    kind: str
    corrections: Corrections
    estimates: tuple[Estimate, ...] = ()
    noise: dict[str, float] = field(default_factory=dict)
    notes: tuple[Finding, ...] = ()
    data: str = ""
    prediction: Prediction | None = None

    def validated(self, prediction: Prediction) -> Calibration:
        """Copy without estimates that fail the cross-validation. Few withheld observations depend on large clock
        offsets and slip, so these are rejected only if they reduce the log-likelihood by :data:`GAIN` or more.
        """
        found, supported = replace(self, prediction=prediction), prediction.supported
        if supported == "all":
            return found
        kept = self.corrections.without_constants() if supported == "noise" else Corrections()
        kept = replace(kept, heading_cover=None)  # it covers the errors that the constants leave
        own, timed = self.corrections, prediction.timed
        kept = replace(kept, clock=own.clock if timed.clock else 0.0, slips=own.slips if timed.slips else ())
        refused = [
            replace(e, why_not=prediction.text()) if e.applied and not (e.name == "clock" and kept.clock) else e
            for e in self.estimates
        ]
        return replace(found, estimates=tuple(refused), corrections=kept)

    def findings(self) -> list[Finding]:
        """Lines of the verdict: corrections that are applied, and those that are not, with the reason."""
        against = self.contradictions()
        if against:
            text = (
                f"{', '.join(against)} (from {self.data}) — implausibly large: a unit, a sign, a mounting or a stream "
            )
            text += "is wrong. Nothing was calibrated; default noise is used. To do: `graphslam data check`."
            return [Finding("bad", "calibration-contradiction", text)]
        out = []
        supported = "all" if self.prediction is None else self.prediction.supported
        if self.prediction is not None:
            text = f"{self.prediction.text()} ({self.data})"
            alike = supported == "nothing" and self.prediction.gains["all"] > -GAIN
            text += {
                "all": " — used.",
                "noise": " — systematic errors are not corrected.",
                "nothing": " — the noise of the log is kept." if alike else " — the estimate is not used.",
            }[supported]
            right = supported == "all" or alike
            out.append(Finding("", "calibrated", text) if right else Finding("look", "calibration-refused", text))
        for e in self.estimates:
            estimate = estimate_text(e.name, e.value, e.sigma)
            if e.applied:
                how = f"{CORRECTION_VERBS[e.name]} (log-likelihood +{e.gain:.0f} nats)"
                text = f"calibration from {self.data}: {estimate} — {how}."
                out.append(Finding("", "calibrated", text))
            elif e.why_not != "not significant":
                text = f"calibration from {self.data}: {estimate} — not corrected: {e.why_not}."
                out.append(Finding("look", "calibration-left", text))
        chance = [NAMES[e.name] for e in self.estimates if e.why_not == "not significant"]
        if chance:
            out.append(Finding("", "calibrated", f"systematic errors of {' and '.join(chance)}: none found."))
        if self.noise:
            text = f"noise from {self.data}: {noise_text(self.noise)}{', not used' * (supported == 'nothing')}."
            if (cover := self.corrections.heading_cover) is not None:
                text += (
                    f" A larger σ of distances in the log is kept; that of the heading is {cover:.2g} times this one."
                )
            elif self.corrections.widen_only:
                text += " A larger σ in the log is kept."
            out.append(Finding("", "calibrated", text))
        return [*out, *self.notes]

    def contradictions(self) -> list[str]:
        """Implausibly large estimates as text; with any of them nothing of the calibration is used."""
        out = [estimate_text(e.name, e.value, e.sigma) for e in self.estimates if e.contradiction]
        large = {k: v for k, v in self.noise.items() if v > LARGEST_NOISE.get(k, math.inf)}
        return out + ([f"noise {noise_text(large)}"] if large else [])

    def config(self) -> dict[str, Any]:
        """Options ``calibrate.…`` of a run that uses this calibration and makes no new one."""
        return {"use": "none", "given": options_dict(self.corrections)}

    def as_dict(self) -> dict[str, Any]:
        """JSON object."""
        return {
            "kind": self.kind,
            "data": self.data,
            "given": options_dict(self.corrections),
            "estimates": [
                {k: _number(getattr(e, k)) for k in e.__dataclass_fields__} | {"applied": e.applied}
                for e in self.estimates
            ],
            "noise": {k: float(v) for k, v in self.noise.items()},
            "prediction": None
            if self.prediction is None
            else options_dict(self.prediction) | {"supported": self.prediction.supported},
            "lines": [f.as_row() for f in self.findings()],
        }


NAMES = {
    "yaw_bias": "the yaw rate",
    "distance_scale": "the odometry distances",
    "turn_per_metre": "the turn per metre",
    "turn_scale": "the turns",
    "range_scale": "the range scale",
    "range_offset": "the range offset",
    "sensor_yaw": "the sensor yaw",
    "clock": "the clocks",
    "mount_x": "the sensor position",
    "mount_y": "the sensor position",
}
CORRECTION_VERBS = {
    "yaw_bias": "subtracted",
    "distance_scale": "divided out",
    "turn_per_metre": "subtracted",
    "turn_scale": "divided out",
    "range_scale": "divided out",
    "range_offset": "subtracted",
    "sensor_yaw": "corrected",
    "clock": "corrected",
}


def estimate_text(name: str, value: float, sigma: float) -> str:
    """A constant with its σ as text without a full stop."""
    deg = np.rad2deg
    if name == "yaw_bias":
        return f"yaw rate {deg(abs(value)):.3f} ± {deg(sigma):.3f} deg/s too {'high' if value > 0 else 'low'}"
    if name == "distance_scale":
        return f"odometry distances {100 * abs(np.expm1(value)):.2f} ± {100 * sigma:.2f} % too {_long(value)}"
    if name == "turn_per_metre":
        return f"odometry turns {deg(abs(value)):.3f} ± {deg(sigma):.3f} deg/m too far to the {_left(value)}"
    if name == "turn_scale":
        return f"turns {100 * abs(value):.2f} ± {100 * sigma:.2f} % too {'large' if value > 0 else 'small'}"
    if name == "range_scale":
        return f"range scale {1 + value:.4f} ± {sigma:.4f} relative to the wheels"
    if name == "range_offset":
        return f"ranges {abs(value):.3f} ± {sigma:.3f} m too {_long(value)}"
    if name == "sensor_yaw":
        return (
            f"sensor turned {deg(abs(value)):.2f} ± {deg(sigma):.2f} deg further to the {_left(value)} than configured"
        )
    if name == "mount_x":
        return f"sensor {abs(value):.3f} ± {sigma:.3f} m further {'ahead' if value > 0 else 'back'} than configured"
    if name == "mount_y":
        return f"sensor {abs(value):.3f} ± {sigma:.3f} m further to the {_left(value)} than configured"
    if name == "clock":
        return f"odometry stamps {abs(value):.3f} ± {sigma:.3f} s too {'late' if value > 0 else 'early'}"
    return f"{name} {value:.4g} ± {sigma:.2g}"


def noise_text(noise: dict[str, float]) -> str:
    """Standard deviations as a list."""
    units = {
        "along_metre": ("along the path", "m/√m"),
        "along_second": ("along the path", "m/√s"),
        "lateral_metre": ("to the side", "m/√m"),
        "heading_metre": ("heading", "rad/√m"),
        "heading_radian": ("heading", "rad/√rad"),
        "heading_second": ("heading", "rad/√s"),
        "range_sigma": ("ranges", "m"),
        "bearing_sigma": ("bearings", "rad"),
        "range_visit": ("ranges per visit", "m"),
        "bearing_visit": ("bearings per visit", "rad"),
    }
    found = [f"{units[k][0]} {v:.3g} {units[k][1]}" for k, v in noise.items() if k in units]
    return ", ".join(found)


def round_digits(x: float) -> float:
    """Round to five digits, so that the applied value is the written one on every machine."""
    return float(f"{x:.5g}")


def _long(value: float) -> str:
    return "long" if value > 0 else "short"


def _left(value: float) -> str:
    return "left" if value > 0 else "right"


def _number(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value
