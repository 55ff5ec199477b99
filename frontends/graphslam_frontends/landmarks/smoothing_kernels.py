"""Compiled Gauss-Newton smoothing of one submap: all poses and landmarks under a given association.

The normal equations are a block-tridiagonal chain of poses with an arrow of landmark columns. Poses are eliminated from
the base towards the exit. The remaining matrix is the information matrix of {exit pose, landmarks}: the marginal that
the submap needs. Cost is poses × landmarks²; no matrix of size poses² is formed.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from graphslam.core.jit import callee, njit
from graphslam_frontends.landmarks.measurement_kernels import observe_landmark, wrap_angle_kernel


class SmoothingMeasurements(NamedTuple):
    """Measurements of T poses and L landmarks."""

    u: Any
    """(T, 3): odometry increments."""
    W: Any
    """(T, 3, 3): their information."""
    ob_pose: Any
    """(q,): pose of each observation."""
    ob_lm: Any
    """(q,): its landmark."""
    ob: Any
    """(q, 4): range, bearing and their variances."""
    weight: Any
    """(q,)"""
    sensor: Any
    """(3,): T_base_sensor."""


class NormalBlocks(NamedTuple):
    """Normal equations."""

    A: Any
    """(T, 3, 3)"""
    B: Any
    """(T, 3, 3), coupling k to k + 1."""
    C: Any
    """(T, 3, 2 L)"""
    H: Any
    """(2 L, 2 L)"""
    g: Any
    """(T, 3): right-hand side of the poses."""
    gl: Any
    """(2 L,): that of the landmarks."""


@callee(error_model="numpy")
def bound_bearing_slopes(h, variance):
    """Bound the derivatives of a bearing, 1/r, if the landmark is nearer than the σ of the range."""
    near = math.sqrt(variance)
    if h[0] < near:
        share = h[0] / near
        h[5], h[6], h[7] = share * h[5], share * h[6], share * (h[7] + 1.0) - 1.0
        h[10], h[11] = share * h[10], share * h[11]


@callee(error_model="numpy")
def _inverse3(A):
    """Inverse of a symmetric 3×3 matrix by cofactors."""
    out = np.empty((3, 3))
    out[0, 0] = A[1, 1] * A[2, 2] - A[1, 2] * A[2, 1]
    out[0, 1] = A[0, 2] * A[2, 1] - A[0, 1] * A[2, 2]
    out[0, 2] = A[0, 1] * A[1, 2] - A[0, 2] * A[1, 1]
    out[1, 1] = A[0, 0] * A[2, 2] - A[0, 2] * A[2, 0]
    out[1, 2] = A[0, 2] * A[1, 0] - A[0, 0] * A[1, 2]
    out[2, 2] = A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]
    det = A[0, 0] * out[0, 0] + A[0, 1] * out[0, 1] + A[0, 2] * out[0, 2]
    for i in range(3):
        for j in range(i, 3):
            out[i, j] /= det
            out[j, i] = out[i, j]
    return out


@callee(error_model="numpy")
def _odometry_residual(a, b, u, e):
    """``e = u⁻¹ ∘ (a⁻¹ ∘ b)`` as (x, y, θ), and the between pose a⁻¹ ∘ b in e[3:6]."""
    c, s = math.cos(a[2]), math.sin(a[2])
    dx, dy = b[0] - a[0], b[1] - a[1]
    bx, by, bt = c * dx + s * dy, -s * dx + c * dy, wrap_angle_kernel(b[2] - a[2])
    c, s = math.cos(u[2]), math.sin(u[2])
    dx, dy = bx - u[0], by - u[1]
    e[0], e[1], e[2] = c * dx + s * dy, -s * dx + c * dy, wrap_angle_kernel(bt - u[2])
    e[3], e[4], e[5] = bx, by, bt


@njit(error_model="numpy")
def smoothing_cost(poses, landmarks, evidence, d2, parts):
    """Objective Σ rᵀ Σ⁻¹ r; fills d2 per observation and parts = (odometry, range, bearing) shares."""
    u, W, ob_pose, ob_lm, ob, weight, sensor = evidence
    e = np.empty(6)
    h = np.empty(12)
    base = np.zeros(3)
    parts[:] = 0.0
    for k in range(len(poses)):
        _odometry_residual(base if k == 0 else poses[k - 1], poses[k], u[k], e)
        for r in range(3):
            for q in range(3):
                parts[0] += e[r] * W[k, r, q] * e[q]
    total = parts[0]
    for o in range(len(ob)):
        k, j = ob_pose[o], ob_lm[o]
        observe_landmark(poses[k, 0], poses[k, 1], poses[k, 2], sensor, landmarks[j, 0], landmarks[j, 1], h)
        n0, n1 = ob[o, 0] - h[0], wrap_angle_kernel(ob[o, 1] - h[1])
        a, b = n0 * n0 / ob[o, 2], n1 * n1 / ob[o, 3]
        d2[o] = a + b
        parts[1] += weight[o] * a
        parts[2] += weight[o] * b
        total += weight[o] * d2[o]
    return total


@callee(error_model="numpy")
def _linearise(poses, landmarks, evidence, normal):
    """Fill the normal equations."""
    u, W, ob_pose, ob_lm, ob, weight, sensor = evidence
    A, B, C, H, g, gl = normal
    A[:] = 0.0
    B[:] = 0.0
    C[:] = 0.0
    H[:] = 0.0
    g[:] = 0.0
    gl[:] = 0.0
    e = np.empty(6)
    h = np.empty(12)
    base = np.zeros(3)
    Jb = np.zeros((3, 3))
    Ad = np.zeros((3, 3))
    for k in range(len(poses)):
        _odometry_residual(base if k == 0 else poses[k - 1], poses[k], u[k], e)
        c, s = math.cos(e[2]), math.sin(e[2])
        Jb[0, 0], Jb[0, 1], Jb[0, 2] = c, -s, 0.0
        Jb[1, 0], Jb[1, 1], Jb[1, 2] = s, c, 0.0
        Jb[2, 0], Jb[2, 1], Jb[2, 2] = 0.0, 0.0, 1.0
        M = Jb.T @ W[k]
        r = e[:3].copy()
        A[k] += M @ Jb
        g[k] -= M @ r
        if k > 0:
            # ∂e/∂ξ_{k-1} = -J_b Ad(between⁻¹)
            c, s = math.cos(e[5]), math.sin(e[5])
            ix, iy = -c * e[3] - s * e[4], s * e[3] - c * e[4]
            Ad[0, 0], Ad[0, 1], Ad[0, 2] = c, s, iy
            Ad[1, 0], Ad[1, 1], Ad[1, 2] = -s, c, -ix
            Ad[2, 0], Ad[2, 1], Ad[2, 2] = 0.0, 0.0, 1.0
            Ja = -Jb @ Ad
            Ma = Ja.T @ W[k]
            A[k - 1] += Ma @ Ja
            B[k - 1] += Ma @ Jb
            g[k - 1] -= Ma @ r
    for o in range(len(ob)):
        if weight[o] == 0.0:
            continue
        k, j = ob_pose[o], ob_lm[o]
        observe_landmark(poses[k, 0], poses[k, 1], poses[k, 2], sensor, landmarks[j, 0], landmarks[j, 1], h)
        n0, n1 = ob[o, 0] - h[0], wrap_angle_kernel(ob[o, 1] - h[1])
        bound_bearing_slopes(h, ob[o, 2])
        w0, w1 = weight[o] / ob[o, 2], weight[o] / ob[o, 3]
        for r_ in range(3):
            a0, a1 = h[2 + r_] * w0, h[5 + r_] * w1
            g[k, r_] += a0 * n0 + a1 * n1
            for q in range(3):
                A[k, r_, q] += a0 * h[2 + q] + a1 * h[5 + q]
            for q in range(2):
                C[k, r_, 2 * j + q] += a0 * h[8 + q] + a1 * h[10 + q]
        for r_ in range(2):
            a0, a1 = h[8 + r_] * w0, h[10 + r_] * w1
            gl[2 * j + r_] += a0 * n0 + a1 * n1
            for q in range(2):
                H[2 * j + r_, 2 * j + q] += a0 * h[8 + q] + a1 * h[10 + q]


@callee(error_model="numpy")
def _eliminate(normal, last_seen, Ainv):
    """Eliminate poses 0 … T-2 forwards. Columns of C beyond ``last_seen[k]`` are still zero at pose k."""
    A, B, C, H, g, gl = normal
    T, n = len(A), H.shape[0]
    G = np.empty((3, n))
    for k in range(T - 1):
        Ai = _inverse3(A[k])
        Ainv[k] = Ai
        w = last_seen[k]
        GB = Ai @ B[k]
        gg = Ai @ g[k]
        for r in range(3):
            for q in range(w):
                G[r, q] = Ai[r, 0] * C[k, 0, q] + Ai[r, 1] * C[k, 1, q] + Ai[r, 2] * C[k, 2, q]
        A[k + 1] -= B[k].T @ GB
        g[k + 1] -= B[k].T @ gg
        for r in range(3):
            for q in range(w):
                C[k + 1, r, q] -= B[k, 0, r] * G[0, q] + B[k, 1, r] * G[1, q] + B[k, 2, r] * G[2, q]
        for r in range(w):
            c0, c1, c2 = C[k, 0, r], C[k, 1, r], C[k, 2, r]
            gl[r] -= c0 * gg[0] + c1 * gg[1] + c2 * gg[2]
            if c0 != 0.0 or c1 != 0.0 or c2 != 0.0:
                for q in range(w):
                    H[r, q] -= c0 * G[0, q] + c1 * G[1, q] + c2 * G[2, q]


@callee(error_model="numpy")
def _reduced(A, C, H):
    """Information matrix of {exit pose, landmarks} after the elimination."""
    T, n = len(A), H.shape[0]
    M = np.empty((3 + n, 3 + n))
    M[:3, :3] = A[T - 1]
    M[:3, 3:] = C[T - 1]
    M[3:, :3] = C[T - 1].T
    M[3:, 3:] = H
    return 0.5 * (M + M.T)


@njit(error_model="numpy")
def smooth_kernel(poses, landmarks, evidence, max_iterations, tolerance):
    """Damped Gauss-Newton over poses (T,3) and landmarks (L,2), both updated in place; base pose fixed at identity.

    Returns (objective, iterations, converged). Converged: relative decrease below ``tolerance``.
    """
    T, n = len(poses), 2 * len(landmarks)
    A, B, C = np.empty((T, 3, 3)), np.empty((T, 3, 3)), np.empty((T, 3, n))
    H, g, gl, Ainv = np.empty((n, n)), np.empty((T, 3)), np.empty(n), np.empty((T, 3, 3))
    last_seen = observed_columns(T, n, evidence.ob_pose, evidence.ob_lm)
    normal = NormalBlocks(A, B, C, H, g, gl)
    d2, parts = np.empty(len(evidence.ob)), np.empty(3)
    cost = smoothing_cost(poses, landmarks, evidence, d2, parts)
    new_poses, new_lm = np.empty_like(poses), np.empty_like(landmarks)
    step = np.empty((T, 3))
    rhs = np.empty(3 + n)
    for iteration in range(max_iterations):
        _linearise(poses, landmarks, evidence, normal)
        _eliminate(normal, last_seen, Ainv)
        rhs[:3] = g[T - 1]
        rhs[3:] = gl
        x = np.linalg.solve(_reduced(A, C, H), rhs)
        step[T - 1] = x[:3]
        for k in range(T - 2, -1, -1):
            v = g[k] - B[k] @ step[k + 1]
            for q in range(last_seen[k]):
                for r in range(3):
                    v[r] -= C[k, r, q] * x[3 + q]
            step[k] = Ainv[k] @ v
        scale = 1.0
        for _ in range(12):
            for k in range(T):
                c, s = math.cos(poses[k, 2]), math.sin(poses[k, 2])
                dx, dy = scale * step[k, 0], scale * step[k, 1]
                new_poses[k, 0] = poses[k, 0] + c * dx - s * dy
                new_poses[k, 1] = poses[k, 1] + s * dx + c * dy
                new_poses[k, 2] = wrap_angle_kernel(poses[k, 2] + scale * step[k, 2])
            for j in range(len(landmarks)):
                new_lm[j, 0] = landmarks[j, 0] + scale * x[3 + 2 * j]
                new_lm[j, 1] = landmarks[j, 1] + scale * x[4 + 2 * j]
            new_cost = smoothing_cost(new_poses, new_lm, evidence, d2, parts)
            if new_cost <= cost * (1.0 + 1e-12):
                break
            scale *= 0.5
        if not new_cost <= cost * (1.0 + 1e-12):
            return cost, iteration + 1, False
        gain = cost - new_cost
        cost = new_cost
        poses[:] = new_poses
        landmarks[:] = new_lm
        if gain <= tolerance * max(cost, 1e-9):
            return cost, iteration + 1, True
    return cost, max_iterations, False


@callee
def observed_columns(T, n, ob_pose, ob_lm):
    """last_seen[k]: number of leading landmark columns of poses 0 … k (landmarks in order of first observation)."""
    out = np.zeros(T, np.int64)
    for o in range(len(ob_pose)):
        w = 2 * ob_lm[o] + 2
        if w > out[ob_pose[o]]:
            out[ob_pose[o]] = w
    for k in range(1, T):
        if out[k - 1] > out[k]:
            out[k] = out[k - 1]
    return np.minimum(out, n)


@callee(error_model="numpy")
def _at_optimum(poses, landmarks, evidence):
    """The elimination ``(Ainv, B, C)`` at the optimum, and the joint covariance of {exit pose, landmarks}."""
    T, n = len(poses), 2 * len(landmarks)
    A, B, C = np.empty((T, 3, 3)), np.empty((T, 3, 3)), np.empty((T, 3, n))
    H, g, gl, Ainv = np.empty((n, n)), np.empty((T, 3)), np.empty(n), np.empty((T, 3, 3))
    last_seen = observed_columns(T, n, evidence.ob_pose, evidence.ob_lm)
    normal = NormalBlocks(A, B, C, H, g, gl)
    _linearise(poses, landmarks, evidence, normal)
    _eliminate(normal, last_seen, Ainv)
    joint = np.linalg.inv(_reduced(A, C, H))
    joint = 0.5 * (joint + joint.T)
    return Ainv, B, C, joint


@callee(error_model="numpy")
def _pose_before(Ainv, B, C, Sl, S, X):
    """One step of the backward recursion: covariance of pose k, and with the landmarks, from those of pose k + 1."""
    # pose k given the rest: -Ainv (B ξ_{k+1} + C l), conditional covariance Ainv
    F = Ainv @ B
    G = Ainv @ C
    Xk = -(F @ X + G @ Sl)
    Sk1 = -(F @ S + G @ X.T)  # cov(ξ_k, ξ_{k+1})
    Sk = Ainv - Sk1 @ F.T - Xk @ G.T
    return 0.5 * (Sk + Sk.T), Xk


@njit(error_model="numpy")
def smoothed_covariances(poses, landmarks, evidence):
    """Laplace covariances at the optimum, Gauss-Newton Hessian.

    Returns the joint covariance (3 + 2L, …) of {exit pose (right tangent), landmarks} and the marginal covariances
    (T, 3, 3) of every pose (right tangent), by the backward recursion of the same elimination.
    """
    T = len(poses)
    Ainv, B, C, joint = _at_optimum(poses, landmarks, evidence)
    marginal = np.empty((T, 3, 3))
    marginal[T - 1] = joint[:3, :3]
    Sl = joint[3:, 3:].copy()
    S = joint[:3, :3].copy()  # covariance of pose k+1
    X = joint[:3, 3:].copy()  # its cross-covariance with the landmarks
    for k in range(T - 2, -1, -1):
        S, X = _pose_before(Ainv[k], B[k], C[k], Sl, S, X)
        marginal[k] = S
    return joint, marginal


@njit(error_model="numpy")
def path_covariances(poses, landmarks, evidence, at, G0, G1):
    """Joint covariances of points of the path, by the backward recursion of :func:`smoothed_covariances`.

    Point p moves by ``G0[p] ξ_k + G1[p] ξ_{k+1}`` with k = at[p] (right tangents; k = -1 is the base, which is fixed).

    Parameters
    ----------
    at : (q,)
        In increasing order, -1 ... T - 2.
    G0, G1 : (q, 2, 3)

    Returns
    -------
    cross : (2q, 3 + 2L)
        With {exit pose (right tangent), landmarks}.
    own : (2q, 2q)
    """
    T, n, q = len(poses), 2 * len(landmarks), len(at)
    Ainv, B, C, joint = _at_optimum(poses, landmarks, evidence)
    Sl = joint[3:, :].copy()  # landmarks with {exit, landmarks}
    Y1, S1 = joint[:3, :].copy(), joint[:3, :3].copy()  # pose k + 1 with {exit, landmarks}, and with itself
    Z1 = np.zeros((3, 2 * q))  # pose k + 1 with the points so far
    Zl = np.zeros((n, 2 * q))  # landmarks with the points so far
    cross, own = np.zeros((2 * q, 3 + n)), np.zeros((2 * q, 2 * q))
    p = q - 1
    for k in range(T - 2, -2, -1):
        Y0, Z0, S0, S01 = np.zeros((3, 3 + n)), np.zeros((3, 2 * q)), np.zeros((3, 3)), np.zeros((3, 3))
        if k >= 0:
            F = Ainv[k] @ B[k]
            G = Ainv[k] @ C[k]
            Y0 = -(F @ Y1 + G @ Sl)
            Z0 = -(F @ Z1 + G @ Zl)
            X1 = Y1[:, 3:].copy()
            S01 = -(F @ S1 + G @ X1.T)
            S0 = Ainv[k] - S01 @ F.T - Y0[:, 3:].copy() @ G.T
            S0 = 0.5 * (S0 + S0.T)
        while p >= 0 and at[p] == k:
            a, b = np.ascontiguousarray(G0[p]), np.ascontiguousarray(G1[p])
            mine = slice(2 * p, 2 * p + 2)
            row = a @ Y0 + b @ Y1
            cross[mine] = row
            Z0[:, mine] = S0 @ a.T + S01 @ b.T
            Z1[:, mine] = S01.T.copy() @ a.T + S1 @ b.T
            Zl[:, mine] = row[:, 3:].T
            both = a @ Z0 + b @ Z1
            own[mine] = both
            own[:, mine] = both.T
            p -= 1
        Y1, S1, Z1 = Y0, S0, Z0
    return cross, own


@njit(error_model="numpy")
def second_order_bias(poses, landmarks, evidence):
    """Mean effect of curvature on ranges and bearings, from the covariance of each landmark relative to its sensor.

    The line of sight q, in the frame of the pose, changes by ``F`` times the errors of pose and landmark; with its
    covariance ``Q = F Σ Fᵀ`` a range is on average larger by ``tr(n nᵀ Q) / 2 r`` than at the mean, n across the line
    of sight u, and a bearing is off by ``-uᵀ Q n / r²``. A common rotation changes neither.

    Returns
    -------
    mean : (q, 2)
        Of the change of range and bearing.
    """
    T = len(poses)
    ob_pose, ob_lm, ob, sensor = evidence.ob_pose, evidence.ob_lm, evidence.ob, evidence.sensor
    Ainv, B, C, joint = _at_optimum(poses, landmarks, evidence)
    Sl, S, X = joint[3:, 3:].copy(), joint[:3, :3].copy(), joint[:3, 3:].copy()
    mean = np.zeros((len(ob), 2))
    order = np.argsort(ob_pose, kind="mergesort")
    h, F, P = np.empty(12), np.zeros((2, 5)), np.empty((5, 5))
    F[0, 0] = F[1, 1] = -1.0
    o = len(order) - 1
    for k in range(T - 1, -1, -1):
        if k < T - 1:
            S, X = _pose_before(Ainv[k], B[k], C[k], Sl, S, X)
        c, s = math.cos(poses[k, 2]), math.sin(poses[k, 2])
        F[0, 3], F[0, 4], F[1, 3], F[1, 4] = c, s, -s, c
        P[:3, :3] = S
        while o >= 0 and ob_pose[order[o]] == k:
            i = order[o]
            j = ob_lm[i]
            observe_landmark(poses[k, 0], poses[k, 1], poses[k, 2], sensor, landmarks[j, 0], landmarks[j, 1], h)
            r = max(h[0], math.sqrt(ob[i, 2]))  # a range shorter than its σ gives no direction
            ux, uy = -h[2], -h[3]
            F[0, 2], F[1, 2] = r * uy + sensor[1], -r * ux - sensor[0]
            P[:3, 3:], P[3:, 3:] = X[:, 2 * j : 2 * j + 2], Sl[2 * j : 2 * j + 2, 2 * j : 2 * j + 2]
            P[3:, :3] = P[:3, 3:].T
            Q = F @ P @ F.T
            mean[i, 0] = (uy * uy * Q[0, 0] - 2.0 * ux * uy * Q[0, 1] + ux * ux * Q[1, 1]) / (2.0 * r)
            mean[i, 1] = (ux * uy * (Q[0, 0] - Q[1, 1]) + (uy * uy - ux * ux) * Q[0, 1]) / (r * r)
            o -= 1
    return mean
