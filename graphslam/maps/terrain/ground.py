"""Vertical direction and height of a scanner, estimated from the ground in its scans.

The frame of a recorded path can be tilted, and a hand-carried scanner has no fixed height.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.errors import DataError
from graphslam.core.geometry import Array

_NEAR, _FAR = 1.0, 15.0
_SQUARE = 1.0
_LEAST = 6
_TILT = 0.35


@dataclass(frozen=True, slots=True, eq=False)
class GroundPlane:
    """The ground around a scanner.

    Parameters
    ----------
    up : (3,)
        Upward normal in the frame of the points.
    below : float
        Height of the scanner above it [m].
    """

    up: Array
    below: float


def ground_plane(points: Array, origin: Array, up: Array, height: float | None = None) -> GroundPlane | None:
    """Plane through the lowest points of the squares around a scanner; None if there is none.

    Parameters
    ----------
    points : (n, 3)
        [m]
    origin : (3,)
        Position of the scanner.
    up : (3,)
        Approximate upward direction; the ground normal must be within 20° of it.
    height : float, optional
        Approximate height of the scanner above the ground [m]; points more than 0.5 m off are not ground.
    """
    R = level_rotation(up)
    q = (np.asarray(points, dtype=np.float64) - origin) @ R.T
    reach = np.hypot(q[:, 0], q[:, 1])
    q = q[(reach > _NEAR) & (reach < _FAR) & (q[:, 2] < -0.2) & (q[:, 2] > -4.0)]
    if height is not None:
        q = q[np.abs(q[:, 2] + height) < 0.5]
    square = np.floor(q[:, :2] / _SQUARE).astype(np.int64)
    order = np.lexsort((q[:, 2], square[:, 1], square[:, 0]))
    q, square = q[order], square[order]
    first = (
        np.flatnonzero(np.any(np.diff(square, axis=0, prepend=square[:1] - 1), axis=1)) if len(q) else np.zeros(0, int)
    )
    many = np.diff(np.append(first, len(q)))
    low = q[first[many >= 3] + many[many >= 3] // 10]  # not the lowest one, which can be a stray beam
    if len(low) < _LEAST:
        return None
    plane = np.array([0.0, 0.0, float(np.median(low[:, 2]))])  # z = a x + b y + c
    for limit in (0.5, 0.2, 0.1, 0.1):
        near = np.abs(low[:, 2] - low[:, :2] @ plane[:2] - plane[2]) < limit
        if np.count_nonzero(near) < _LEAST:
            return None
        A = np.column_stack([low[near, :2], np.ones(np.count_nonzero(near))])
        plane = np.linalg.lstsq(A, low[near, 2], rcond=None)[0]
    normal = np.array([-plane[0], -plane[1], 1.0])
    normal /= np.linalg.norm(normal)
    if normal[2] < np.cos(_TILT):
        return None
    return GroundPlane(R.T @ normal, float(-plane[2] * normal[2]))


def level_rotation(up: Array) -> npt.NDArray[np.float64]:
    """The smallest rotation ``(3, 3)`` that rotates ``up`` to z."""
    u = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
    axis = np.cross(u, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return np.eye(3) if u[2] > 0 else np.diag([1.0, -1.0, -1.0])
    return np.asarray(se3.quat_to_matrix(se3.so3_exp(axis / sine * np.arctan2(sine, u[2]))))


def common_up(planes: list[GroundPlane | None]) -> Array:
    """Upward direction of a whole path: mean of the plane normals, without those that differ by more than 10°."""
    normals = np.array([p.up for p in planes if p is not None])
    if len(normals) < 3:
        raise DataError(
            "the ground was not found in the scans, so it is not known where up is",
            got=f"{len(normals)} scans with ground under the sensor",
            wanted="at least 3",
        )
    up = np.median(normals, axis=0)
    for _ in range(3):
        up = up / np.linalg.norm(up)
        near = normals @ up > np.cos(np.deg2rad(10.0))
        if np.any(near):
            up = normals[near].mean(axis=0)
    return np.asarray(up / np.linalg.norm(up))
