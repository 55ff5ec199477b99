"""Preparation of points for matching: finite, consistent dimension, downsampled."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.errors import GeometryError
from graphslam.core.geometry import Array
from graphslam.core.log import DropCounter
from graphslam.core.poses import SE2, SE3

FARTHEST = 1e6
"""Larger coordinates are not measurements [m]."""


def finite_points(points: Any, *, what: str = "points", drops: DropCounter | None = None) -> Array:
    """Points ``(m, 2 | 3)`` [m] without non-finite ones or those beyond :data:`FARTHEST`, which are counted."""
    p = np.ascontiguousarray(points, dtype=np.float64)
    if p.ndim != 2 or p.shape[1] not in (2, 3):
        raise GeometryError(f"{what} have the wrong shape", got=p.shape, wanted="(m, 2) or (m, 3)")
    good = (np.abs(p) < FARTHEST).all(axis=1)  # also excludes NaN
    if good.all():
        return p
    if drops is not None:
        drops.drop(what, "not finite, or too far", int(np.sum(~good)))
    return p[good]


def check_pose(pose: Any, dim: int, *, what: str = "pose") -> Array:
    """Validate a pose, ``(3,)`` in 2-D and ``(7,)`` in 3-D; its quaternion is normalised."""
    T = np.array(pose, dtype=np.float64)
    n = 3 if dim == 2 else 7
    if T.shape != (n,) or not np.all(np.isfinite(T)):
        raise GeometryError(f"{what} is impossible", got=T, wanted=f"{n} finite numbers")
    if dim == 3:
        T[3:] = se3.quat_normalize(T[3:])
    return T


def transform_points(T_ab: Array, points: Array) -> Array:
    """Points ``(m, dim)`` of frame b in frame a; poses may have leading axes to broadcast."""
    return (SE2 if points.shape[-1] == 2 else SE3).transform(T_ab, points)


def voxel_downsample(points: Array, voxel: float) -> Array:
    """One point per voxel, the mean of those in it; voxels in the order of their coordinates, x slowest.

    Parameters
    ----------
    points : (m, dim)
        Finite [m].
    voxel : float
        Edge [m].

    Returns
    -------
    (n, dim)
    """
    if not len(points):
        return points
    dims = range(points.shape[1])  # one axis at a time, to save memory

    def cells(a: int) -> npt.NDArray[np.int64]:
        c = np.floor(points[:, a] / voxel).astype(np.int64)
        c -= c.min()
        return c

    size = [int(cells(a).max()) + 1 for a in dims]
    few = float(np.prod(np.array(size, dtype=np.float64))) <= 2.0**62  # otherwise keys would overflow

    def numbers(a: int) -> npt.NDArray[np.int64]:
        return cells(a) if few else np.unique(cells(a), return_inverse=True)[1].ravel().astype(np.int64)

    if not few:
        size = [int(numbers(a).max()) + 1 for a in dims]
    key = numbers(0)
    for a in dims[1:]:
        key *= size[a]
        key += numbers(a)
    _, which, count = np.unique(key, return_inverse=True, return_counts=True)
    return np.stack([np.bincount(which, x) / count for x in points.T], axis=1)


def evenly_spaced(points: Array, most: int) -> Array:
    """At most ``most`` of the points, evenly from first to last."""
    if len(points) <= most:
        return points
    return points[np.linspace(0, len(points) - 1, most).round().astype(np.int64)]
