"""A few related maps on one pool with their twins, small enough to be made hundreds of times in a test."""

from __future__ import annotations

import numpy as np

from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.pool import GridPool
from tests.reference.evidence_pool import assert_same, check_pool
from tests.reference.evidence_twin import EvidenceTwin

VOXEL = 0.25
IDENTITY = np.array([0.0, 0, 0, 0, 0, 0, 1])
ORIGIN = np.array([0.03, 0.05, 0.02])
"""Where beams start: not on a corner of the lattice, where rays leave through edges."""


class World:
    """A map, a copy of it that went on, and their twins, on one pool."""

    def __init__(self, levels: int = 3) -> None:
        rng = np.random.default_rng(7)
        self.pool = GridPool(levels=levels)
        self.grids = [EvidenceGrid(VOXEL, pool=self.pool)]
        self.twins = [EvidenceTwin(VOXEL, self.grids[0].model, self.pool.half)]
        self.scan = rng.normal(size=(5, 3))
        self.poses = np.tile(IDENTITY, (3, 1)) + np.array([0.11, 0.07, -0.03, 0, 0, 0, 0]) * np.arange(3)[:, None]
        self.insert(0, rng.normal(size=(4, 3)))
        for _ in range(2):
            self.grids.append(self.grids[0].copy())
            self.twins.append(self.twins[0].copy())
        self.insert(1, rng.normal(size=(2, 3)))

    def insert(self, k: int, points: np.ndarray) -> None:
        self.grids[k].insert_scan(points, ORIGIN)
        self.twins[k].insert_scan(points, ORIGIN)

    def check(self) -> None:
        """Everything is as the twins have it."""
        for grid, twin in zip(self.grids, self.twins):
            assert_same(grid, twin)
        check_pool(self.pool, self.grids)
