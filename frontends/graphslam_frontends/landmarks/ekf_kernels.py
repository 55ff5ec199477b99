"""Compiled EKF-SLAM over the active part of a map: pose and nearby landmarks (compressed filter).

State ``x = [x, y, θ, l_1x, l_1y, …]`` in the frame of the first base, its covariance P dense and symmetric, both in
buffers with n entries in use. The rest of the map (passive landmarks, index B) is not changed: with A₀ the active state
when it was chosen and C = P[A₀, B] at that time, every later cross covariance is P[A, B] = Φ C, and P[B, B] is reduced
by Σ (V C)ᵀ (V C). The kernels update Φ (n, n₀), the rows of V and θ = Σ Vᵀ y; folding them into the map is exact, so
the result equals that of the plain filter (Guivant & Nebot 2001). Reference: ``tests/reference/ekf_slam.py``.

An observation is a row (range, bearing, variance, variance). An infinite bearing variance means that there is no
bearing, and the observation is one equation instead of two.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from graphslam.core.jit import callee, njit
from graphslam_frontends.landmarks.measurement_kernels import observe_landmark, wrap_angle_kernel


class ActiveState(NamedTuple):
    """Data of an update: the active state, and accumulated updates of the passive landmarks."""

    x: Any
    P: Any
    Phi: Any
    V: Any
    theta: Any


class PoseState(NamedTuple):
    """The current pose, with landmarks that are not up to date."""

    pose: Any
    """(3,)"""
    Pvv: Any
    """(3, 3)"""
    cross: Any
    """(3, N): P[pose, B]."""
    shift: Any
    """(N,): change of B since the last fold."""


@njit(error_model="numpy")
def predict_kernel(x, P, n, Phi, n0, u, Q):
    """``x ← x ∘ u``; u (3,) with right-tangent covariance Q (3, 3). Changes the rows and columns of the pose only."""
    c, s = math.cos(x[2]), math.sin(x[2])
    dx, dy = c * u[0] - s * u[1], s * u[0] + c * u[1]
    x[0] += dx
    x[1] += dy
    x[2] = wrap_angle_kernel(x[2] + u[2])
    # F = [[1, 0, -dy], [0, 1, dx], [0, 0, 1]]: rows first, then columns
    for j in range(n):
        P[0, j] -= dy * P[2, j]
        P[1, j] += dx * P[2, j]
    for i in range(3):
        P[i, 0] -= dy * P[i, 2]
        P[i, 1] += dx * P[i, 2]
    for j in range(n0):
        Phi[0, j] -= dy * Phi[2, j]
        Phi[1, j] += dx * Phi[2, j]
    # Q is in the tangent at the new pose: G Q Gᵀ with G = blkdiag(R(θ), 1)
    c, s = math.cos(x[2]), math.sin(x[2])
    a00, a01, a02 = c * Q[0, 0] - s * Q[1, 0], c * Q[0, 1] - s * Q[1, 1], c * Q[0, 2] - s * Q[1, 2]
    a10, a11, a12 = s * Q[0, 0] + c * Q[1, 0], s * Q[0, 1] + c * Q[1, 1], s * Q[0, 2] + c * Q[1, 2]
    P[0, 0] += a00 * c - a01 * s
    P[0, 1] += a00 * s + a01 * c
    P[1, 1] += a10 * s + a11 * c
    P[0, 2] += a02
    P[1, 2] += a12
    P[2, 2] += Q[2, 2]
    for i in range(3):
        for j in range(i + 1, n):
            P[j, i] = P[i, j]


@callee(error_model="numpy")
def linearise_observation(x, k, row, sensor, h, H, nu):
    """Jacobian rows H (2, 5) over [x, y, θ, l_x, l_y] and innovation nu (2,) of active landmark k; returns 1 or 2.

    h (12,) is scratch.
    """
    observe_landmark(x[0], x[1], x[2], sensor, x[3 + 2 * k], x[4 + 2 * k], h)
    nu[0] = row[0] - h[0]
    for r in range(2):  # range and bearing depend on l - p, so ∂/∂p = -∂/∂l in the same frame
        H[r, 0], H[r, 1], H[r, 2] = -h[8 + 2 * r], -h[9 + 2 * r], h[4 + 3 * r]
        H[r, 3], H[r, 4] = h[8 + 2 * r], h[9 + 2 * r]
    if math.isinf(row[3]):
        return 1
    nu[1] = wrap_angle_kernel(row[1] - h[1])
    return 2


@njit(error_model="numpy")
def update_kernel(active, n, n0, first, obs, at, sensor):
    """Exact stacked update by all observations o with ``at[o]`` = active landmark ≥ 0, linearised at the prediction.

    With S = H P Hᵀ + R = L Lᵀ and W = L⁻¹ H P: x += Wᵀ L⁻¹ν, P -= Wᵀ W (square form). V gets the rows L⁻¹ H Φ from
    row ``first`` on. Returns (normalised innovation squared, rows); rows = -1 if S is not positive definite.
    """
    x, P, Phi, V, theta = active
    q = len(obs)
    H, col, nu, var = np.empty((2 * q, 5)), np.empty(2 * q, np.int64), np.empty(2 * q), np.empty(2 * q)
    h, Hk, nk = np.empty(12), np.empty((2, 5)), np.empty(2)
    m = 0
    for o in range(q):
        if at[o] < 0:
            continue
        for r in range(linearise_observation(x, at[o], obs[o], sensor, h, Hk, nk)):
            H[m] = Hk[r]
            col[m], nu[m], var[m] = 3 + 2 * at[o], nk[r], obs[o, 2 + r]
            m += 1
    if m == 0:
        return 0.0, 0
    W = np.empty((m, n))
    for r in range(m):
        h0, h1, h2, h3, h4, c = H[r, 0], H[r, 1], H[r, 2], H[r, 3], H[r, 4], col[r]
        for j in range(n):
            W[r, j] = h0 * P[0, j] + h1 * P[1, j] + h2 * P[2, j] + h3 * P[c, j] + h4 * P[c + 1, j]
        for j in range(n0):
            V[first + r, j] = h0 * Phi[0, j] + h1 * Phi[1, j] + h2 * Phi[2, j] + h3 * Phi[c, j] + h4 * Phi[c + 1, j]
    L = np.empty((m, m))
    for r in range(m):
        for p in range(r + 1):
            c = col[p]
            s = H[p, 0] * W[r, 0] + H[p, 1] * W[r, 1] + H[p, 2] * W[r, 2] + H[p, 3] * W[r, c] + H[p, 4] * W[r, c + 1]
            L[r, p] = s + var[r] if p == r else s
    for r in range(m):  # Cholesky
        for p in range(r + 1):
            s = L[r, p]
            for k in range(p):
                s -= L[r, k] * L[p, k]
            if p < r:
                L[r, p] = s / L[p, p]
            elif s > 0.0:
                L[r, r] = math.sqrt(s)
            else:
                return 0.0, -1
    nis = 0.0
    for r in range(m):  # forward substitution of ν, H P and H Φ together
        for k in range(r):
            f = L[r, k]
            nu[r] -= f * nu[k]
            for j in range(n):
                W[r, j] -= f * W[k, j]
            for j in range(n0):
                V[first + r, j] -= f * V[first + k, j]
        f = 1.0 / L[r, r]
        nu[r] *= f
        nis += nu[r] * nu[r]
        for j in range(n):
            W[r, j] *= f
        for j in range(n0):
            V[first + r, j] *= f
    for r in range(m):
        y = nu[r]
        for j in range(n):
            x[j] += y * W[r, j]
        for j in range(n0):
            theta[j] += y * V[first + r, j]
    x[2] = wrap_angle_kernel(x[2])
    for i in range(n):
        for r in range(m):
            f = W[r, i]
            for j in range(i, n):
                P[i, j] -= f * W[r, j]
            for j in range(n0):
                Phi[i, j] -= f * V[first + r, j]
        for j in range(i + 1, n):
            P[j, i] = P[i, j]
    return nis, m


@njit(error_model="numpy")
def augment_kernel(x, P, n, Phi, n0, row, sensor):
    """Append the landmark seen in ``row`` (range, bearing, variances), with its exact cross covariances."""
    c, s = math.cos(x[2]), math.sin(x[2])
    ax, ay = c * sensor[0] - s * sensor[1], s * sensor[0] + c * sensor[1]
    th = x[2] + sensor[2] + row[1]
    ct, st, r = math.cos(th), math.sin(th), row[0]
    x[n], x[n + 1] = x[0] + ax + r * ct, x[1] + ay + r * st
    # l = p + R(θ) a + r (cos, sin): ∂l/∂θ is the lever arm rotated by 90°
    gx, gy = -(ay + r * st), ax + r * ct
    for j in range(n):
        P[n, j] = P[0, j] + gx * P[2, j]
        P[n + 1, j] = P[1, j] + gy * P[2, j]
    for j in range(n0):
        Phi[n, j] = Phi[0, j] + gx * Phi[2, j]
        Phi[n + 1, j] = Phi[1, j] + gy * Phi[2, j]
    vr, vt = row[2], r * r * row[3]
    P[n, n] = P[n, 0] + gx * P[n, 2] + ct * ct * vr + st * st * vt
    P[n, n + 1] = P[n, 1] + gy * P[n, 2] + ct * st * (vr - vt)
    P[n + 1, n + 1] = P[n + 1, 1] + gy * P[n + 1, 2] + st * st * vr + ct * ct * vt
    P[n + 1, n] = P[n, n + 1]
    for j in range(n):
        P[j, n], P[j, n + 1] = P[n, j], P[n + 1, j]


@njit(error_model="numpy")
def passive_distance_kernel(now, slots, x, P, obs, sensor, out):
    """Lower bound of the Mahalanobis distance² of every observation to each passive landmark, relative to its gate.

    x (N,), P (N, N; lower triangle): at the last fold. P[l, l] only decreases after that, so the innovation covariance
    from it is an upper bound, and the distance a lower one. obs (q, 6): range, bearing, variances, weight with one and
    with two equations. out (len(slots),): least weighted distance².
    """
    pose, Pvv, cross, shift = now
    h = np.empty(12)
    for i in range(len(slots)):
        b = 3 + 2 * slots[i]
        observe_landmark(pose[0], pose[1], pose[2], sensor, x[b] + shift[b], x[b + 1] + shift[b + 1], h)
        S00 = S01 = S11 = 0.0
        for r in range(2):
            g0, g1, g2, g3, g4 = -h[8 + 2 * r], -h[9 + 2 * r], h[4 + 3 * r], h[8 + 2 * r], h[9 + 2 * r]
            v0 = g0 * Pvv[0, 0] + g1 * Pvv[1, 0] + g2 * Pvv[2, 0] + g3 * cross[0, b] + g4 * cross[0, b + 1]
            v1 = g0 * Pvv[0, 1] + g1 * Pvv[1, 1] + g2 * Pvv[2, 1] + g3 * cross[1, b] + g4 * cross[1, b + 1]
            v2 = g0 * Pvv[0, 2] + g1 * Pvv[1, 2] + g2 * Pvv[2, 2] + g3 * cross[2, b] + g4 * cross[2, b + 1]
            w0 = g0 * cross[0, b] + g1 * cross[1, b] + g2 * cross[2, b] + g3 * P[b, b] + g4 * P[b + 1, b]
            w1 = g0 * cross[0, b + 1] + g1 * cross[1, b + 1] + g2 * cross[2, b + 1]
            w1 += g3 * P[b + 1, b] + g4 * P[b + 1, b + 1]
            if r == 0:
                S00 = -h[8] * v0 - h[9] * v1 + h[4] * v2 + h[8] * w0 + h[9] * w1
                S01 = -h[10] * v0 - h[11] * v1 + h[7] * v2 + h[10] * w0 + h[11] * w1
            else:
                S11 = -h[10] * v0 - h[11] * v1 + h[7] * v2 + h[10] * w0 + h[11] * w1
        best = np.inf
        for o in range(len(obs)):
            e0 = obs[o, 0] - h[0]
            s00 = S00 + obs[o, 2]
            if math.isinf(obs[o, 3]):
                d2 = e0 * e0 / s00 * obs[o, 4]
            else:
                e1, s11 = wrap_angle_kernel(obs[o, 1] - h[1]), S11 + obs[o, 3]
                det = s00 * s11 - S01 * S01
                d2 = (s11 * e0 * e0 - 2.0 * S01 * e0 * e1 + s00 * e1 * e1) / det * obs[o, 5]
            best = min(best, d2)
        out[i] = best


@njit
def gather_kernel(P, rows, cols, out):
    """``out[i, j] = P[rows[i], cols[j]]`` of a symmetric matrix stored as its lower triangle."""
    for i in range(len(rows)):
        a = rows[i]
        for j in range(len(cols)):
            b = cols[j]
            out[i, j] = P[a, b] if a >= b else P[b, a]


@njit
def scatter_kernel(P, rows, cols, block):
    """``P[rows[i], cols[j]] = block[i, j]``, stored in the lower triangle."""
    for i in range(len(rows)):
        a = rows[i]
        for j in range(len(cols)):
            b = cols[j]
            if a >= b:
                P[a, b] = block[i, j]
            else:
                P[b, a] = block[i, j]


@njit(error_model="numpy")
def innovation_kernel(x, P, obs, at, sensor):
    """Mahalanobis distance² (q,) of every observation to its active landmark ``at``; 0 if there is none."""
    out = np.zeros(len(obs))
    H, nu, h = np.empty((2, 5)), np.empty(2), np.empty(12)
    ix = np.array([0, 1, 2, 0, 0])
    S = np.zeros((2, 2))
    for o in range(len(obs)):
        if at[o] < 0:
            continue
        ix[3], ix[4] = 3 + 2 * at[o], 4 + 2 * at[o]
        rows = linearise_observation(x, at[o], obs[o], sensor, h, H, nu)
        for r in range(rows):
            for t in range(rows):
                s = obs[o, 2 + r] if r == t else 0.0
                for i in range(5):
                    for j in range(5):
                        s += H[r, i] * P[ix[i], ix[j]] * H[t, j]
                S[r, t] = s
        if rows == 1:
            out[o] = nu[0] * nu[0] / S[0, 0]
        else:
            det = S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]
            out[o] = (S[1, 1] * nu[0] ** 2 - 2.0 * S[0, 1] * nu[0] * nu[1] + S[0, 0] * nu[1] ** 2) / det
    return out
