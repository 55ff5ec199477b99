"""Preintegrate IMU readings between two instants, independently of the initial velocity and attitude.

For a unit with pose (R, p) and velocity v in a frame with gravity g, and for bias-corrected readings
(Forster et al. 2017, eq. 33)::

    R_j = R_i ΔR
    v_j = v_i + g T + R_i Δv
    p_j = p_i + v_i T + ½ g T² + R_i Δp

ΔR, Δv, Δp depend on the readings and on the biases only; their dependence on the biases is known to first order, and
their covariance includes the white noise of the readings and the random walk of the biases.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import ConfigError, DataError
from graphslam.core.geometry import Array, ArrayLike
from graphslam.core.imu import Imu, ImuNoise
from graphslam.core.se3 import quat_multiply, quat_rotate, so3_exp

LEAST_WALK = 1e-4
"""Minimum bias random walk per interval, as a share of the bias σ, so that the factor is not singular."""
LEAST_BIAS = np.array([1e-6, 1e-6, 1e-6, 1e-5, 1e-5, 1e-5])
"""Minimum prior σ of a bias [rad/s, m/s²]."""


@dataclass(frozen=True, slots=True, eq=False)
class Preintegrated:
    """Preintegrated measurements of k time intervals.

    Parameters
    ----------
    seconds : (k,)
        T.
    R : (k, 3, 3)
        ΔR.
    p, v : (k, 3)
    covariance : (k, 15, 15)
        Of ``[φ, p, v, b_g, b_a]``: right tangent of ΔR, Δp, Δv, change of the biases.
    J : (k, 9, 6)
        Of ``[φ, p, v]`` by the biases of gyro and accelerometer.
    bias : (k, 6)
        Bias that was subtracted from the readings.
    """

    seconds: Array
    R: Array
    p: Array
    v: Array
    covariance: Array
    J: Array
    bias: Array

    def __len__(self) -> int:
        return len(self.seconds)


def bias_sigma(noise: ImuNoise) -> Array:
    """Prior σ ``(6,)`` of the biases of gyro [rad/s] and accelerometer [m/s²]."""
    sigma = np.repeat([noise.gyro_bias, noise.accelerometer_bias], 3)
    return np.asarray(np.maximum(sigma, LEAST_BIAS))


def walk_sigma(noise: ImuNoise, seconds: ArrayLike) -> Array:
    """σ ``(..., 6)`` of the change of the biases in ``seconds`` ``(...)``."""
    T = np.asarray(seconds, dtype=np.float64)[..., None]
    sigma = np.repeat([noise.gyro_walk, noise.accelerometer_walk], 3) * np.sqrt(T)
    return np.asarray(np.maximum(sigma, LEAST_WALK * bias_sigma(noise)))


def preintegrate(imu: Imu, begin: ArrayLike, end: ArrayLike, bias: ArrayLike = 0.0) -> Preintegrated:
    """Preintegrate readings over time intervals.

    Parameters
    ----------
    begin, end : (k,)
        ``begin < end`` [s], inside the readings.
    bias : (6,) or (k, 6)
        Of gyro and accelerometer.
    """
    from graphslam.graph.factors.imu.imu_kernels import preintegrate_spans  # numba is slow to load

    t0, t1 = (np.atleast_1d(np.asarray(t, dtype=np.float64)) for t in (begin, end))
    n = imu.noise
    if not (n.gyro > 0 and n.accelerometer > 0):
        raise ConfigError(f"IMU without noise cannot be weighed: gyro {n.gyro}, accelerometer {n.accelerometer}")
    wrong = ~((t0 < t1) & (t0 >= imu.times[0]) & (t1 <= imu.times[-1])) if len(imu.times) > 1 else np.ones_like(t0) > 0
    if np.any(wrong):
        k = int(np.flatnonzero(wrong)[0])
        span = f"[{imu.times[0]:.3f}, {imu.times[-1]:.3f}] s" if len(imu.times) else "no readings"
        raise DataError(f"span {k} is not inside the readings of the IMU", got=(t0[k], t1[k]), wanted=span)
    b = np.ascontiguousarray(np.broadcast_to(np.asarray(bias, dtype=np.float64), (len(t0), 6)))
    noise = np.array([n.gyro, n.gyro_walk, n.accelerometer, n.accelerometer_walk])
    R, p, v, P, J = preintegrate_spans(imu.times, imu.angular_rate, imu.specific_force, t0, t1, b, noise)
    k6 = np.arange(9, 15)
    P[:, k6, k6] = np.maximum(P[:, k6, k6], (LEAST_WALK * bias_sigma(n)) ** 2)
    return Preintegrated(t1 - t0, R, p, v, P, J, b)


def longest_pause(times: Array, begin: Array, end: Array) -> Array:
    """Longest time ``(k,)`` [s] without a reading inside or around each interval within ``times``."""
    gaps = np.diff(times)
    i = np.clip(np.searchsorted(times, begin, side="right") - 1, 0, len(gaps) - 1)
    j = np.clip(np.searchsorted(times, end, side="left"), i + 1, len(gaps))
    return np.array([gaps[a:b].max() for a, b in zip(i.tolist(), j.tolist())])


def mean_force(imu: Imu, at: Array, half: float) -> tuple[Array, npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """Mean specific force around instants, rotated into the unit's axes at each instant with the gyro.

    Parameters
    ----------
    at : (k,)
        With ``half`` seconds of readings before and after.

    Returns
    -------
    force : (k, 3)
    count : (k,) int
        Number of readings; 0 if there are none.
    still : (k,) bool
        The standard deviations of rates and forces are below three times their noise.
    """
    rate_hz = 1.0 / float(np.median(np.diff(imu.times)))
    limits = 3.0 * np.sqrt(rate_hz) * np.array([imu.noise.gyro, imu.noise.accelerometer])
    force, count = np.zeros((len(at), 3)), np.zeros(len(at), dtype=np.int64)
    still: npt.NDArray[np.bool_] = np.zeros(len(at), dtype=np.bool_)
    for k, t in enumerate(at.tolist()):
        a, b = np.searchsorted(imu.times, [t - half, t + half])
        if b - a < 3:
            continue
        w, f, dt = imu.angular_rate[a:b], imu.specific_force[a:b], np.diff(imu.times[a:b])
        mid = int(np.argmin(np.abs(imu.times[a:b] - t)))
        q = np.empty((b - a, 4))
        q[mid] = [0.0, 0.0, 0.0, 1.0]
        turns = so3_exp(0.5 * (w[:-1] + w[1:]) * dt[:, None])
        for m in range(mid, b - a - 1):
            q[m + 1] = quat_multiply(q[m], turns[m])
        for m in range(mid, 0, -1):
            q[m - 1] = quat_multiply(q[m], turns[m - 1] * [-1.0, -1.0, -1.0, 1.0])
        force[k], count[k] = quat_rotate(q, f).mean(axis=0), b - a
        still[k] = bool(w.std(axis=0).max() < limits[0] and f.std(axis=0).max() < limits[1])
    return force, count, still
