"""Merge of two maps: sum of their log-odds under a rigid transform (SegSLAM A12)."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import GridError
from graphslam.core.geometry import Array
from graphslam.evidence.batch import write_packed
from graphslam.evidence.grid_tree import GridTree
from graphslam.evidence.layout import BRICK_EDGE, BRICK_VOXELS, UNKNOWN
from graphslam.evidence.merge_kernels import sample_bricks
from graphslam.evidence.scan import pose_row

CHUNK = 2048
"""Bricks that are processed at a time; limits the memory of a merge to a few megabytes."""


def merge_grids(grid: GridTree, other: GridTree, pose: Any = None) -> int:
    """Add the log-odds of ``other`` to ``grid``; returns the number of voxels updated.

    The value added to a voxel is that of the voxel of ``other`` that contains its centre, or 0 if that is unknown. Sums
    are clamped to the bounds of the model of ``grid``. The grids may be of different pools, and may share bricks.

    Parameters
    ----------
    grid, other : EvidenceGrid
        With the same voxel size and dimension.
    pose : (7,), (4, 4), or (3,) in 2-D
        ``T_grid_other``; default identity.
    """
    grid.check_writable()
    if other.voxel_size != grid.voxel_size or other.dim != grid.dim:
        raise GridError(
            "grids of different voxel size or dimension cannot be merged",
            got=f"{other.voxel_size} m, {other.dim}-D",
            wanted=f"{grid.voxel_size} m, {grid.dim}-D",
        )
    source = other.copy()  # unaffected by the write, even if it shares bricks with the written grid
    T = pose_row(pose, grid.dim)
    R, t = T[:9].reshape(3, 3), T[9:]
    if grid.dim == 2 and abs(R[2, 2] - 1) + abs(t[2]) > 1e-9:
        raise GridError("a 2-D grid was to be merged out of its plane", got=T.tolist(), wanted="rotation about z")
    T_inverse = np.concatenate([R.T.ravel(), -R.T @ t])
    keys = _touched(grid, source.brick_coordinates(), R, t)
    work = grid.copy()  # the grid itself is replaced at the end, so that the merge is atomic
    pool = grid.pool
    with pool.lock:
        bricks = grid.packed_bricks()  # unchanged during the merge, because only the copy is written
    found = 0
    for begin in range(0, len(keys), CHUNK):
        part = keys[begin : begin + CHUNK]
        values = np.empty((len(part), BRICK_VOXELS), np.int16)
        theirs = source.pool
        with theirs.lock:
            known = sample_bricks(part, T_inverse, grid.voxel_size, pool.half, source.root, theirs.tree, values)
        if known == 0:
            continue
        found += known
        some = (values != UNKNOWN).any(axis=1)
        part, values = part[some], values[some]
        with pool.lock:
            old = pool.tree.bricks[_ids(bricks, part)]
        write_packed(work, part, _sum(old, values, *grid.model.clamp_steps))
    grid.replace_contents(work)
    return found


def _ids(bricks: npt.NDArray[np.int64], keys: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Ids of bricks at packed coordinates, 0 (the unknown brick) if absent; ``bricks (n, 2)`` is ascending."""
    if len(bricks) == 0:
        return np.zeros(len(keys), np.int64)
    at = np.minimum(np.searchsorted(bricks[:, 0], keys), len(bricks) - 1)
    return np.where(bricks[at, 0] == keys, bricks[at, 1], 0)


def _sum(old: npt.NDArray[np.int16], add: npt.NDArray[np.int16], low: int, high: int) -> npt.NDArray[np.int16]:
    """Clamped sum of log-odds; unknown values of ``add`` add nothing, unknown voxels of ``old`` start at 0."""
    known = add != UNKNOWN
    new = np.where(old == UNKNOWN, 0, old).astype(np.int32) + add
    return np.where(known, np.clip(new, low, high), old).astype(np.int16)


def _touched(grid: GridTree, coordinates: npt.NDArray[np.int64], R: Array, t: Array) -> npt.NDArray[np.int64]:
    """Packed coordinates of the target bricks that the bounding boxes of moved source bricks overlap, ascending."""
    edge = BRICK_EDGE * grid.voxel_size
    half = grid.pool.half // BRICK_EDGE
    if len(coordinates) == 0:
        return np.zeros(0, np.int64)
    centre = (coordinates + 0.5) * edge @ R.T + t
    reach = 0.5 * edge * np.abs(R).sum(axis=1)  # half extent of the box around a rotated cube
    # slack: bricks that only touch are not merged if both lattices coincide
    slack = 1e-6 * grid.voxel_size
    first = np.floor((centre - reach + slack) / edge).astype(np.int64)
    last = np.floor((centre + reach - slack) / edge).astype(np.int64)
    if grid.dim == 2:
        first[:, 2] = last[:, 2] = 0
    if first.min() < -half or last.max() >= half:
        raise GridError(
            "a merged map would reach out of the addressable cube",
            got=f"bricks {first.min(axis=0).tolist()} … {last.max(axis=0).tolist()}",
            wanted=f"[{-half}, {half}), or a pool of more levels",
        )
    span = int((last - first).max()) + 1
    offsets = np.stack(np.meshgrid(*[np.arange(span)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    found = []
    for offset in offsets:
        b = first + offset
        u = b[np.all(b <= last, axis=1)] + half
        found.append((u[:, 2] << 40) | (u[:, 1] << 20) | u[:, 0])
    return np.unique(np.concatenate(found))
