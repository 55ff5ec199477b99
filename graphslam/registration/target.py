"""A cloud prepared for matching: its k-d tree and the local surface shape of each point."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import small_gicp
from scipy.spatial import cKDTree

from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array
from graphslam.core.log import DropCounter
from graphslam.core.points import finite_points, voxel_downsample
from graphslam.registration.plane_kernels import principal_axes

FLATNESS = 1e-3
"""Variance across a surface over that along it, in the covariance of a point (Segal 2009)."""
LEAST_NEIGHBOURS = 5
"""With fewer neighbours a point has no normal."""
SMALLER = (5, 3)
"""Fallback numbers of neighbours if more are not on one line."""
SCATTER = 9.0
"""Neighbours are not on one line if their variance across it is above this multiple of the median."""


class Target:
    """Target points of a registration; also a source that is matched repeatedly.

    Parameters
    ----------
    points : (m, dim)
        dim 2 or 3 [m]. Non-finite points are ignored and counted in ``dropped``.
    voxel : float, optional
        Edge of the voxels for downsampling by the mean [m]; None: no downsampling. Points much denser than those of the
        other cloud take time without benefit.
    neighbours : int
        Neighbours for the local shape of a point, including itself.
    drops : DropCounter, optional
        Also counts the ignored points.
    """

    def __init__(
        self, points: Any, *, voxel: float | None = None, neighbours: int = 10, drops: DropCounter | None = None
    ) -> None:
        if voxel is not None and not (np.isfinite(voxel) and voxel > 0):
            raise ConfigError(f"target: voxel is {voxel}; wanted a positive number of metres")
        if neighbours < 3:
            raise ConfigError(f"target: {neighbours} neighbours; wanted at least 3")
        p = finite_points(points, what="points to register", drops=drops)
        self.dropped = len(points) - len(p)
        self.points: Array = p if voxel is None else voxel_downsample(p, voxel)
        self.neighbours = neighbours

    @property
    def dim(self) -> int:
        """2 or 3."""
        return self.points.shape[1]

    def __len__(self) -> int:
        return len(self.points)

    @cached_property
    def tree(self) -> cKDTree:
        """k-d tree of the points."""
        return cKDTree(self.points)

    @cached_property
    def cloud(self) -> tuple[small_gicp.PointCloud, small_gicp.KdTree]:
        """The points with their covariances, and their tree, for the 3-D matcher."""
        cloud = small_gicp.PointCloud(self.points)
        tree = small_gicp.KdTree(cloud)
        small_gicp.estimate_covariances(cloud, tree, self.neighbours)
        return cloud, tree

    def normals(self, rows: npt.NDArray[np.intp]) -> tuple[Array, Array]:
        """Normals of given points with their noise covariances.

        Parameters
        ----------
        rows : (k,) int

        Returns
        -------
        normals : (k, dim)
            Unit vectors; 0 with too few neighbours.
        noise : (k, dim, dim)
            For a plane through n neighbours with variance λ₀ across it and λⱼ along its axes: λ₀ / (n λⱼ) about each.
            Computed lazily.
        """
        if self.dim == 2:
            return self.lines[0][rows], self.lines[1][rows]
        known, normals, noise = self._normals
        new = np.unique(rows[~known[rows]])
        n = min(self.neighbours, len(self))
        if len(new) and n >= LEAST_NEIGHBOURS:
            spread, axes = self._spread(self.points[new], n)
            normals[new] = axes[:, :, 0]
            turned = np.minimum(spread[:, :1] / (n * spread[:, 1:]), 1.0)
            noise[new] = (axes[:, :, 1:] * turned[:, None]) @ np.swapaxes(axes[:, :, 1:], 1, 2)
        known[new] = True
        return normals[rows], noise[rows]

    def _spread(self, points: Array, n: int) -> tuple[Array, Array]:
        """Variances ``(k, dim)`` of the n nearest points around each, ascending, and their axes."""
        d = self.dim
        rows = self.tree.query(points, n)[1] if d == 2 else self.cloud[1].batch_knn_search(points, n)[0]
        spread, axes = np.empty((len(rows), d)), np.empty((len(rows), d, d))
        principal_axes(self.points, rows.astype(np.int64), spread, axes)
        return np.maximum(spread, 1e-12 * np.maximum(spread[:, -1:], 1e-300)), axes

    @cached_property
    def lines(self) -> tuple[Array, Array]:
        """2-D normals and their noise.

        In sparse parts of a scan (far in a corridor, at a corner) the neighbours of a point can be on two walls. A line
        through them follows the beam pattern, which moves with the robot, so a match would be biased towards no motion.
        Such a point gets fewer neighbours, or no normal.
        """
        m = len(self)
        normals, noise = np.zeros((m, 2)), np.zeros((m, 2, 2))
        n = min(self.neighbours, m)
        if n < LEAST_NEIGHBOURS:
            return normals, noise
        rows, usual = np.arange(m), 0.0
        for k in (n, *(k for k in SMALLER if k < n)):
            spread, axes = self._spread(self.points[rows], k)
            usual = usual or float(np.median(spread[:, 0]))
            good = spread[:, 0] <= SCATTER * usual
            across = spread[good, 0] if k == n else np.maximum(spread[good, 0], usual)  # unreliable for three points
            turned = np.minimum(across / (k * spread[good, 1]), 1.0)
            along = axes[good, :, 1]
            normals[rows[good]] = axes[good, :, 0]
            noise[rows[good]] = turned[:, None, None] * along[:, :, None] * along[:, None, :]
            rows = rows[~good]
            if not len(rows):
                break
        return normals, noise

    @cached_property
    def _normals(self) -> tuple[npt.NDArray[np.bool_], Array, Array]:
        m, d = self.points.shape
        return np.zeros(m, bool), np.zeros((m, d)), np.zeros((m, d, d))


def flat_shapes(normals: Array) -> Array:
    """Covariances ``(k, dim, dim)``: 1 along a surface, :data:`FLATNESS` across it; all 1 if the normal is 0."""
    return np.eye(normals.shape[1]) - (1.0 - FLATNESS) * normals[:, :, None] * normals[:, None, :]
