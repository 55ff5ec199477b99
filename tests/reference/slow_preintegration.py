"""Preintegration one reading after the other, in plain words and without a covariance."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from graphslam.core.imu import Imu


def slow_preintegrate(imu: Imu, begin: float, end: float, bias: np.ndarray) -> tuple[Rotation, np.ndarray, np.ndarray]:
    """ΔR, Δp, Δv between two instants: readings joined by straight lines, a middle attitude in every step."""
    stamps = [begin, *(t for t in imu.times if begin < t < end), end]

    def reading(t: float) -> np.ndarray:
        both = np.hstack([imu.angular_rate, imu.specific_force])
        return np.array([np.interp(t, imu.times, both[:, k]) for k in range(6)]) - bias

    R, p, v = Rotation.identity(), np.zeros(3), np.zeros(3)
    for a, b in pairwise(stamps):
        dt, mean = b - a, 0.5 * (reading(a) + reading(b))
        turn, force = mean[:3], mean[3:]
        f = (R * Rotation.from_rotvec(0.5 * dt * turn)).apply(force)
        p = p + v * dt + 0.5 * f * dt**2
        v = v + f * dt
        R = R * Rotation.from_rotvec(dt * turn)
    return R, p, v
