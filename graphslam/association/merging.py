"""Detection of duplicate landmarks.

Two tests with different limitations. The Mahalanobis test relies on the covariances and never merges two landmarks of
one submap, so it cannot repair a duplicate within a submap, nor one due to an overconfident covariance. The Euclidean
test uses only the minimum distance between two landmarks (trees do not grow within 0.7 m of each other, and the
detector separates them by metres) and repairs both.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from graphslam.core.geometry import Array
from graphslam.graph.factor_graph import FactorGraph


def euclidean_merges(graph: FactorGraph, distance: float = 0.7, *, within_submap: bool = True) -> list[tuple[int, int]]:
    """Landmarks closer than ``distance`` [m], as (keep, drop).

    Parameters
    ----------
    within_submap : bool
        Also merge two landmarks that occur in one submap.

    Returns
    -------
    list of (int, int)
        Ready for :meth:`FactorGraph.merge_landmarks` in this order. Closest pairs first; the one observed more often
        (then the older) is kept. Every dropped landmark lies within ``distance`` of the one that is kept, so a row of
        close landmarks does not collapse into one.
    """
    pairs = cKDTree(graph.values.landmarks).query_pairs(distance, output_type="ndarray")
    if len(pairs) == 0:
        return []
    gaps = np.linalg.norm(graph.values.landmarks[pairs[:, 0]] - graph.values.landmarks[pairs[:, 1]], axis=1)
    return _resolve(graph, pairs[np.argsort(gaps, kind="stable")], within_submap=within_submap, limit=distance)


def mahalanobis_merges(graph: FactorGraph, gate: float = 11.8, *, distance: float = 5.0) -> list[tuple[int, int]]:
    """Landmarks of different submaps that the joint covariance does not distinguish, as (keep, drop).

    ``d² = δᵀ (P_ii + P_jj - P_ij - P_ji)⁻¹ δ < gate`` with the graph's joint covariance, closest in d² first.

    Parameters
    ----------
    gate : float
        χ² with two degrees of freedom.
    distance : float
        Pairs further apart [m] are not considered.
    """
    pairs = cKDTree(graph.values.landmarks).query_pairs(distance, output_type="ndarray")
    ids = graph.values.landmark_ids
    pairs = np.array([p for p in pairs if not _share(graph, int(ids[p[0]]), int(ids[p[1]]))]).reshape(-1, 2)
    if len(pairs) == 0:
        return []
    covariance, lay = graph.covariance(), graph.flat().layout
    d2 = np.empty(len(pairs))
    for k, (a, b) in enumerate(pairs):
        c = lay.landmark_start + 2 * np.array([a, a, b, b]) + np.array([0, 1, 0, 1])
        P = covariance.columns(c)
        S = P[:2, :2] + P[2:, 2:] - P[:2, 2:] - P[2:, :2]
        delta = graph.values.landmarks[a] - graph.values.landmarks[b]
        d2[k] = delta @ np.linalg.solve(S, delta)
    order = np.argsort(d2, kind="stable")
    return _resolve(graph, pairs[order[d2[order] < gate]], within_submap=False, limit=distance)


def _share(graph: FactorGraph, i: int, j: int) -> bool:
    """Whether one submap contains both."""
    return bool(graph.detections(i) & graph.detections(j))


def _resolve(graph: FactorGraph, pairs: Array, *, within_submap: bool, limit: float) -> list[tuple[int, int]]:
    """Turn pairs of rows into merges, each landmark dropped at most once and never kept after."""
    ids, points = graph.values.landmark_ids, graph.values.landmarks
    seen = {int(i): set(graph.detections(int(i))) for i in ids[np.unique(pairs)]}
    home: dict[int, int] = {}
    row = {int(i): r for r, i in enumerate(ids)}
    members: dict[int, list[int]] = {i: [i] for i in seen}

    def root(i: int) -> int:
        while i in home:
            i = home[i]
        return i

    merges = []
    for a, b in pairs:
        i, j = root(int(ids[a])), root(int(ids[b]))
        if i == j or (not within_submap and seen[i] & seen[j]):
            continue
        keep, drop = (i, j) if (len(seen[i]), -i) >= (len(seen[j]), -j) else (j, i)
        if any(np.linalg.norm(points[row[m]] - points[row[keep]]) > limit for m in members[drop]):
            continue
        home[drop] = keep
        seen[keep] |= seen[drop]
        members[keep] += members[drop]
        merges.append((keep, drop))
    return merges
