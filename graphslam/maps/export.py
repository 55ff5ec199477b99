"""Export of fused maps: points (PLY), OctoMap (``.bt``, ``.ot``), floor plans (PGM and YAML)."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from graphslam.core.atomic import atomic_open
from graphslam.core.errors import FormatError, GridError
from graphslam.core.geometry import Array, arc_length
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.layout import BRICK_EDGE, BRICK_VOXELS, UNKNOWN
from graphslam.evidence.map_server import save_map_server
from graphslam.evidence.octomap import write_octomap
from graphslam.evidence.pool import GridPool
from graphslam.maps.coarse import drawable_map, fit_octomap

STOREY_GAP = 1.5
"""Least difference of heights between two floors of a path [m]."""
LEVEL_SLOPE = 0.05
"""A path with a smaller slope is on a floor, otherwise on a ramp."""


def save_ply(grid: EvidenceGrid, path: str | os.PathLike[str]) -> Path:
    """Write the centres of the occupied voxels as points with their log-odds; those of a 2-D grid have height 0.

    Binary PLY: float32 ``x``, ``y``, ``z``, ``log_odds``.
    """
    target = Path(path)
    if target.suffix != ".ply":
        raise FormatError("unknown ending of a cloud", where=str(path), got=target.suffix, wanted=".ply")
    points, log_odds = grid.occupied_cloud(with_log_odds=True)
    return _write_ply(target, points, log_odds=log_odds)


def save_points(points: Array, path: str | os.PathLike[str]) -> Path:
    """Write points ``(n, 2 | 3)`` as binary PLY, float32 ``x``, ``y``, ``z``; 2-D points have height 0."""
    return _write_ply(Path(path), points)


def _write_ply(target: Path, points: Array, **columns: Array) -> Path:
    rows = np.zeros((len(points), 3 + len(columns)), "<f4")
    rows[:, : points.shape[1]] = points
    for k, values in enumerate(columns.values()):
        rows[:, 3 + k] = values
    head = "".join(f"property float {name}\n" for name in ("x", "y", "z", *columns))
    with atomic_open(target) as stream:
        stream.write(f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{head}end_header\n".encode())
        stream.write(rows.tobytes())
    return target


def floor_plan(grid: EvidenceGrid, low: float, high: float) -> EvidenceGrid:
    """A 2-D map of a height band: the largest log-odds of each column in the band; unknown if all are.

    Parameters
    ----------
    grid : EvidenceGrid
        3-D.
    low, high : float
        The band [m]; voxels with centres inside it are used.
    """
    if grid.dim != 3:
        raise GridError("a 2-D grid is a floor plan already", got="2-D", wanted="3-D")
    if not (np.isfinite([low, high]).all() and high > low):
        raise GridError("impossible band of heights", got=f"{low} … {high} m", wanted="low < high")
    first, last = (int(np.ceil(z / grid.voxel_size - 0.5)) for z in (low, high))  # the one after the last
    if last <= first:
        raise GridError("no layer of voxels has its middle in this band", got=f"{low} … {high} m")
    coordinates, pool = grid.brick_coordinates(), grid.pool
    bottom = BRICK_EDGE * coordinates[:, 2]
    near = np.flatnonzero((bottom < last) & (bottom + BRICK_EDGE > first))
    with pool.lock:
        values = pool.tree.bricks[grid.packed_bricks()[near, 1]].reshape(-1, BRICK_EDGE, BRICK_EDGE**2)
    coordinates = coordinates[near]
    z = BRICK_EDGE * coordinates[:, 2, None] + np.arange(BRICK_EDGE)
    tops = np.where(((z >= first) & (z < last))[:, :, None], values, np.int16(UNKNOWN)).max(axis=1)  # unknown is least
    columns, where = np.unique(coordinates[:, :2], axis=0, return_inverse=True)
    plan = np.full((len(columns), BRICK_EDGE**2), UNKNOWN, np.int16)
    np.maximum.at(plan, where.ravel(), tops)
    some = (plan != UNKNOWN).any(axis=1)
    bricks = np.full((int(some.sum()), BRICK_VOXELS), UNKNOWN, np.int16)
    bricks[:, : BRICK_EDGE**2] = plan[some]
    out = EvidenceGrid(grid.voxel_size, model=grid.model, dim=2, pool=GridPool(grid.pool.levels))
    out.write_bricks(np.column_stack([columns[some], np.zeros(int(some.sum()), np.int64)]), bricks)
    return out


def storeys(positions: Array, *, shortest: float = 5.0) -> list[float]:
    """Heights of the floors of a path, ascending [m]: those with at least ``shortest`` metres of level path.

    Parameters
    ----------
    positions : (n, 3)
        Along the path [m].
    shortest : float
        Level path length on a floor [m].
    """
    p = np.asarray(positions, dtype=np.float64)
    if p.ndim != 2 or p.shape[1] != 3 or not np.all(np.isfinite(p)):
        raise GridError("impossible positions of a path", got=p.shape, wanted="(n, 3), finite")
    if len(p) < 2:
        return []
    arc = arc_length(p)
    if arc[-1] <= 0:
        return []
    at = np.arange(0.0, arc[-1], 0.25)  # even in distance, so that standstill has no weight
    z = np.interp(at, arc, p[:, 2])
    # the slope over two metres: wheels go over bumps
    slope = np.abs(np.interp(at + 1.0, arc, p[:, 2]) - np.interp(at - 1.0, arc, p[:, 2])) / 2.0
    flat = np.sort(z[slope < LEVEL_SLOPE])
    groups = np.split(flat, np.flatnonzero(np.diff(flat) > STOREY_GAP) + 1)
    return [float(np.median(g)) for g in groups if 0.25 * len(g) >= shortest]


def save_maps(
    grid: EvidenceGrid,
    folder: str | os.PathLike[str],
    *,
    name: str = "map",
    bands: Mapping[str, tuple[float, float]] | None = None,
) -> list[Path]:
    """Write a map in all available formats.

    Parameters
    ----------
    folder : path
        Created if it does not exist.
    name : str
        ``name.ply``, ``name.bt`` (3-D), and map_server pairs ``name.yaml``, ``name.pgm`` (2-D) or one for each band.
    bands : mapping of str to (low, high), optional
        Floor plans of a 3-D map, ``name-<band>.yaml`` [m].

    Returns
    -------
    list of paths written; a band without known voxels is left out. Floor plans with too many pixels,
    and a map larger than OctoMap's cube, get larger voxels (:mod:`graphslam.maps.coarse`), which the files contain.
    """
    target = Path(folder)
    if grid.voxel_counts().known == 0:
        raise GridError("a map in which nothing is known cannot be written", where=str(folder))
    target.mkdir(parents=True, exist_ok=True)
    made = [save_ply(grid, target / f"{name}.ply")]
    if grid.dim == 2:
        return made + list(save_map_server(drawable_map(grid), target / f"{name}.yaml"))
    write_octomap(fit_octomap(grid), target / f"{name}.bt")
    made.append(target / f"{name}.bt")
    for band, (low, high) in (bands or {}).items():
        plan = floor_plan(grid, low, high)
        if plan.voxel_counts().known:
            made += save_map_server(drawable_map(plan), target / f"{name}-{band}.yaml")
    return made
