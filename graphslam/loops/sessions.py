"""Initial alignment of maps of several robots, or of several days, by common landmarks.

The maps are then solved as one least-squares problem over all chains (:meth:`FactorGraph.start_session`); this module
gives the initial pose of another chain and its landmark associations. If identities are the same everywhere (barcodes,
survey numbers), a rigid fit to the common landmarks gives both. Otherwise the two constellations are matched: every
pair of landmarks of one map is placed on every pair of the other with the same length, and the motion that matches most
landmarks is used, if no other motion matches nearly as many.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array, ArrayLike, align_se2, se2_transform, wrap_angle

Ints = npt.NDArray[np.int64]
Index = npt.NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class Alignment:
    """Pose of one map in another.

    Parameters
    ----------
    T_reference_map : (3,)
    pairs : (k, 2) int
        Rows of (map, reference) that are the same landmark and agree with the motion.
    rejected : int
        Number of common identities that did not agree.
    rms : float
        Of the distances of the pairs after the motion [m].
    runner_up : int
        Number of landmarks that the best *other* motion matches; 0 with given identities.
    """

    T_reference_map: Array
    pairs: Index
    rejected: int
    rms: float
    runner_up: int = 0


def align_by_identity(
    ids: ArrayLike, points: ArrayLike, reference_ids: ArrayLike, reference: ArrayLike, *, tolerance: float = 0.5
) -> Alignment:
    """Rigid motion of a map onto another by landmarks of the same id.

    Robust against wrong identities: the motion is that of the pair of landmarks with which most others agree,
    followed by a least-squares fit to all that agree.

    Parameters
    ----------
    ids, points : (n,), (n, 2)
    reference_ids, reference : (m,), (m, 2)
    tolerance : float
        Common landmarks farther apart than this after the motion do not agree [m].
    """
    p, q = np.asarray(points, dtype=np.float64), np.asarray(reference, dtype=np.float64)
    _, i, j = np.intersect1d(np.asarray(ids), np.asarray(reference_ids), return_indices=True)
    if len(i) < 2:
        raise DataError("the maps share too few landmarks", got=f"{len(i)} common ids", wanted="at least 2")
    T = _motions(p[i], q[j], np.arange(len(i))[:, None] == np.arange(len(i)), tolerance)
    if len(T) == 0:
        raise DataError(
            "no two common landmarks are as far apart in both maps",
            got=f"{len(i)} common ids",
            wanted=f"± {tolerance} m",
        )
    distance = np.linalg.norm(se2_transform(T[:, None], p[i]) - q[j], axis=2)
    agree = distance[int(np.argmin(np.minimum(distance, tolerance).sum(axis=1)))] <= tolerance
    return _fit(p, q, np.column_stack([i[agree], j[agree]]), rejected=int((~agree).sum()))


LEAST_COMMON, MOST_ELSEWHERE = 4, 0.75
"""Minimum number of matched landmarks, and largest share that another motion (1 m or 10° away) may match."""


def align_by_constellation(points: ArrayLike, reference: ArrayLike, *, tolerance: float = 0.3) -> Alignment:
    """Rigid motion of a map onto another by the constellation of their landmarks alone.

    Parameters
    ----------
    points, reference : (n, 2), (m, 2)
    tolerance : float
        Landmarks with a smaller distance after the motion are matched [m].
    """
    p, q = np.asarray(points, dtype=np.float64), np.asarray(reference, dtype=np.float64)
    T = _motions(p, q, np.ones((len(p), len(q)), dtype=np.bool_), tolerance)
    if len(T) == 0:
        raise DataError("no two landmarks are as far apart in both maps", got=(len(p), len(q)), wanted="common ones")
    counts = np.concatenate([_count(part, p, q, tolerance) for part in np.array_split(T, max(1, len(T) // 2000))])
    order = np.argsort(-counts, kind="stable")
    best = None
    for t in T[order[:20]]:  # the counts may match a landmark twice: repeat the best motions with an assignment
        pairs = _assign(t, p, q, tolerance)
        if best is None or len(pairs) > len(best[1]):
            best = t, pairs
    assert best is not None
    found = _fit(p, q, best[1], rejected=0)
    refined = _assign(found.T_reference_map, p, q, tolerance)
    if len(refined) >= len(best[1]):
        found = _fit(p, q, refined, rejected=0)
    n = len(found.pairs)
    moved = se2_transform(T, p.mean(axis=0)) - se2_transform(found.T_reference_map, p.mean(axis=0))
    turned = np.abs(wrap_angle(T[:, 2] - found.T_reference_map[2]))
    elsewhere = (np.linalg.norm(moved, axis=1) > 1.0) | (turned > np.deg2rad(10.0))
    runner_up = max((len(_assign(t, p, q, tolerance)) for t in T[order][elsewhere[order]][:20]), default=0)
    if n < LEAST_COMMON or runner_up > MOST_ELSEWHERE * n:
        raise DataError(
            "the landmarks do not say how the maps lie"
            if n < LEAST_COMMON
            else "two motions fit the landmarks about as well",
            got=f"{n} together, {runner_up} elsewhere",
            wanted=f"at least {LEAST_COMMON}, and at most {MOST_ELSEWHERE:.0%} of them elsewhere",
        )
    return Alignment(found.T_reference_map, found.pairs, 0, found.rms, runner_up)


def _motions(p: Array, q: Array, allowed: npt.NDArray[np.bool_], tolerance: float) -> Array:
    """Motions ``(k, 3)`` that place a pair of ``p`` on a pair of ``q`` of the same length, with equal midpoints."""
    a, b = np.triu_indices(len(p), 1)
    c, d = (x.ravel() for x in np.indices((len(q), len(q))))
    c, d = c[c != d], d[c != d]
    u, v = p[b] - p[a], q[d] - q[c]
    lu, lv = np.linalg.norm(u, axis=1), np.linalg.norm(v, axis=1)
    # a short pair does not determine the heading
    k, m = np.nonzero((np.abs(lu[:, None] - lv) <= tolerance) & (np.minimum(lu[:, None], lv) > 2 * tolerance))
    ok = allowed[a[k], c[m]] & allowed[b[k], d[m]]
    k, m = k[ok], m[ok]
    turn = wrap_angle(np.arctan2(v[m, 1], v[m, 0]) - np.arctan2(u[k, 1], u[k, 0]))
    middle = 0.5 * (p[a[k]] + p[b[k]])
    rotated = se2_transform(np.column_stack([np.zeros((len(k), 2)), turn]), middle)
    return np.column_stack([0.5 * (q[c[m]] + q[d[m]]) - rotated, turn])


def _count(T: Array, p: Array, q: Array, tolerance: float) -> Ints:
    """For every motion, the number of ``p`` near some of ``q``, each weighted by ``1 - d²/tolerance²``."""
    moved = se2_transform(T[:, None], p)
    d2 = ((moved[:, :, None] - q) ** 2).sum(axis=-1).min(axis=2)
    return np.asarray(np.sum(np.maximum(0.0, 1.0 - d2 / tolerance**2), axis=1))


def _assign(T: Array, p: Array, q: Array, tolerance: float) -> Index:
    """One-to-one pairs ``(k, 2)`` within ``tolerance`` after the motion, with the smallest sum of squares."""
    d2 = ((se2_transform(T, p)[:, None] - q) ** 2).sum(axis=-1)
    i, j = linear_sum_assignment(np.minimum(d2, tolerance**2))
    near = d2[i, j] < tolerance**2
    return np.column_stack([i[near], j[near]])


def _fit(p: Array, q: Array, pairs: Index, *, rejected: int) -> Alignment:
    a, b = p[pairs[:, 0]], q[pairs[:, 1]]
    T = align_se2(a, b)
    rms = float(np.sqrt(np.mean(np.sum((se2_transform(T, a) - b) ** 2, axis=1))))
    return Alignment(T, pairs, rejected, rms)
