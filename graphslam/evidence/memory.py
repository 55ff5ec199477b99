"""Memory of evidence grids, private and shared with other grids."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.errors import GridError
from graphslam.evidence.grid_tree import GridTree
from graphslam.evidence.pool import BRICK_BYTES, NODE_BYTES
from graphslam.evidence.query_kernels import count_private, walk_once
from graphslam.evidence.tree_kernels import BRICKS_USED, NODES_USED


@dataclass(frozen=True, slots=True)
class MemoryUse:
    """Memory of one grid or of a set of grids; parts shared within the set count once.

    Parameters
    ----------
    nodes, bricks : int
        Total numbers reachable from the grids.
    private_nodes, private_bricks : int
        Numbers that would be freed if exactly these grids were released; grids outside the set share the rest.
    """

    nodes: int
    bricks: int
    private_nodes: int
    private_bricks: int

    @property
    def total(self) -> int:
        """Private and shared memory [bytes]."""
        return self.nodes * NODE_BYTES + self.bricks * BRICK_BYTES

    @property
    def private(self) -> int:
        """Memory that would be freed by releasing exactly these grids [bytes]."""
        return self.private_nodes * NODE_BYTES + self.private_bricks * BRICK_BYTES

    @property
    def shared(self) -> int:
        """Memory that other grids use too [bytes]."""
        return self.total - self.private


def measure_memory(grids: GridTree | Sequence[GridTree]) -> MemoryUse:
    """Memory of a grid or of a set of grids of one pool.

    Parameters
    ----------
    grids : EvidenceGrid, or several of one pool
    """
    several = list(grids) if isinstance(grids, Sequence) else [grids]
    if not several:
        return MemoryUse(0, 0, 0, 0)
    pool = several[0].pool
    if any(g.pool is not pool for g in several):
        raise GridError("the memory of grids of different pools cannot be counted together", wanted="one pool")
    with pool.lock:
        pool.collect()
        distinct = list({id(g): g for g in several}.values())
        mine = Counter(g.root for g in distinct if g.root)
        free: dict[int, bool] = {}
        for g in distinct:
            if g.root:
                # copies share one box, so its reference count is the number of handles, plus the argument itself
                free[g.root] = sys.getrefcount(g._box) - 1 == mine[g.root]
        roots = np.array(list(free), np.int64)
        n, b = int(pool.tree.counters[NODES_USED]), int(pool.tree.counters[BRICKS_USED])  # ids beyond were never used
        nodes, bricks = np.empty(n, np.int64), np.empty(b, np.int64)
        begins = np.empty(pool.levels + 1, np.int64)
        found = walk_once(
            roots, pool.levels, pool.tree.children, np.zeros(n, np.int64), np.zeros(b, np.int64), nodes, bricks, begins
        )  # fmt: skip
        given_back = np.array(list(free.values()), np.bool_)
        private = count_private(nodes, begins, given_back, np.zeros(n, np.int32), np.zeros(b, np.int32), pool.tree)
    return MemoryUse(int(begins[-1]), found, int(private[0]), int(private[1]))
