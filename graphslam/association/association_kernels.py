"""Numba kernel: joint-compatibility beam search. Plain arrays only."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from graphslam.core.jit import callee, njit

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


@callee
def _mahalanobis(vx: float, vy: float, a: float, b: float, c: float) -> tuple[float, float]:
    """``vᵀ [[a, b], [b, c]]⁻¹ v`` and the determinant."""
    det = a * c - b * b
    return (c * vx * vx - 2.0 * b * vx * vy + a * vy * vy) / det, det


class PairingArrays(NamedTuple):
    """Individually compatible pairings."""

    observed: Index
    """(p,): submap entry."""
    target: Index
    """(p,): graph candidate; each is used once."""
    nu: Array
    """(p, 2): innovations."""
    C: Array
    """(2p, 2p): their joint covariance."""


class AcceptedPairings(NamedTuple):
    """Accepted pairings of every start (output)."""

    pairs: Index
    """(k, most): Indices of the pairings, in the order of acceptance."""
    number: Index
    """(k,): Number of accepted pairings."""
    score: Array
    """(k,): ``Σ (gate - d²)``."""
    cost: Array
    """(k,): ``Σ (d² + ln det)``."""


@njit
def joint_compatibility(
    pairings: PairingArrays, seeds: Index, gate: float, joint_limit: Array, persistent: bool, accepted: AcceptedPairings
) -> None:
    """From every seed pairing, add the best compatible pairing, conditional on the accepted ones, until none is left.

    The conditional innovation of a pairing given the accepted ones comes from an incremental Cholesky factor whose
    columns are computed for accepted pairings only, so an addition costs O(accepted · pairings).

    Parameters
    ----------
    seeds : (k,) int
        First pairing of each start.
    gate : float
        χ² gate of each added pairing, conditional on the accepted ones.
    joint_limit : (most + 1,)
        χ² limit of the joint distance with 1, 2, … pairings (index = number of pairings).
    persistent : bool
        A pairing that would break the joint limit is skipped for the next likely one, instead of ending the search.
    """
    observed, target, nu, C = pairings
    out_pairs, out_count, out_score, out_cost = accepted
    p = observed.shape[0]
    for s in range(seeds.shape[0]):
        v = nu.copy()
        D = np.empty((p, 3))  # conditional 2×2 blocks: xx, xy, yy
        for i in range(p):
            D[i, 0], D[i, 1], D[i, 2] = C[2 * i, 2 * i], C[2 * i, 2 * i + 1], C[2 * i + 1, 2 * i + 1]
        free = np.ones(p, dtype=np.bool_)
        W = np.empty((2 * out_pairs.shape[1], 2 * p))
        count = 0
        total = 0.0
        score = 0.0
        summed = 0.0
        pick = seeds[s]
        d2, first = _mahalanobis(v[pick, 0], v[pick, 1], D[pick, 0], D[pick, 1], D[pick, 2])
        best = d2 + np.log(first)
        while pick >= 0:
            if total + d2 > joint_limit[count + 1]:
                break
            total += d2
            score += gate - d2
            summed += best
            out_pairs[s, count] = pick
            # Cholesky of the accepted 2×2 block and its whitened rows over all pairings
            l00 = np.sqrt(D[pick, 0])
            l10 = D[pick, 1] / l00
            l11 = np.sqrt(D[pick, 2] - l10 * l10)
            y0 = v[pick, 0] / l00
            y1 = (v[pick, 1] - l10 * y0) / l11
            w0, w1 = 2 * count, 2 * count + 1
            for j in range(p):
                if observed[j] == observed[pick] or target[j] == target[pick]:
                    free[j] = False
                if not free[j]:
                    continue
                for a in range(2):
                    c = 2 * j + a
                    r0, r1 = C[2 * pick, c], C[2 * pick + 1, c]
                    for k in range(w0):
                        r0 -= W[k, 2 * pick] * W[k, c]
                        r1 -= W[k, 2 * pick + 1] * W[k, c]
                    W[w0, c] = r0 / l00
                    W[w1, c] = (r1 - l10 * W[w0, c]) / l11
                    v[j, a] -= W[w0, c] * y0 + W[w1, c] * y1
                x, y = 2 * j, 2 * j + 1
                D[j, 0] -= W[w0, x] * W[w0, x] + W[w1, x] * W[w1, x]
                D[j, 1] -= W[w0, x] * W[w0, y] + W[w1, x] * W[w1, y]
                D[j, 2] -= W[w0, y] * W[w0, y] + W[w1, y] * W[w1, y]
            count += 1
            # most likely next pairing: d² + ln|S|, so that a precise prediction is preferred to an uncertain one
            pick = -1
            best = np.inf
            if count == out_pairs.shape[1]:
                break
            for j in range(p):
                if free[j] and D[j, 0] > 0.0 and D[j, 2] > 0.0:
                    e2, det = _mahalanobis(v[j, 0], v[j, 1], D[j, 0], D[j, 1], D[j, 2])
                    if det > 0.0 and e2 <= gate and (not persistent or total + e2 <= joint_limit[count + 1]):
                        cost = e2 + np.log(det)
                        if cost < best:
                            best, pick, d2 = cost, j, e2
        out_count[s] = count
        out_score[s] = score
        out_cost[s] = summed
