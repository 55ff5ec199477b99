"""Conversion of scans and poses to the input arrays of the kernels, and the report of an update."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import GeometryError, GridError
from graphslam.core.geometry import Array

_NO_RETURNS = np.zeros(0, np.uint8)
_ZERO = np.zeros((1, 3))
_IDENTITY = np.array([1.0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0])


@dataclass(frozen=True, slots=True)
class UpdateReport:
    """Counts of inserted and dropped beams of an update, summed over its grids.

    Parameters
    ----------
    rays : int
        Beams that were inserted.
    cut : int
        Of these, beams cut at the maximum range: they mark free space only.
    not_finite, zero_length, outside : int
        Dropped beams: NaN or infinite, of length 0, or not inside the addressable cube.
    locked : int
        Grids that were not updated because they are locked.
    bricks : int
        Bricks that were written.
    """

    rays: int = 0
    cut: int = 0
    not_finite: int = 0
    zero_length: int = 0
    outside: int = 0
    locked: int = 0
    bricks: int = 0

    @property
    def dropped(self) -> int:
        """Beams that were not inserted."""
        return self.not_finite + self.zero_length + self.outside

    def __add__(self, other: UpdateReport) -> UpdateReport:
        return UpdateReport(*(getattr(self, f) + getattr(other, f) for f in self.__dataclass_fields__))


def pose_row(pose: Any, dim: int) -> Array:
    """``T_grid_scan`` for the kernels, ``(12,)``: rotation matrix row by row, then translation [m].

    Parameters
    ----------
    pose : (7,) x y z qx qy qz qw, (3,) x y θ in 2-D, (4, 4), or None for the identity
    """
    if pose is None:
        return _IDENTITY
    T = np.asarray(pose, dtype=np.float64)
    if T.shape != (7,):
        return pose_rows(T[None], dim)[0]
    # fast path for a single map: twenty array operations would take as long as the scan itself
    px, py, pz, x, y, z, w = T.tolist()
    n = x * x + y * y + z * z + w * w
    if not (0.25 <= n <= 4.0 and math.isfinite(px + py + pz)):
        return pose_rows(T[None], dim)[0]
    s = 2.0 / n
    return np.array(
        (
            1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w),
            s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w),
            s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y),
            px, py, pz,
        )
    )  # fmt: skip


def pose_rows(poses: Any, dim: int) -> Array:
    """As :func:`pose_row` for many poses, ``(n, 7)``, ``(n, 3)`` or ``(n, 4, 4)`` to ``(n, 12)``."""
    T = np.asarray(poses, dtype=np.float64)
    finite = math.isfinite(T.sum())  # fast; the sum of finite numbers may overflow, hence the second test
    if not finite and not np.all(np.isfinite(T)):
        k = int(np.argwhere(~np.isfinite(T))[0][0])
        raise GeometryError(f"pose {k} is not finite", got=T[k], wanted="finite numbers")
    out = np.empty((len(T), 12))
    if T.ndim == 3 and T.shape[1:] == (4, 4):
        R = T[:, :3, :3]
        # tolerance for matrices from text files, whose entries are rounded
        wrong = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0.0) > 1e-4
        wrong |= np.linalg.det(R) < 0
        if wrong.any():
            k = int(np.flatnonzero(wrong)[0])
            raise GeometryError(f"pose {k} is no rigid motion", got=T[k].tolist(), wanted="a rotation matrix")
        out[:, :9] = R.reshape(-1, 9)
        out[:, 9:] = T[:, :3, 3]
    elif T.ndim == 2 and T.shape[1] == 7:
        x, y, z, w = T[:, 3], T[:, 4], T[:, 5], T[:, 6]
        n = x * x + y * y + z * z + w * w
        if n.min(initial=1.0) < 0.25 or n.max(initial=1.0) > 4.0:
            k = int(np.argmax(np.abs(n - 1)))
            raise GeometryError(f"quaternion of pose {k} is not of unit length", got=T[k, 3:], wanted="length 1")
        s = 2.0 / n
        out[:, 0] = 1 - s * (y * y + z * z)
        out[:, 1] = s * (x * y - z * w)
        out[:, 2] = s * (x * z + y * w)
        out[:, 3] = s * (x * y + z * w)
        out[:, 4] = 1 - s * (x * x + z * z)
        out[:, 5] = s * (y * z - x * w)
        out[:, 6] = s * (x * z - y * w)
        out[:, 7] = s * (y * z + x * w)
        out[:, 8] = 1 - s * (x * x + y * y)
        out[:, 9:] = T[:, :3]
    elif T.ndim == 2 and T.shape[1] == 3 and dim == 2:
        c, s = np.cos(T[:, 2]), np.sin(T[:, 2])
        out[:] = 0.0
        out[:, 0], out[:, 1], out[:, 3], out[:, 4], out[:, 8] = c, -s, s, c, 1.0
        out[:, 9:11] = T[:, :2]
    else:
        raise GeometryError(
            "poses have the wrong shape", got=T.shape, wanted="(n, 7) or (n, 4, 4)" + (" or (n, 3)" if dim == 2 else "")
        )
    return out


def point_rows(points: Any, dim: int, voxel_size: float, what: str = "points") -> Array:
    """Points ``(n, 3)`` or ``(n, 2)`` as ``(n, 3)`` [m]; 2-D points get the height of the centre of the layer k = 0."""
    p = np.ascontiguousarray(points, dtype=np.float64)
    if p.ndim != 2 or p.shape[1] != dim:
        raise GridError(f"{what} have the wrong shape", got=p.shape, wanted=f"(n, {dim})")
    if dim == 3:
        # numba treats a read-only array as another type and would compile every kernel again
        return p if p.flags.writeable else p.copy()
    flat = np.empty((len(p), 3))
    flat[:, :2] = p
    flat[:, 2] = 0.5 * voxel_size
    return flat


def scan_rows(
    points: Any, origin: Any, returns: Any, max_range: float | None, dim: int, voxel_size: float
) -> tuple[Array, Array, npt.NDArray[np.uint8], float]:
    """Scan for the kernels: points ``(n, 3)``, origins ``(n, 3)`` or ``(1, 3)``, returns, maximum range [m]."""
    p = point_rows(points, dim, voxel_size)
    if origin is None:
        o = _ZERO if dim == 3 else np.array([[0.0, 0.0, 0.5 * voxel_size]])
    else:
        o = np.asarray(origin, dtype=np.float64)
        o = point_rows(o[None] if o.ndim == 1 else o, dim, voxel_size, "beam origins")
        if len(o) not in (1, len(p)):
            raise GridError("beam origins and points differ in number", got=len(o), wanted=f"1 or {len(p)}")
    if returns is None:
        r = _NO_RETURNS
    else:
        r = np.array(returns, dtype=np.uint8, order="C")
        if r.shape != (len(p),):
            raise GridError("returns and points differ in number", got=r.shape, wanted=f"({len(p)},)")
        if len(p) == 0:
            r = _NO_RETURNS
    limit = math.inf if max_range is None else float(max_range)
    if not limit > 0.0:
        raise GridError("impossible maximum range", got=max_range, wanted="> 0 m")
    return p, o, r, limit


def check_number(what: str, got: Sequence[Any] | Array, wanted: int) -> None:
    """Raise `GridError` if a list has not one entry per grid."""
    if len(got) != wanted:
        raise GridError(f"{what} differ in number from the grids", got=len(got), wanted=wanted)
