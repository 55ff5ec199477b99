"""Pool of nodes and bricks that is shared by any number of evidence grids.

Deferred reference counting (SegSLAM's DRCO): copying a grid changes nothing here. The grid that writes first copies
the nodes and bricks that it changes. Trees of deleted grids are freed at the next use of the pool, because a finaliser
may run at any moment, even while a kernel works on these arrays.
"""

from __future__ import annotations

import threading
from collections import deque
from typing import Any

import numpy as np

from graphslam.core.errors import GridError
from graphslam.evidence.layout import BRICK_VOXELS, CHILDREN, DEFAULT_LEVELS, MAX_LEVELS, UNKNOWN, half_edge
from graphslam.evidence.scratch import Scratch, aligned_empty, aligned_zeros
from graphslam.evidence.tree_kernels import (
    BRICKS_FREE,
    BRICKS_USED,
    NODES_FREE,
    NODES_USED,
    Tree,
    release_roots,
    unique_roots,
)

NODE_BYTES = 4 * CHILDREN + 4 + 8
BRICK_BYTES = 2 * BRICK_VOXELS + 4 + 2
OF_NODES = ("children", "node_ref", "node_occupied", "node_free")
OF_BRICKS = ("bricks", "brick_ref", "brick_lines", "brick_free")


class RootBox:
    """Owner of one tree; copies of a grid refer to the same box until one of them is written to."""

    __slots__ = ("dead", "root", "shared")

    def __init__(self, root: int, dead: deque[int]) -> None:
        self.root = root
        self.shared = False
        self.dead = dead

    def __del__(self) -> None:
        if getattr(self, "root", 0):  # no attribute yet if Ctrl-C interrupted __init__
            self.dead.append(self.root)  # atomic; freed by GridPool.collect


class GridPool:
    """Shared storage of evidence grids.

    Parameters
    ----------
    levels : int
        Levels of nodes above the bricks, 2 … 7. The edge of the addressable cube is ``8·4**levels`` voxels: 8,192 for
        the default of 5, or 819 m with 0.1 m voxels.
    """

    def __init__(self, levels: int = DEFAULT_LEVELS) -> None:
        if not (isinstance(levels, int) and 2 <= levels <= MAX_LEVELS):
            raise GridError("impossible number of tree levels", got=levels, wanted=f"2 … {MAX_LEVELS}")
        self.levels = levels
        self.half = half_edge(levels)
        self.lock = threading.RLock()
        """Must be held while `tree` is used."""
        self.tree = Tree(
            children=aligned_zeros((64, CHILDREN), np.int32),
            node_ref=np.zeros(64, np.int32),
            node_occupied=np.zeros(64, np.uint64),
            node_free=np.zeros(64, np.int32),
            bricks=aligned_zeros((64, BRICK_VOXELS), np.int16),
            brick_ref=np.zeros(64, np.int32),
            brick_lines=np.zeros(64, np.uint16),
            brick_free=np.zeros(64, np.int32),
            counters=np.array([1, 0, 1, 0, 0], np.int64),  # node 0 and brick 0 mean "absent"
            levels=levels,
            half=self.half,
        )
        self.tree.bricks[:] = UNKNOWN
        self.dead: deque[int] = deque()
        self._scratches: list[Scratch] = []
        self.kept: RootBox | None = None
        """A tree that is never freed before the pool (:mod:`graphslam.evidence.spilled_grid`)."""

    def scratch(self, thread: int) -> Scratch:
        """Scratch memory of one thread of an update."""
        while len(self._scratches) <= thread:
            self._scratches.append(Scratch())
        return self._scratches[thread]

    def release_scratch(self) -> None:
        """Free the scratch memory of updates (about 20 MB per thread); the next update allocates it again."""
        with self.lock:
            self._scratches.clear()

    # --- capacity --------------------------------------------------------------------------------------------

    def reserve(self, nodes: int, bricks: int) -> None:
        """Ensure capacity for this number of new nodes and bricks; raises MemoryError if there is none."""
        c = self.tree.counters
        more_nodes = nodes - (len(self.tree.node_ref) - c[NODES_USED] + c[NODES_FREE])
        more_bricks = bricks - (len(self.tree.brick_ref) - c[BRICKS_USED] + c[BRICKS_FREE])
        if more_nodes > 0:
            self.tree = _grown(self.tree, OF_NODES, int(more_nodes), c[NODES_USED])
        if more_bricks > 0:
            self.tree = _grown(self.tree, OF_BRICKS, int(more_bricks), c[BRICKS_USED])

    def fit(self) -> None:
        """Free the unused capacity of a pool whose grids will not be written to any more."""
        with self.lock:
            for names, used in ((OF_NODES, NODES_USED), (OF_BRICKS, BRICKS_USED)):
                n = int(self.tree.counters[used])
                self.tree = _resized(self.tree, names, n, n)

    @property
    def used_nodes(self) -> int:
        """Nodes used by existing grids."""
        with self.lock:
            self.collect()
            return int(self.tree.counters[NODES_USED] - 1 - self.tree.counters[NODES_FREE])

    @property
    def used_bricks(self) -> int:
        """Bricks used by existing grids."""
        with self.lock:
            self.collect()
            return int(self.tree.counters[BRICKS_USED] - 1 - self.tree.counters[BRICKS_FREE])

    @property
    def used_bytes(self) -> int:
        """Memory of existing grids; shared parts count once [bytes]."""
        return self.used_nodes * NODE_BYTES + self.used_bricks * BRICK_BYTES

    @property
    def nbytes(self) -> int:
        """Allocated memory [bytes]; pages never written do not occupy physical memory yet."""
        return sum(a.nbytes for a in self.tree if isinstance(a, np.ndarray))

    # --- ownership -------------------------------------------------------------------------------------------

    def collect(self) -> None:
        """Free the trees of grids deleted since the last call."""
        if not self.dead:
            return
        with self.lock:
            roots = []
            while self.dead:
                roots.append(self.dead.popleft())
            t = self.tree
            release_roots(
                np.array(roots, np.int64), self.levels, t.children, t.node_ref, t.brick_ref, t.node_free, t.brick_free,
                t.counters,
            )  # fmt: skip

    def own(self, boxes: list[RootBox]) -> list[RootBox]:
        """Return a writable box for each box: the same one, or a new one with a copied root. Hold `lock`.

        The caller must drop its old boxes before it calls :meth:`collect`. Then the children of roots without another
        owner become writable in place.
        """
        foreign = [k for k, box in enumerate(boxes) if box.shared or not box.root]
        if not foreign:
            return boxes
        self.reserve(len(foreign), 0)
        before = [boxes[k].root for k in foreign]
        roots = np.array(before, np.int64)
        fresh = [RootBox(0, self.dead) for _ in foreign]

        def hand_over() -> None:
            for box, old, new in zip(fresh, before, roots.tolist()):
                box.root = new if new != old else 0

        try:
            t = self.tree
            unique_roots(
                roots, self.levels, t.children, t.node_ref, t.node_occupied, t.brick_ref, t.node_free, t.counters
            )
            hand_over()
        except BaseException:  # Ctrl-C after the roots were copied and before a box owns them
            hand_over()
            raise
        owned = list(boxes)
        for k, box in zip(foreign, fresh):
            owned[k] = box
        return owned

    def __repr__(self) -> str:
        return (
            f"GridPool(levels={self.levels}): {self.used_nodes} nodes, {self.used_bricks} bricks, "
            f"{self.used_bytes / 1e6:.1f} MB"
        )


def _grown(tree: Tree, names: tuple[str, ...], more: int, used: int) -> Tree:
    """A tree in which the named arrays have at least ``more`` additional rows, or many more if memory allows.

    Unused rows take no physical memory, while each growth copies the arrays into fresh memory, which can take longer
    than the update itself.
    """
    size = len(getattr(tree, names[0]))
    try:
        return _resized(tree, names, size + max(more, 3 * size), used)
    except MemoryError:
        return _resized(tree, names, size + max(more, size // 4), used)


def _resized(tree: Tree, names: tuple[str, ...], n: int, used: int) -> Tree:
    """Copy the named arrays to arrays with n rows. Only used rows are written, so others take no physical memory."""
    arrays: dict[str, Any] = {}
    for name in names:
        a = getattr(tree, name)
        arrays[name] = aligned_empty((n, *a.shape[1:]), a.dtype)
        arrays[name][:used] = a[:used]
    return tree._replace(**arrays)
