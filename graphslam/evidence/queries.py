"""Queries on evidence grids: expected ranges of beams (ray casting), and values of voxels at points.

`cast_grids` and `endpoint_probability` work on many grids in one call, each with its own pose, to weight particles.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import ConfigError, GridError
from graphslam.core.geometry import Array
from graphslam.evidence.batch import _in_threads
from graphslam.evidence.cast_kernels import (
    HIT,
    INSIDE,
    LEFT,
    MAX_RANGE,
    UNKNOWN_SPACE,
    UNUSABLE,
    cast_rays,
    unit_directions,
)
from graphslam.evidence.grid_tree import GridTree
from graphslam.evidence.layout import STEP
from graphslam.evidence.query_kernels import look_up_values
from graphslam.evidence.scan import check_number, point_rows, pose_row, pose_rows

__all__ = [
    "HIT",
    "INSIDE",
    "LEFT",
    "MAX_RANGE",
    "UNKNOWN_SPACE",
    "UNUSABLE",
    "CastResult",
    "cast_beams",
    "cast_grids",
    "endpoint_probability",
    "known_at",
    "log_odds_at",
    "occupied_at",
]

_NO_VOXELS = np.empty((0, 0, 0), np.int32)


@dataclass(frozen=True, slots=True)
class CastResult:
    """Expected ranges of beams, for one grid ``(n,)`` or for P grids ``(P, n)``.

    Parameters
    ----------
    ranges : (..., n)
        For a hit, distance from the origin to the middle of the beam's chord in the first occupied voxel, at most the
        maximum range [m]. A beam measured in this voxel may end anywhere on the chord, so its middle is unbiased,
        while the entry point would be too short by half a chord. For other beams, the range where they ended; NaN for
        unusable beams.
    status : (..., n) int8
        `MAX_RANGE` 0: no hit up to the maximum range; `HIT` 1; `INSIDE` 2: starts in an occupied voxel, range 0;
        `LEFT` 3: left the addressable cube; `UNUSABLE` 4: direction zero or not finite, or origin not finite or
        outside the cube; `UNKNOWN_SPACE` 5: reached an unknown voxel (only if ``ignore_unknown`` is False).
    voxels : (..., n, 3) int32 or None
        Signed coordinates of the voxel where a beam ended, if requested. For hits it is the occupied voxel, for other
        beams that of the end point, up to rounding. Undefined for unusable beams.
    """

    ranges: Array
    status: npt.NDArray[np.int8]
    voxels: npt.NDArray[np.int32] | None = None

    @property
    def hit(self) -> npt.NDArray[np.bool_]:
        """Beams that ended in an occupied voxel, including those that started in one."""
        return (self.status == HIT) | (self.status == INSIDE)


def cast_beams(
    grid: GridTree,
    origins: Any,
    directions: Any,
    max_range: float,
    *,
    pose: Any = None,
    ignore_unknown: bool = True,
    voxels: bool = False,
) -> CastResult:
    """First occupied voxel along each beam in one grid.

    Parameters
    ----------
    origins : (3,) or (n, 3), (2,) or (n, 2) in 2-D, or None for 0
        In the scan frame [m].
    directions : (n, 3) or (n, 2)
        In the scan frame, of any length.
    max_range : float
        Voxels entered beyond this range are ignored [m]; infinite: up to the faces of the addressable cube.
    pose : (7,), (4, 4), or (3,) in 2-D
        ``T_grid_scan``; default identity.
    ignore_unknown : bool
        True: unknown voxels are treated as free (an option of OctoMap's ``castRay``). False: beams stop there.
    voxels : bool
        Also return the end voxels.

    Returns
    -------
    CastResult
        Arrays ``(n, …)``.
    """
    rows = pose_row(pose, grid.dim)[None]
    found = _cast([grid], rows, origins, directions, max_range, ignore_unknown, voxels, 1)
    return CastResult(found.ranges[0], found.status[0], None if found.voxels is None else found.voxels[0])


def cast_grids(
    grids: Sequence[GridTree],
    poses: Any,
    origins: Any,
    directions: Any,
    max_range: float,
    *,
    ignore_unknown: bool = True,
    voxels: bool = False,
    threads: int = 1,
) -> CastResult:
    """As :func:`cast_beams` for one scan in many grids, each with its own pose.

    Parameters
    ----------
    grids : sequence of EvidenceGrid
        P grids with the same pool, voxel size and threshold; a grid may occur several times.
    poses : (P, 7), (P, 4, 4), or (P, 3) in 2-D
        ``T_grid_scan`` for each grid.
    threads : int
        The result is the same for any number.

    Returns
    -------
    CastResult
        Arrays ``(P, n, …)``.
    """
    if not len(grids):
        n = len(np.asarray(directions))
        return CastResult(
            np.zeros((0, n)), np.zeros((0, n), np.int8), np.zeros((0, n, 3), np.int32) if voxels else None
        )
    rows = pose_rows(poses, grids[0].dim)
    return _cast(grids, rows, origins, directions, max_range, ignore_unknown, voxels, threads)


def _cast(
    grids: Sequence[GridTree],
    rows: Array,
    origins: Any,
    directions: Any,
    max_range: float,
    ignore_unknown: bool,
    voxels: bool,
    threads: int,
) -> CastResult:
    first = check_together(grids, same_threshold=True)
    check_number("poses", rows, len(grids))
    limit = float(max_range)
    if not limit > 0.0:
        raise GridError("impossible maximum range", got=max_range, wanted="> 0 m")
    # z of a 2-D direction is 0; only the origin is at half the height of the layer
    d = point_rows(directions, first.dim, 0.0, "beam directions")
    o = np.zeros(first.dim) if origins is None else np.asarray(origins, dtype=np.float64)
    o = point_rows(o[None] if o.ndim == 1 else o, first.dim, first.voxel_size, "beam origins")
    if len(o) not in (1, len(d)):
        raise GridError("beam origins and directions differ in number", got=len(o), wanted=f"1 or {len(d)}")
    shape = (len(grids), len(d))
    units = np.empty(d.shape)
    unit_directions(d, units)
    ranges, status = np.empty(shape), np.empty(shape, np.int8)
    ends = np.empty((*shape, 3), np.int32) if voxels else _NO_VOXELS
    pool = first.pool
    with pool.lock:
        roots, t = np.array([g.root for g in grids], np.int64), pool.tree

        def run(begin: int, end: int) -> None:
            cast_rays(
                begin, end, roots, rows, o, units, limit, first.voxel_size, pool.half, pool.levels,
                first.model.threshold_step, not ignore_unknown, t.children, t.node_occupied, t.bricks,
                t.brick_lines, ranges, status, ends,
            )  # fmt: skip

        _share(run, len(grids), threads)
    return CastResult(ranges, status, ends if voxels else None)


def endpoint_probability(
    grids: Sequence[GridTree],
    poses: Any,
    points: Any,
    *,
    interpolation: str = "nearest",
    unknown: float = 0.5,
    threads: int = 1,
) -> npt.NDArray[np.float32]:
    """Occupancy probabilities at the points of one scan, in many grids.

    Parameters
    ----------
    grids, poses, points
        P grids; ``T_grid_scan`` ``(P, 7)``, ``(P, 4, 4)`` or ``(P, 3)``; ``(n, 3 | 2)`` in the scan frame [m].
    interpolation : {"nearest", "trilinear"}
        Value of the voxel that contains the point, or interpolation between the centres of the eight voxels around it
        (four in 2-D), which is continuous in the pose.
    unknown : float
        Probability used for unknown voxels and outside the cube.

    Returns
    -------
    (P, n) float32
        NaN for points that are not finite.
    """
    if interpolation not in ("nearest", "trilinear"):
        raise ConfigError(f"interpolation {interpolation!r}; wanted 'nearest' or 'trilinear'")
    if not 0.0 <= unknown <= 1.0:
        raise ConfigError(f"probability of the unknown is {unknown}; wanted 0 … 1")
    table = _probability_table(float(unknown))
    return _look_up(grids, _rows(grids, poses), points, table, interpolation == "trilinear", threads)


def log_odds_at(grid: GridTree, points: Any) -> npt.NDArray[np.float32]:
    """Log-odds ``(n,)`` of the voxels that contain points ``(n, dim)`` [m] in the grid frame; NaN where unknown."""
    rows = pose_row(None, grid.dim)[None]
    return _look_up([grid], rows, points, _log_odds_table(), False, 1)[0]


def occupied_at(grid: GridTree, points: Any) -> npt.NDArray[np.bool_]:
    """Whether points ``(n, dim)`` [m] in the grid frame lie in occupied voxels: known, value ≥ threshold."""
    return grid.values_at(points) >= grid.model.threshold_step


def known_at(grid: GridTree, points: Any) -> npt.NDArray[np.bool_]:
    """Whether points ``(n, dim)`` [m] in the grid frame lie in observed voxels."""
    return ~np.isnan(log_odds_at(grid, points))


def _rows(grids: Sequence[GridTree], poses: Any) -> Array:
    return pose_rows(poses, grids[0].dim) if len(grids) else np.empty((0, 12))


def _look_up(
    grids: Sequence[GridTree],
    rows: Array,
    points: Any,
    table: npt.NDArray[np.float32],
    trilinear: bool,
    threads: int,
) -> npt.NDArray[np.float32]:
    if not len(grids):
        return np.zeros((0, len(np.asarray(points))), np.float32)
    first = check_together(grids)
    check_number("poses", rows, len(grids))
    p = point_rows(points, first.dim, first.voxel_size)
    out = np.empty((len(grids), len(p)), np.float32)
    pool = first.pool
    with pool.lock:
        roots, t = np.array([g.root for g in grids], np.int64), pool.tree

        def run(begin: int, end: int) -> None:
            look_up_values(
                begin, end, roots, rows, p, 1.0 / first.voxel_size, pool.half, pool.levels, trilinear, table,
                t.children, t.bricks, out,
            )  # fmt: skip

        _share(run, len(grids), threads)
    return out


def check_together(grids: Sequence[GridTree], *, same_threshold: bool = False) -> GridTree:
    """Raise `GridError` for grids that cannot be read in one call; returns the first grid."""
    first = grids[0]
    for k, g in enumerate(grids):
        if g.pool is not first.pool or g.voxel_size != first.voxel_size or g.dim != first.dim:
            raise GridError(
                f"grid {k} does not belong to the others", wanted="one pool, voxel size and dimension", got=repr(g)
            )
        if same_threshold and g.model.threshold_step != first.model.threshold_step:
            raise GridError(
                f"grid {k} has another threshold than the first", got=g.model.threshold, wanted=first.model.threshold
            )
    return first


def _share(run: Callable[[int, int], None], n: int, threads: int) -> None:
    """Call ``run(begin, end)`` on blocks of n grids, one block per thread."""
    if threads < 1:
        raise ConfigError(f"{threads} threads; wanted at least 1")
    threads = min(threads, n)
    if threads == 1:
        run(0, n)
        return
    cuts = [n * i // threads for i in range(threads + 1)]
    _in_threads(lambda i: run(cuts[i], cuts[i + 1]), threads)


@lru_cache(maxsize=1)
def _log_odds_table() -> npt.NDArray[np.float32]:
    """Log-odds of each value, row v + 32768; NaN for unknown."""
    table = (np.arange(-32768, 32768) * STEP).astype(np.float32)  # exact: STEP is a power of two
    table[0] = math.nan
    return table


@lru_cache(maxsize=8)
def _probability_table(unknown: float) -> npt.NDArray[np.float32]:
    """Probability of each value, row v + 32768."""
    table = (1.0 / (1.0 + np.exp(-np.arange(-32768, 32768) * STEP))).astype(np.float32)
    table[0] = unknown
    return table
