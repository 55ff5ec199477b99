"""Offset of the motion's clock against that of the detections."""

from __future__ import annotations

import math

import numpy as np

from graphslam.calibrate import landmarks as L
from graphslam.calibrate.estimate import Estimate
from graphslam.calibrate.smoothing import Smoothing
from graphslam.calibrate.windows import ObservationLog

MOST_PERIODS = 20
"""Largest offset that is looked for, in periods of the motion's records."""


def profile_clock(s: Smoothing, seen: ObservationLog) -> Estimate:
    """Offset of the motion's clock, by smoothing with the motion cut at shifted stamps.

    Only shifts by whole periods of the motion's records are compared: a shift by half a period averages two records,
    so that independent noise looks smaller, and its likelihood is larger whatever the clocks are. The search first goes
    in steps of the time between observations: likelihoods of nearer shifts differ by the noise of the records that they
    do not share, which has minima of its own. Then it goes in steps of one period. The offset between two periods is
    that of a parabola through the likelihood of three shifts.

    Parameters
    ----------
    s : Smoothing
        Fitted without an offset.
    """
    period = seen.period
    stride = max(round(min(seen.spacing / period, MOST_PERIODS)), 1)
    scores: dict[int, float] = {}

    def score(k: int) -> float:
        if k not in scores:
            moved = L.shift_motion(s, seen, k * period)
            moved.converge(8)
            moved.fit(rounds=1)
            scores[k] = moved.objective()
        return scores[k]

    best = 0
    for step in (stride, 1):
        while abs(best) < MOST_PERIODS:
            near = min((best, best - step, best + step), key=score)
            if near == best:
                break
            best = near
    a, b, c = score(best - 1), score(best), score(best + 1)
    bend = max(a - 2.0 * b + c, 1e-6)
    at = float(np.clip(0.5 * (a - c) / bend, -0.5, 0.5))
    # of a straight course every offset fits; noise of the records themselves blurs it by their spacing
    sigma = max(period / math.sqrt(bend), 0.1 * period)
    value = (best + at) * period
    gain = score(0) - (b - 0.5 * bend * at**2)
    return Estimate(name="clock", value=value, sigma=sigma, gain=gain, other=value, other_sigma=sigma).gated()
