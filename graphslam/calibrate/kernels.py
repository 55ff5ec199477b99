"""Compiled elimination of one window of a log: a chain of poses, bordered by landmarks, visits and constants."""

from __future__ import annotations

import math
from collections import namedtuple

import numpy as np

from graphslam.calibrate.residual_kernels import (
    ALONG_METRE,
    ALONG_SECOND,
    BEARING,
    CONSTANTS,
    FLOOR_HEADING,
    FLOOR_POSITION,
    HEAD,
    HEADING_METRE,
    HEADING_RADIAN,
    HEADING_SECOND,
    LATERAL_METRE,
    PARAMETERS,
    RANGE,
    RHS,
    VISIT_BEARING,
    VISIT_RANGE,
    Model,
    Row,
    bearing_row,
    motion_row,
    motion_variances,
    range_row,
    visit_row,
    wrap_residual,
)
from graphslam.core.jit import callee, njit

Work = namedtuple("Work", ["L", "X", "C", "S", "chi2", "rows", "pivots", "order", "when", "at"])
"""Output of :func:`eliminate_window`."""
_Blocks = namedtuple("_Blocks", ["A", "An", "B", "C", "Cn", "S"])
_FAR = 1e-8  # prior information of a landmark position [1/m²]


@callee(error_model="numpy")
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


@callee(error_model="numpy")
def _leave(at, active, A, C, S, row):
    """Eliminate a border column without later observations; its row goes to ``row``. Returns the pivot."""
    D, m = C.shape
    pivot = S[at, at]
    row[:] = 0.0
    for b in range(at):
        row[b], S[b, at] = S[b, at], 0.0
    for b in range(at + 1, active):
        row[b], S[at, b] = S[at, b], 0.0
    S[at, at] = 0.0
    for a in range(D):
        row[m + a], C[a, at] = C[a, at], 0.0
    for a in range(active):
        w = row[a] / pivot
        if w != 0.0:
            for b in range(a, active):
                S[a, b] -= w * row[b]
    for a in range(D):
        w = row[m + a] / pivot
        if w != 0.0:
            for b in range(active):
                C[a, b] -= w * row[b]
            for b in range(D):
                A[a, b] -= w * row[m + b]
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
        ``detections`` : (q, 2) range and bearing; NaN: no bearing.
        slots : (q, 2) nuisance of the landmark, and of the visit or -1.
        kinds (M,): 0 landmark, 1 visit.
    sensor : (3,) pose of the sensor in the base frame.
    p : (PARAMETERS,) standard deviations.
    damping : Levenberg-Marquardt factor; diagonals of poses and nuisances are multiplied by 1 + damping.
    work : Work
        L (n, D, D), X (n, D, D), C (n, D, m), S (m, m), chi2 (6,), rows (2 M, m + D), pivots (2 M,), order (M,),
        when (M,), at (M,): output for :func:`substitute_window`; m = HEAD + 2 · maximal number of active nuisances.
        ``order`` lists the nuisances in elimination order, ``when`` the pose of each elimination, ``at`` the index in
        the border. S[:HEAD, :HEAD] is the information of the constants, with the right-hand side and χ² in row RHS;
        chi2 is χ² at the linearisation point by class: along, lateral, heading, range, bearing, priors.

    Returns
    -------
    (float, float)
        ln det of the eliminated blocks, and the sum of ln σ of all residuals.
    """
    steps, first, detections, slots, kinds = data
    L, X, C, S, chi2, rows, pivots, order, when, at = work
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
    model, here, onward = Model(g, sensor, p), Row(jp, zero, cols, vals), Row(jp, jn, cols, vals)
    alone = Row(zero, zero, cols, vals)
    for a in range(3):
        A[a, a] = 1e12
    last = np.zeros(M, np.int64)
    for k in range(n):
        for q in range(first[k], first[k + 1]):
            for j in slots[q]:
                if j >= 0:
                    last[j] = k
    at[:], when[:], order[:] = -1, -1, -1
    used, passed = np.zeros((m - HEAD) // 2, np.bool_), np.zeros(M, np.bool_)
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
                        visit_row(nuisance[new, a], a, p, place, alone)
                        _add(alone, 2, blocks)
                        chi2[5] += vals[0] * vals[0]
                    else:
                        S[col, col] += _FAR
            volume += math.log(p[RANGE])
            count = range_row(poses[k], nuisance, model, data, q, at, here)
            chi2[3] += vals[0] * vals[0]
            _add(here, count, blocks)
            if detections[q, 1] == detections[q, 1]:
                volume += math.log(p[BEARING])
                count = bearing_row(poses[k], nuisance, model, data, q, at, here)
                chi2[4] += vals[0] * vals[0]
                _add(here, count, blocks)
        if k + 1 < n:
            motion_variances(steps[k + 1], p, variances)
            for axis in range(3):
                volume += 0.5 * math.log(variances[axis])
                motion_row(poses[k], poses[k + 1], g, steps[k + 1], variances, axis, onward)
                chi2[axis] += vals[0] * vals[0]
                _add(onward, 5, blocks)
        if damping > 0.0:
            for a in range(D):
                A[a, a] *= 1.0 + damping
        # eliminate nuisances without later observations, then Cholesky of the pose, then update next pose and border
        active = HEAD + 2 * known
        for q in range(first[k], first[k + 1]):
            for j in slots[q]:
                if j < 0 or last[j] != k or passed[j]:
                    continue
                order[went], when[went] = j, k
                went += 1
                passed[j], used[at[j]] = True, False
                col = HEAD + 2 * at[j]
                if damping > 0.0:
                    S[col, col] *= 1.0 + damping
                    S[col + 1, col + 1] *= 1.0 + damping
                for a in range(1, -1, -1):
                    pivot = _leave(col + a, active, A, C[k], S, rows[2 * j + a])
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
    L, X, C, _, _, rows, pivots, order, when, at = work
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
                    t += rows[2 * j + a, b] * y[b]
                for b in range(D):
                    t += rows[2 * j + a, m + b] * d_poses[k, b]
                d_nuisance[j, a] = y[HEAD + 2 * at[j] + a] = -t / pivots[2 * j + a]
            last -= 1


@callee(error_model="numpy")
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


@callee(error_model="numpy")
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


@callee(error_model="numpy")
def _spread(step, p, axis, slope, out):
    """Add twice a derivative by the variance of a step along an axis to those of the standard deviations in it."""
    turn, dt, d = abs(step[2]), step[3], step[4]
    if axis == 0 and not step[5] > 0.0:
        out[ALONG_METRE] += slope * p[ALONG_METRE] ** 2 * d
        out[ALONG_SECOND] += slope * p[ALONG_SECOND] ** 2 * dt
        out[FLOOR_POSITION] += slope * p[FLOOR_POSITION] ** 2
    elif axis == 1 and not step[6] > 0.0:
        out[LATERAL_METRE] += slope * p[LATERAL_METRE] ** 2 * d
        out[FLOOR_POSITION] += slope * p[FLOOR_POSITION] ** 2
    elif axis == 2 and not step[6] > 0.0:
        out[HEADING_METRE] += slope * p[HEADING_METRE] ** 2 * d
        out[HEADING_RADIAN] += slope * p[HEADING_RADIAN] ** 2 * turn
        out[HEADING_SECOND] += slope * p[HEADING_SECOND] ** 2 * dt
        out[FLOOR_HEADING] += slope * p[FLOOR_HEADING] ** 2


@njit(error_model="numpy", nogil=True)
def differentiate_window(poses, nuisance, g, data, sensor, p, moments, work):
    """Derivative of a window's negative log-likelihood by ln σ of each standard deviation ``(PARAMETERS,)``.

    A residual of variance v, with whitened Jacobian a and states of covariance P, adds ½ (1 - E[e²]) to the derivative
    by ln v, where E[e²] = ê² + a P aᵀ and ê is the whitened residual at the optimum. Back-substitution from the last
    pose to the first gives the second moments of the states that a residual involves.

    moments : (HEAD, HEAD) second moments of the constants, and of -1 in row RHS, at the optimum of all windows.
    work : Work of :func:`eliminate_window` for the same window, states and ``p``, undamped.
    """
    steps, first, detections, slots, kinds = data
    L, X, C, _, _, rows, pivots, order, when, at = work
    n, D = poses.shape
    m = C.shape[2]
    out = np.zeros(PARAMETERS)
    M, z = np.zeros((m + 2 * D, m + 2 * D)), np.zeros(m + 2 * D)
    M[:HEAD, :HEAD] = moments
    jp, jn, zero = np.zeros(D), np.zeros(D), np.zeros(D)
    cols, vals, variances = np.zeros(16, np.int64), np.zeros(16), np.zeros(3)
    cols[0] = RHS
    model, here, onward = Model(g, sensor, p), Row(jp, zero, cols, vals), Row(jp, jn, cols, vals)
    alone = Row(zero, zero, cols, vals)
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
                z[:m] = rows[2 * j + a, :m]
                z[mine : mine + D] = rows[2 * j + a, m:]
                _enter(M, z, HEAD + 2 * at[j] + a, pivots[2 * j + a], 1.0 / pivots[2 * j + a])
            last -= 1
        for q in range(first[k], first[k + 1]):
            count = range_row(poses[k], nuisance, model, data, q, at, here)
            out[RANGE] += _unexplained(here, count, M, mine, then)
            if detections[q, 1] == detections[q, 1]:
                count = bearing_row(poses[k], nuisance, model, data, q, at, here)
                out[BEARING] += _unexplained(here, count, M, mine, then)
            for j in slots[q]:
                if j >= 0 and begun[j] == k and kinds[j] == 1:
                    begun[j] = -1
                    for a in range(2):
                        visit_row(nuisance[j, a], a, p, at[j], alone)
                        out[VISIT_RANGE if a == 0 else VISIT_BEARING] += _unexplained(alone, 2, M, mine, then)
        if k + 1 < n:
            motion_variances(steps[k + 1], p, variances)
            for axis in range(3):
                motion_row(poses[k], poses[k + 1], g, steps[k + 1], variances, axis, onward)
                _spread(steps[k + 1], p, axis, _unexplained(onward, 5, M, mine, then) / variances[axis], out)
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
