"""Change of frame for the values of each variable type."""

from __future__ import annotations

from typing import Literal

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.poses import Group, heading_of
from graphslam.core.se3 import quat_rotate, quat_to_matrix, skew, so3_exp

Rule = Literal["pose", "point", "vector", "constant", "datum", "tilt", "heading", "first-base"]

RULES: dict[str, Rule] = {
    "x": "pose", "l": "point", "point": "point", "beacon": "point", "velocity": "vector", "datum": "datum",
    "tilt": "tilt", "compass": "heading", "wheels": "constant", "sensor": "constant", "mount": "constant",
    "bias": "constant", "imubias": "constant", "deviation": "constant",
}  # fmt: skip
"""Transformation rule of each variable type; types without an entry wait for the frame of the first base."""


def rule_of(word: str, dim: int) -> Rule:
    """Transformation rule of a variable type, in 2-D or 3-D."""
    rule = RULES.get(word, "first-base")
    return "first-base" if dim == 3 and rule in ("datum", "heading") else rule


def tilt_direction(tilt: Array) -> Array:
    """Upward unit vector ``(3,)`` of a tilt ``(2,)``."""
    return quat_rotate(so3_exp(np.append(tilt, 0.0)), np.array([0.0, 0.0, 1.0]))


def tilt_of_direction(up: Array) -> Array:
    """Inverse of :func:`tilt_direction`."""
    sine = float(np.hypot(up[0], up[1]))
    scale = 1.0 if sine < 1e-12 else float(np.arctan2(sine, up[2])) / sine
    return scale * np.array([-up[1], up[0]])


def rotation_of(group: Group, pose: Array) -> Array:
    """Rotation matrix ``(d, d)`` of a pose."""
    if group.dim == 3:
        return quat_to_matrix(pose[3:])
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([[c, -s], [s, c]])


def rows_in_frame(rule: Rule, group: Group, T: Array, rows: Array) -> tuple[Array, Array | None]:
    """Transform values ``(n, size)`` of one type from frame b to frame a, with ``T`` = ``T_a_b``.

    Returns
    -------
    rows : (n, size)
    J : (dof, dof), (n, dof, dof) or None
        Derivative of a step in frame a with respect to one in frame b; None for the identity.
    """
    if not len(rows) or rule in ("constant", "first-base"):
        return rows, None
    if rule == "pose":
        return group.compose(np.broadcast_to(T, rows.shape), rows), None
    R = rotation_of(group, T)
    if rule == "point":
        return rows @ R.T + T[: group.dim], R
    if rule == "vector":
        return rows @ R.T, R
    if rule == "datum":  # T_gps_a = T_gps_b ∘ T_b_a
        back = group.inverse(T)
        return group.compose(rows, np.broadcast_to(back, rows.shape)), group.adjoint(T)
    if rule == "heading":
        return rows - heading_of(T), None
    moved = np.array([tilt_of_direction(R @ tilt_direction(t)) for t in rows])
    h = 1e-6
    steps = [
        [(tilt_of_direction(R @ tilt_direction(t + e)) - tilt_of_direction(R @ tilt_direction(t - e))) / (2 * h)
         for e in h * np.eye(2)]
        for t in rows
    ]  # fmt: skip
    return moved, np.swapaxes(np.array(steps), 1, 2)


def lever_matrix(group: Group, m: Array) -> Array:
    """Jacobian ``(n, d, dof)`` of points ``(n, d)`` in the body frame with respect to a right tangent of the pose."""
    if group.dim == 2:
        turn = np.stack([-m[:, 1], m[:, 0]], axis=1)[:, :, None]
        return np.concatenate([np.broadcast_to(np.eye(2), (len(m), 2, 2)), turn], axis=2)
    return np.concatenate([-skew(m), np.broadcast_to(np.eye(3), (len(m), 3, 3))], axis=2)
