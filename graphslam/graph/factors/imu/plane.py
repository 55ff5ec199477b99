"""An IMU in a graph of the plane: the equations of space, of which yaw and two axes are kept.

A body in the plane turns about its vertical axis alone. So readings are turned into the axes of the body, and what is
left of them is the yaw rate and two accelerations; a level body has no gravity in these. Poses, velocities and biases
are embedded in space, where the same preintegration and the same residuals hold
(:mod:`graphslam.graph.factors.imu.batch`); rows and columns out of the plane are left out, since they are zero.

A unit with three axes sees gravity as well. A body that leans by β has ``g sin β`` of it in the plane, which a path
cannot say. It enters as a bias of the accelerometer: at the start within :data:`LEAN`, and walking by as much in
:data:`LEAN_TIME`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.imu import GRAVITY, Imu
from graphslam.core.se3 import quat_rotate
from graphslam.core.trajectory import Trajectory

LEAN = 0.01
"""σ of roll and pitch of a body that moves in a plane: mounting and floor [rad]."""
LEAN_TIME = 10.0
"""Time in which they change by that much [s]."""
LEVEL_FORCE = 0.1 * GRAVITY
"""The mean vertical force of a level unit with three axes is gravity within this [m/s²]."""

_SIZE = {"x": 7, "velocity": 3, "imubias": 6}
IN_PLANE = {"x": [3, 4, 2], "velocity": [0, 1], "imubias": [2, 3, 4]}
"""Degrees of freedom of space that the plane has, in the order of the plane's."""


def lift(word: str, rows: Array) -> Array:
    """Values ``(k, size)`` of a kind of variable as they stand in space; those of space as they are."""
    if rows.shape[-1] == _SIZE[word]:
        return rows
    out = np.zeros((len(rows), _SIZE[word]))
    if word == "x":
        out[:, :2] = rows[:, :2]
        out[:, 5], out[:, 6] = np.sin(0.5 * rows[:, 2]), np.cos(0.5 * rows[:, 2])
    else:
        out[:, IN_PLANE[word]] = rows
    return out


def lift_covariances(P: Array) -> Array:
    """Covariances ``(k, 3, 3)`` of poses of the plane as ``(k, 6, 6)`` of space (right tangents)."""
    if P.shape[-1] == 6:
        return P
    out = np.zeros((len(P), 6, 6))
    out[:, np.array(IN_PLANE["x"])[:, None], IN_PLANE["x"]] = P
    return out


def lift_path(path: Trajectory) -> Trajectory:
    """A path as it stands in space, without its covariances."""
    return path if path.dim == 3 else Trajectory(path.times, lift("x", path.poses))


def with_gravity(imu: Imu) -> Imu:
    """The readings of a level unit, gravity among them."""
    if not imu.planar:
        return imu
    up = quat_rotate(imu.T_base_imu[3:] * [-1.0, -1.0, -1.0, 1.0], np.array([0.0, 0.0, GRAVITY]))
    return replace(imu, specific_force=imu.specific_force + up)


def planar_imu(imu: Imu, where: str) -> Imu:
    """Yaw rate and accelerations in the axes of the body, which is level.

    Parameters
    ----------
    imu : Imu
        Planar, or of three axes on a level body.

    Returns
    -------
    Imu
        Entries out of the plane are zero; ``T_base_imu`` is a shift. The noise of a unit with three axes holds the
        gravity that a body which leans has in the plane.
    """
    rate, force = (quat_rotate(imu.T_base_imu[3:], a) for a in (imu.angular_rate, imu.specific_force))
    noise = imu.noise
    if not imu.planar and len(force):
        mean = force.mean(axis=0)
        if not abs(mean[2] - GRAVITY) < LEVEL_FORCE:
            raise DataError(
                "an IMU with three axes that is to be used in the plane is not level", where=where,
                got=f"mean specific force {np.array2string(mean, precision=2)} m/s² in the axes of the body",
                wanted=f"(0, 0, {GRAVITY:.2f}): T_base_imu as it is mounted; or gravity taken out, with angular rates "
                "about x and y and forces along z of zero",
            )  # fmt: skip
        lean = GRAVITY * LEAN
        noise = replace(
            noise,
            accelerometer_bias=float(np.hypot(noise.accelerometer_bias, lean)),
            accelerometer_walk=float(np.hypot(noise.accelerometer_walk, lean / np.sqrt(LEAN_TIME))),
        )
    return replace(
        imu, angular_rate=rate * [0.0, 0.0, 1.0], specific_force=force * [1.0, 1.0, 0.0], noise=noise, attitude=None,
        T_base_imu=np.array([*imu.T_base_imu[:2], 0.0, 0.0, 0.0, 0.0, 1.0]),
    )  # fmt: skip
