"""Compiled elimination of one window of a log: a chain of poses, bordered by landmarks, visits and constants."""

from __future__ import annotations

import math
from collections import namedtuple

import numpy as np

from graphslam.core.jit import njit

YAW_BIAS, DISTANCE_SCALE, TURN_PER_METRE, TURN_SCALE, RANGE_SCALE, RANGE_OFFSET, SENSOR_YAW = range(7)
CONSTANTS = 7
RHS = CONSTANTS
HEAD = CONSTANTS + 1
(
    ALONG_METRE,
    ALONG_SECOND,
    LATERAL_METRE,
    HEADING_METRE,
    HEADING_RADIAN,
    HEADING_SECOND,
    RANGE,
    BEARING,
    VISIT_RANGE,
    VISIT_BEARING,
    FLOOR_POSITION,
    FLOOR_HEADING,
) = range(12)
PARAMETERS = 12
Data = namedtuple("Data", ["steps", "first", "sightings", "slots", "kinds"])
"""Measurements of a window."""
Work = namedtuple("Work", ["L", "X", "C", "S", "chi2", "gone", "pivots", "order", "when", "at"])
"""Output of :func:`eliminate_window`."""
_Row = namedtuple("_Row", ["jp", "jn", "cols", "vals"])
_Blocks = namedtuple("_Blocks", ["A", "An", "B", "C", "Cn", "S"])
_FAR = 1e-8  # prior information of a landmark position [1/m²]


@njit(error_model="numpy", nogil=True)
def wrap_residual(a):
    """Angle in (-π, π]."""
    return math.pi - (math.pi - a) % (2.0 * math.pi)


@njit(error_model="numpy", nogil=True)
def _add(row, n, blocks):
    """Add one whitened residual row to the blocks of this pose, of the next one, and of ``n`` border columns."""
    jp, jn, cols, vals = row
    A, An, B, C, Cn, S = blocks
    D = len(jp)
    for a in range(D):
        if jp[a] != 0.0:
            for b in range(D):
                A[a, b] += jp[a] * jp[b]
                B[a, b] += jp[a] * jn[b]
            for i in range(n):
                C[a, cols[i]] += jp[a] * vals[i]
        if jn[a] != 0.0:
            for b in range(D):
                An[a, b] += jn[a] * jn[b]
            for i in range(n):
                Cn[a, cols[i]] += jn[a] * vals[i]
    for i in range(n):
        for j in range(n):
            a, b = cols[i], cols[j]
            if a <= b:
                S[a, b] += vals[i] * vals[j]


@njit(error_model="numpy", nogil=True)
def _leave(at, active, A, C, S, gone):
    """Eliminate a border column without later observations; its row goes to ``gone``. Returns the pivot."""
    D, m = C.shape
    pivot = S[at, at]
    gone[:] = 0.0
    for b in range(at):
        gone[b], S[b, at] = S[b, at], 0.0
    for b in range(at + 1, active):
        gone[b], S[at, b] = S[at, b], 0.0
    S[at, at] = 0.0
    for a in range(D):
        gone[m + a], C[a, at] = C[a, at], 0.0
    for a in range(active):
        w = gone[a] / pivot
        if w != 0.0:
            for b in range(a, active):
                S[a, b] -= w * gone[b]
    for a in range(D):
        w = gone[m + a] / pivot
        if w != 0.0:
            for b in range(active):
                C[a, b] -= w * gone[b]
            for b in range(D):
                A[a, b] -= w * gone[m + b]
    return pivot


@njit(error_model="numpy", nogil=True)
def eliminate_window(poses, nuisance, g, data, sensor, p, damping, work):
    """Linearise a window and marginalise its poses and nuisances, so that the constants remain.

    A nuisance is eliminated with the last pose that observes it, and its border columns are reused. So the width of the
    border is given by the nuisances that are active at the same time, not by the length of the window.

    poses : (n, D) x, y, heading; D = 3.
    nuisance : (M, 2) landmarks (x, y) and constants of visits (range, bearing), in order of their first observation.
    g : (CONSTANTS,)
    data : Data
        steps (n, 8): dx, dy, turn, seconds, metres from pose k - 1 to k; then variances: column 5 (along) if > 0, and
            columns 6 and 7 (lateral, heading) if column 6 > 0, replace those of the noise model; row 0 is not read.
        first : (n + 1,) observations of pose k are ``first[k]:first[k + 1]``.
        ``sightings`` : (q, 2) range and bearing; NaN: no bearing.
        slots : (q, 2) nuisance of the landmark, and of the visit or -1.
        kinds (M,): 0 landmark, 1 visit.
    sensor : (3,) pose of the sensor in the base frame.
    p : (PARAMETERS,) standard deviations.
    damping : Levenberg-Marquardt factor; diagonals of poses and nuisances are multiplied by 1 + damping.
    work : Work
        L (n, D, D), X (n, D, D), C (n, D, m), S (m, m), chi2 (6,), gone (2 M, m + D), pivots (2 M,), order (M,),
        when (M,), at (M,): output for :func:`substitute_window`; m = HEAD + 2 · maximal number of active nuisances.
        ``order`` lists the nuisances in elimination order, ``when`` the pose of each elimination, ``at`` the index in
        the border. S[:HEAD, :HEAD] is the information of the constants, with the right-hand side and χ² in row RHS;
        chi2 is χ² at the linearisation point by class: along, lateral, heading, range, bearing, priors.

    Returns
    -------
    (float, float)
        ln det of the eliminated blocks, and the sum of ln σ of all residuals.
    """
    steps, first, sightings, slots, kinds = data
    L, X, C, S, chi2, gone, pivots, order, when, at = work
    n, D = poses.shape
    M = len(nuisance)
    m = C.shape[2]
    S[:] = 0.0
    C[:] = 0.0
    chi2[:] = 0.0
    logdet, volume = 0.0, 0.0
    A, An = np.zeros((D, D)), np.zeros((D, D))
    jp, jn, zero = np.zeros(D), np.zeros(D), np.zeros(D)
    cols, vals = np.zeros(16, np.int64), np.zeros(16)
    cols[0] = RHS
    here, onward = _Row(jp, zero, cols, vals), _Row(jp, jn, cols, vals)
    alone = _Row(zero, zero, cols, vals)
    for a in range(3):
        A[a, a] = 1e12
    last = np.zeros(M, np.int64)
    for k in range(n):
        for q in range(first[k], first[k + 1]):
            for j in slots[q]:
                if j >= 0:
                    last[j] = k
    at[:], when[:], order[:] = -1, -1, -1
    used, gone_by = np.zeros((m - HEAD) // 2, np.bool_), np.zeros(M, np.bool_)
    known = went = 0
    for k in range(n):
        X[k] = 0.0
        An[:] = 0.0
        blocks = _Blocks(A, An, X[k], C[k], C[min(k + 1, n - 1)], S)
        x, y, th = poses[k, 0], poses[k, 1], poses[k, 2]
        c, s = math.cos(th), math.sin(th)
        ox, oy = c * sensor[0] - s * sensor[1], s * sensor[0] + c * sensor[1]
        for q in range(first[k], first[k + 1]):
            j, v = slots[q, 0], slots[q, 1]
            for new in (j, v):  # first observation: add the prior
                if new < 0 or at[new] >= 0:
                    continue
                place = 0
                while used[place]:
                    place += 1
                at[new], used[place], known = place, True, max(known, place + 1)
                for a in range(2):
                    col = HEAD + 2 * place + a
                    if kinds[new] == 1:
                        sv = p[VISIT_RANGE] if a == 0 else p[VISIT_BEARING]
                        volume += math.log(sv)
                        cols[1], vals[0], vals[1] = col, -nuisance[new, a] / sv, 1.0 / sv
                        _add(alone, 2, blocks)
                        chi2[5] += vals[0] * vals[0]
                    else:
                        S[col, col] += _FAR
            dx, dy = nuisance[j, 0] - x - ox, nuisance[j, 1] - y - oy
            r2 = dx * dx + dy * dy + 1e-12
            r = math.sqrt(r2)
            base = HEAD + 2 * at[j]
            grow = 1.0 + g[RANGE_SCALE]
            w = 1.0 / p[RANGE]
            volume += math.log(p[RANGE])
            # residual: predicted minus measured
            e = grow * r + g[RANGE_OFFSET] - sightings[q, 0]
            jp[:] = 0.0
            jp[0], jp[1] = -w * grow * dx / r, -w * grow * dy / r
            jp[2] = w * grow * (dx * oy - dy * ox) / r
            cols[1], vals[1] = base, w * grow * dx / r
            cols[2], vals[2] = base + 1, w * grow * dy / r
            cols[3], vals[3] = RANGE_SCALE, w * r
            cols[4], vals[4] = RANGE_OFFSET, w
            count = 5
            if v >= 0:
                e += nuisance[v, 0]
                cols[5], vals[5] = HEAD + 2 * at[v], w
                count = 6
            vals[0] = -w * e
            chi2[3] += vals[0] * vals[0]
            _add(here, count, blocks)
            if sightings[q, 1] == sightings[q, 1]:
                w = 1.0 / p[BEARING]
                volume += math.log(p[BEARING])
                e = math.atan2(dy, dx) - th - sensor[2] - g[SENSOR_YAW] - sightings[q, 1]
                if v >= 0:
                    e += nuisance[v, 1]
                e = wrap_residual(e)
                jp[:] = 0.0
                jp[0], jp[1] = w * dy / r2, -w * dx / r2
                jp[2] = w * (-(dx * ox + dy * oy) / r2 - 1.0)
                cols[1], vals[1] = base, -w * dy / r2
                cols[2], vals[2] = base + 1, w * dx / r2
                cols[3], vals[3] = SENSOR_YAW, -w
                count = 4
                if v >= 0:
                    cols[4], vals[4] = HEAD + 2 * at[v] + 1, w
                    count = 5
                vals[0] = -w * e
                chi2[4] += vals[0] * vals[0]
                _add(here, count, blocks)
        if k + 1 < n:
            ux, uy, turn, dt, d = steps[k + 1, 0], steps[k + 1, 1], steps[k + 1, 2], steps[k + 1, 3], steps[k + 1, 4]
            less = g[YAW_BIAS] * dt + g[TURN_PER_METRE] * d + g[TURN_SCALE] * turn
            h = 0.5 * turn
            cx, cyy = math.cos(h) * ux + math.sin(h) * uy, -math.sin(h) * ux + math.cos(h) * uy
            longer = math.exp(g[DISTANCE_SCALE])  # the prediction is scaled, not the measurement with its noise
            phi = th + h - 0.5 * less
            cp, sp = math.cos(phi), math.sin(phi)
            mx, my = poses[k + 1, 0] - x, poses[k + 1, 1] - y
            qx, qy = cp * mx + sp * my, -sp * mx + cp * my
            qx, qy = longer * qx, longer * qy
            ex, ey = qx - cx, qy - cyy
            et = wrap_residual(poses[k + 1, 2] - th - turn + less)
            var_x = p[ALONG_METRE] ** 2 * d + p[ALONG_SECOND] ** 2 * dt + p[FLOOR_POSITION] ** 2
            var_y = p[LATERAL_METRE] ** 2 * d + p[FLOOR_POSITION] ** 2
            var_t = p[HEADING_METRE] ** 2 * d + p[HEADING_RADIAN] ** 2 * abs(turn) + p[HEADING_SECOND] ** 2 * dt
            var_t += p[FLOOR_HEADING] ** 2
            if steps[k + 1, 5] > 0.0:
                var_x = steps[k + 1, 5]
            if steps[k + 1, 6] > 0.0:
                var_y, var_t = steps[k + 1, 6], steps[k + 1, 7]
            volume += 0.5 * (math.log(var_x) + math.log(var_y) + math.log(var_t))
            for row in range(3):
                jp[:] = 0.0
                jn[:] = 0.0
                if row == 0:
                    w, e, dphi = 1.0 / math.sqrt(var_x), ex, qy
                    u = w * longer
                    jp[0], jp[1], jn[0], jn[1] = -u * cp, -u * sp, u * cp, u * sp
                    scale = qx
                elif row == 1:
                    w, e, dphi = 1.0 / math.sqrt(var_y), ey, -qx
                    u = w * longer
                    jp[0], jp[1], jn[0], jn[1] = u * sp, -u * cp, -u * sp, u * cp
                    scale = qy
                else:
                    w, e, dphi, scale = 1.0 / math.sqrt(var_t), et, -1.0, 0.0
                    jn[2] = w
                jp[2] = w * dphi
                # a change of the turn by the constants rotates the chord by half of it, the heading by all of it
                part = -0.5 * dphi if row < 2 else 1.0
                cols[1], vals[1] = YAW_BIAS, w * part * dt
                cols[2], vals[2] = DISTANCE_SCALE, w * scale
                cols[3], vals[3] = TURN_PER_METRE, w * part * d
                cols[4], vals[4] = TURN_SCALE, w * part * turn
                vals[0] = -w * e
                chi2[row] += vals[0] * vals[0]
                _add(onward, 5, blocks)
        if damping > 0.0:
            for a in range(D):
                A[a, a] *= 1.0 + damping
        # eliminate nuisances without later observations, then Cholesky of the pose, then update next pose and border
        active = HEAD + 2 * known
        for q in range(first[k], first[k + 1]):
            for j in slots[q]:
                if j < 0 or last[j] != k or gone_by[j]:
                    continue
                order[went], when[went] = j, k
                went += 1
                gone_by[j], used[at[j]] = True, False
                col = HEAD + 2 * at[j]
                if damping > 0.0:
                    S[col, col] *= 1.0 + damping
                    S[col + 1, col + 1] *= 1.0 + damping
                for a in range(1, -1, -1):
                    pivot = _leave(col + a, active, A, C[k], S, gone[2 * j + a])
                    if not pivot > 0.0:
                        return np.nan, volume
                    pivots[2 * j + a] = pivot
                    logdet += math.log(pivot)
        for a in range(D):
            for b in range(a + 1):
                t = A[a, b]
                for i in range(b):
                    t -= L[k, a, i] * L[k, b, i]
                if a == b:
                    if not t > 0.0:
                        return np.nan, volume
                    L[k, a, a] = math.sqrt(t)
                    logdet += math.log(t)
                else:
                    L[k, a, b] = t / L[k, b, b]
                    L[k, b, a] = 0.0
        for a in range(D):
            for b in range(D):
                t = X[k, a, b]
                for i in range(a):
                    t -= L[k, a, i] * X[k, i, b]
                X[k, a, b] = t / L[k, a, a]
            for i in range(a):
                w = L[k, a, i]
                for b in range(active):
                    C[k, a, b] -= w * C[k, i, b]
            w = 1.0 / L[k, a, a]
            for b in range(active):
                C[k, a, b] *= w
        for i in range(D):
            for a in range(D):
                w = X[k, i, a]
                for b in range(D):
                    An[a, b] -= w * X[k, i, b]
                if k + 1 < n:
                    for b in range(active):
                        C[k + 1, a, b] -= w * C[k, i, b]
            for a in range(active):
                w = C[k, i, a]
                if w != 0.0:
                    for b in range(a, active):
                        S[a, b] -= w * C[k, i, b]
        A, An = An, A
    return logdet, volume


@njit(error_model="numpy", nogil=True)
def substitute_window(work, dg, d_poses, d_nuisance):
    """Back-substitution: updates of poses (n, D) and nuisances (M, 2) for an update ``dg`` of the constants."""
    L, X, C, _, _, gone, pivots, order, when, at = work
    n, D = d_poses.shape
    m = C.shape[2]
    y = np.zeros(m)
    y[:CONSTANTS] = dg
    y[RHS] = -1.0
    d_nuisance[:] = 0.0
    last = len(order) - 1
    while last >= 0 and order[last] < 0:
        last -= 1
    for k in range(n - 1, -1, -1):
        for a in range(D - 1, -1, -1):
            t = 0.0
            for b in range(m):
                t += C[k, a, b] * y[b]
            if k + 1 < n:
                for b in range(D):
                    t += X[k, a, b] * d_poses[k + 1, b]
            for b in range(a + 1, D):
                t += L[k, b, a] * d_poses[k, b]
            d_poses[k, a] = -t / L[k, a, a]
        while last >= 0 and when[last] == k:  # nuisances eliminated with pose k, in reverse order
            j = order[last]
            for a in range(2):
                t = 0.0
                for b in range(m):
                    t += gone[2 * j + a, b] * y[b]
                for b in range(D):
                    t += gone[2 * j + a, m + b] * d_poses[k, b]
                d_nuisance[j, a] = y[HEAD + 2 * at[j] + a] = -t / pivots[2 * j + a]
            last -= 1


@njit(error_model="numpy", nogil=True)
def compose_steps(increments, start, poses):
    """Chain increments ``(n, >= 3)`` from ``start`` into ``poses`` (n, >= 3); row 0 of the increments is not read."""
    poses[0, 0], poses[0, 1], poses[0, 2] = start[0], start[1], start[2]
    for k in range(1, len(poses)):
        c, s = math.cos(poses[k - 1, 2]), math.sin(poses[k - 1, 2])
        x, y = increments[k, 0], increments[k, 1]
        poses[k, 0] = poses[k - 1, 0] + c * x - s * y
        poses[k, 1] = poses[k - 1, 1] + s * x + c * y
        poses[k, 2] = wrap_residual(poses[k - 1, 2] + increments[k, 2])
