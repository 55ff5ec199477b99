"""What maps say of two groups of loops that cannot both be right: in which of two solutions do they deny each other?

A loop that takes one place for another brings two maps together that do not belong together, and walls of the one then
stand in what the other has free. How much maps deny each other where they do belong together, and how much where they
do not, differs from sensor to sensor and world to world; so both are told by the run itself, at loops that nobody
disputes: as they lie, and moved by what the two solutions differ by. In a world that repeats itself with that motion
both are alike, and then the maps say nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from graphslam.core.geometry import Array
from graphslam.loops.measure import Loop

Witness = Callable[[Sequence[Loop], Array], Array]
"""Share of contradiction between the maps of loops ``(k,)``, at the relative poses ``(k, 7|3)`` of their ends."""

ERROR = 1e-3
"""The maps decide where they are so much likelier by one solution: by Markov's inequality they decide wrongly with no
greater probability than this."""
FEWEST = 10
"""Pairs of submaps that must tell how maps lie on each other before they are asked."""
GRAIN = 0.5 / math.sqrt(500)
"""Least σ of the angle of a share: that of counting in 500 points."""


def overlap_log_likelihood_ratio(right: Array, moved: Array, first: Array, second: Array) -> float:
    """Logarithm of how much likelier the shares of contradiction are if the first of two solutions is right.

    Parameters
    ----------
    right, moved : (n,), (m,)
        Shares at loops that nobody disputes: as they lie, and moved from there.
    first, second : (k,), (k,)
        Shares at the places in dispute, in either solution; each is one piece of evidence.

    Returns
    -------
    float
        0 where there are too few to learn from.
    """
    if min(len(right), len(moved)) < FEWEST:
        return 0.0
    good, bad = _law(right), _law(moved)
    return float(np.sum(good(first) - bad(first) - good(second) + bad(second)))


def disagreement_shares(loops: Sequence[Loop], shares: Array) -> Array:
    """Mean share of each pair of submaps: its places see the same walls, and are one piece of evidence."""
    _, row = np.unique(np.sort([x.submaps for x in loops], axis=1), axis=0, return_inverse=True)
    return np.asarray(np.bincount(row.ravel(), weights=shares) / np.bincount(row.ravel()))


def _law(shares: Array) -> Callable[[Array], Array]:
    """Log density of the next share, given these: Student's, of the angle whose squared sine it is."""
    from scipy import stats  # takes half a second to load

    z, n = _angle(shares), len(shares)
    width = max(float(z.std(ddof=1)), GRAIN) * math.sqrt(1.0 + 1.0 / n)
    return lambda q: np.asarray(stats.t.logpdf(_angle(q), n - 1, float(z.mean()), width))


def _angle(shares: npt.ArrayLike) -> Array:
    return np.asarray(np.arcsin(np.sqrt(np.clip(shares, 0.0, 1.0))))
