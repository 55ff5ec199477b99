"""Compaction of evidence grids, and conversion of a grid to and from a list of bricks and uniform cubes (for files).

Only a few per cent of the bricks of a map have a single value, so updates do not search for them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import GridError
from graphslam.core.interrupt import defer_interrupts
from graphslam.evidence.batch import make_unique
from graphslam.evidence.cube_kernels import UNSEEN, States, build_tree, find_states, list_pieces, share_cubes
from graphslam.evidence.grid_tree import GridTree
from graphslam.evidence.layout import BRICK_EDGE, FAN, MAX_LEVELS, UNKNOWN
from graphslam.evidence.pool import GridPool
from graphslam.evidence.tree_kernels import BRICKS_USED, NODES_USED

Ints = npt.NDArray[np.int64]

VALUES = 1 << 16
"""Number of distinct voxel values, including UNKNOWN; value v has row v + 32768 in tables."""

G = TypeVar("G", bound=GridTree)


@dataclass(frozen=True, slots=True)
class CompactReport:
    """Nodes and bricks that a compaction returned to the pool.

    Parameters
    ----------
    nodes, bricks : int
        Numbers freed.
    """

    nodes: int = 0
    bricks: int = 0


def find_all_states(
    grids: Sequence[GridTree], *, classes: bool = False, threshold: int = 0, maxima: bool = False
) -> States:
    """States of all nodes and bricks of grids of one pool; hold the pool's lock while the states are used."""
    pool = grids[0].pool
    counters = pool.tree.counters
    b, n = int(counters[BRICKS_USED]), int(counters[NODES_USED])  # ids beyond were never used
    states = States(
        np.full(b, UNSEEN, np.int32),
        np.full(n, UNSEEN, np.int32),
        np.full(b if maxima else 0, UNKNOWN, np.int16),
        np.full(n if maxima else 0, UNKNOWN, np.int16),
    )
    for g in grids:
        if g.root and states.node[g.root] == UNSEEN:
            find_states(g.root, classes, threshold, pool.tree, states)
    return states


def compact_grids(grids: GridTree | Sequence[GridTree]) -> CompactReport:
    """Make all uniform cubes of some grids share one brick or node per size and value; lossless.

    Bricks and nodes with a single value are stored once per value; unknown ones are removed. Sharing with other grids
    is kept. No value changes, so locked grids may be compacted too.

    Parameters
    ----------
    grids : EvidenceGrid, or several of one pool

    Returns
    -------
    CompactReport
        Numbers of freed nodes and bricks.
    """
    several = list(grids) if isinstance(grids, Sequence) else [grids]
    if not several:
        return CompactReport()
    pool = several[0].pool
    if any(g.pool is not pool for g in several):
        raise GridError("grids to be compacted together are of different pools", wanted="one pool")
    with pool.lock, defer_interrupts():
        nodes, bricks = pool.used_nodes, pool.used_bricks
        states = find_all_states(several)
        # occupancy flags depend on the threshold, so grids with different thresholds cannot share cubes
        for threshold in sorted({g.model.threshold_step for g in several}):
            shared = np.zeros((pool.levels, VALUES), np.int32)
            seen = np.zeros(len(states.node), np.uint8)
            for g in several:
                if g.root and g.model.threshold_step == threshold and not seen[g.root]:
                    share_cubes(g.root, states, seen, shared, pool.tree)
        return CompactReport(nodes - pool.used_nodes, bricks - pool.used_bricks)


@dataclass(frozen=True, slots=True)
class GridPieces:
    """A map as a list of bricks and of uniform cubes, ascending in (z, y, x); unknown space is not listed.

    Parameters
    ----------
    bricks : (n, 3) int64
        Signed coordinates; brick b holds voxels 8b … 8b + 7.
    values : (n, 512) int16
        Of the bricks, x fastest, in units of `layout.STEP`.
    cubes : (m, 3) int64
        Signed coordinates of the first brick of each cube.
    log_edges : (m,) int64
        The cube's edge is ``2**log_edge`` ≥ 8 voxels.
    cube_values : (m,) int64
        Known values.
    """

    bricks: Ints
    values: npt.NDArray[np.int16]
    cubes: Ints
    log_edges: Ints
    cube_values: Ints


def grid_pieces(grid: GridTree) -> GridPieces:
    """Pieces of a grid; equal maps give equal pieces, independent of their history."""
    pool = grid.pool
    half = pool.half // BRICK_EDGE
    with pool.lock:
        mixed, cubes = list_grid(grid)
        mixed = mixed[np.argsort(mixed[:, 0])]
        cubes = cubes[np.argsort(cubes[:, 0])]
        values = pool.tree.bricks[mixed[:, 1]]
    return GridPieces(
        _unpack(mixed[:, 0]) - half, values, _unpack(cubes[:, 0]) - half, 3 + 2 * cubes[:, 1], cubes[:, 2]
    )


def list_grid(grid: GridTree) -> tuple[Ints, Ints]:
    """Mixed bricks ``(n, 2)`` and cubes ``(m, 3)`` from `cube_kernels.list_pieces`; hold the pool's lock."""
    pool = grid.pool
    states = find_all_states([grid])
    found = np.zeros(2, np.int64)
    mixed, cubes = np.zeros((0, 2), np.int64), np.zeros((0, 3), np.int64)
    if grid.root:
        for _ in range(2):  # count, then list
            mixed, cubes = np.empty((found[0], 2), np.int64), np.empty((found[1], 3), np.int64)
            list_pieces(grid.root, pool.levels, pool.tree.children, states, mixed, cubes, found)
    return mixed, cubes


def fill_grid(grid: G, pieces: GridPieces) -> G:
    """Fill an empty grid. Pieces must fit its addressable cube and must not overlap (:func:`find_overlap`)."""
    pool = grid.pool
    half = pool.half // BRICK_EDGE
    sizes = (pieces.log_edges - 3) // 2  # a cube is one child, or eight, of a node of this level
    values = len(np.unique(pieces.cube_values))
    nodes = 1 + values * int(sizes.max(initial=0))
    for level in range(pool.levels - 1):  # nodes on the paths to the pieces
        below = np.concatenate([pieces.bricks, pieces.cubes[sizes <= level]]) + half
        nodes += len(np.unique(_pack(below >> 2 * (level + 1))))
    cubes = np.column_stack([pieces.cubes + half, pieces.log_edges, pieces.cube_values])
    uniform = np.zeros((pool.levels, VALUES), np.int32)
    with pool.lock:
        pool.collect()
        pool.reserve(nodes, len(pieces.bricks) + values)
        make_unique((grid,), pool)
        threshold = grid.model.threshold_step
        build_tree(grid.root, pieces.bricks + half, pieces.values, cubes, threshold, uniform, pool.tree)
    return grid


def find_overlap(pieces: GridPieces) -> str | None:
    """Describe the first error in the order, alignment or overlap of pieces from a file, or return None."""
    for name, rows in (("bricks", pieces.bricks), ("cubes", pieces.cubes)):
        if np.any(np.diff(_pack(rows + (1 << 18))) <= 0):
            return f"{name} are not in ascending order"
    shifts = pieces.log_edges - 3
    if np.any(pieces.cubes & ((1 << shifts) - 1)[:, None]):
        return "a cube does not begin at a multiple of its edge"
    for shift in np.unique(shifts).tolist():
        larger = pieces.cubes[shifts == shift] >> shift
        smaller = np.concatenate([pieces.bricks, pieces.cubes[shifts < shift]]) >> shift
        if np.isin(_pack(smaller + (1 << 18)), _pack(larger + (1 << 18))).any():
            return "a cube overlaps another piece"
    return None


def tree_levels(reach: int) -> int | None:
    """Smallest number of levels of a tree that covers voxels -reach … reach - 1; None if too many."""
    for levels in range(2, MAX_LEVELS + 1):
        if BRICK_EDGE * FAN**levels // 2 >= reach:
            return levels
    return None


def check_reach(reach: int, pool: GridPool, where: str) -> None:
    """Raise `GridError` if a map extends beyond the addressable cube of a pool."""
    if reach > pool.half:
        needed = tree_levels(reach)
        raise GridError(
            f"map reaches {reach} voxels from the origin, beyond the addressable cube of {pool.levels} levels",
            where=where,
            got=f"levels={pool.levels}, ±{pool.half} voxels",
            wanted=f"a pool with levels={needed}" if needed else f"at most ±{BRICK_EDGE * FAN**MAX_LEVELS // 2} voxels",
        )


def _pack(coordinates: Ints) -> Ints:
    return (coordinates[:, 2] << 40) | (coordinates[:, 1] << 20) | coordinates[:, 0]


def _unpack(keys: Ints) -> Ints:
    return np.stack([keys & 0xFFFFF, (keys >> 20) & 0xFFFFF, keys >> 40], axis=1)
