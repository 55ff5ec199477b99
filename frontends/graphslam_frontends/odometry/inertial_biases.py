"""What dead reckoning from an IMU and wheels gives: poses, and the errors they share.

Errors of an IMU last: one bias of the gyro bends the whole path, and increments that pretend to be independent promise
a path many times better than it is. The errors that last are therefore carried in the error state, and the covariance
of a motion over any interval is had by running that state through the interval.

Error state (12), true minus estimated, position in the frame of the path: heading; x, y, z; bias of the gyro (3, base
frame); scale of the wheels; roll and pitch that fade (Ornstein-Uhlenbeck, 2); roll and pitch that last (2).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from graphslam.core import se3
from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.records import Odometry
from graphslam.core.trajectory import Trajectory
from graphslam_frontends.odometry.gaps import Gaps

PSI, POS, GYRO, SCALE, FADING, LASTING = 0, slice(1, 4), slice(4, 7), 7, slice(8, 10), slice(10, 12)
STATES = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class DeadReckoningErrorModel:
    """σ of the errors that outlive a step, at the first record of the path, and how they walk."""

    gyro_bias: float
    """[rad/s]"""
    gyro_walk: float
    """[rad/s/√s]"""
    wheel_scale: float
    """Share of the distance."""
    attitude: float
    """Roll and pitch, the part that fades [rad]."""
    attitude_time: float
    """Time over which it fades [s]."""
    attitude_bias: float
    """Roll and pitch, the part that lasts [rad]."""
    attitude_walk: float
    """Walk of that part [rad/√s]."""
    epoch: float
    """When the biases had the σ above [s]: the first record of the IMU."""
    filtered: bool = False
    """Roll and pitch come from the gyro, drawn to gravity over ``attitude_time``: then the gyro's bias tilts them."""

    def covariance(self, time: float) -> Array:
        """Of the state ``(12, 12)`` at the start of an interval that begins at ``time`` [s]."""
        since = max(time - self.epoch, 0.0)
        P = np.zeros(STATES)
        P[GYRO] = self.gyro_bias**2 + self.gyro_walk**2 * since
        P[SCALE] = self.wheel_scale**2
        P[FADING] = self.attitude**2
        P[LASTING] = self.attitude_bias**2 + self.attitude_walk**2 * since
        M = np.eye(STATES)
        if self.filtered:
            # the filter's error is T times the gyro's bias, and was the opposite when it started, coming backwards
            gain = self.attitude_time * (1.0 - 2.0 * np.exp(-since / self.attitude_time))
            M[FADING.start, GYRO.start] = M[FADING.start + 1, GYRO.start + 1] = gain
        return (M * P) @ M.T


@dataclass(frozen=True, slots=True, kw_only=True)
class DeadReckonedPath:
    """A dead-reckoned path at given times.

    Parameters
    ----------
    odometry : Odometry
        Increments ``(n, 7)`` with the covariance of what is new in each step: for filters that sample steps as
        independent. Errors that last are not in it.
    poses : (n, 7)
        Frame of the path: position and heading of its start, level.
    path : Trajectory
        Poses at every record of the sensors, same frame.
    tilt : (n, 2)
        Roll and pitch [rad].
    transitions, noises : (n, 12, 12)
        Of the error state from pose k - 1 to k; record 0 is identity and zero.
    floor : (6,)
        σ that every covariance has at least: radians, metres.
    gaps : Gaps
        Of either stream, bridged.
    """

    odometry: Odometry
    poses: Array
    path: Trajectory
    tilt: Array
    lasting: DeadReckoningErrorModel
    transitions: Array
    noises: Array
    floor: Array
    gaps: Gaps = field(default_factory=Gaps)

    def between(
        self, start: int, end: int, *, level_start: bool = False, level_end: bool = False
    ) -> tuple[Array, Array]:
        """Motion from pose ``start`` to pose ``end`` and its covariance, errors that last included.

        Parameters
        ----------
        start, end : int
            0 ≤ start ≤ end < n.
        level_start, level_end : bool
            True: the frame there has position and heading of the body, but stands level, as frames of submaps do. Such
            a frame is level by definition; what the sensors get wrong about it is only where it is and heads.

        Returns
        -------
        pose : (7,)
        covariance : (6, 6)
            Right tangent.
        """
        n = len(self.poses)
        if not 0 <= start <= end < n:
            raise DataError("no such interval of the path", got=(start, end), wanted=f"0 ≤ start ≤ end < {n}")
        times = self.odometry.times
        # two more states: errors of roll and pitch at the start, kept as they were
        pick = np.vstack([np.eye(STATES), np.eye(STATES)[FADING] + np.eye(STATES)[LASTING]])
        P = pick @ self.lasting.covariance(float(times[start])) @ pick.T
        F = np.eye(STATES + 2)
        for k in range(start + 1, end + 1):
            F[:STATES, :STATES] = self.transitions[k]
            P = F @ P @ F.T
            P[:STATES, :STATES] += self.noises[k]
        a = level_by_euler(self.poses[start]) if level_start else self.poses[start]
        b = level_by_euler(self.poses[end]) if level_end else self.poses[end]
        G = tangent_of_state(a[None], b[None], level_start=level_start, level_end=level_end)[0]
        C = G @ P @ G.T + np.diag(self.floor**2)
        return se3.se3_between(a, b), 0.5 * (C + C.T)

    def covariance(self, start: int, end: int, *, level_start: bool = False, level_end: bool = False) -> Array:
        """Of :meth:`between` ``(6, 6)``."""
        return self.between(start, end, level_start=level_start, level_end=level_end)[1]


def euler(poses: Array) -> Array:
    """Roll, pitch, heading ``(..., 3)`` [rad] of poses ``(..., 7)``: R = Rz(heading) Ry(pitch) Rx(roll)."""
    R = se3.quat_to_matrix(np.asarray(poses)[..., 3:])
    pitch = np.arcsin(np.clip(-R[..., 2, 0], -1.0, 1.0))
    return np.stack([np.arctan2(R[..., 2, 1], R[..., 2, 2]), pitch, np.arctan2(R[..., 1, 0], R[..., 0, 0])], -1)


def euler_quat(roll: Array, pitch: Array, heading: Array) -> Array:
    """Quaternions ``(..., 4)`` of Rz(heading) Ry(pitch) Rx(roll)."""
    zero = np.zeros_like(heading)
    turns = [(0, roll), (1, pitch), (2, heading)]
    x, y, z = (se3.so3_exp(np.stack([a if i == j else zero for j in range(3)], -1)) for i, a in turns)
    return se3.quat_normalize(se3.quat_multiply(se3.quat_multiply(z, y), x))


def level_by_euler(poses: Array) -> Array:
    """Poses ``(..., 7)`` with position and heading kept, roll and pitch removed."""
    p = np.asarray(poses, dtype=np.float64)
    heading = euler(p)[..., 2]
    zero = np.zeros_like(heading)
    return np.concatenate([p[..., :3], euler_quat(zero, zero, heading)], -1)


def tangent_of_state(start: Array, end: Array, *, level_start: bool, level_end: bool) -> Array:
    """Right tangent of ``T_start_end`` from the error state, ``(k, 6, 14)``; poses ``(k, 7)``.

    ``ξ = ξ_end - Ad(T_end⁻¹ T_start) ξ_start``, each made of errors of roll, pitch, heading and position there.
    """
    G = np.zeros((len(end), 6, STATES + 2))
    to_end = body_rates(end)
    G[:, :3, PSI] = to_end[:, :, 2]
    if not level_end:
        G[:, :3, FADING] = to_end[:, :, :2]
        G[:, :3, LASTING] = to_end[:, :, :2]
    G[:, 3:, POS] = np.swapaxes(se3.quat_to_matrix(end[:, 3:]), -1, -2)
    if not level_start:
        ad = se3.se3_adjoint(se3.se3_between(end, start))
        G[:, :, STATES:] = -ad[:, :, :3] @ body_rates(start)[:, :, :2]
    return G


def body_rates(poses: Array) -> Array:
    """Rotation in the body ``(k, 3, 3)`` per change of roll, pitch and heading."""
    roll, pitch, _ = np.moveaxis(euler(poses), -1, 0)
    E = np.zeros((len(poses), 3, 3))
    E[:, 0, 0] = 1.0
    E[:, 0, 2] = -np.sin(pitch)
    E[:, 1, 1], E[:, 1, 2] = np.cos(roll), np.sin(roll) * np.cos(pitch)
    E[:, 2, 1], E[:, 2, 2] = -np.sin(roll), np.cos(roll) * np.cos(pitch)
    return E
