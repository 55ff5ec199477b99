"""Compiled data association of one scan with a joint Gaussian: candidates, nearest neighbour, joint compatibility.

All use the active state of :mod:`graphslam_frontends.landmarks.ekf_kernels`. Gates are an array over the degrees of
freedom, so that an observation without bearing has one. Reference: ``tests/reference/ekf_slam.py``.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from graphslam.core.jit import callee, njit
from graphslam_frontends.landmarks.ekf_kernels import linearise_observation
from graphslam_frontends.landmarks.measurement_kernels import observe_landmark, wrap_angle_kernel


class JointGaussian(NamedTuple):
    """A Gaussian over pose and landmarks."""

    x: Any
    """(3 + 2 nl,)"""
    P: Any


class PairingBuffer(NamedTuple):
    """Arrays for pairings (q · nl,)."""

    o: Any
    """Observation."""
    k: Any
    """Landmark."""
    d2: Any
    """Distance²."""


class LandmarkCounts(NamedTuple):
    """Counts of landmarks, by slot."""

    hits: Any
    misses: Any
    born: Any


@njit(error_model="numpy")
def candidates_kernel(state, alive, obs, sensor, gates, polar, nearest, pairs):
    """Individually compatible pairings, grouped by observation and sorted by distance within.

    alive (nl,) bool; polar (nl, 2) out: predicted range and bearing; nearest (q,) out: least distance² of any landmark
    as a share of the gate (≤ 1 is inside). pairs: out. Returns their number.
    """
    x, P = state
    pair_o, pair_k, pair_d2 = pairs
    nl, q = len(alive), len(obs)
    h = np.empty(12)
    S = np.empty((nl, 3))
    for k in range(nl):
        if not alive[k]:
            continue
        c = 3 + 2 * k
        observe_landmark(x[0], x[1], x[2], sensor, x[c], x[c + 1], h)
        polar[k, 0], polar[k, 1] = h[0], h[1]
        t = np.zeros((2, 5))
        for r in range(2):
            g0, g1, g2, g3, g4 = -h[8 + 2 * r], -h[9 + 2 * r], h[4 + 3 * r], h[8 + 2 * r], h[9 + 2 * r]
            for i in range(5):
                j = i if i < 3 else c + i - 3
                t[r, i] = g0 * P[0, j] + g1 * P[1, j] + g2 * P[2, j] + g3 * P[c, j] + g4 * P[c + 1, j]
        S[k, 0] = -h[8] * t[0, 0] - h[9] * t[0, 1] + h[4] * t[0, 2] + h[8] * t[0, 3] + h[9] * t[0, 4]
        S[k, 1] = -h[10] * t[0, 0] - h[11] * t[0, 1] + h[7] * t[0, 2] + h[10] * t[0, 3] + h[11] * t[0, 4]
        S[k, 2] = -h[10] * t[1, 0] - h[11] * t[1, 1] + h[7] * t[1, 2] + h[10] * t[1, 3] + h[11] * t[1, 4]
    count = 0
    for o in range(q):
        nearest[o] = np.inf
        begin = count
        flat = math.isinf(obs[o, 3])
        gate = gates[1] if flat else gates[2]
        for k in range(nl):
            if not alive[k]:
                continue
            e0, s00 = obs[o, 0] - polar[k, 0], S[k, 0] + obs[o, 2]
            if flat:
                d2 = e0 * e0 / s00
            else:
                e1, s11 = wrap_angle_kernel(obs[o, 1] - polar[k, 1]), S[k, 2] + obs[o, 3]
                d2 = (s11 * e0 * e0 - 2.0 * S[k, 1] * e0 * e1 + s00 * e1 * e1) / (s00 * s11 - S[k, 1] ** 2)
            nearest[o] = min(nearest[o], d2 / gate)
            if d2 <= gate:
                at = count
                while at > begin and pair_d2[at - 1] > d2:  # insertion sort: few candidates
                    pair_o[at], pair_k[at], pair_d2[at] = pair_o[at - 1], pair_k[at - 1], pair_d2[at - 1]
                    at -= 1
                pair_o[at], pair_k[at], pair_d2[at] = o, k, d2
                count += 1
    return count


@njit
def nearest_kernel(pairs, pair_o, pair_k, cost, match):
    """Greedy gated nearest neighbour: the least cost first, each observation and each landmark at most once."""
    match[:] = -1
    used = np.zeros(pairs, np.bool_)
    while True:
        best, at = np.inf, -1
        for i in range(pairs):
            if not used[i] and cost[i] < best:
                best, at = cost[i], i
        if at < 0:
            return
        match[pair_o[at]] = pair_k[at]
        for i in range(pairs):
            if pair_o[i] == pair_o[at] or pair_k[i] == pair_k[at]:
                used[i] = True


@callee(error_model="numpy")
def _levels(pair_o, count, observations):
    """First and end index of the pairings of each observation with a candidate, and the number of such observations."""
    begin, end = np.empty(observations, np.int64), np.empty(observations, np.int64)
    levels = 0
    for i in range(count):
        if i == 0 or pair_o[i] != pair_o[i - 1]:
            begin[levels] = i
            levels += 1
        end[levels - 1] = i + 1
    return begin, end, levels


@callee(error_model="numpy")
def _linearise_pairings(x, obs, sensor, pair_o, pair_k, count):
    """Jacobian, innovation and number of rows of each pairing, and the largest landmark index."""
    H, nu, rows = np.empty((count, 2, 5)), np.empty((count, 2)), np.empty(count, np.int64)
    h = np.empty(12)
    last = 0
    for i in range(count):
        rows[i] = linearise_observation(x, pair_k[i], obs[pair_o[i]], sensor, h, H[i], nu[i])
        last = max(last, pair_k[i])
    return H, nu, rows, last


@njit(error_model="numpy")
def joint_kernel(state, obs, sensor, gates, count, pairs, max_nodes, match):
    """Joint compatibility by branch and bound (Neira & Tardós 2001): most pairings, then least joint distance².

    Observations are assigned in the given order, candidates nearest first, then "none". Every partial hypothesis is
    jointly compatible: D² ≤ gates[rows]. D² grows by one forward substitution per pairing (incremental Cholesky of the
    joint innovation covariance). A branch is cut if it cannot improve the best: fewer pairings even if all remaining
    observations were paired, or the same number with a D² that is not smaller (D² never decreases).

    Returns (nodes tested, 1 if ``max_nodes`` stopped the search, else 0, D² of the result).
    """
    x, P = state
    pair_o, pair_k = pairs.o, pairs.k
    match[:] = -1
    best_match = match.copy()
    begin, end, levels = _levels(pair_o, count, len(obs))
    H, nu, rows, last = _linearise_pairings(x, obs, sensor, pair_o, pair_k, count)
    used = np.zeros(last + 1, np.bool_)
    L, y = np.zeros((2 * levels, 2 * levels)), np.zeros(2 * levels)
    choice, chosen = np.empty(levels + 1, np.int64), np.full(levels + 1, -1)
    paired, depth, D2 = np.zeros(levels + 1, np.int64), np.zeros(levels + 1, np.int64), np.zeros(levels + 1)
    best_n, best_d2 = 0, np.inf
    nodes = 0
    level = 0
    choice[0] = begin[0] if levels else 0
    while level >= 0:
        remaining = levels - level
        hopeless = paired[level] + remaining < best_n or (paired[level] + remaining == best_n and D2[level] >= best_d2)
        if level == levels and not hopeless:
            best_n, best_d2 = paired[level], D2[level]
            best_match[:] = match
        if level == levels or hopeless or choice[level] > end[level]:
            level -= 1
            if level >= 0 and chosen[level] >= 0:  # undo the pairing of this branch
                used[pair_k[chosen[level]]] = False
                match[pair_o[chosen[level]]] = -1
                chosen[level] = -1
            continue
        i = choice[level]
        choice[level] += 1
        if i < end[level]:
            if used[pair_k[i]]:
                continue
            if nodes >= max_nodes:
                return _hand_over(best_match, match, nodes, 1, best_d2)
            nodes += 1
            d2, d = D2[level], depth[level]
            ci = 3 + 2 * pair_k[i]
            # rows of the joint covariance with every earlier pairing, then with itself
            at = 0
            for v in range(level):
                p = chosen[v]
                if p < 0:
                    continue
                cp = 3 + 2 * pair_k[p]
                for r in range(rows[i]):
                    for t in range(rows[p]):
                        L[d + r, at + t] = _cross(P, H[i, r], ci, H[p, t], cp)
                at += rows[p]
            for r in range(rows[i]):
                for t in range(r + 1):
                    L[d + r, d + t] = _cross(P, H[i, r], ci, H[i, t], ci)
                L[d + r, d + r] += obs[pair_o[i], 2 + r]
                for t in range(d + r + 1):
                    s = L[d + r, t]
                    for k in range(t):
                        s -= L[d + r, k] * L[t, k]
                    if t < d + r:
                        L[d + r, t] = s / L[t, t]
                    else:
                        L[t, t] = math.sqrt(max(s, 1e-300))
                s = nu[i, r]
                for k in range(d + r):
                    s -= L[d + r, k] * y[k]
                y[d + r] = s / L[d + r, d + r]
                d2 += y[d + r] ** 2
            if d2 > gates[d + rows[i]]:
                continue
            chosen[level] = i
            used[pair_k[i]] = True
            match[pair_o[i]] = pair_k[i]
            paired[level + 1], depth[level + 1], D2[level + 1] = paired[level] + 1, d + rows[i], d2
        else:
            paired[level + 1], depth[level + 1], D2[level + 1] = paired[level], depth[level], D2[level]
        level += 1
        if level < levels:
            choice[level] = begin[level]
    return _hand_over(best_match, match, nodes, 0, best_d2)


@njit(inline="always")
def _hand_over(best_match, match, nodes, capped, d2):
    match[:] = best_match
    return nodes, capped, d2 if d2 < np.inf else 0.0


@callee(error_model="numpy")
def _cross(P, a, ca, b, cb):
    """``a P bᵀ`` for two rows over [pose, landmark at column ca or cb]."""
    total = 0.0
    for i in range(5):
        r = i if i < 3 else ca + i - 3
        total += a[i] * (P[r, 0] * b[0] + P[r, 1] * b[1] + P[r, 2] * b[2] + P[r, cb] * b[3] + P[r, cb + 1] * b[4])
    return total


@njit
def misses_kernel(slots, scan, at, polar, counts, limits, dropped):
    """Provisional landmarks that were expected but not observed: counts misses, marks those to delete.

    slots (nl,) of the active landmarks; at (q,): active landmark of each observation or -1; limits: confirm hits,
    misses, scans, range, least and greatest bearing; dropped (nl,) bool out.
    """
    hits, misses, born = counts
    count = 0
    seen = np.zeros(len(slots), np.bool_)
    for o in range(len(at)):
        if at[o] >= 0:
            seen[at[o]] = True
    for k in range(len(slots)):
        s = slots[k]
        dropped[k] = False
        if hits[s] <= 0 or hits[s] >= limits[0] or born[s] >= scan:
            continue
        if not seen[k] and polar[k, 0] < limits[3] and polar[k, 1] > limits[4] and polar[k, 1] < limits[5]:
            misses[s] += 1
        if misses[s] >= limits[1] or scan - born[s] >= limits[2]:
            dropped[k] = True
            count += 1
    return count
