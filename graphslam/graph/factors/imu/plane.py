"""An IMU in a 2-D graph: the 3-D equations, of which yaw and two axes are kept.

A planar body rotates about its vertical axis only. So readings are rotated into the axes of the body, and only the yaw
rate and two accelerations are used; for a level body they contain no gravity. Poses, velocities and biases
are embedded in 3-D, with the same preintegration and residuals
(:mod:`graphslam.graph.factors.imu.batch`); rows and columns out of the plane are omitted because they are zero.

A unit with three axes measures gravity too. If the body leans by β, ``g sin β`` of it is in the plane, which a planar
path cannot explain. It is modelled as an accelerometer bias with an initial σ for :data:`LEAN`, and a random walk of
the same size in :data:`LEAN_TIME`.
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
"""σ of roll and pitch of a planar body, due to mounting and floor [rad]."""
LEAN_TIME = 10.0
"""Time in which they change by that σ [s]."""
LEVEL_FORCE = 0.1 * GRAVITY
"""Tolerance of the mean vertical force of a level unit with three axes, relative to gravity [m/s²]."""

_SIZE = {"x": 7, "velocity": 3, "imubias": 6}
IN_PLANE = {"x": [3, 4, 2], "velocity": [0, 1], "imubias": [2, 3, 4]}
"""Degrees of freedom in 3-D that 2-D has, in the order of 2-D."""


def lift(word: str, rows: Array) -> Array:
    """Values ``(k, size)`` of a kind of variable embedded in 3-D; 3-D values are unchanged."""
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
    """Covariances ``(k, 3, 3)`` of 2-D poses as ``(k, 6, 6)`` of 3-D poses (right tangents)."""
    if P.shape[-1] == 6:
        return P
    out = np.zeros((len(P), 6, 6))
    out[:, np.array(IN_PLANE["x"])[:, None], IN_PLANE["x"]] = P
    return out


def lift_path(path: Trajectory) -> Trajectory:
    """A path embedded in 3-D; a 2-D path loses its covariances."""
    return path if path.dim == 3 else Trajectory(path.times, lift("x", path.poses))


def with_gravity(imu: Imu) -> Imu:
    """The readings of a level unit, with gravity in the specific force."""
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
        Components out of the plane are zero; ``T_base_imu`` is a translation. The noise of a unit with three axes
        includes the planar component of gravity of a leaning body.
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
