"""Recorded odometry in 2-D or 3-D: integration, bridging of gaps, corrections."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphslam.core.errors import ConfigError
from graphslam.core.geometry import se2_exp, se2_log
from graphslam.core.log import DropCounter
from graphslam.core.poses import group_of
from graphslam.core.records import Odometry
from graphslam.core.trajectory import Trajectory
from graphslam_frontends.odometry.gaps import Gaps, refuse_long_gaps

BRIDGED = 0.2
"""σ of the division of a bridged record, relative to its motion."""


def add_yaw_bias(odometry: Odometry, rate: float) -> Odometry:
    """Add a constant gyro error ``rate`` about the z axis of the base [rad/s] to the odometry."""
    g = group_of(odometry.increments)
    seconds = np.concatenate([[0.0], np.diff(odometry.times)])[: len(odometry.times)]
    xi = g.log(odometry.increments)
    xi[:, g.heading] += rate * seconds
    return replace(odometry, increments=g.exp(xi))


def chain_odometry(odometry: Odometry) -> Trajectory:
    """Poses ``(n, 3 | 7)`` of recorded increments in the frame of the first pose."""
    poses = odometry.increments.copy()
    g = group_of(poses)
    if len(poses):
        poses[0] = g.identity
    for k in range(1, len(poses)):
        poses[k] = g.compose(poses[k - 1], odometry.increments[k])
    return Trajectory(odometry.times, poses)


def bridge_gap(
    odometry: Odometry, limit: float, *, where: str, drops: DropCounter | None = None
) -> tuple[Odometry, Gaps]:
    """Odometry with larger covariances of records that span a gap; and the gaps.

    A record gives the motion over its interval, but not the velocity within it, so pieces of it are less certain.
    Records longer than 3 times the median (and than 1 s) are counted and get an additional σ of 20 % of their motion on
    every axis. If the body moved before and after, and the record has less than half of that speed, records may be
    missing: σ is then that speed (and the RMS yaw rate) times the interval.
    """
    if len(odometry.times) < 2:
        return odometry, Gaps()
    spacing = np.diff(odometry.times)
    k = np.flatnonzero(spacing > max(3.0 * float(np.median(spacing)), 1.0))
    refuse_long_gaps(odometry.times, k, limit, where)
    if drops is not None:
        drops.drop(where, "gap bridged", len(k))
    g = group_of(odometry.increments)
    xi = g.log(odometry.increments[1:])
    metres = np.linalg.norm(xi[:, g.position], axis=1)
    radians = np.linalg.norm(np.delete(xi, np.r_[g.position], axis=1), axis=1)
    sound = np.setdiff1d(np.arange(len(spacing)), k)
    turns = float(np.sqrt(np.mean((radians[sound] / spacing[sound]) ** 2))) if len(sound) else 0.0
    covariances = odometry.covariances.copy()
    for i in k:
        near = [j for j in (i - 1, i + 1) if 0 <= j < len(spacing) and j not in k]
        # the first and the last record have one neighbour only: a stationary body starts or stops there
        speed = min(float(metres[j] / spacing[j]) for j in near) if len(near) == 2 else 0.0
        sigma = np.full(g.dof, BRIDGED * radians[i])
        sigma[g.position] = BRIDGED * metres[i]
        if metres[i] < 0.5 * speed * spacing[i]:
            sigma[g.heading] = max(sigma[g.heading], turns * spacing[i])
            sigma[g.position] = speed * spacing[i]
        covariances[i + 1] += np.diag(np.square(sigma))
    return replace(odometry, covariances=covariances), Gaps(odometry.times[k], odometry.times[k + 1])


def without_yaw_per_metre(odometry: Odometry, rate: float, *, where: str = "odometry") -> Odometry:
    """The odometry minus a rotation of ``rate`` [rad/m] per metre driven."""
    if odometry.increments.shape[1] != 3:
        raise ConfigError(f"{where}: yaw_per_metre is for odometry in the plane")
    xi = se2_log(odometry.increments)
    xi[:, 2] -= rate * np.hypot(xi[:, 0], xi[:, 1])
    return replace(odometry, increments=se2_exp(xi))
