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
from graphslam.core.points import finite_points, thin

FLATNESS = 1e-3
"""Variance across a surface over that along it, of the covariance that stands for a point (Segal 2009)."""
LEAST_NEIGHBOURS = 5
"""With fewer a point has no normal."""


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

    Raises
    ------
    GeometryError
        Points of an impossible shape. No points at all are no error here: a registration to them is refused.
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
        self.points: Array = p if voxel is None else thin(p, voxel)
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
        known, normals, noise = self._normals
        new = np.unique(rows[~known[rows]])
        n = min(self.neighbours, len(self))
        if len(new) and n >= LEAST_NEIGHBOURS:
            around = self.points[self.tree.query(self.points[new], n)[1]]
            d = around - around.mean(axis=1, keepdims=True)
            spread, axes = np.linalg.eigh(np.einsum("mki,mkj->mij", d, d) / n)
            spread = np.maximum(spread, 1e-12 * np.maximum(spread[:, -1:], 1e-300))
            normals[new] = axes[:, :, 0]
            turned = np.minimum(spread[:, :1] / (n * spread[:, 1:]), 1.0)
            noise[new] = np.einsum("mij,mj,mkj->mik", axes[:, :, 1:], turned, axes[:, :, 1:])
        known[new] = True
        return normals[rows], noise[rows]

    @cached_property
    def _normals(self) -> tuple[npt.NDArray[np.bool_], Array, Array]:
        m, d = self.points.shape
        return np.zeros(m, bool), np.zeros((m, d)), np.zeros((m, d, d))


def flat_shapes(normals: Array) -> Array:
    """Covariances ``(k, dim, dim)``: 1 along a surface, :data:`FLATNESS` across it; all 1 where a normal is 0."""
    return np.eye(normals.shape[1]) - (1.0 - FLATNESS) * normals[:, :, None] * normals[:, None, :]
