"""Odometry with an assumed noise model, from poses without covariances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphslam.core import se3
from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of
from graphslam.core.records import Odometry


@dataclass(frozen=True, slots=True)
class OdometryNoise:
    """σ of one motion of the odometry: root sum of squares of its parts.

    Parameters
    ----------
    floor : (float, float)
        Constant part of position [m] and rotation [rad].
    per_metre : (float, float)
        Part per metre driven: of position [m/m] and of rotation [rad/m].
    per_radian : float
        Part of rotation per radian turned.
    """

    floor: tuple[float, float] = (0.01, 0.005)
    per_metre: tuple[float, float] = (0.1, 0.15)
    per_radian: float = 0.2

    def __post_init__(self) -> None:
        more = (*self.per_metre, self.per_radian)
        if not (all(np.isfinite(v) and v > 0 for v in self.floor) and all(np.isfinite(v) and v >= 0 for v in more)):
            raise ConfigError(
                f"odometry: floor = {self.floor}, per_metre = {self.per_metre}, per_radian = {self.per_radian};"
                " wanted floors above 0, the others at least 0"
            )

    def odometry(self, times: Array, poses: Array) -> Odometry:
        """Motions between consecutive poses ``(n, 3|7)``, with covariances; the first motion is the identity."""
        group = group_of(poses)
        motion = np.tile(group.identity, (len(poses), 1))
        motion[1:] = group.between(poses[:-1], poses[1:])
        driven = np.linalg.norm(motion[:, : group.dim], axis=1)
        turned = np.abs(motion[:, 2]) if group.dim == 2 else np.linalg.norm(se3.so3_log(motion[:, 3:]), axis=1)
        turn = self.floor[1] ** 2 + (self.per_metre[1] * driven) ** 2 + (self.per_radian * turned) ** 2
        variance = np.tile(turn[:, None], (1, group.dof))
        variance[:, group.position] = (self.floor[0] ** 2 + (self.per_metre[0] * driven) ** 2)[:, None]
        return Odometry(times=times, increments=motion, covariances=variance[:, :, None] * np.eye(group.dof))


DEFAULT_NOISE = OdometryNoise()
"""For a wheeled robot: about the median difference of 1 m motions between raw and corrected CARMEN logs."""


def constant_noise(sigmas: tuple[float, float]) -> OdometryNoise:
    """The same σ for every motion, per axis [m, rad]."""
    return OdometryNoise(sigmas, (0.0, 0.0), 0.0)
