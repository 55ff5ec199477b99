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
def _range_row(x, nuisance, g, data, sensor, p, q, at, row):
    """Whitened residual of the range of observation ``q`` from pose ``x``; returns its number of border columns."""
    jp, _, cols, vals = row
    j, v = data.slots[q]
    c, s = math.cos(x[2]), math.sin(x[2])
    ox, oy = c * sensor[0] - s * sensor[1], s * sensor[0] + c * sensor[1]
    dx, dy = nuisance[j, 0] - x[0] - ox, nuisance[j, 1] - x[1] - oy
    r = math.sqrt(dx * dx + dy * dy + 1e-12)
    base = HEAD + 2 * at[j]
    grow, w = 1.0 + g[RANGE_SCALE], 1.0 / p[RANGE]
    # residual: predicted minus measured
    e = grow * r + g[RANGE_OFFSET] - data.sightings[q, 0]
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
    return count


@njit(error_model="numpy", nogil=True)
def _bearing_row(x, nuisance, g, data, sensor, p, q, at, row):
    """Whitened residual of the bearing of observation ``q`` from pose ``x``; returns its number of border columns."""
    jp, _, cols, vals = row
    j, v = data.slots[q]
    c, s = math.cos(x[2]), math.sin(x[2])
    ox, oy = c * sensor[0] - s * sensor[1], s * sensor[0] + c * sensor[1]
    dx, dy = nuisance[j, 0] - x[0] - ox, nuisance[j, 1] - x[1] - oy
    r2 = dx * dx + dy * dy + 1e-12
    base = HEAD + 2 * at[j]
    w = 1.0 / p[BEARING]
    e = math.atan2(dy, dx) - x[2] - sensor[2] - g[SENSOR_YAW] - data.sightings[q, 1]
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
    return count


@njit(error_model="numpy", nogil=True)
def _visit_row(value, part, p, at, row):
    """Whitened prior of the range (``part`` 0) or bearing (1) of a visit."""
    _, _, cols, vals = row
    w = 1.0 / (p[VISIT_RANGE] if part == 0 else p[VISIT_BEARING])
    cols[1], vals[0], vals[1] = HEAD + 2 * at + part, -w * value, w


@njit(error_model="numpy", nogil=True)
def _motion_variances(step, p, out):
    """Variances of a step: along, lateral, heading."""
    turn, dt, d = step[2], step[3], step[4]
    out[0] = p[ALONG_METRE] ** 2 * d + p[ALONG_SECOND] ** 2 * dt + p[FLOOR_POSITION] ** 2
    out[1] = p[LATERAL_METRE] ** 2 * d + p[FLOOR_POSITION] ** 2
    out[2] = p[HEADING_METRE] ** 2 * d + p[HEADING_RADIAN] ** 2 * abs(turn) + p[HEADING_SECOND] ** 2 * dt
    out[2] += p[FLOOR_HEADING] ** 2
    if step[5] > 0.0:
        out[0] = step[5]
    if step[6] > 0.0:
        out[1], out[2] = step[6], step[7]


@njit(error_model="numpy", nogil=True)
def _motion_row(x, then, g, step, variances, axis, row):
    """Whitened residual of a step from pose ``x`` to ``then``: along, lateral or heading; 5 border columns."""
    jp, jn, cols, vals = row
    ux, uy, turn, dt, d = step[0], step[1], step[2], step[3], step[4]
    less = g[YAW_BIAS] * dt + g[TURN_PER_METRE] * d + g[TURN_SCALE] * turn
    h = 0.5 * turn
    phi = x[2] + h - 0.5 * less
    cp, sp = math.cos(phi), math.sin(phi)
    mx, my = then[0] - x[0], then[1] - x[1]
    longer = math.exp(g[DISTANCE_SCALE])  # the prediction is scaled, not the measurement with its noise
    qx, qy = longer * (cp * mx + sp * my), longer * (-sp * mx + cp * my)
    w = 1.0 / math.sqrt(variances[axis])
    u = w * longer
    jp[:] = 0.0
    jn[:] = 0.0
    if axis == 0:
        e, dphi, scale = qx - (math.cos(h) * ux + math.sin(h) * uy), qy, qx
        jp[0], jp[1], jn[0], jn[1] = -u * cp, -u * sp, u * cp, u * sp
    elif axis == 1:
        e, dphi, scale = qy - (-math.sin(h) * ux + math.cos(h) * uy), -qx, qy
        jp[0], jp[1], jn[0], jn[1] = u * sp, -u * cp, -u * sp, u * cp
    else:
        e, dphi, scale = wrap_residual(then[2] - x[2] - turn + less), -1.0, 0.0
        jn[2] = w
    jp[2] = w * dphi
    # a change of the turn by the constants rotates the chord by half of it, the heading by all of it
    part = -0.5 * dphi if axis < 2 else 1.0
    cols[1], vals[1] = YAW_BIAS, w * part * dt
    cols[2], vals[2] = DISTANCE_SCALE, w * scale
    cols[3], vals[3] = TURN_PER_METRE, w * part * d
    cols[4], vals[4] = TURN_SCALE, w * part * turn
    vals[0] = -w * e


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
    cols, vals, variances = np.zeros(16, np.int64), np.zeros(16), np.zeros(3)
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
                        volume += math.log(p[VISIT_RANGE] if a == 0 else p[VISIT_BEARING])
                        _visit_row(nuisance[new, a], a, p, place, alone)
                        _add(alone, 2, blocks)
                        chi2[5] += vals[0] * vals[0]
                    else:
                        S[col, col] += _FAR
            volume += math.log(p[RANGE])
            count = _range_row(poses[k], nuisance, g, data, sensor, p, q, at, here)
            chi2[3] += vals[0] * vals[0]
            _add(here, count, blocks)
            if sightings[q, 1] == sightings[q, 1]:
                volume += math.log(p[BEARING])
                count = _bearing_row(poses[k], nuisance, g, data, sensor, p, q, at, here)
                chi2[4] += vals[0] * vals[0]
                _add(here, count, blocks)
        if k + 1 < n:
            _motion_variances(steps[k + 1], p, variances)
            for axis in range(3):
                volume += 0.5 * math.log(variances[axis])
                _motion_row(poses[k], poses[k + 1], g, steps[k + 1], variances, axis, onward)
                chi2[axis] += vals[0] * vals[0]
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
def _enter(M, coefficients, at, pivot, variance):
    """Second moments ``M`` of z where z[at] becomes -coefficients · z / pivot + noise of a variance."""
    f, new = len(M), M[at]
    new[:] = 0.0
    for i in range(f):
        w = coefficients[i] / pivot
        if w != 0.0:
            for b in range(f):
                new[b] -= w * M[i, b]
    new[at] = variance
    for i in range(f):
        if i != at:
            new[at] -= coefficients[i] / pivot * new[i]
            M[i, at] = new[i]


@njit(error_model="numpy", nogil=True)
def _unexplained(row, n, M, here, then):
    """1 minus the expected square of a whitened residual: a variance is too small where it is below 0."""
    jp, jn, cols, vals = row
    total, D = 0.0, len(jp)
    for i in range(n):
        part = 0.0
        for j in range(n):
            part += M[cols[i], cols[j]] * vals[j]
        for b in range(D):
            part += 2.0 * (M[cols[i], here + b] * jp[b] + M[cols[i], then + b] * jn[b])
        total += vals[i] * part
    for a in range(D):
        for b in range(D):
            total += jp[a] * M[here + a, here + b] * jp[b] + jn[a] * M[then + a, then + b] * jn[b]
            total += 2.0 * jp[a] * M[here + a, then + b] * jn[b]
    return 1.0 - total


@njit(error_model="numpy", nogil=True)
def differentiate_window(poses, nuisance, g, data, sensor, p, moments, work):
    """Derivative of a window's negative log-likelihood by ln σ of each standard deviation ``(PARAMETERS,)``.

    A residual of variance v, with whitened Jacobian a and states of covariance P, adds ½ (1 - E[e²]) to the derivative
    by ln v, where E[e²] = ê² + a P aᵀ and ê is the whitened residual at the optimum. Back-substitution from the last
    pose to the first gives the second moments of the states that a residual involves.

    moments : (HEAD, HEAD) second moments of the constants, and of -1 in row RHS, at the optimum of all windows.
    work : Work of :func:`eliminate_window` for the same window, states and ``p``, undamped.
    """
    steps, first, sightings, slots, kinds = data
    L, X, C, _, _, gone, pivots, order, when, at = work
    n, D = poses.shape
    m = C.shape[2]
    out = np.zeros(PARAMETERS)
    M, z = np.zeros((m + 2 * D, m + 2 * D)), np.zeros(m + 2 * D)
    M[:HEAD, :HEAD] = moments
    jp, jn, zero = np.zeros(D), np.zeros(D), np.zeros(D)
    cols, vals, variances = np.zeros(16, np.int64), np.zeros(16), np.zeros(3)
    cols[0] = RHS
    here, onward = _Row(jp, zero, cols, vals), _Row(jp, jn, cols, vals)
    alone = _Row(zero, zero, cols, vals)
    begun = np.full(len(nuisance), n, np.int64)
    for k in range(n - 1, -1, -1):
        for q in range(first[k], first[k + 1]):
            for j in slots[q]:
                if j >= 0:
                    begun[j] = k
    last = len(order) - 1
    while last >= 0 and order[last] < 0:
        last -= 1
    for k in range(n - 1, -1, -1):
        mine, then = m + D * (k % 2), m + D * ((k + 1) % 2)
        for a in range(D - 1, -1, -1):
            z[:m] = C[k, a]
            for b in range(D):
                z[then + b] = X[k, a, b] if k + 1 < n else 0.0
                z[mine + b] = L[k, b, a] if b > a else 0.0
            _enter(M, z, mine + a, L[k, a, a], 1.0 / L[k, a, a] ** 2)
        z[then : then + D] = 0.0
        while last >= 0 and when[last] == k:  # nuisances eliminated with pose k, in reverse order
            j = order[last]
            for a in range(2):
                z[:m] = gone[2 * j + a, :m]
                z[mine : mine + D] = gone[2 * j + a, m:]
                _enter(M, z, HEAD + 2 * at[j] + a, pivots[2 * j + a], 1.0 / pivots[2 * j + a])
            last -= 1
        for q in range(first[k], first[k + 1]):
            count = _range_row(poses[k], nuisance, g, data, sensor, p, q, at, here)
            out[RANGE] += _unexplained(here, count, M, mine, then)
            if sightings[q, 1] == sightings[q, 1]:
                count = _bearing_row(poses[k], nuisance, g, data, sensor, p, q, at, here)
                out[BEARING] += _unexplained(here, count, M, mine, then)
            for j in slots[q]:
                if j >= 0 and begun[j] == k and kinds[j] == 1:
                    begun[j] = -1
                    for a in range(2):
                        _visit_row(nuisance[j, a], a, p, at[j], alone)
                        out[VISIT_RANGE if a == 0 else VISIT_BEARING] += _unexplained(alone, 2, M, mine, then)
        if k + 1 < n:
            _motion_variances(steps[k + 1], p, variances)
            turn, dt, d = abs(steps[k + 1, 2]), steps[k + 1, 3], steps[k + 1, 4]
            for axis in range(3):
                _motion_row(poses[k], poses[k + 1], g, steps[k + 1], variances, axis, onward)
                excess = _unexplained(onward, 5, M, mine, then) / variances[axis]
                if axis == 0 and not steps[k + 1, 5] > 0.0:
                    out[ALONG_METRE] += excess * p[ALONG_METRE] ** 2 * d
                    out[ALONG_SECOND] += excess * p[ALONG_SECOND] ** 2 * dt
                    out[FLOOR_POSITION] += excess * p[FLOOR_POSITION] ** 2
                elif axis == 1 and not steps[k + 1, 6] > 0.0:
                    out[LATERAL_METRE] += excess * p[LATERAL_METRE] ** 2 * d
                    out[FLOOR_POSITION] += excess * p[FLOOR_POSITION] ** 2
                elif axis == 2 and not steps[k + 1, 6] > 0.0:
                    out[HEADING_METRE] += excess * p[HEADING_METRE] ** 2 * d
                    out[HEADING_RADIAN] += excess * p[HEADING_RADIAN] ** 2 * turn
                    out[HEADING_SECOND] += excess * p[HEADING_SECOND] ** 2 * dt
                    out[FLOOR_HEADING] += excess * p[FLOOR_HEADING] ** 2
    return out


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
