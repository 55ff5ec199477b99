"""Detection of wheel slip: intervals of about a second whose odometry distances contradict the observations."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from scipy import special

from graphslam.calibrate.smoothing import Smoothing
from graphslam.calibrate.windows import ObservationLog
from graphslam.core.findings import Finding

Stretches = tuple[tuple[float, float], ...]
LONG = 1.0
"""Length of an interval [s]."""
CHANCE = 0.005
"""Probability of a false detection in a log with known Gaussian noise; about three times larger if the scale is
estimated from 150 intervals."""
ROUNDS = 4
"""Maximal number of fits: slip inflates the noise of the test, so the fit is repeated without the found intervals."""


def find_slips(s: Smoothing, spacing: float, known: Stretches = ()) -> Stretches:
    """Disjoint intervals ``(begin, end)`` whose distances contradict the observations, without the known ones [s].

    The statistic is the decrease of χ² without the distances of an interval. Its threshold is scaled by its median over
    all intervals, because slip inflates the fitted noise, but changes the median little.

    Parameters
    ----------
    spacing : float
        Time between observations [s].
    known : tuple of (float, float)
        Intervals that were found before. An interval that overlaps with one of them is not returned: if the odometry
        reports no distance there, it is found in each round.
    """
    count = max(round(LONG / spacing), 1)
    stride = max(count // 2, 1)
    gains = s.gain_without_distances(count, stride)
    tested = np.concatenate([np.zeros(0), *gains])
    if not len(tested):
        return ()
    least = special.chdtri(count, CHANCE / len(tested)) / special.chdtri(count, 0.5) * float(np.median(tested))
    out: list[tuple[float, float]] = []
    for w, gain in zip(s.windows, gains):
        free = np.ones(len(w.times), dtype=np.bool_)
        for i in np.argsort(-gain):
            k = i * stride
            if gain[i] > least and np.all(free[k : k + count]):
                free[k : k + count] = False
                out.append((float(w.times[k]), float(w.times[k + count])))
    return tuple(sorted((a, b) for a, b in set(out) if all(b <= c or d <= a for c, d in known)))


def with_untested(slips: Stretches, seen: ObservationLog) -> Stretches:
    """If there are slips, add intervals before the first and after the last observation: slip there is unobservable."""
    if not slips:
        return ()
    out, s = list(slips), seen.detections
    times = s.times[np.diff(s.offsets) > 0]
    for a, b in ((seen.span[0], times[0]), (times[-1], seen.span[1])):
        if b > a:
            out += pairwise(np.linspace(a, b, math.ceil((b - a) / LONG) + 1).tolist())
    return tuple(sorted(out))


def slip_finding(slips: Stretches, s: Smoothing, span: tuple[float, float]) -> Finding:
    """Line of the verdict, with times since the start of the motion, and the part of the log that was searched [s]."""
    at = ", ".join(f"{a - span[0]:.1f}" for a, _ in slips[:8]) + ", …" * (len(slips) > 8)
    searched = sum(float(np.ptp(w.times)) for w in s.windows)
    text = (
        f"wheels slipped at t = {at} s: distances of the odometry contradict the observations for a second. Slip was "
        f"searched in {searched:.0f} s of {span[1] - span[0]:.0f} s."
    )
    return Finding("look", "wheels-slipped", text)
