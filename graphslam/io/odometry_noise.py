"""Odometry of a log that has poses and states no covariance."""

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
    """σ of one motion of the odometry.

    Parameters
    ----------
    floor : (float, float)
        At least [m], [rad].
    per_metre : (float, float)
        Per metre driven: of the position [m/m] and of the heading [rad/m].
    per_radian : float
        Of the heading per radian turned.
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
        """Motions from each of the poses ``(n, 3|7)`` to the next."""
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
"""Of a wheeled robot. Motions of a metre differ from those of corrected CARMEN logs about as much (median)."""


def constant_noise(sigmas: tuple[float, float]) -> OdometryNoise:
    """The same σ of every motion, per axis: metres, radians."""
    return OdometryNoise(sigmas, (0.0, 0.0), 0.0)
