"""A cloud prepared for matching: its k-d tree and the shape of the surface around each point, made once."""

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

FLATNESS = 1e-3
"""Variance across a surface over that along it, of the covariance that stands for a point (Segal 2009)."""
LEAST_NEIGHBOURS = 5
"""With fewer a point has no normal."""
SMALLER = (5, 3)
"""Neighbours to do with where more of them do not lie on one line."""
SCATTER = 9.0
"""Neighbours whose variance across their line is more than this many times the usual one do not lie on one line."""


class Target:
    """Points that others are matched to; also a source that is matched more than once.

    Parameters
    ----------
    points : (m, dim)
        dim 2 or 3 [m]. Those that are not finite are left out and counted in ``dropped``.
    voxel : float, optional
        First take the mean of the points of each voxel of this edge [m]. Without it the points are taken as they are:
        points much denser than the distance to their neighbours in the other cloud cost time and give nothing.
    neighbours : int
        Points that the shape around a point is taken from, itself included.
    drops : DropCounter, optional
        Counts the points left out too.
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
        """The points with their covariances, and their tree, for the matcher in three dimensions."""
        cloud = small_gicp.PointCloud(self.points)
        tree = small_gicp.KdTree(cloud)
        small_gicp.estimate_covariances(cloud, tree, self.neighbours)
        return cloud, tree

    @cached_property
    def covariances(self) -> Array:
        """Shapes ``(m, 2, 2)`` in two dimensions: variance 1 along the line through the neighbours of a point,
        :data:`FLATNESS` across it; the unit matrix where there are fewer than 5 points.
        """
        normals, _ = self.normals(np.arange(len(self)))
        return flat_shapes(normals)

    def normals(self, rows: npt.NDArray[np.intp]) -> tuple[Array, Array]:
        """Normals of some of the points and the covariances that noise gives them.

        Parameters
        ----------
        rows : (k,) int

        Returns
        -------
        normals : (k, dim)
            Unit vectors; 0 where there are too few points around.
        noise : (k, dim, dim)
            Of a plane through n neighbours whose spread across it is λ₀ and along its axes λⱼ: λ₀ / (n λⱼ) about each.
            Computed when first asked for.
        """
        if self.dim == 2:
            return self._lines[0][rows], self._lines[1][rows]
        known, normals, noise = self._normals
        new = np.unique(rows[~known[rows]])
        n = min(self.neighbours, len(self))
        if len(new) and n >= LEAST_NEIGHBOURS:
            spread, axes = self._spread(self.points[new], n)
            normals[new] = axes[:, :, 0]
            turned = np.minimum(spread[:, :1] / (n * spread[:, 1:]), 1.0)
            noise[new] = np.einsum("mij,mj,mkj->mik", axes[:, :, 1:], turned, axes[:, :, 1:])
        known[new] = True
        return normals[rows], noise[rows]

    def _spread(self, points: Array, n: int) -> tuple[Array, Array]:
        """Variances ``(k, dim)`` of the n nearest of all points around each, the least first, and their axes."""
        around = self.points[self.tree.query(points, n)[1]]
        d = around - around.mean(axis=1, keepdims=True)
        spread, axes = np.linalg.eigh(np.einsum("mki,mkj->mij", d, d) / n)
        return np.maximum(spread, 1e-12 * np.maximum(spread[:, -1:], 1e-300)), axes

    @cached_property
    def _lines(self) -> tuple[Array, Array]:
        """Normals in the plane and their noise.

        Where a scan is sparse, far down a corridor or at a corner, the neighbours of a point lie on two walls. The line
        through them is neither, and as it follows the pattern of the beams, which moves along with the robot, a match
        would find that nothing moved. Such a point makes do with fewer neighbours, or has no normal.
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
            across = spread[good, 0] if k == n else np.maximum(spread[good, 0], usual)  # of three, it says little
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
    """Covariances ``(k, dim, dim)``: 1 along a surface, :data:`FLATNESS` across it; all 1 where a normal is 0."""
    return np.eye(normals.shape[1]) - (1.0 - FLATNESS) * normals[:, :, None] * normals[:, None, :]
