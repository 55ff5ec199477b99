"""Evidence grids that are kept in a spill cache: in memory while they are used, else in a file.

A run keeps the grid of every submap, but uses only a few at a time. A grid from :func:`spill_grid` has the same
interface as any other grid; it moves back into memory for good when it is written to.
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
    """A grid whose tree is in a separate pool, which is stored in a spill cache.

    Pool and root are loaded on access. They do not change while a reference to the pool exists, so code that reads
    first the pool and then the root gets both from one tree.
    """

    __slots__ = ("_own", "_slot")

    def __init__(self, grid: EvidenceGrid, slot: CacheEntry[GridPool]) -> None:
        self.voxel_size, self.model, self.dim, self.locked = grid.voxel_size, grid.model, grid.dim, grid.locked
        self._slot: CacheEntry[GridPool] | None = slot
        self._own: tuple[GridPool, RootBox] | None = None

    def empty(self, pool: GridPool | None = None) -> EvidenceGrid:  # type: ignore[override]
        """An empty grid like this one, in memory."""
        return EvidenceGrid(self.voxel_size, model=self.model, pool=self.pool if pool is None else pool, dim=self.dim)

    @property
    def on_shelf(self) -> bool:
        """Whether the grid is in the spill cache, i.e. it was never written to."""
        return self._slot is not None

    @property
    def pool(self) -> GridPool:  # type: ignore[override]
        """Pool of the tree; loaded from the spill file if necessary."""
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
    """The same map in the spill cache, with its own pool; ``grid`` itself is not freed.

    Parameters
    ----------
    shelf : SpillCache, optional
        Default: the cache of the process.
    """
    if isinstance(grid, SpilledGrid) and grid.on_shelf:
        return grid
    return _put(
        grid, _pool_of(_kind(grid, grid.pool.levels), grid_pieces(grid)), SPILL_CACHE if shelf is None else shelf
    )


def load_spilled(path: str | os.PathLike[str]) -> EvidenceGrid:
    """Read a file of `EvidenceGrid.save` into the spill cache of the process; errors as in `formats.load_npz`."""
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
    """Fill an empty grid with pieces and return its pool."""
    fill_grid(kind, pieces)
    return _with(kind.pool, kind._box)


def _with(pool: GridPool, box: RootBox) -> GridPool:
    """Make a pool keep its only tree, and free its unused capacity."""
    box.shared = True  # a write then copies the root
    pool.kept = box
    pool.fit()
    return pool


def _tree_of(pool: GridPool) -> RootBox:
    assert pool.kept is not None
    return pool.kept


def _packed(kind: _Kind, pool: GridPool) -> Arrays:
    """Arrays of the tree of a pool; of bricks only the known values and their positions."""
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
    """Bit mask ``(n, 64)`` of the known voxels of bricks ``(n, 512)``, and their values in one array."""
    known = values != UNKNOWN
    return np.packbits(known, axis=1), values[known]


def unpacked_values(where: npt.NDArray[np.uint8], known: npt.NDArray[np.int16]) -> npt.NDArray[np.int16]:
    """Inverse of :func:`packed_values`: bricks ``(n, 512)``."""
    values = np.full((len(where), BRICK_VOXELS), UNKNOWN, np.int16)
    values[np.unpackbits(where, axis=1).view(np.bool_)] = known
    return values
