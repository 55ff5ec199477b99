"""Calibration of logs with landmarks: range and bearing in many windows, range-only logs in one window."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from graphslam.calibrate import landmarks as L
from graphslam.calibrate.clock import profile_clock
from graphslam.calibrate.corrections import Corrections
from graphslam.calibrate.estimate import ALIKE, GAIN, LASTS, SIGNIFICANT, Calibration, Estimate, round_digits
from graphslam.calibrate.prediction_check import predict_withheld_observations
from graphslam.calibrate.slips import ROUNDS, find_slips, slip_finding, with_untested
from graphslam.calibrate.smoothing import CONSTANTS, PRIOR, Ints, Smoothing, SmoothingWindow, rebuild_window
from graphslam.calibrate.windows import ObservationLog, window_scans
from graphslam.core.errors import DataError
from graphslam.core.findings import Finding
from graphslam.core.geometry import Array
from graphslam.core.records import SteeringControls
from graphslam_frontends.odometry.motion import MotionNoise, motion_stream

SHORT, LONG = 15.0, 60.0
"""Lengths of the windows [s]."""
VISITS = 240.0
"""Length of the windows that contain several visits of a landmark [s]."""
FEW = 40
"""With at most this many landmarks, visit errors are always estimated: it costs little."""
RAN_AWAY = 5.0
"""A constant that is more than this many prior σ from zero has diverged and is fixed at zero: with sparse observations
the likelihood has a spurious maximum with very large motion noise and a very large motion error."""
PERHAPS = 0.15
"""If the autocorrelation of residuals exceeds this, errors common to a visit are estimated."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationBudget:
    """Limits of the data and of the computing effort of a calibration."""

    windows: int | None = 20
    """Maximal number of short windows; a quarter of it for long ones. None: all of the log."""
    poses: int = 2000
    """Total number of poses in the short windows, or in the one window of a range-only log."""
    clock: bool = True
    """Estimate the clock offset?"""
    again: bool = False
    """Repeat the range-bearing estimate with all data after the test on withheld data? Range-only estimates are always
    repeated."""


QUICK = CalibrationBudget()
FULL = CalibrationBudget(windows=60, poses=6000, again=True)


def calibrate_observations(
    seen: ObservationLog, effort: CalibrationBudget = QUICK, *, seed: int = 0, noise: MotionNoise | None = None
) -> Calibration:
    """Estimate noise and systematic errors of motion and observations; parts that fail the cross-validation are unused.

    Parameters
    ----------
    noise : MotionNoise, optional
        Noise of controls without a calibration, for comparison.
    """
    held, noise = seen.with_withheld(), noise or MotionNoise()
    blind = not np.any(seen.detections.has_bearing)
    if blind:
        found, whole = _ranges_alone(held, effort, seed)
        scans = [window_scans(seen, 1e9)[0][: len(whole.windows[0].poses)]]
        predict = partial(
            predict_withheld_observations, held, found, scans, noise, partial(_along, whole, seen.detections.ids)
        )
    else:
        found = _range_and_bearing(held, effort)
        predict = partial(predict_withheld_observations, held, found, _tested(held, effort), noise)
    prediction = None if found.contradictions() else predict()
    if blind or effort.again:  # after the test, the withheld data are used, too
        found = _ranges_alone(seen, effort, seed)[0] if blind else _range_and_bearing(seen, effort)
    return found if prediction is None or found.contradictions() else found.validated(prediction)


def _tested(held: ObservationLog, effort: CalibrationBudget) -> list[Ints]:
    """Scans of long windows with withheld observations, spread over the log."""
    s = held.detections
    assert held.withheld is not None
    hidden = np.concatenate([[0], np.cumsum(held.withheld)])[s.offsets]
    there = [k for k in window_scans(held, LONG) if np.any(hidden[k + 1] > hidden[k])]
    count = max(int(0.5 * effort.poses / max(_rate(held) * LONG, 1.0)), 3)
    return [there[i] for i in np.unique(np.linspace(0, len(there) - 1, min(count, len(there))).round().astype(int))]


def _along(whole: Smoothing, ids: Ints | None, w: SmoothingWindow) -> SmoothingWindow | None:
    """A range-only window with initial states from a fitted smoothing; None if they have no beacon in common."""
    first = whole.windows[0]
    if ids is None:
        return None
    names = np.full(len(first.nuisance), -1)
    names[first.slots[:, 0]] = ids[first.rows]
    place = dict(zip(names.tolist(), first.nuisance))
    own = ids[w.rows]
    w = rebuild_window(replace(w, poses=first.poses.copy()), np.isin(own, names))
    for j, name in zip(w.slots[:, 0].tolist(), ids[w.rows].tolist()):
        w.nuisance[j] = place[name]
    return w if len(w.rows) else None


def _rate(seen: ObservationLog) -> float:
    """Mean rate of the scans [Hz]."""
    return len(seen.detections.times) / max(seen.span[1] - seen.span[0], 1e-9)


def _range_and_bearing(seen: ObservationLog, effort: CalibrationBudget, held: tuple[str, ...] = ()) -> Calibration:
    """Calibrate a log with bearings; ``held`` are constants that diverged before and are fixed at zero."""
    steers = isinstance(motion_stream(seen.log)[1], SteeringControls)
    named = ("turn_per_metre" if steers else "yaw_bias", "distance_scale", "range_offset", "sensor_yaw")
    free = tuple(c for c in named if c not in held)
    count = _count(seen, SHORT, effort)
    seen, short, short_value = _without_slips(seen, count, free)
    wild = tuple(c for c in free if abs(short.constants[CONSTANTS.index(c)]) > RAN_AWAY * PRIOR[CONSTANTS.index(c)])
    if wild:
        held, free = (*held, *wild), tuple(c for c in free if c not in wild)
        short, short_value = L.fit_noise(L.smooth_observations(seen, SHORT, count, free))
    _enough(short, seen)
    start = dict(short.sigmas), short.constants.copy()
    long = L.smooth_observations(seen, LONG, None if count is None else max(count // 4, 3), free)
    long.sigmas, long.constants = dict(start[0]), start[1].copy()
    clock = None
    long, _ = L.fit_noise(long, trims=L.TRIMS[1:])
    _enough(long, seen)
    notes: list[Finding] = []
    if held:
        text = f"{', '.join(held)}: not observable in this log — the values of the log are kept."
        notes.append(Finding("", "calibrated", text))
    if effort.clock:
        clock = profile_clock(short, seen)
    if clock is not None and clock.applied:
        return _again(seen, clock, effort, held)
    estimates, short, long = cross_check_windows(short, short_value, long)
    if clock is not None:
        estimates.append(clock)
    noise, lasts = combine_noise(short, long)
    alike = residual_autocorrelation(long)
    few = len(np.unique(seen.detections.ids)) <= FEW if seen.detections.ids is not None else False
    if lasts or alike > PERHAPS or few:
        two, estimates = fit_two_level_noise(seen, long, effort, estimates)
        noise |= two
        if two or lasts or alike > ALIKE:
            notes.append(_correlation_note(short, long, alike))
    if seen.slips:
        notes.append(slip_finding(seen.slips, short, seen.span))
    made = calibration_of("observations", estimates, noise, notes, _data(short))
    slips = () if made.contradictions() else with_untested(seen.slips, seen)
    return replace(made, corrections=replace(made.corrections, slips=slips))


def _without_slips(
    seen: ObservationLog, count: int | None, free: tuple[str, ...]
) -> tuple[ObservationLog, Smoothing, float]:
    """The log with its intervals of wheel slip, and a fit of short windows that does not use distances there."""
    for _ in range(ROUNDS):
        short, value = L.fit_noise(L.smooth_observations(seen, SHORT, count, free))
        slips = find_slips(short, seen.spacing, seen.slips)
        if not slips:
            return seen, short, value
        seen = replace(seen, slips=tuple(sorted((*seen.slips, *slips))))
    return seen, *L.fit_noise(L.smooth_observations(seen, SHORT, count, free))


def _again(seen: ObservationLog, clock: Estimate, effort: CalibrationBudget, held: tuple[str, ...]) -> Calibration:
    """The calibration repeated with the corrected clock of the motion."""
    found = _range_and_bearing(
        seen.corrected(Corrections(clock=round_digits(clock.value))), replace(effort, clock=False), held
    )
    if found.contradictions():
        return found
    corrections = replace(found.corrections, clock=round_digits(clock.value))
    return replace(found, corrections=corrections, estimates=(*found.estimates, clock))


def _ranges_alone(seen: ObservationLog, effort: CalibrationBudget, seed: int) -> tuple[Calibration, Smoothing]:
    begin, end = seen.span
    until = end - begin if effort.windows is None else min(effort.poses / max(_rate(seen), 1e-9), end - begin)
    found = L.smooth_ranges(seen, until, seed=seed)
    if found is None:
        raise DataError("too few ranges to calibrate", where=seen.log.name)
    whole, half = found
    estimates, whole, half = cross_check_windows(whole, whole.objective(), half)
    noise, lasts = combine_noise(half, whole)
    alike = residual_autocorrelation(whole)
    notes = []
    ratio = next(e for e in estimates if e.name == "range_scale")
    if ratio.applied:
        size = "large" if ratio.value < 0 else "small"
        text = (
            f"scale: ranges and wheels differ by {abs(ratio.value):.1%} — the scale of the wheels is used. If the "
            f"ranges are right, path and map are that much too {size}; the covariances do not include this."
        )
        notes.append(Finding("look", "metre", text))
    if lasts or alike > ALIKE:
        notes.append(_correlation_note(half, whole, alike))
    data = f"{until:.0f} s of ranges ({len(whole.windows[0].rows)})"
    return calibration_of("ranges", estimates, noise, notes, data), whole


def cross_check_windows(s: Smoothing, value: float, other: Smoothing) -> tuple[list[Estimate], Smoothing, Smoothing]:
    """Compare the constants of a smoothing with those from windows of another length; refit both with only the
    constants that are applied.
    """
    out = []
    first = s
    sd = np.sqrt(np.diag(s.covariance))
    for name in first.free:
        i = CONSTANTS.index(name)
        gain = math.nan
        if abs(s.constants[i]) > SIGNIFICANT * sd[i]:
            alone, alone_value = L.fit_without(s, name)
            gain = alone_value - value
            if gain < 0.0:
                s, value, sd = alone, alone_value, np.nan_to_num(np.sqrt(np.diag(alone.covariance)), nan=0.0)
                out.append(_estimate(name, first, other, gain))
                continue
        out.append(_estimate(name, s, other, gain))
    applied = tuple(e.name for e in out if e.applied)
    if applied == first.free:
        return out, s, other
    left = []
    for x in (s, other):
        alone = x.copy(free=applied)
        for name in set(first.free) - set(applied):
            alone.constants[CONSTANTS.index(name)] = 0.0
        alone.fit(rounds=3)
        left.append(alone)
    again = [e if not e.applied else replace(e, **_values(e.name, *left)) for e in out]
    return again, left[0], left[1]


def _values(name: str, s: Smoothing, other: Smoothing) -> dict[str, Any]:
    i = CONSTANTS.index(name)
    found = {"value": s.constants[i], "sigma": np.sqrt(s.covariance[i, i])}
    found |= {"other": other.constants[i], "other_sigma": np.sqrt(other.covariance[i, i])}
    return {k: float(v) for k, v in found.items()}


def _estimate(name: str, s: Smoothing, other: Smoothing, gain: float) -> Estimate:
    return Estimate(name=name, gain=float(gain), **_values(name, s, other)).gated()


def combine_noise(short: Smoothing, long: Smoothing) -> tuple[dict[str, float], bool]:
    """For each part of the noise, the larger σ of the two; and whether range or bearing errors are time-correlated."""
    pairs = [(s, _typical(s)) for s in (short, long)]
    heading = [_heading_variance(s, t) for s, t in pairs]
    best = long if heading[1] >= heading[0] else short
    noise = {k: best.sigmas[k] for k in ("heading_metre", "heading_radian", "heading_second")}
    along = [s.sigmas["along_metre"] ** 2 * t[0] + s.sigmas["along_second"] ** 2 * t[2] for s, t in pairs]
    best = long if along[1] >= along[0] else short
    noise |= {k: best.sigmas[k] for k in ("along_metre", "along_second")}
    noise["lateral_metre"] = max(short.sigmas["lateral_metre"], long.sigmas["lateral_metre"])
    lasts = False
    for k in ("range", "bearing"):
        if k in short.fitted:
            noise[f"{k}_sigma"] = max(short.sigmas[k], long.sigmas[k])
            lasts |= long.sigmas[k] > LASTS * short.sigmas[k]
    return noise, lasts


def _typical(s: Smoothing) -> Array:
    """Mean metres, absolute radians and seconds of a step."""
    steps = np.concatenate([w.steps[1:] for w in s.windows])
    return np.array([steps[:, 4].mean(), np.abs(steps[:, 2]).mean(), steps[:, 3].mean()])


def _heading_variance(s: Smoothing, step: Array) -> float:
    v = [s.sigmas[k] ** 2 for k in ("heading_metre", "heading_radian", "heading_second")]
    return float(v @ step)


def residual_autocorrelation(s: Smoothing) -> float:
    """Lag-1 autocorrelation of the residuals per landmark; the larger of range and bearing."""
    seen = s.residuals()
    products, squares = np.zeros(2), np.zeros(2)
    for w, r in zip(s.windows, seen):
        for l in np.unique(w.slots[:, 0]):
            x = np.nan_to_num(r[w.slots[:, 0] == l])
            if len(x) > 2:
                products += (x[1:] * x[:-1]).sum(axis=0)
                squares += (x**2).sum(axis=0) * (len(x) - 1) / len(x)
    return float(np.max(products / np.maximum(squares, 1e-12)))


def fit_two_level_noise(
    seen: ObservationLog, long: Smoothing, effort: CalibrationBudget, estimates: list[Estimate]
) -> tuple[dict[str, float], list[Estimate]]:
    """Observation noise with an additional error per visit of a landmark; empty unless it gains :data:`GAIN` nats.

    The windows contain several visits of a landmark; otherwise its position and the error could not be separated.
    Constants that passed the acceptance tests are tested again, because visit errors may have caused them.
    """
    count = max(int(effort.poses / max(_rate(seen) * VISITS, 1.0)), 1)
    values, fits = [], []
    for visits in (False, True):
        s = L.smooth_observations(seen, VISITS, count, long.free, visits=visits)
        for k in long.fitted:
            s.sigmas[k] = long.sigmas[k]
        s.constants = long.constants.copy()
        s, value = L.fit_noise(s, trims=())
        values.append(value)
        fits.append(s)
    if not values[0] - values[1] > GAIN:
        return {}, estimates
    s, value = fits[1], values[1]
    again = []
    for e in estimates:
        if e.applied and e.name in s.free:
            gain = float(L.fit_without(s, e.name)[1] - value)
            e = replace(e, **_values(e.name, s, s), gain=min(gain, e.gain)).gated()
        again.append(e)
    if any(e.name in s.free and not e.applied for e in again):
        s = s.copy(free=tuple(e.name for e in again if e.applied and e.name in s.free))
        for e in again:
            if not e.applied and e.name in CONSTANTS:
                s.constants[CONSTANTS.index(e.name)] = 0.0
        s.fit(rounds=2)
    out = {}
    for k in ("range", "bearing"):
        for of_fit, of_noise in ((k, f"{k}_sigma"), (f"visit_{k}", f"{k}_visit")):
            if of_fit in s.fitted:
                out[of_noise] = s.sigmas[of_fit]
    there = 1.0 if seen.withheld is None else 1.0 - float(seen.withheld.mean())
    return out | {"visit_observations": observations_of_a_visit(s.windows) / there} | motion_noise(s), again


def motion_noise(s: Smoothing) -> dict[str, float]:
    """σ of the motion of a smoothing."""
    return {k: s.sigmas[k] for k in L.WHEELS}


def observations_of_a_visit(windows: Sequence[SmoothingWindow]) -> float:
    """Expected number of observations in the visit of a randomly chosen observation: Σn² / Σn."""
    n = np.concatenate([np.bincount(w.slots[w.slots[:, 1] >= 0, 1]) for w in windows])
    n = n[n > 0]
    return float((n**2).sum() / max(n.sum(), 1))


def _count(seen: ObservationLog, seconds: float, effort: CalibrationBudget) -> int | None:
    """Number of windows that keeps the number of poses within the budget; None: all."""
    if effort.windows is None:
        return None
    return int(np.clip(effort.poses / max(_rate(seen) * seconds, 1.0), 6, effort.windows))


def _enough(s: Smoothing, seen: ObservationLog) -> None:
    n = sum(len(w.rows) for w in s.windows)
    if n < 50:
        raise DataError(
            "too few observations of landmarks that are observed twice", where=seen.log.name, got=n, wanted=50
        )


def _data(s: Smoothing) -> str:
    n = sum(len(w.rows) for w in s.windows)
    return f"{len(s.windows)} windows with {n} observations"


def _correlation_note(short: Smoothing, long: Smoothing, alike: float) -> Finding:
    r = [s.sigmas["range"] for s in (short, long)]
    text = f"range errors: σ {r[0]:.3g} m in short windows, {r[1]:.3g} m in long ones, autocorrelation per landmark "
    text += f"{alike:.2f} — time-correlated. Treat landmarks seen from one side only as less certain than reported."
    return Finding("look", "errors-last", text)


def calibration_of(
    kind: str, estimates: Sequence[Estimate], noise: dict[str, float], notes: Sequence[Finding], data: str
) -> Calibration:
    """A calibration with its corrections; without any if an estimate is implausibly large."""
    found = Calibration(
        kind=kind,
        corrections=replace(_corrections(estimates, noise), widen_only=kind == "scans"),
        estimates=tuple(estimates),
        noise={k: float(v) for k, v in noise.items()},
        notes=tuple(notes),
        data=data,
    )
    return replace(found, corrections=Corrections()) if found.contradictions() else found


def _corrections(estimates: Sequence[Estimate], noise: dict[str, float]) -> Corrections:
    """Corrections from constants that passed the acceptance tests, and from the noise."""
    applied = {e.name: e.value for e in estimates if e.applied}
    values: dict[str, Any] = {}
    for name, value in applied.items():
        if name == "distance_scale":
            values[name] = round_digits(math.exp(value))
        elif name in ("range_scale", "turn_scale"):
            values[name] = round_digits(1.0 + value)
        else:
            values[name] = round_digits(value)
    names = Corrections.__dataclass_fields__
    values |= {k: round_digits(v) for k, v in noise.items() if k in names}
    return Corrections(**values)
