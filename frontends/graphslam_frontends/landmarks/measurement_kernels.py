"""Compiled measurement model of a point landmark, and small matrix operations of the filters.

An observation has the channels range and bearing; with an infinite bearing variance it has the range only
(:func:`inverse_innovation` drops the channel), so one filter covers range-bearing and range-only.
"""

from __future__ import annotations

import math

import numpy as np

from graphslam.core.jit import callee, njit

TWO_PI = 2.0 * math.pi
LOG_2PI = math.log(TWO_PI)


@njit(inline="always")
def wrap_angle_kernel(a):
    """Wrap an angle to (-π, π]."""
    return math.pi - (math.pi - a) % TWO_PI


@callee(error_model="numpy")
def observe_landmark(x, y, th, sensor, lx, ly, out):
    """Range, bearing and their Jacobians for a landmark (lx, ly) from pose (x, y, th) with ``sensor (3,)``.

    out[0:2] range, bearing; out[2:8] rows of ∂/∂ξ (right tangent of the pose); out[8:12] rows of ∂/∂l.
    """
    ax, ay, ath = sensor[0], sensor[1], sensor[2]
    c, s = math.cos(th), math.sin(th)
    dx, dy = lx - (x + c * ax - s * ay), ly - (y + s * ax + c * ay)
    r = math.sqrt(dx * dx + dy * dy)
    if r < 1e-6:
        r = 1e-6
    ux, uy = dx / r, dy / r
    ex, ey = c * ux + s * uy, -s * ux + c * uy  # line of sight in the body frame
    out[0] = r
    out[1] = wrap_angle_kernel(math.atan2(dy, dx) - th - ath)
    out[2], out[3], out[4] = -ex, -ey, ex * ay - ey * ax
    out[5], out[6], out[7] = ey / r, -ex / r, (-ey * ay - ex * ax) / r - 1.0
    out[8], out[9], out[10], out[11] = ux, uy, -uy / r, ux / r


@njit(inline="always")
def pose_block(h, P):
    """``H_x P H_xᵀ`` (three numbers: 00, 01, 11) for the Jacobian rows h[2:8]."""
    a0 = h[2] * P[0, 0] + h[3] * P[1, 0] + h[4] * P[2, 0]
    a1 = h[2] * P[0, 1] + h[3] * P[1, 1] + h[4] * P[2, 1]
    a2 = h[2] * P[0, 2] + h[3] * P[1, 2] + h[4] * P[2, 2]
    b0 = h[5] * P[0, 0] + h[6] * P[1, 0] + h[7] * P[2, 0]
    b1 = h[5] * P[0, 1] + h[6] * P[1, 1] + h[7] * P[2, 1]
    b2 = h[5] * P[0, 2] + h[6] * P[1, 2] + h[7] * P[2, 2]
    return (
        a0 * h[2] + a1 * h[3] + a2 * h[4],
        a0 * h[5] + a1 * h[6] + a2 * h[7],
        b0 * h[5] + b1 * h[6] + b2 * h[7],
    )


@njit(inline="always")
def landmark_block(h, c0, c1, c2):
    """``H_l Σ H_lᵀ`` (00, 01, 11) for Σ = [[c0, c1], [c1, c2]]."""
    a0, a1 = h[8] * c0 + h[9] * c1, h[8] * c1 + h[9] * c2
    b0, b1 = h[10] * c0 + h[11] * c1, h[10] * c1 + h[11] * c2
    return a0 * h[8] + a1 * h[9], a0 * h[10] + a1 * h[11], b0 * h[10] + b1 * h[11]


@callee(error_model="numpy")
def pose_update(m, P, h, nu0, nu1, i00, i01, i11):
    """EKF update of the proposal Gaussian (mean pose m, right-tangent covariance P) by one observation."""
    G = np.empty((3, 2))
    for r in range(3):
        G[r, 0] = P[r, 0] * h[2] + P[r, 1] * h[3] + P[r, 2] * h[4]
        G[r, 1] = P[r, 0] * h[5] + P[r, 1] * h[6] + P[r, 2] * h[7]
    K = np.empty((3, 2))
    for r in range(3):
        K[r, 0] = G[r, 0] * i00 + G[r, 1] * i01
        K[r, 1] = G[r, 0] * i01 + G[r, 1] * i11
    for r in range(3):
        for q in range(3):
            P[r, q] -= K[r, 0] * G[q, 0] + K[r, 1] * G[q, 1]
    for r in range(3):  # symmetrise: rounding must not accumulate over many features
        for q in range(r):
            P[r, q] = P[q, r] = 0.5 * (P[r, q] + P[q, r])
    retract_pose(m, K[0, 0] * nu0 + K[0, 1] * nu1, K[1, 0] * nu0 + K[1, 1] * nu1, K[2, 0] * nu0 + K[2, 1] * nu1)


@njit(inline="always")
def retract_pose(m, dx, dy, dth):
    """``m ← m ∘ (dx, dy, dθ)``; first-order retraction, equal to Exp to the order of the filter."""
    c, s = math.cos(m[2]), math.sin(m[2])
    m[0] += c * dx - s * dy
    m[1] += s * dx + c * dy
    m[2] = wrap_angle_kernel(m[2] + dth)


@callee(error_model="numpy")
def cholesky3(P, L):
    """Lower Cholesky factor of a 3×3 covariance; a direction without variance gets a zero column."""
    L[:] = 0.0
    for i in range(3):
        for j in range(i + 1):
            s = P[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                L[i, i] = math.sqrt(s) if s > 0.0 else 0.0
            elif L[j, j] > 0.0:
                L[i, j] = s / L[j, j]


@callee(error_model="numpy")
def sample_pose(m, P, z, L):
    """``m ← m ∘ L z`` with P = L Lᵀ and z standard normal."""
    cholesky3(P, L)
    retract_pose(m, L[0, 0] * z[0], L[1, 0] * z[0] + L[1, 1] * z[1], L[2, 0] * z[0] + L[2, 1] * z[1] + L[2, 2] * z[2])


@njit(inline="always")
def inverse_innovation(s00, s01, s11):
    """Inverse (00, 01, 11) and determinant of an innovation covariance; of its range only if s11 is infinite."""
    if math.isinf(s11):
        return 1.0 / s00, 0.0, 0.0, s00
    det = s00 * s11 - s01 * s01
    return s11 / det, -s01 / det, s00 / det, det


@njit(inline="always")
def log_2pi_channels(vb):
    """``k/2 · log 2π`` of an observation with k channels: 2, or 1 if its bearing variance ``vb`` is infinite."""
    return 0.5 * LOG_2PI if math.isinf(vb) else LOG_2PI
