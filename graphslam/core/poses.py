"""Common interface for 2-D and 3-D poses, gravity-aligned frames, and means of poses.

A pose is ``(..., 7)`` or ``(..., 3)``; tangents as in :mod:`graphslam.core.geometry`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphslam.core import geometry, se3
from graphslam.core.errors import GeometryError
from graphslam.core.geometry import Array, ArrayLike
from graphslam.core.reading import finite_mask


@dataclass(frozen=True, slots=True)
class Group:
    """The functions of SE(2) or SE(3).

    Parameters
    ----------
    dim : {2, 3}
    size : {3, 7}
        Numbers of a pose.
    dof : {3, 6}
        Numbers of a tangent.
    heading : int
        Tangent component of the rotation about z.
    position : slice
        Tangent components of the position.
    """

    dim: int
    size: int
    dof: int
    identity: Array
    heading: int
    position: slice
    compose: Callable[[ArrayLike, ArrayLike], Array]
    inverse: Callable[[ArrayLike], Array]
    between: Callable[[ArrayLike, ArrayLike], Array]
    exp: Callable[[ArrayLike], Array]
    log: Callable[[ArrayLike], Array]
    adjoint: Callable[[ArrayLike], Array]
    right_jacobian: Callable[[ArrayLike], Array]
    right_jacobian_inverse: Callable[[ArrayLike], Array]
    transform: Callable[[ArrayLike, ArrayLike], Array]


SE2 = Group(
    2, 3, 3, np.zeros(3), 2, slice(0, 2), geometry.se2_compose, geometry.se2_inverse, geometry.se2_between,
    geometry.se2_exp, geometry.se2_log, geometry.se2_adjoint, geometry.se2_right_jacobian,
    geometry.se2_right_jacobian_inverse, geometry.se2_transform,
)  # fmt: skip
SE3 = Group(
    3, 7, 6, np.array([0.0, 0, 0, 0, 0, 0, 1]), 2, slice(3, 6), se3.se3_compose, se3.se3_inverse, se3.se3_between,
    se3.se3_exp, se3.se3_log, se3.se3_adjoint, se3.se3_right_jacobian, se3.se3_right_jacobian_inverse,
    se3.se3_transform,
)  # fmt: skip


def group_of(poses: Any) -> Group:
    """SE(2) or SE(3), by the length of the last axis."""
    size = np.shape(poses)[-1] if np.ndim(poses) else 0
    if size not in (3, 7):
        raise GeometryError("poses have the wrong shape", got=np.shape(poses), wanted="(..., 3) or (..., 7)")
    return SE2 if size == 3 else SE3


def rotation_matrices(poses: Array) -> Array:
    """Rotation matrices ``(n, dim, dim)`` of poses ``(n, 3|7)``."""
    return geometry.rotation2(poses[:, 2]) if poses.shape[1] == 3 else se3.quat_to_matrix(poses[:, 3:])


def heading_of(poses: ArrayLike) -> Array:
    """Heading ``(...)`` [rad]: direction of the body's x axis in the horizontal plane (yaw of yaw-pitch-roll)."""
    p = np.asarray(poses, dtype=np.float64)
    if p.shape[-1] == 3:
        return p[..., 2]
    x, y, z, w = p[..., 3], p[..., 4], p[..., 5], p[..., 6]
    return np.asarray(np.arctan2(2.0 * (x * y + z * w), 1.0 - 2.0 * (y * y + z * z)))


def remove_roll_pitch(poses: ArrayLike) -> Array:
    """The same positions and headings without roll and pitch; unchanged in 2-D."""
    p = np.array(poses, dtype=np.float64)
    return p if p.shape[-1] == 3 else level_poses(p[..., :3], heading_of(p))


def frame_between(T_a_body: ArrayLike, T_b_body: ArrayLike, *, gravity: bool) -> Array:
    """``T_a_b`` of two frames from the pose of one body in both at the same time (SegSLAM eq. 11).

    Parameters
    ----------
    T_a_body, T_b_body : (..., 7) or (..., 3)
        For a particle that leaves segment a and starts segment b: its exit and its entry.
    gravity : bool
        Both frames are gravity-aligned, so they differ only by a rotation about z: other differences of the body's roll
        and pitch are errors that would tilt everything after it. The position of the body is kept.
    """
    group = group_of(T_a_body)
    if group.dim == 2 or not gravity:
        return group.compose(T_a_body, group.inverse(T_b_body))
    a, b = np.asarray(T_a_body, dtype=np.float64), np.asarray(T_b_body, dtype=np.float64)
    turn = level_poses(np.zeros(a.shape[:-1] + (3,)), heading_of(a) - heading_of(b))
    turn[..., :3] = a[..., :3] - se3.quat_rotate(turn[..., 3:], b[..., :3])
    return turn


def level_poses(positions: ArrayLike, headings: ArrayLike) -> Array:
    """Level poses ``(..., 7)`` at positions ``(..., 3)`` [m] with headings ``(...)`` [rad]."""
    half = 0.5 * geometry.wrap_angle(headings)
    zero = np.zeros_like(half)
    turn = np.stack([zero, zero, np.sin(half), np.cos(half)], axis=-1)
    return np.concatenate([np.asarray(positions, dtype=np.float64), turn], axis=-1)


def normalise_weights(weights: ArrayLike | None, n: int) -> Array:
    """Weights ``(n,)`` that sum to one; uniform if none are given."""
    if weights is None:
        return np.full(n, 1.0 / n)
    w = np.asarray(weights, dtype=np.float64)
    if w.shape != (n,) or not np.all(finite_mask(w)) or np.any(w < 0) or not w.sum() > 0:
        raise GeometryError("impossible weights", got=w, wanted=f"{n} finite numbers ≥ 0, not all zero")
    return np.asarray(w / w.sum())


def pose_mean(poses: ArrayLike, weights: ArrayLike | None = None, *, iterations: int = 20) -> Array:
    """Weighted Karcher mean: the pose about which the weighted tangents sum to zero.

    Parameters
    ----------
    poses : (n, 7) or (n, 3)
    weights : (n,), optional
    """
    p = np.asarray(poses, dtype=np.float64)
    group = group_of(p)
    if p.ndim != 2 or not len(p):
        raise GeometryError("no poses to take the mean of", got=p.shape, wanted=f"(n, {group.size})")
    w = normalise_weights(weights, len(p))
    mean = p[int(np.argmax(w))]
    for _ in range(iterations):
        step = w @ group.log(group.between(np.broadcast_to(mean, p.shape), p))
        mean = group.compose(mean, group.exp(step))
        if np.abs(step).max() < 1e-12:
            break
    return mean


def pose_scatter(poses: ArrayLike, about: ArrayLike, weights: ArrayLike | None = None) -> Array:
    """Second moment ``(d, d)`` of poses ``(n, 7|3)`` about one, in its right tangent; their covariance if it is their
    mean."""
    p = np.asarray(poses, dtype=np.float64)
    group = group_of(p)
    w = normalise_weights(weights, len(p))
    e = group.log(group.between(np.broadcast_to(about, p.shape), p))
    return np.asarray((w[:, None] * e).T @ e)


def compose_increments(increments: Array) -> Array:
    """Poses of nodes in the frame of the first ``(n + 1, 7|3)`` from successive relative poses ``(n, 7|3)``."""
    g = group_of(increments)
    poses, reach = np.concatenate([g.identity[None], increments]), 1
    while reach < len(poses):  # each pose is that of the last 1, 2, 4, … increments before it
        poses[reach:] = g.compose(poses[:-reach], poses[reach:])
        reach *= 2
    return poses


def position_covariances(poses: Array, covariances: Array) -> Array:
    """Covariances of positions ``(n, 2, 2)`` or ``(n, 3, 3)`` in the axes of the frame the poses are in.

    Parameters
    ----------
    poses : (n, 3) or (n, 7)
    covariances : (n, 3, 3) or (n, 6, 6)
        Right tangents.
    """
    if poses.shape[-1] == 3:
        R, C = geometry.rotation2(poses[..., 2]), covariances[..., :2, :2]
    else:
        R, C = se3.quat_to_matrix(poses[..., 3:]), covariances[..., 3:, 3:]
    return np.asarray(R @ C @ np.swapaxes(R, -1, -2))
