"""Test whether odometry and landmark observations fit one map, and which calibration error explains a misfit.

Landmark front ends store sums over short windows in the reports of their submaps
(:mod:`graphslam_frontends.landmarks.bias_score`); the windows are independent, so their sums are added. Two tests:

- χ² of the residuals over their degrees of freedom, bounds at 99.9 %;
- each calibration error alone, ``ĉ = g / S`` with σ² = 1/S. The noise of recorded logs is not white, and then the
  windows scatter more than S predicts: σ² is the larger of 1/S and the variance from their scatter.

Thresholds are quantiles of these statistics at 99.9 %, corrected for the number of tests (Bonferroni). On 96 simulated
logs of three noise levels (seeds 100 to 115, ``rbpf-ekf`` and ``ekf-slam``) the normalised scores had σ 0.6 to 1.1 and
a largest absolute value of 2.6, χ²/dof a mean of 1.00 to 1.01.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

from graphslam.core.findings import Finding, Level
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array

CERTAIN = 0.999
UNDERSTATED = 1.5
"""χ²/dof above which the misfit is reported as ``bad``: the errors exceed the noise model by more than 20 % in σ."""
AS_MUCH = 0.7
"""Errors that reduce χ² by at least this fraction of the best reduction are reported as alternative causes."""
HALF = 0.5
"""Fraction of the excess χ² that the best error must remove to be reported."""
APART = 0.05
"""An error is not tested if less than this fraction of its information is independent of the errors that the graph
estimates (for example a common scale of ranges and distances)."""
LEAST_WINDOWS = 3
"""With fewer windows their scatter is not estimated."""


@dataclass(frozen=True, slots=True)
class BiasKind:
    """One type of calibration error.

    Parameters
    ----------
    more, less : str
        Message for a positive and for a negative error, with a placeholder for the amount.
    unit : str
        Unit of the amount in the message: ``m``, ``°``, ``°/m``, or ``%`` for a factor.
    careful : float
        Error that remains after a calibration by hand; a larger error makes the finding ``bad``.
    mend : str
        What to do.
    """

    more: str
    less: str
    unit: str
    careful: float
    mend: str


_TO_UNIT = {"m": 1.0, "°": 180.0 / np.pi, "°/m": 180.0 / np.pi, "%": 100.0}
KINDS = {
    "range-scale": BiasKind(
        "ranges look {} too long", "ranges look {} too short", "%", 0.05, "check the unit and the scale of the ranges"
    ),
    "range-offset": BiasKind(
        "ranges look {} too long",
        "ranges look {} too short",
        "m",
        0.2,
        "set the range offset frontend.noise.range_offset",
    ),
    "bearing-offset": BiasKind(
        "bearings look {} too large (sensor rotated to the right)",
        "bearings look {} too small (sensor rotated to the left)",
        "°",
        float(np.deg2rad(2.0)),
        "correct the angle of T_base_sensor",
    ),
    "mount-x": BiasKind(
        "the sensor seems to be {} ahead of its configured position",
        "the sensor seems to be {} behind its configured position",
        "m",
        0.2,
        "correct x of T_base_sensor",
    ),
    "mount-y": BiasKind(
        "the sensor seems to be {} to the left of its configured position",
        "the sensor seems to be {} to the right of its configured position",
        "m",
        0.2,
        "correct y of T_base_sensor",
    ),
    "distance-scale": BiasKind(
        "wheel distances look {} too long",
        "wheel distances look {} too short",
        "%",
        0.05,
        "check the unit, the sign and the scale of the speeds",
    ),
    "turn-scale": BiasKind(
        "wheel turns look {} too large",
        "wheel turns look {} too small",
        "%",
        0.05,
        "check the unit and the sign of steering or yaw rate, and those of the bearings",
    ),
    "turn-per-metre": BiasKind(
        "the wheels seem to turn {} too much to the left",
        "the wheels seem to turn {} too much to the right",
        "°/m",
        float(np.deg2rad(0.2)),
        "check the zero and the sign of the steering",
    ),
}
"""In the order of `graphslam_frontends.landmarks.bias_score.PARAMETERS`."""


@dataclass(frozen=True, slots=True)
class BiasTest:
    """Sums over all windows of a run.

    Parameters
    ----------
    error, sigma : (p,)
        Each error of :data:`KINDS` as if it were the only one, and its σ.
    reduction : (p,)
        Reduction of χ² if it is corrected.
    drift, drift_dof : (p,)
        Mean of ``g² / S`` over the windows, weighted by S: 1 if the noise is white within a window, more if it is
        time-correlated; and its degrees of freedom ``(Σ S)² / Σ S²``.
    """

    windows: int
    chi2: float
    dof: int
    error: Array
    sigma: Array
    reduction: Array
    drift: Array
    drift_dof: Array

    @property
    def ratio(self) -> float:
        """χ²/dof."""
        return self.chi2 / self.dof

    @property
    def bound(self) -> float:
        """χ²/dof that a consistent run exceeds once in a thousand."""
        return float(np.divide(chi2_quantile(CERTAIN, self.dof), self.dof))


ESTIMATED = {
    "range_scale": "range-scale",
    "range_offset": "range-offset",
    "sensor_yaw": "bearing-offset",
    "distance_scale": "distance-scale",
    "yaw_bias": "turn-per-metre",
    "turn_per_metre": "turn-per-metre",
    "mount_x": "mount-x",
    "mount_y": "mount-y",
}
"""Constant errors that a graph may estimate (:mod:`graphslam.core.sensor_biases`) → their name in :data:`KINDS`."""


def sum_bias_windows(reports: Sequence[Mapping[str, Any]]) -> BiasTest | None:
    """Sum over the reports of all submaps; None if no report has bias sums.

    Errors that the graph estimates are marginalised out: they are not reported, and the other errors are tested with
    the part that they do not explain.
    """
    found = [r["systematic"] for r in reports if r.get("systematic")]
    if not found:
        return None
    total = {k: np.sum([np.asarray(f[k], dtype=np.float64) for f in found], axis=0) for k in found[0]}
    free = {ESTIMATED[n] for r in reports for n in r.get("biases", ())}
    s = np.maximum(np.diag(total["information"]), 1e-12)
    alone = total["score"] / s
    windows = int(total["windows"])
    left = total["score2"] - 2 * alone * total["score_information"] + alone**2 * total["information2"]
    left *= windows / max(windows - 1, 1)
    scatter = left if windows >= LEAST_WINDOWS else np.zeros(len(s))
    drift, dof = total["score2"] / s, s**2 / np.maximum(total["information2"], 1e-24)
    score, own, chi2 = total["score"], s, float(total["chi2"])
    if free:
        drift = left / s
        a = [k for k, name in enumerate(KINDS) if name in free]
        S_a = total["information"][np.ix_(a, a)]
        gain = np.linalg.lstsq(S_a, np.column_stack([total["information"][a], score[a]]), rcond=1e-9)[0]
        chi2 -= float(score[a] @ gain[:, -1])
        score = score - total["information"][:, a] @ gain[:, -1]
        own = s - np.einsum("ja,aj->j", total["information"][:, a], gain[:, :-1])
        none = np.isin(np.arange(len(s)), a) | (own < APART * s)
        score, own = np.where(none, 0.0, score), np.where(none, s, own)
    sigma = np.sqrt(np.maximum(s, scatter) / s / own)
    return BiasTest(windows, chi2, int(total["dof"]) - len(free), score / own, sigma, score**2 / own, drift, dof)


def bias_test_findings(reports: Sequence[Mapping[str, Any]]) -> list[Finding]:
    """Findings on misfit and calibration errors for the verdict.

    Parameters
    ----------
    reports : sequence of mapping
        Reports of all submaps of a run.
    """
    found = sum_bias_windows(reports)
    if found is None:
        return []
    names = list(KINDS)
    z = np.abs(found.error) / found.sigma
    certain = z > -special.ndtri((1.0 - CERTAIN) / len(names) / 2.0)
    best = int(np.argmax(np.where(certain, found.reduction, -1.0)))
    out = []
    misfit = found.ratio > found.bound
    if misfit:
        level: Level = "bad" if found.ratio > UNDERSTATED else "look"
        left = (found.chi2 - found.reduction[best]) / found.dof if certain.any() else found.ratio
        text = (
            f"χ²/dof of odometry and observations: {found.ratio:.3g} over {found.windows} short windows "
            f"[≤ {found.bound:.3g} in 999 of 1000 consistent runs] — they do not fit one map. "
        )
        if left > found.bound:
            text += (
                "No small calibration error explains it. Check units, signs, ids and constant values of the "
                "observations and the odometry, or increase their noise."
            )
        else:
            text += "The calibration error below explains it."
        out.append(Finding(level, "residuals", text))
    excess = found.chi2 - found.dof
    if certain.any() and (not misfit or found.reduction[best] > HALF * excess):
        others = [
            k
            for k in np.argsort(-found.reduction)
            if k != best and found.reduction[k] > AS_MUCH * found.reduction[best]
        ]
        errors = [_error_text(names[k], found.error[k], found.sigma[k]) for k in (best, *others)]
        large = abs(found.error[best]) > KINDS[names[best]].careful
        text = f"systematic residuals: {errors[0]}"
        if len(errors) > 1:
            text += "; or, hardly distinguishable in this run, " + "; or ".join(errors[1:])
        mends = dict.fromkeys(KINDS[names[k]].mend for k in (best, *others))
        text += f". To do: {'; or '.join(mends)}."
        out.append(Finding("bad" if large else "look", "calibration", text))
    return out


def _error_text(name: str, error: float, sigma: float) -> str:
    k = KINDS[name]
    if k.unit == "%" and error < -1.0:  # a factor below zero
        what = k.less.partition(" look ")[0]
        return f"{what} look reversed, {1.0 + error:.2f} ± {sigma:.2g} times the expected value"
    to = _TO_UNIT[k.unit]
    return (k.more if error > 0 else k.less).format(f"{to * abs(error):.3g} ± {to * sigma:.2g} {k.unit}")
