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
from graphslam.graph.factors.imu.preintegration import Preintegrated, preintegrate

FIRST = 8
"""Positions of the first stretch that is solved; each next one is twice as long."""
ROUNDS = 4
"""Gauss–Newton steps on the bias in each stretch."""
PLACE, SPEED = slice(3, 6), slice(6, 9)
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

    Raises
    ------
    DataError
        Fewer than four positions, or readings do not cover them.
    """
    n = len(times)
    if n < 4:
        raise DataError("a start by positions needs four of them", got=n)
    bias, stretch = np.zeros(3), FIRST
    while True:
        stretch = min(stretch, n)
        at, points = times[:stretch], positions[:stretch]
        for _ in range(ROUNDS):
            pim = preintegrate(imu, at[:-1], at[1:], np.append(bias, np.zeros(3)))
            r, R = _contradiction(pim, points, np.zeros(3))
            J = np.stack([(_contradiction(pim, points, d)[0] - r) / STEP for d in STEP * np.eye(3)], axis=1)
            scale = 1e-6 * np.trace(J.T @ J) / 3.0  # an axis about which nothing turned stays as it is
            bias = bias - np.linalg.solve(J.T @ J + scale * np.eye(3), J.T @ r)
        if stretch == n:
            return matrix_to_quat(R), bias
        stretch *= 2


def turned_on(attitude: Array, imu: Imu, times: Array, bias: Array) -> Array:
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
