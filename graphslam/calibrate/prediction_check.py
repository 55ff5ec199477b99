"""Cross-validation with withheld observations: likelihood under an estimate and under the noise of the log.

With fixed parameters, the likelihood of withheld data given the rest is the likelihood of all data divided by that of
the rest; each is from one smoothing of the same windows.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from graphslam.calibrate.corrections import Corrections
from graphslam.calibrate.estimate import GAIN, Calibration, Prediction
from graphslam.calibrate.landmarks import smoothing_of, trim_outliers
from graphslam.calibrate.smoothing import Ints, Smoothing, SmoothingWindow, keep_observations
from graphslam.calibrate.windows import ObservationLog, make_window
from graphslam_frontends.odometry.motion import MotionNoise

TRIM = 4.0
"""Observations with a larger residual are ignored for both [σ, the larger one of log and estimate]."""
ITERATIONS = 12


def predict_withheld_observations(
    seen: ObservationLog,
    found: Calibration,
    scans: list[Ints],
    noise: MotionNoise,
    start: Callable[[SmoothingWindow], SmoothingWindow | None] = lambda w: w,
) -> Prediction | None:
    """Log-likelihood of withheld observations under a calibration, relative to the noise of the log.

    Parameters
    ----------
    seen : ObservationLog
        The uncorrected log, with its withheld observations marked.
    found : Calibration
        Estimated without the withheld observations.
    scans : list of (n,) int64
        Scans of the windows in which they are predicted.
    noise : MotionNoise
        Noise of controls in the front end.
    start : function
        Sets the initial states of a window; returns None if the window cannot be used.

    Returns
    -------
    Prediction or None
        None if fewer than :data:`LEAST` observations were withheld.
    """
    assert seen.withheld is not None
    hidden, c = seen.withheld, found.corrections
    seen = replace(seen, stated=noise, withheld=None)
    stated = _stated(seen)
    kept: Ints | None = None

    def score(c: Corrections) -> tuple[float, int]:
        """Negative log-likelihood of the withheld observations [nats], and their number; the first call trims."""
        nonlocal kept
        own = _sigmas(c, stated)
        s = _smoothing(seen.corrected(c), scans, start, visits=own["visit_range"] > 0.0)
        if kept is None:
            s.sigmas |= {k: max(own[k], stated[k]) for k in ("range", "bearing")}
            s.converge(ITERATIONS)
            s = trim_outliers(s, TRIM)
            kept = np.concatenate([w.rows for w in s.windows]) if s.windows else np.zeros(0, dtype=np.int64)
        else:
            s = keep_observations(s, [np.isin(w.rows, kept) for w in s.windows])
        s.sigmas |= {k: v for k, v in own.items() if v > 0.0}
        s.converge(ITERATIONS)
        rest = keep_observations(s, [~hidden[w.rows] for w in s.windows])
        rest.converge(ITERATIONS)
        n = sum(int(hidden[w.rows].sum()) for w in s.windows)
        return s.objective() - rest.objective() + n * math.log(c.range_scale), n

    every, n = score(c)
    if n < LEAST:
        return None
    before = score(Corrections())[0]
    gains = {"all": before - every}
    if c.without_constants() != c:
        gains["noise"] = before - score(c.without_constants())[0]
    # likelihoods of offsets within the time between observations differ by chance: these must predict better
    far = abs(c.clock) > 0.5 * seen.spacing
    timed = Corrections(clock=c.clock if far else 0.0, slips=c.slips)
    if not timed.neutral and before - score(timed)[0] <= -GAIN:
        timed = Corrections()
    return Prediction(what="withheld observations", count=n, gains=gains, timed=timed)


LEAST = 20
"""Minimal number of withheld observations for a test."""


def _stated(seen: ObservationLog) -> dict[str, float]:
    """Median σ of the observations in the log."""
    s = seen.detections
    out = {"range": float(np.median(s.sigmas[:, 0])), "visit_range": 0.0, "visit_bearing": 0.0}
    blind = not np.any(s.has_bearing)
    return out | {"bearing": 1.0 if blind else float(np.median(s.sigmas[s.has_bearing, 1]))}


def _sigmas(c: Corrections, stated: dict[str, float]) -> dict[str, float]:
    """σ of the observations after corrections are applied."""
    out = {"range": (c.range_sigma or stated["range"]) / c.range_scale, "bearing": c.bearing_sigma or stated["bearing"]}
    return out | {"visit_range": c.range_visit / c.range_scale, "visit_bearing": max(c.bearing_visit, 1e-6)}


def _smoothing(
    seen: ObservationLog, scans: list[Ints], start: Callable[[SmoothingWindow], SmoothingWindow | None], *, visits: bool
) -> Smoothing:
    """Smoothing of windows with all their observations; only the states are estimated."""
    begin, end = seen.span
    t = seen.detections.times
    inside = [k for k in scans if t[k[0]] >= begin and t[k[-1]] <= end]
    made = (make_window(seen, k, visits=visits) for k in inside)
    windows = [x for w in made if w is not None and (x := start(w)) is not None]
    return smoothing_of(windows, seen.detections.T_base_sensor, (), visits=visits).copy(fitted=())
