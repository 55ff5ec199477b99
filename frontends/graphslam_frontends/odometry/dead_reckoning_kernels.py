"""Compiled complementary filter of dead reckoning."""

from __future__ import annotations

import math

import numpy as np

from graphslam.core.jit import njit


@njit(error_model="numpy")
def complementary_kernel(times, rate, seen, time_constant, first, up):
    """Up direction in the base from a gyro, pulled towards the one that the accelerometer shows.

    times : (n,) [s]; rate : (n, 3) [rad/s]; seen : (n, 3) unit vectors.
    time_constant : of the pull [s]. first : (3,) unit vector to start from. up : (n, 3) out, unit vectors.
    """
    u = np.empty(3)
    u[:] = first
    up[0] = u
    for k in range(1, len(times)):
        h = times[k] - times[k - 1]
        # a fixed direction rotates backwards in a rotating body: du/dt = -ω × u, over h by Rodrigues' formula
        wx = -0.5 * (rate[k, 0] + rate[k - 1, 0]) * h
        wy = -0.5 * (rate[k, 1] + rate[k - 1, 1]) * h
        wz = -0.5 * (rate[k, 2] + rate[k - 1, 2]) * h
        angle2 = wx * wx + wy * wy + wz * wz
        if angle2 < 1e-8:
            a, b = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
        else:
            angle = math.sqrt(angle2)
            a, b = math.sin(angle) / angle, 2.0 * math.sin(0.5 * angle) ** 2 / angle2
        cx, cy, cz = wy * u[2] - wz * u[1], wz * u[0] - wx * u[2], wx * u[1] - wy * u[0]
        dx, dy, dz = wy * cz - wz * cy, wz * cx - wx * cz, wx * cy - wy * cx
        u[0] += a * cx + b * dx
        u[1] += a * cy + b * dy
        u[2] += a * cz + b * dz
        pull = 1.0 - math.exp(-h / time_constant)
        for i in range(3):
            u[i] += pull * (seen[k, i] - u[i])
        norm = math.sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2])
        for i in range(3):
            u[i] /= norm
            up[k, i] = u[i]
