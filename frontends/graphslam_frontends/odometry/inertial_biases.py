"""Systematic errors of dead reckoning from an IMU and wheels.

Error state (12), true minus estimated, position in the frame of the path: heading; x, y, z; bias of the gyro (3, base
frame); scale of the wheels; time-correlated roll and pitch (Ornstein–Uhlenbeck, 2); constant roll and pitch (2).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from graphslam.core import se3
from graphslam.core.geometry import Array
from graphslam.core.poses import remove_roll_pitch

PSI, POS, GYRO, SCALE, FADING, CONSTANT = 0, slice(1, 4), slice(4, 7), 7, slice(8, 10), slice(10, 12)
STATES = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class DeadReckoningErrorModel:
    """σ of the systematic errors at the first record of the path, and their random walks."""

    gyro_bias: float
    """[rad/s]"""
    gyro_walk: float
    """[rad/s/√s]"""
    wheel_scale: float
    """Relative error of distances."""
    attitude: float
    """Roll and pitch, time-correlated part [rad]."""
    attitude_time: float
    """Correlation time of that part [s]."""
    attitude_bias: float
    """Roll and pitch, constant part [rad]."""
    attitude_walk: float
    """Random walk of the constant part [rad/√s]."""
    epoch: float
    """Time of the σ above [s]: the first record of the IMU."""
    filtered: bool = False
    """Roll and pitch are from a filter with time constant ``attitude_time``: then the gyro bias tilts them."""

    def covariance(self, time: float) -> Array:
        """Covariance ``(12, 12)`` of the state at the start of an interval that begins at ``time`` [s]."""
        since = max(time - self.epoch, 0.0)
        P = np.zeros(STATES)
        P[GYRO] = self.gyro_bias**2 + self.gyro_walk**2 * since
        P[SCALE] = self.wheel_scale**2
        P[FADING] = self.attitude**2
        P[CONSTANT] = self.attitude_bias**2 + self.attitude_walk**2 * since
        M = np.eye(STATES)
        if self.filtered:
            # error of the filter: T · gyro bias in steady state, and the opposite at its start, from the backward run
            gain = self.attitude_time * (1.0 - 2.0 * np.exp(-since / self.attitude_time))
            M[FADING.start, GYRO.start] = M[FADING.start + 1, GYRO.start + 1] = gain
        return (M * P) @ M.T


@dataclass(frozen=True, slots=True, kw_only=True)
class InertialBiases:
    """Errors of a dead-reckoned path as states of a linear system.

    Two states follow the error state: the errors of roll and pitch at the start of the interval.

    Parameters
    ----------
    times : (n,)
        [s]
    poses : (n, 7)
        Of the path.
    transitions, noises : (n, 12, 12)
        Of the error state from pose k - 1 to k; record 0 is identity and zero.
    floor : (6,)
        Least σ of every covariance: radians, metres.
    """

    times: Array
    poses: Array
    model: DeadReckoningErrorModel
    transitions: Array
    noises: Array
    floor: Array

    @property
    def sigmas(self) -> Mapping[str, float]:
        """See :class:`~graphslam_frontends.odometry.motion_prior.BiasStates`."""
        e = self.model
        return {"yaw_bias": e.gyro_bias, "yaw_walk": e.gyro_walk, "scale": e.wheel_scale, "tilt": e.attitude_bias}

    def initial(self, start: int) -> Array:
        """See :class:`~graphslam_frontends.odometry.motion_prior.BiasStates`."""
        pick = np.vstack([np.eye(STATES), np.eye(STATES)[FADING] + np.eye(STATES)[CONSTANT]])
        return np.asarray(pick @ self.model.covariance(float(self.times[start])) @ pick.T)

    def step(self, k: int) -> tuple[Array, Array]:
        """See :class:`~graphslam_frontends.odometry.motion_prior.BiasStates`."""
        F, Q = np.eye(STATES + 2), np.zeros((STATES + 2, STATES + 2))
        F[:STATES, :STATES], Q[:STATES, :STATES] = self.transitions[k], self.noises[k]
        return F, Q

    def tangent(self, start: int, end: int, *, level_start: bool, level_end: bool) -> Array:
        """See :class:`~graphslam_frontends.odometry.motion_prior.BiasStates`."""
        a = remove_roll_pitch(self.poses[start]) if level_start else self.poses[start]
        b = remove_roll_pitch(self.poses[end]) if level_end else self.poses[end]
        return tangent_of_state(a[None], b[None], level_start=level_start, level_end=level_end)[0]


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


def tangent_of_state(start: Array, end: Array, *, level_start: bool, level_end: bool) -> Array:
    """Jacobian ``(k, 6, 14)`` of the right tangent of ``T_start_end`` by the error state; poses ``(k, 7)``.

    ``ξ = ξ_end - Ad(T_end⁻¹ T_start) ξ_start``, each from the errors of roll, pitch, heading and position there.
    """
    G = np.zeros((len(end), 6, STATES + 2))
    to_end = body_rates(end)
    G[:, :3, PSI] = to_end[:, :, 2]
    if not level_end:
        G[:, :3, FADING] = to_end[:, :, :2]
        G[:, :3, CONSTANT] = to_end[:, :, :2]
    G[:, 3:, POS] = np.swapaxes(se3.quat_to_matrix(end[:, 3:]), -1, -2)
    if not level_start:
        ad = se3.se3_adjoint(se3.se3_between(end, start))
        G[:, :, STATES:] = -ad[:, :, :3] @ body_rates(start)[:, :, :2]
    return G


def body_rates(poses: Array) -> Array:
    """Rotation in the body frame ``(k, 3, 3)`` per change of roll, pitch and heading."""
    roll, pitch, _ = np.moveaxis(euler(poses), -1, 0)
    E = np.zeros((len(poses), 3, 3))
    E[:, 0, 0] = 1.0
    E[:, 0, 2] = -np.sin(pitch)
    E[:, 1, 1], E[:, 1, 2] = np.cos(roll), np.sin(roll) * np.cos(pitch)
    E[:, 2, 1], E[:, 2, 2] = -np.sin(roll), np.cos(roll) * np.cos(pitch)
    return E
