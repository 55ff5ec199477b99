"""Test by overlapping maps which of two contradictory groups of loops is right.

A wrong loop brings two maps together that do not belong together, so walls of one are in free space of the other. The
size of this contradiction, for correct and for wrong overlaps, depends on sensor and world. So both distributions are
learnt from the run itself, at undisputed loops: at their relative poses, and moved by the difference between the two
solutions. In a world that repeats with this motion both distributions are equal, and the maps do not decide.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from graphslam.core.geometry import Array
from graphslam.loops.measure import Loop

MapCheck = Callable[[Sequence[Loop], Array], Array]
"""Share of contradiction between the maps of loops ``(k,)``, at the relative poses ``(k, 7|3)`` of their ends."""

ERROR = 1e-3
"""The maps decide if the likelihood ratio is above one over this: by Markov's inequality the probability of a wrong
decision is not larger."""
FEWEST = 10
"""Minimum number of submap pairs for learning the distributions."""
GRAIN = 0.5 / math.sqrt(500)
"""Minimum σ of the angle of a share, from counting 500 points."""


def overlap_log_likelihood_ratio(right: Array, moved: Array, first: Array, second: Array) -> float:
    """Log-likelihood ratio of the shares of contradiction, in favour of the first of two solutions.

    Parameters
    ----------
    right, moved : (n,), (m,)
        Shares at undisputed loops, at their relative poses and moved.
    first, second : (k,), (k,)
        Shares at the disputed places, in each solution; each is one independent piece of evidence.

    Returns
    -------
    float
        0 if there are too few undisputed ones.
    """
    if min(len(right), len(moved)) < FEWEST:
        return 0.0
    good, bad = _law(right), _law(moved)
    return float(np.sum(good(first) - bad(first) - good(second) + bad(second)))


def disagreement_shares(loops: Sequence[Loop], shares: Array) -> Array:
    """Mean share of each pair of submaps, because its places observe the same walls."""
    _, row = np.unique(np.sort([x.submaps for x in loops], axis=1), axis=0, return_inverse=True)
    return np.asarray(np.bincount(row.ravel(), weights=shares) / np.bincount(row.ravel()))


def _law(shares: Array) -> Callable[[Array], Array]:
    """Predictive log density of a share given these: Student's t of the angle whose squared sine it is."""
    from scipy import stats  # takes half a second to load

    z, n = _angle(shares), len(shares)
    width = max(float(z.std(ddof=1)), GRAIN) * math.sqrt(1.0 + 1.0 / n)
    return lambda q: np.asarray(stats.t.logpdf(_angle(q), n - 1, float(z.mean()), width))


def _angle(shares: npt.ArrayLike) -> Array:
    return np.asarray(np.arcsin(np.sqrt(np.clip(shares, 0.0, 1.0))))
