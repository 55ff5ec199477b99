"""Compiled preintegration of inertial readings (Forster et al., On-Manifold Preintegration, 2017, section V).

The error state is ``[φ, p, v, b_g, b_a]``: right tangent of ΔR, then Δp and Δv, then gyro and accelerometer biases at
the end minus their assumed values.
"""

from __future__ import annotations

import math

import numpy as np

from graphslam.core.jit import callee, njit


@callee
def _turn(w, R, J):
    """``Exp(w)`` and its right Jacobian, both (3, 3), in place."""
    x, y, z = w[0], w[1], w[2]
    t2 = x * x + y * y + z * z
    if t2 < 1e-8:
        s, c, b = 1.0 - t2 / 6.0, 0.5 - t2 / 24.0, 1.0 / 6.0 - t2 / 120.0
    else:
        t = math.sqrt(t2)
        s, c, b = math.sin(t) / t, (1.0 - math.cos(t)) / t2, (t - math.sin(t)) / (t2 * t)
    O = np.zeros((3, 3))
    O[0, 1], O[0, 2], O[1, 2] = -z, y, -x
    O[1, 0], O[2, 0], O[2, 1] = z, -y, x
    for i in range(3):
        for j in range(3):
            o2 = O[i, 0] * O[0, j] + O[i, 1] * O[1, j] + O[i, 2] * O[2, j]
            one = 1.0 if i == j else 0.0
            R[i, j] = one + s * O[i, j] + c * o2
            J[i, j] = one - c * O[i, j] + b * o2


@callee
def _step(w, a, dt, noise, state):
    """One step over ``dt`` with constant, bias-corrected rate ``w`` and force ``a``; updates the state in place."""
    R, p, v, P, Phi = state
    half, J_half, whole, J_whole = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    _turn(0.5 * dt * w, half, J_half)
    _turn(dt * w, whole, J_whole)
    R_m = R @ half  # attitude in the middle of the step, at which the force is applied
    f = R_m @ a
    S = np.zeros((3, 3))
    S[0, 1], S[0, 2], S[1, 2] = -a[2], a[1], -a[0]
    S[1, 0], S[2, 0], S[2, 1] = a[2], -a[1], a[0]
    M = -R_m @ S  # derivative of the force by a right rotation of R_m
    M_phi = M @ half.T  # R Exp(φ) Exp(w/2) = R_m Exp(Exp(-w/2) φ)
    M_g = -0.5 * dt * (M @ J_half)  # the gyro bias rotates R_m
    A = np.eye(15)
    A[:3, :3] = whole.T
    A[:3, 9:12] = -dt * J_whole
    A[3:6, :3] = 0.5 * dt * dt * M_phi
    A[3:6, 6:9] = dt * np.eye(3)
    A[3:6, 9:12] = 0.5 * dt * dt * M_g
    A[3:6, 12:] = -0.5 * dt * dt * R_m
    A[6:9, :3] = dt * M_phi
    A[6:9, 9:12] = dt * M_g
    A[6:9, 12:] = -dt * R_m
    # white noise of a step has the variance σ² / dt and enters like a bias (eq. 62); bias random walk: σ² dt
    G = A[:9, 9:].copy()
    for k in range(6):
        G[:, k] *= noise[0 if k < 3 else 2] / math.sqrt(dt)
    P[:, :] = A @ P @ A.T
    P[:9, :9] += G @ G.T
    for k in range(6):
        walk = noise[1 if k < 3 else 3]
        P[9 + k, 9 + k] += walk * walk * dt
    Phi[:, :] = A @ Phi
    p += dt * v + 0.5 * dt * dt * f
    v += dt * f
    R[:, :] = R @ whole


@njit
def preintegrate_spans(times, rate, force, begin, end, bias, noise):
    """Preintegrate over many time intervals.

    Readings are interpolated linearly; a step is from one reading to the next, or to an end of the interval.

    Parameters
    ----------
    times : (n,)
    rate, force : (n, 3)
    begin, end : (k,)
        Inside ``times``.
    bias : (k, 6)
        Of gyro and accelerometer, subtracted.
    noise : (4,)
        Densities: gyro, gyro bias random walk, accelerometer, accelerometer bias random walk.

    Returns
    -------
    R : (k, 3, 3)
    p, v : (k, 3)
    P : (k, 15, 15)
    J : (k, 9, 6)
        Of ``[φ, p, v]`` by the biases.
    """
    k = len(begin)
    R_out, p_out, v_out = np.empty((k, 3, 3)), np.empty((k, 3)), np.empty((k, 3))
    P_out, J_out = np.empty((k, 15, 15)), np.empty((k, 9, 6))
    for s in range(k):
        R, p, v = np.eye(3), np.zeros(3), np.zeros(3)
        P, Phi = np.zeros((15, 15)), np.eye(15)
        i = max(np.searchsorted(times, begin[s], side="right") - 1, 0)
        t = begin[s]
        w0, a0 = np.empty(3), np.empty(3)
        w1, a1 = np.empty(3), np.empty(3)
        while t < end[s] and i + 1 < len(times):
            to = min(times[i + 1], end[s])
            dt = to - t
            if dt > 0.0:
                span = times[i + 1] - times[i]
                u0, u1 = (t - times[i]) / span, (to - times[i]) / span
                for c in range(3):
                    w0[c] = rate[i, c] + u0 * (rate[i + 1, c] - rate[i, c])
                    w1[c] = rate[i, c] + u1 * (rate[i + 1, c] - rate[i, c])
                    a0[c] = force[i, c] + u0 * (force[i + 1, c] - force[i, c])
                    a1[c] = force[i, c] + u1 * (force[i + 1, c] - force[i, c])
                _step(0.5 * (w0 + w1) - bias[s, :3], 0.5 * (a0 + a1) - bias[s, 3:], dt, noise, (R, p, v, P, Phi))
            t = to
            i += 1
        R_out[s], p_out[s], v_out[s] = R, p, v
        P_out[s] = 0.5 * (P + P.T)
        J_out[s] = Phi[:9, 9:]
    return R_out, p_out, v_out, P_out, J_out
