"""Evidence grids that are finished: in memory while they are used, else in the file of a shelf.

A run holds the grid of every submap to its end, and uses a few at a time. :func:`spill_grid` makes a grid that is the
same to everybody who asks it something; whoever writes to it has it in memory from then on.
"""

from __future__ import annotations

import os
from functools import partial
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from graphslam.core.spill_cache import SPILL_CACHE, Arrays, CacheEntry, SpillCache
from graphslam.evidence.beams import BeamModel
from graphslam.evidence.compact import GridPieces, fill_grid, grid_pieces
from graphslam.evidence.formats import load_npz
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.layout import BRICK_VOXELS, UNKNOWN
from graphslam.evidence.pool import GridPool, RootBox

_Kind: TypeAlias = tuple[float, BeamModel, int]


class SpilledGrid(EvidenceGrid):
    """A grid whose tree is in a pool of its own, which a shelf holds.

    Both are asked for when they are needed. They stay the same for as long as somebody holds the pool, so that whoever
    takes the pool first and its root later has both of one tree.
    """

    __slots__ = ("_own", "_slot")

    def __init__(self, grid: EvidenceGrid, slot: CacheEntry[GridPool]) -> None:
        self.voxel_size, self.model, self.dim, self.locked = grid.voxel_size, grid.model, grid.dim, grid.locked
        self._slot: CacheEntry[GridPool] | None = slot
        self._own: tuple[GridPool, RootBox] | None = None

    def empty(self, pool: GridPool | None = None) -> EvidenceGrid:  # type: ignore[override]
        """A grid like this one, that is empty and lies on no shelf."""
        return EvidenceGrid(self.voxel_size, model=self.model, pool=self.pool if pool is None else pool, dim=self.dim)

    @property
    def on_shelf(self) -> bool:
        """Has nobody written to it?"""
        return self._slot is not None

    @property
    def pool(self) -> GridPool:  # type: ignore[override]
        """Where the tree is now."""
        if self._slot is not None:
            return self._slot.get()
        assert self._own is not None
        return self._own[0]

    @pool.setter
    def pool(self, pool: GridPool) -> None:
        self._own, self._slot = (pool, RootBox(0, pool.dead)), None

    @property
    def _box(self) -> RootBox:  # type: ignore[override]
        if self._slot is not None:
            return _tree_of(self._slot.get())
        assert self._own is not None
        return self._own[1]

    @_box.setter
    def _box(self, box: RootBox) -> None:
        self._own, self._slot = (self.pool, box), None


def spill_grid(grid: EvidenceGrid, shelf: SpillCache | None = None) -> EvidenceGrid:
    """The same map on a shelf, in a pool of its own; the memory of ``grid`` goes with its last owner.

    Parameters
    ----------
    shelf : SpillCache, optional
        By default that of the process.
    """
    if isinstance(grid, SpilledGrid) and grid.on_shelf:
        return grid
    return _put(
        grid, _pool_of(_kind(grid, grid.pool.levels), grid_pieces(grid)), SPILL_CACHE if shelf is None else shelf
    )


def load_spilled(path: str | os.PathLike[str]) -> EvidenceGrid:
    """Read what `EvidenceGrid.save` wrote, onto the shelf of the process; errors are those of `formats.load_npz`."""
    grid = load_npz(path)
    return _put(grid, _with(grid.pool, grid._box), SPILL_CACHE)


def _put(grid: EvidenceGrid, pool: GridPool, shelf: SpillCache) -> EvidenceGrid:
    kind = (grid.voxel_size, grid.model, grid.dim)
    return SpilledGrid(
        grid, shelf.put(pool, pool.nbytes, partial(_packed, kind), partial(_unpacked, kind, pool.levels))
    )


def _kind(grid: EvidenceGrid, levels: int) -> EvidenceGrid:
    return EvidenceGrid(grid.voxel_size, model=grid.model, pool=GridPool(levels), dim=grid.dim)


def _pool_of(kind: EvidenceGrid, pieces: GridPieces) -> GridPool:
    """The pool of an empty grid, with a tree of some pieces."""
    fill_grid(kind, pieces)
    return _with(kind.pool, kind._box)


def _with(pool: GridPool, box: RootBox) -> GridPool:
    """A pool that keeps its only tree, and has no more room than that takes."""
    box.shared = True  # whoever writes to it has a root of his own
    pool.kept = box
    pool.fit()
    return pool


def _tree_of(pool: GridPool) -> RootBox:
    assert pool.kept is not None
    return pool.kept


def _packed(kind: _Kind, pool: GridPool) -> Arrays:
    """What a pool's tree holds: bricks as the values that are known, and where."""
    voxel_size, model, dim = kind
    grid = EvidenceGrid(voxel_size, model=model, pool=pool, dim=dim)
    grid._box = _tree_of(pool)
    p = grid_pieces(grid)
    return [p.bricks.astype(np.int32), *packed_values(p.values), p.cubes.astype(np.int32), p.log_edges, p.cube_values]


def _unpacked(kind: _Kind, levels: int, arrays: Arrays) -> GridPool:
    bricks, where, known, cubes, log_edges, cube_values = arrays
    voxel_size, model, dim = kind
    empty = EvidenceGrid(voxel_size, model=model, pool=GridPool(levels), dim=dim)
    values = unpacked_values(where, known)
    return _pool_of(empty, GridPieces(bricks.astype(np.int64), values, cubes.astype(np.int64), log_edges, cube_values))


def packed_values(values: npt.NDArray[np.int16]) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.int16]]:
    """Which voxels of bricks ``(n, 512)`` are known, a bit each ``(n, 64)``, and their values in a row."""
    known = values != UNKNOWN
    return np.packbits(known, axis=1), values[known]


def unpacked_values(where: npt.NDArray[np.uint8], known: npt.NDArray[np.int16]) -> npt.NDArray[np.int16]:
    """Bricks ``(n, 512)`` of what :func:`packed_values` made."""
    values = np.full((len(where), BRICK_VOXELS), UNKNOWN, np.int16)
    values[np.unpackbits(where, axis=1).view(np.bool_)] = known
    return values
