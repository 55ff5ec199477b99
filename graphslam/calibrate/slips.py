"""Stretches in which wheels slip: distances that contradict the sightings for about a second."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from scipy import special

from graphslam.calibrate.smoothing import Smoothing
from graphslam.calibrate.windows import SightingLog
from graphslam.core.findings import Finding

Stretches = tuple[tuple[float, float], ...]
LONG = 1.0
"""Length of a stretch [s]."""
CHANCE = 0.005
"""Probability that one is found in a log whose noise is Gaussian and known; the scale that is estimated of 150 of them
makes it three times as large."""
ROUNDS = 4
"""Fits at most: slip inflates the noise that it is compared with, and what was found is left out of the next."""


def find_slips(s: Smoothing) -> Stretches:
    """Stretches ``(begin, end)`` whose distances contradict sightings [s], none overlapping another.

    The statistic is the χ² that goes if the distances of a stretch are left out. Its scale is that of its median over
    all stretches, which few bursts do not move: fitted noise is inflated by them.
    """
    if not s.windows:
        return ()
    between = np.median(np.concatenate([np.diff(w.times) for w in s.windows]))
    count = max(round(LONG / between), 1)
    stride = max(count // 2, 1)
    gains = s.gain_without_distances(count, stride)
    tested = np.concatenate(gains)
    least = special.chdtri(count, CHANCE / len(tested)) / special.chdtri(count, 0.5) * float(np.median(tested))
    out: list[tuple[float, float]] = []
    for w, gain in zip(s.windows, gains):
        free = np.ones(len(w.times), dtype=np.bool_)
        for i in np.argsort(-gain):
            k = i * stride
            if gain[i] > least and np.all(free[k : k + count]):
                free[k : k + count] = False
                out.append((float(w.times[k]), float(w.times[k + count])))
    return tuple(sorted(out))


def with_untested(slips: Stretches, seen: SightingLog) -> Stretches:
    """Wheels that slip may slip where no sighting tells: second by second before the first one and after the last."""
    if not slips:
        return ()
    out, s = list(slips), seen.sightings
    times = s.times[np.diff(s.offsets) > 0]
    for a, b in ((seen.span[0], times[0]), (times[-1], seen.span[1])):
        if b > a:
            out += pairwise(np.linspace(a, b, math.ceil((b - a) / LONG) + 1).tolist())
    return tuple(sorted(out))


def slip_finding(slips: Stretches, begin: float) -> Finding:
    """Line of the verdict, with times since ``begin`` [s]."""
    at = ", ".join(f"{a - begin:.1f}" for a, _ in slips[:8]) + ", …" * (len(slips) > 8)
    text = f"wheels slipped at t = {at} s: distances of the odometry contradict the observations for a second."
    return Finding("look", "wheels-slipped", text)
