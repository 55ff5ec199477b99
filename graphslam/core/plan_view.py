"""Projection of 3-D poses to the horizontal plane, for plots and 2-D metrics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphslam.core.geometry import Array, ArrayLike, rotation2
from graphslam.core.poses import heading_of
from graphslam.core.se3 import quat_to_matrix
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory


def plan_pose(poses: ArrayLike) -> Array:
    """``(..., 7)`` → ``(..., 3)``: x, y and heading."""
    p = np.asarray(poses, dtype=np.float64)
    return np.concatenate([p[..., :2], heading_of(p)[..., None]], axis=-1)


def plan_covariance(poses: ArrayLike, covariances: Array) -> Array:
    """3-D right-tangent covariances ``(..., 6, 6)`` → ``(..., 3, 3)`` of :func:`plan_pose`, for nearly level poses.

    Heading is the rotation about the world's vertical; the position is rotated to the axes of the plan's heading.
    """
    p = np.asarray(poses, dtype=np.float64)
    R = quat_to_matrix(p[..., 3:])
    turn = np.swapaxes(rotation2(heading_of(p)), -1, -2)
    J = np.zeros((*p.shape[:-1], 3, 6))
    J[..., :2, 3:] = turn @ R[..., :2, :]
    J[..., 2, :3] = R[..., 2, :]
    return np.asarray(J @ covariances @ np.swapaxes(J, -1, -2))


def plan_path(path: Trajectory) -> Trajectory:
    """Projection of a 3-D path to the horizontal plane."""
    C = None if path.covariances is None else plan_covariance(path.poses, path.covariances)
    return Trajectory(path.times, plan_pose(path.poses), C)


def plan_submap(submap: Submap) -> Submap:
    """Projection of a dense 3-D submap to the horizontal plane: its exit and its path."""
    return replace(
        submap,
        exit_pose=plan_pose(submap.exit_pose),
        exit_covariance=plan_covariance(submap.exit_pose, submap.exit_covariance),
        trajectory=None if submap.trajectory is None else plan_path(submap.trajectory),
        grid=None,
        cloud=None,
        matches=(),
    )
