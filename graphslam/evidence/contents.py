"""Statistics of a whole evidence grid: voxel counts, extent, point clouds, entropy."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import GridError
from graphslam.core.geometry import Array
from graphslam.evidence.dense_kernels import known_box
from graphslam.evidence.grid_tree import GridTree
from graphslam.evidence.layout import STEP
from graphslam.evidence.query_kernels import count_boxes, count_voxel_values, list_occupied, walk_once
from graphslam.evidence.scan import point_rows
from graphslam.evidence.tree_kernels import BRICKS_USED, NODES_USED

Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class BoxCounts:
    """Numbers of voxels in boxes, each ``(m,)`` int64.

    Parameters
    ----------
    occupied, known : (m,)
        Occupied voxels; observed voxels.
    voxels : (m,)
        All voxels inside the addressable cube.
    """

    occupied: Ints
    known: Ints
    voxels: Ints


@dataclass(frozen=True, slots=True)
class VoxelCounts:
    """Numbers of voxels of a whole grid: known = occupied + free."""

    occupied: int
    free: int

    @property
    def known(self) -> int:
        """Voxels that were observed."""
        return self.occupied + self.free


@dataclass(frozen=True, slots=True)
class BinnedCloud:
    """Occupied voxels grouped in larger cells, ascending in (z, y, x) of the cells.

    Parameters
    ----------
    points : (m, dim)
        Centroid of the centres of the occupied voxels in each cell [m].
    counts : (m,)
        Their number.
    """

    points: Array
    counts: Ints


def box_query(grid: GridTree, lower: Any, upper: Any) -> BoxCounts:
    """Numbers of occupied, known and all voxels that overlap boxes.

    Parameters
    ----------
    lower, upper : (m, dim)
        Corners in the grid frame [m]; may be infinite. A voxel that a box only touches is not counted; a box without
        extent along an axis overlaps the voxels that contain it. Voxels outside the addressable cube are not counted.
    """
    a = point_rows(lower, grid.dim, grid.voxel_size, "lower corners")
    b = point_rows(upper, grid.dim, grid.voxel_size, "upper corners")
    if a.shape != b.shape:
        raise GridError("lower and upper corners differ in number", got=len(b), wanted=len(a))
    wrong = ~(a <= b).all(axis=1)  # also NaN
    if wrong.any():
        k = int(np.flatnonzero(wrong)[0])
        raise GridError(f"box {k} is no box", got=f"{a[k].tolist()} … {b[k].tolist()}", wanted="lower <= upper")
    pool = grid.pool
    edge = 2.0 * pool.half
    scale = 1.0 / grid.voxel_size
    low = np.floor(a * scale + pool.half)
    high = np.maximum(np.ceil(b * scale + pool.half), low + 1.0)
    low, high = np.clip(low, 0.0, edge).astype(np.int64), np.clip(high, 0.0, edge).astype(np.int64)
    counts = np.empty((len(low), 2), np.int64)
    with pool.lock:
        count_boxes(
            grid.root, low, high, pool.levels, grid.model.threshold_step, pool.tree.children, pool.tree.bricks, counts
        )  # fmt: skip
    return BoxCounts(counts[:, 0], counts[:, 1], np.prod(high - low, axis=1))


def bounding_box(grid: GridTree) -> tuple[Array, Array] | None:
    """Corners ``(dim,)``, ``(dim,)`` of the smallest box that contains all known voxels [m]; None if empty."""
    pool = grid.pool
    bounds = np.empty(6, np.int64)
    with pool.lock:
        known_box(grid.root, pool.levels, pool.tree.children, pool.tree.bricks, bounds)
    if bounds[3] <= bounds[0]:
        return None
    corners = np.stack([bounds[:3], bounds[3:]]) - pool.half
    lower, upper = np.asarray(corners[:, : grid.dim] * grid.voxel_size, dtype=np.float64)
    return lower, upper


def occupied_voxels(grid: GridTree) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int16]]:
    """Signed coordinates ``(n, 3)`` and values ``(n,)`` [`layout.STEP`] of the occupied voxels.

    Order: brick by brick, ascending in (z, y, x) of the bricks and, inside each brick, of the voxels.
    """
    pool = grid.pool
    with pool.lock:
        rows = grid.packed_bricks()
        tree = pool.tree
        rows = rows[tree.brick_lines[rows[:, 1]] != 0]
        args = rows, pool.half, grid.model.threshold_step, tree.bricks, tree.brick_lines
        n = list_occupied(*args, np.empty((0, 3), np.int32), np.empty(0, np.int16))
        voxels, values = np.empty((n, 3), np.int32), np.empty(n, np.int16)
        list_occupied(*args, voxels, values)
    return voxels, values


def occupied_cloud(grid: GridTree, *, with_log_odds: bool = False) -> Any:
    """Centres of the occupied voxels.

    Parameters
    ----------
    with_log_odds : bool
        Also return their log-odds.

    Returns
    -------
    (n, dim) float64, or that and (n,) float32
        In the grid frame [m], in the order of :func:`occupied_voxels`.
    """
    voxels, values = occupied_voxels(grid)
    points = (voxels[:, : grid.dim] + 0.5) * grid.voxel_size
    return (points, (values * STEP).astype(np.float32)) if with_log_odds else points


def binned_cloud(grid: GridTree, level: int, *, minimum: int = 1) -> BinnedCloud:
    """Occupied voxels grouped in cells with an edge of ``2**level`` voxels: a thinned cloud to match submaps with.

    Parameters
    ----------
    level : int
        0: each voxel is a cell. Cells are those of the octree: the lattice of cells contains the origin.
    minimum : int
        Cells with fewer occupied voxels are omitted.
    """
    height = int(grid.pool.half).bit_length()
    if not (isinstance(level, (int, np.integer)) and 0 <= level <= height):
        raise GridError("impossible level of a binned cloud", got=level, wanted=f"0 … {height}")
    voxels, _ = occupied_voxels(grid)
    cells = (voxels.astype(np.int64) >> int(level)) + grid.pool.half
    keys = (cells[:, 2] << 40) | (cells[:, 1] << 20) | cells[:, 0]
    _, first, inverse, counts = np.unique(keys, return_index=True, return_inverse=True, return_counts=True)
    # offsets from the cell corner are small integers, so their sums are exact in any order
    offsets = voxels - ((voxels >> int(level)) << int(level))
    sums = np.stack([np.bincount(inverse, offsets[:, i], len(counts)) for i in range(grid.dim)], axis=1)
    corner = ((voxels[first, : grid.dim] >> int(level)) << int(level)).astype(np.float64)
    points = (corner + sums / counts[:, None] + 0.5) * grid.voxel_size
    keep = counts >= minimum
    return BinnedCloud(points[keep], counts[keep].astype(np.int64))


def value_counts(grid: GridTree) -> Ints:
    """Number of voxels of each value, ``(65536,)``, row v + 32768; row 0 (unknown) is set to 0.

    A brick that occurs in many places of a compacted map is read once.
    """
    pool = grid.pool
    counts = np.zeros(65536, np.int64)
    with pool.lock:
        if grid.root == 0:
            return counts
        n, b = int(pool.tree.counters[NODES_USED]), int(pool.tree.counters[BRICKS_USED])  # ids beyond were never used
        times = np.zeros(b, np.int64)
        bricks = np.empty(b, np.int64)
        found = walk_once(
            np.array([grid.root], np.int64), pool.levels, pool.tree.children, np.zeros(n, np.int64), times,
            np.empty(n, np.int64), bricks, np.empty(pool.levels + 1, np.int64),
        )  # fmt: skip
        count_voxel_values(bricks[:found], times, pool.tree.bricks, counts)
    counts[0] = 0
    return counts


def voxel_counts(grid: GridTree) -> VoxelCounts:
    """Numbers of occupied and free voxels."""
    counts = value_counts(grid)
    row = grid.model.threshold_step + 32768
    return VoxelCounts(int(counts[row:].sum()), int(counts[:row].sum()))


def known_volume(grid: GridTree) -> float:
    """Volume of the observed voxels [m³], in 2-D their area [m²]."""
    return float(value_counts(grid).sum()) * grid.voxel_size**grid.dim


def entropy(grid: GridTree) -> float:
    """Entropy of the observed voxels times the voxel volume (SegSLAM eq. 20–22) [nat m³; in 2-D nat m²].

    ``H = Σ γ (-ρ log ρ - (1 - ρ) log(1 - ρ))``. Voxels are counted by value first, so that the sum does not
    depend on the order of the bricks.
    """
    return entropy_of_counts(value_counts(grid)) * grid.voxel_size**grid.dim


def entropy_of_counts(counts: Ints) -> float:
    """Sum of the entropies of voxels, from the counts of :func:`value_counts` [nat]."""
    return float(np.sum(counts * _entropies()))


@lru_cache(maxsize=1)
def _entropies() -> Array:
    """Entropy of a voxel for each value [nat] (eq. 21), computed from the smaller of ρ and 1 - ρ."""
    q = 1.0 / (1.0 + np.exp(np.abs(np.arange(-32768, 32768)) * STEP))
    return -q * np.log(q) - (1.0 - q) * np.log1p(-q)
