"""Base class of evidence grids: a handle on a tree in a shared pool, with copying, locking and reading of values."""

from __future__ import annotations

import math
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import GridError, GridLockedError
from graphslam.evidence.beams import BeamModel
from graphslam.evidence.layout import BRICK_EDGE
from graphslam.evidence.pool import GridPool, RootBox
from graphslam.evidence.scan import point_rows
from graphslam.evidence.tree_kernels import list_bricks, read_values

_DEFAULT_MODEL = BeamModel()
_new = object.__new__  # a module name is faster to look up; a copy takes tenths of microseconds


class GridTree:
    """Handle on a tree in a shared pool; a copy takes constant time (SegSLAM, section 2).

    Base of :class:`~graphslam.evidence.grid.EvidenceGrid`; its parameters are documented there.
    """

    __slots__ = ("__weakref__", "_box", "dim", "locked", "model", "pool", "voxel_size")
    _plain: ClassVar[Any]
    """Class of copies and of empty grids; copies of a spilled grid are of this in-memory class too."""

    def __init_subclass__(cls) -> None:
        if GridTree in cls.__bases__:
            cls._plain = cls

    def __init__(
        self, voxel_size: float, *, model: BeamModel | None = None, pool: GridPool | None = None, dim: int = 3
    ) -> None:
        if not (isinstance(voxel_size, (int, float, np.number)) and math.isfinite(voxel_size) and voxel_size > 0):
            raise GridError("impossible voxel size", got=voxel_size, wanted="> 0 m")
        if dim not in (2, 3):
            raise GridError("impossible dimension of a grid", got=dim, wanted="2 or 3")
        self.voxel_size = float(voxel_size)
        self.model = _DEFAULT_MODEL if model is None else model
        self.pool = GridPool() if pool is None else pool
        self.dim = dim
        self.locked = False
        self._box = RootBox(0, self.pool.dead)

    def copy(self) -> Self:
        """Copy the map in constant time; nodes and bricks are copied later, when one of the two is written to.

        The copy of a locked grid is not locked.
        """
        twin: Self = _new(self._plain)
        twin.voxel_size = self.voxel_size
        twin.model = self.model
        twin.pool = self.pool
        twin.dim = self.dim
        twin.locked = False
        box = self._box
        box.shared = True
        twin._box = box
        return twin

    __copy__ = copy

    def __deepcopy__(self, memo: Any) -> Self:
        return self.copy()

    def empty(self, pool: GridPool | None = None) -> Self:
        """An empty grid with the same voxel size, beam model and dimension, in the same or another pool."""
        pool = self.pool if pool is None else pool
        made: Self = self._plain(self.voxel_size, model=self.model, pool=pool, dim=self.dim)
        return made

    def release(self) -> None:
        """Free the map now and make this an empty grid. It is also freed when its last handle is deleted."""
        self._box = RootBox(0, self.pool.dead)
        self.pool.collect()

    def lock(self) -> None:
        """For localisation only: from now on, updates raise `GridLockedError` (SegSLAM A12)."""
        self.locked = True

    def unlock(self) -> None:
        """Allow updates again."""
        self.locked = False

    @property
    def root(self) -> int:
        """Root node in the pool, 0 for an empty grid; valid until the next write."""
        return self._box.root

    def replace_contents(self, other: GridTree) -> None:
        """Share the tree of ``other``, a grid of the same kind; makes a long change atomic."""
        other._box.shared = True
        self.pool, self._box = other.pool, other._box

    def same_as(self, other: GridTree) -> bool:
        """Whether two handles share one tree (a copy, and neither was written to since), or both are empty."""
        return self._box is other._box or (self.root == 0 == other.root)

    def check_writable(self) -> None:
        """Raise `GridLockedError` if the grid is locked."""
        if self.locked:
            raise GridLockedError("this evidence grid is locked: it is localised in, not updated; unlock or copy it")

    def packed_bricks(self) -> npt.NDArray[np.int64]:
        """Packed coordinates and ids of the bricks, ``(n, 2)``, ascending; hold the pool's lock."""
        pool = self.pool
        if self.root == 0:
            return np.zeros((0, 2), np.int64)
        n = list_bricks(self.root, pool.levels, pool.tree.children, np.zeros((0, 2), np.int64))
        out = np.empty((n, 2), np.int64)
        list_bricks(self.root, pool.levels, pool.tree.children, out)
        return out[np.argsort(out[:, 0])]

    def brick_coordinates(self) -> npt.NDArray[np.int64]:
        """Signed coordinates of the bricks ``(n, 3)``, ascending in (z, y, x); brick b holds voxels 8b … 8b + 7."""
        with self.pool.lock:
            keys = self.packed_bricks()[:, 0]
        half = self.pool.half // BRICK_EDGE
        return np.stack([keys & 0xFFFFF, (keys >> 20) & 0xFFFFF, keys >> 40], axis=1) - half

    def values_at(self, points: Any) -> npt.NDArray[np.int16]:
        """Values ``(n,)`` of the voxels that contain points, in units of `layout.STEP`; `layout.UNKNOWN` for unknown
        voxels, outside the addressable cube, and for points that are not finite."""
        p = point_rows(points, self.dim, self.voxel_size)
        out = np.empty(len(p), np.int16)
        pool = self.pool
        with pool.lock:
            children, bricks = pool.tree.children, pool.tree.bricks
            read_values(self.root, p, 1.0 / self.voxel_size, pool.half, pool.levels, children, bricks, out)
        return out
