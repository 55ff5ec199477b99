"""Jointly compatible subsets of candidate pairings: the core of landmark association, on plain arrays.

A pairing assigns observation ``i`` to the known landmark ``j``; its innovation and the joint covariance of all
innovations are given. Nearest neighbour takes pairings one by one; joint compatibility (Neira and Tardós 2001) tests a
whole set at once and so accounts for the error common to all observations from one pose.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

from graphslam.association.association_kernels import AcceptedPairings, PairingArrays, joint_compatibility
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array

Ints = npt.NDArray[np.int64]
Index = npt.NDArray[np.intp]


def mahalanobis2(nu: Array, S: Array) -> Array:
    """``νᵀ S⁻¹ ν`` of ``(…, 2)`` and ``(…, 2, 2)``; infinite where ``S`` is not positive definite."""
    a, b, c = S[..., 0, 0], S[..., 0, 1], S[..., 1, 1]
    x, y = nu[..., 0], nu[..., 1]
    det = a * c - b * b
    fit = det > 0
    d2 = (c * x * x - 2 * b * x * y + a * y * y) / np.where(fit, det, 1.0)
    return np.asarray(np.where(fit, d2, np.inf))


def nearest_neighbour_pairs(d2: Array, i: Ints, j: Ints) -> Index:
    """Exclusive nearest neighbours: pairings in the order of distance, each accepted if both its members are unused.

    Parameters
    ----------
    d2 : (p,)
    i, j : (p,)
        Observation and landmark of each pairing.

    Returns
    -------
    (k,)
        Accepted pairings, in that order.
    """
    seen: set[int] = set()
    used: set[int] = set()
    accepted = []
    for k in np.argsort(d2, kind="stable"):
        a, b = int(i[k]), int(j[k])
        if a not in seen and b not in used:
            seen.add(a)
            used.add(b)
            accepted.append(k)
    return np.asarray(accepted, dtype=np.intp)


@dataclass(frozen=True, slots=True)
class SearchResult:
    """Result of a search from each of its starts.

    Parameters
    ----------
    pairings : (k, most)
        Accepted pairings of each start in order; the first ``count`` are valid.
    count : (k,)
    score : (k,)
        ``Σ (gate - d²)``.
    cost : (k,)
        ``Σ (d² + ln det S)``, every pairing given those before it.
    """

    pairings: Ints
    count: Ints
    score: Array
    cost: Array

    def of(self, start: int) -> Index:
        """The pairings accepted from one start."""
        return self.pairings[start, : self.count[start]].astype(np.intp)


def search_compatible_sets(
    i: Ints, j: Ints, nu: Array, C: Array, seeds: Ints, gate: float, limits: Array, *, persistent: bool
) -> SearchResult:
    """Grow a jointly compatible set from every seed pairing.

    Each step adds the most likely pairing (least ``d² + ln det S``) that passes its gate given the accepted ones.

    Parameters
    ----------
    i, j : (p,)
        Observation and landmark of each pairing; each occurs at most once in a set.
    nu : (p, 2)
    C : (2p, 2p)
    seeds : (k,)
        First pairing of each start.
    gate : float
        χ² gate of one pairing given the accepted ones.
    limits : (most + 1,)
        χ² limits of 0 (unused), 1, … pairings together; a set has at most ``most`` pairings.
    persistent : bool
        A pairing that would break the joint limit is skipped in favour of the next one; otherwise it ends the search.
    """
    starts, most = len(seeds), len(limits) - 1
    out = np.zeros((starts, most), dtype=np.int64)
    count, score, cost = np.zeros(starts, dtype=np.int64), np.zeros(starts), np.zeros(starts)
    pairings = PairingArrays(
        np.ascontiguousarray(i, dtype=np.int64), np.ascontiguousarray(j, dtype=np.int64),
        np.ascontiguousarray(nu), np.ascontiguousarray(C),
    )  # fmt: skip
    starts_at = np.ascontiguousarray(seeds, dtype=np.int64)
    joint_compatibility(pairings, starts_at, gate, limits, persistent, AcceptedPairings(out, count, score, cost))
    return SearchResult(out, count, score, cost)


def most_pairings(i: Ints, j: Ints) -> int:
    """Upper bound on the number of pairings in an exclusive set."""
    return min(len(np.unique(i)), len(np.unique(j)))


@cache
def _limits(probability: float, most: int) -> tuple[float, ...]:
    return (np.inf, *(chi2_quantile(probability, 2 * k) for k in range(1, most + 1)))


def joint_limits(probability: float, most: int) -> Array:
    """χ² limits ``(most + 1,)`` of 0 (none), 1, … ``most`` pairings together."""
    return np.array(_limits(probability, most))
