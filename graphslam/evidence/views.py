"""Common view of the dense maps of submaps: of a grid, or of a cloud (whose grid is built when needed)."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.dense import CloudMap, DenseMapView
from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.points import voxel_downsample
from graphslam.core.submap import Submap
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.layout import BRICK_EDGE, BRICK_VOXELS, UNKNOWN
from graphslam.evidence.spilled_grid import spill_grid


class GridView:
    """A `graphslam.core.dense.DenseMapView` of an evidence grid."""

    cloud: CloudMap | None = None
    knows_space = True

    def __init__(self, grid: EvidenceGrid) -> None:
        self._grid = grid

    @property
    def dim(self) -> int:
        """2 or 3."""
        return self._grid.dim

    def points(self, level: int = 0) -> Array:
        """Centres of the occupied voxels; for level ≥ 1 their means in cells of the octree."""
        return np.asarray(self._grid.binned_cloud(level).points if level else self._grid.occupied_cloud())

    def known_at(self, points: Any) -> npt.NDArray[np.bool_]:
        """See `DenseMapView`."""
        return self._grid.known_at(points)

    def log_odds_at(self, points: Any) -> npt.NDArray[np.float32]:
        """See `DenseMapView`."""
        return self._grid.log_odds_at(points)

    def evidence(self) -> EvidenceGrid:
        """The grid itself."""
        return self._grid


class CloudView:
    """A `graphslam.core.dense.DenseMapView` of a cloud: points as measured, free space from the grid of the submap or
    from the beams of the cloud.

    Parameters
    ----------
    grid : EvidenceGrid, optional
        Of the same submap, if the front end built one.
    """

    def __init__(self, cloud: CloudMap, grid: EvidenceGrid | None = None) -> None:
        self.cloud: CloudMap | None = cloud
        self._cloud, self._given = cloud, grid

    @property
    def dim(self) -> int:
        """2 or 3."""
        return self._cloud.dim

    @property
    def knows_space(self) -> bool:
        """Whether free space is known: there is a grid, or the cloud has the sensor origins of its points."""
        return self._given is not None or self._cloud.origins is not None

    def points(self, level: int = 0) -> Array:
        """Means of the points in cells with an edge of ``cell · 2**level`` [m]."""
        return voxel_downsample(self._cloud.points, self._cloud.cell * 2**level)

    def known_at(self, points: Any) -> npt.NDArray[np.bool_]:
        """See `DenseMapView`. Without known space: whether a point of the cloud is in the same 1 m column."""
        if self.knows_space:
            return self._space.known_at(points)
        return np.isin(_columns(np.asarray(points)), _columns(self._cloud.points))

    def log_odds_at(self, points: Any) -> npt.NDArray[np.float32]:
        """See `DenseMapView`."""
        return self._space.log_odds_at(points)

    def evidence(self) -> EvidenceGrid:
        """The given grid; else a grid from the beams of the cloud, or without origins from its points only."""
        return self._space

    @cached_property
    def _space(self) -> EvidenceGrid:
        if self._given is not None:
            return self._given
        c, grid = self._cloud, EvidenceGrid(self._cloud.cell, dim=self._cloud.dim)
        if c.origins is None or c.scan is None:
            _mark(grid, c.points)
            return spill_grid(grid)
        scan, points = c.scan, c.points
        order = np.argsort(scan, kind="stable")
        bounds = np.searchsorted(scan[order], np.arange(len(c.origins) + 1))
        for k, origin in enumerate(c.origins):
            rows = order[bounds[k] : bounds[k + 1]]
            if len(rows):
                grid.insert_scan(points[rows], origin)
        return spill_grid(grid)


def dense_view(submap: Submap) -> DenseMapView:
    """The dense map of a submap."""
    grid = submap.grid
    if submap.cloud is not None and (grid is None or isinstance(grid, EvidenceGrid)):
        return CloudView(submap.cloud, grid)
    if not isinstance(grid, EvidenceGrid):
        raise DataError(
            f"submap {submap.key} has no map", got=type(grid).__name__, wanted="an evidence grid or a cloud"
        )
    return GridView(grid)


def has_dense_view(submap: Submap) -> bool:
    """Whether a submap has a dense map."""
    return submap.cloud is not None or isinstance(submap.grid, EvidenceGrid)


def _columns(points: Array, edge: float = 1.0) -> npt.NDArray[np.int64]:
    """Indices ``(m,)`` of the vertical columns with this edge [m] that contain points."""
    cells = np.floor(points[:, :2] / edge).astype(np.int64)
    return np.asarray((cells[:, 0] << 32) + cells[:, 1])


def _mark(grid: EvidenceGrid, points: Array) -> None:
    """Write one hit per point to the voxels that contain points, up to the clamp; other voxels stay unknown."""
    voxels = np.zeros((len(points), 3), np.int64)
    voxels[:, : grid.dim] = np.floor(points / grid.voxel_size)
    cells, count = np.unique(voxels, axis=0, return_counts=True)
    bricks, row = np.unique(cells // BRICK_EDGE, axis=0, return_inverse=True)
    values = np.full((len(bricks), BRICK_VOXELS), UNKNOWN, np.int16)
    at = cells % BRICK_EDGE
    top = grid.model.clamp_steps[1]
    values[row.ravel(), (at[:, 2] * BRICK_EDGE + at[:, 1]) * BRICK_EDGE + at[:, 0]] = np.minimum(
        count * grid.model.hit_step, top
    )
    grid.write_bricks(bricks, values)
