"""Recorded odometry in two or three dimensions: chained, bridged, and corrected."""

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
"""σ of the pieces of a bridged record together, as a share of its motion."""


def add_yaw_bias(odometry: Odometry, rate: float) -> Odometry:
    """The odometry of a robot whose gyro is off by ``rate`` about the z axis of the base [rad/s], all along."""
    g = group_of(odometry.increments)
    seconds = np.concatenate([[0.0], np.diff(odometry.times)])[: len(odometry.times)]
    xi = g.log(odometry.increments)
    xi[:, g.heading] += rate * seconds
    return replace(odometry, increments=g.exp(xi))


def chain_odometry(odometry: Odometry) -> Trajectory:
    """Poses ``(n, 3 | 7)`` of recorded increments in the frame of the first record's pose."""
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
    """Records of odometry that span a gap, made less certain; and the gaps.

    A record tells the whole motion over its time, however long, but not how it went meanwhile: cut into pieces its
    covariance must cover more than the record's own. Records that take longer than thrice the usual (and than 1 s) are
    counted, and those of which the motion is cut get σ = 20 % of their motion on every axis besides their own. Where
    the body moved before and after, and the record tells less than half of that speed, records may have been lost, and
    with them motion: σ is then what the body drives (and, root of the mean square, turns) in that time.
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
        # beside the first and the last record there is one neighbour only: a body that stands before it sets off
        speed = min(float(metres[j] / spacing[j]) for j in near) if len(near) == 2 else 0.0
        sigma = np.full(g.dof, BRIDGED * radians[i])
        sigma[g.position] = BRIDGED * metres[i]
        if metres[i] < 0.5 * speed * spacing[i]:
            sigma[g.heading] = max(sigma[g.heading], turns * spacing[i])
            sigma[g.position] = speed * spacing[i]
        covariances[i + 1] += np.diag(np.square(sigma))
    return replace(odometry, covariances=covariances), Gaps(odometry.times[k], odometry.times[k + 1])


def without_yaw_per_metre(odometry: Odometry, rate: float, *, where: str = "odometry") -> Odometry:
    """The odometry without a turn of ``rate`` [rad/m] for each metre driven."""
    if odometry.increments.shape[1] != 3:
        raise ConfigError(f"{where}: yaw_per_metre is for odometry in the plane")
    xi = se2_log(odometry.increments)
    xi[:, 2] -= rate * np.hypot(xi[:, 0], xi[:, 1])
    return replace(odometry, increments=se2_exp(xi))
