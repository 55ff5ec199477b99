"""Where a body that carries an IMU stands at first, told by positions: attitudes in their frame, bias of the gyro.

Between three positions the readings say how the velocity changed, in the frame of the body; the positions say it in
theirs. With the turns of the gyro all such pairs are of one unknown rotation, which is the solution of Wahba's problem,
and of one unknown bias, by which turns over a long time are wrong. No body has to stand still for it.
"""

from __future__ import annotations

import numpy as np

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.imu import GRAVITY, Imu
from graphslam.core.se3 import matrix_to_quat, quat_to_matrix, so3_exp
from graphslam.graph.factors.imu.preintegration import Preintegrated, bias_sigma, preintegrate

FIRST = 8
"""Positions of the first stretch that is solved; each next one is twice as long."""
ROUNDS = 4
"""Gauss–Newton steps on the bias in each stretch."""
PLACE, SPEED = slice(3, 6), slice(6, 9)
SPEED_SIGMA = 0.2
"""Of a change of velocity by positions and readings, where the two are compared [m/s]."""
STEP = 1e-4
"""Of the numerical derivative by the bias [rad/s]."""


def inertial_start(imu: Imu, times: Array, positions: Array) -> tuple[Array, Array]:
    """Attitude at the first position, and the gyro's bias.

    Parameters
    ----------
    imu : Imu
        At the body's own place and axes; a mounting is not looked at.
    times : (n,)
        Inside the readings [s].
    positions : (n, 3)
        East, north, up or any other frame whose z axis is up [m].

    Returns
    -------
    attitude : (4,)
        Quaternion of the body in the frame of the positions at the first of ``times``.
    bias : (3,)
        [rad/s]
    """
    n = len(times)
    if n < 4:
        raise DataError("a start by positions needs four of them", got=n)
    sigma, stretch = bias_sigma(imu.noise)[:3], min(FIRST, n)
    # over a long first stretch an unknown bias turns by radians, so that several are tried
    starts = np.concatenate([np.zeros((1, 3)), np.diag(sigma), -np.diag(sigma)])
    tried = [_converged(imu, times[:stretch], positions[:stretch], start) for start in starts]
    while True:
        _, bias, R = min(tried, key=lambda found: found[0])
        if stretch == n:
            return matrix_to_quat(R), bias
        stretch = min(2 * stretch, n)
        tried = [_converged(imu, times[:stretch], positions[:stretch], bias)]


def _converged(imu: Imu, times: Array, positions: Array, bias: Array) -> tuple[float, Array, Array]:
    """Cost, bias and first attitude after some Gauss–Newton steps from a bias; a large one is dear, as its σ says."""
    weight = (SPEED_SIGMA / bias_sigma(imu.noise)[:3]) ** 2
    for _ in range(ROUNDS):
        pim = preintegrate(imu, times[:-1], times[1:], np.append(bias, np.zeros(3)))
        r, R = _contradiction(pim, positions, np.zeros(3))
        J = np.stack([(_contradiction(pim, positions, d)[0] - r) / STEP for d in STEP * np.eye(3)], axis=1)
        here = float(r @ r + weight @ bias**2), bias, R
        bias = bias - np.linalg.solve(J.T @ J + np.diag(weight), J.T @ r + weight * bias)
    return here


def integrate_attitude(attitude: Array, imu: Imu, times: Array, bias: Array) -> Array:
    """Attitudes ``(n, 4)`` at ``times`` ``(n,)`` by the gyro less its bias ``(3,)``, from that at the first."""
    R = [quat_to_matrix(attitude)]
    for turn in preintegrate(imu, times[:-1], times[1:], np.append(bias, np.zeros(3))).R:
        R.append(R[-1] @ turn)
    return np.array([matrix_to_quat(r) for r in R])


def _contradiction(pim: Preintegrated, positions: Array, bias: Array) -> tuple[Array, Array]:
    """Changes of velocity by positions less those by readings ``(3k,)``, and the first attitude ``(3, 3)``.

    ``bias`` is what the gyro's is more than the readings were integrated with, to first order.
    """
    moved = pim.J[:, :, :3] @ bias
    turns = pim.R @ quat_to_matrix(so3_exp(moved[:, :3]))
    p, dv = pim.p + moved[:, PLACE], pim.v + moved[:, SPEED]
    T = pim.seconds[:, None]
    v = np.diff(positions, axis=0) / T
    seen = v[1:] - v[:-1] + 0.5 * GRAVITY * (T[1:] + T[:-1]) * [0.0, 0.0, 1.0]
    turned = [np.eye(3)]
    for R in turns[:-2]:
        turned.append(turned[-1] @ R)
    ahead = (turns[:-1] @ (p[1:] / T[1:])[..., None])[..., 0]
    read = (np.array(turned) @ (ahead + dv[:-1] - p[:-1] / T[:-1])[..., None])[..., 0]
    U, _, Vt = np.linalg.svd(seen.T @ read)
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return (seen - read @ R.T).ravel(), R
