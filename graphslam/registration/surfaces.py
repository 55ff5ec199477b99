"""Neighbourhoods of points as planes (in 2-D lines): which places of a cloud are surfaces, and which way they face."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from graphslam.core.geometry import Array, rotation2
from graphslam.core.se3 import quat_to_matrix
from graphslam.registration.plane_kernels import fit_surfaces

Index = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


def rotations(poses: Array) -> Array:
    """Rotation matrices ``(n, d, d)`` of poses ``(n, 7|3)``."""
    return quat_to_matrix(poses[:, 3:]) if poses.shape[1] == 7 else rotation2(poses[:, 2])


@dataclass(frozen=True, slots=True, kw_only=True)
class SurfaceFitConfig:
    """What counts as a surface."""

    radius: float = 0.8
    """Of neighbourhoods [m]."""
    spacing: float = 0.1
    """Points of one chunk nearer together than this are one place [m]."""
    neighbours: int = 12
    """Places that a surface is fitted to at most."""
    thickness: float = 0.06
    """Greatest RMS distance from the plane [m]."""
    flatness: float = 0.15
    """Greatest ratio of the smallest eigenvalue to the middle one (in 2-D: to the greatest)."""
    extent: float = 0.045
    """Least RMS extent along the middle axis [m]."""


SURFACE = SurfaceFitConfig()
"""Of the refinement and of scan-to-window odometry: walls, floors and ground as robots meet them."""


def thin_places(W: Array, a: int, b: int, spacing: float, stands: Index) -> Index:
    """Rows of the points ``a:b`` that stand for themselves; enters into ``stands`` who stands for the others."""
    if a == b:
        return np.zeros(0, np.int64)
    cell = np.floor(W[a:b] / spacing).astype(np.int64)
    cell -= cell.min(axis=0)
    size = cell.max(axis=0) + 1
    key = cell[:, 0]
    for k in range(1, cell.shape[1]):
        key = key * size[k] + cell[:, k]
    _, first, back = np.unique(key, return_index=True, return_inverse=True)
    stands[a:b] = a + first[back]
    return np.sort(a + first)


def fit_places(W: Array, O: Array, own: Index, near: Index, config: SurfaceFitConfig) -> tuple[Array, Array, Flags]:
    """Planes of places among their neighbours.

    Parameters
    ----------
    W, O : (q, d)
        Points and where their beams came from, world [m].
    own : (k,)
        Rows of the places that are asked for.
    near : (m,)
        Rows of the places that may be neighbours, ``own`` among them.

    Returns
    -------
    normals : (k, d)
        World, towards where the beams came from.
    tilts : (k, d - 1, d)
        Axes of the surfaces, world, each as long as the σ by which noise tilts the normal towards it [rad].
    flat : (k,) bool
        Is it a surface?
    """
    d = W.shape[1]
    k = min(config.neighbours, len(near))
    _, at = cKDTree(W[near]).query(W[own], k=k, distance_upper_bound=config.radius)
    at = at.reshape(len(own), k).astype(np.int64)
    rows = np.append(near, -1)[at]
    n, w, tilts = np.zeros((len(own), d)), np.zeros((len(own), 3)), np.zeros((len(own), d - 1, d))
    fit_surfaces(W, rows, 2 * d, n, w, tilts)
    middle = w[:, 1 if d == 3 else 2]
    with np.errstate(invalid="ignore"):
        good = (w[:, 0] <= config.thickness**2) & (middle >= config.extent**2)
        good &= w[:, 0] <= config.flatness * middle
    n[np.einsum("ki,ki->k", n, O[own] - W[own]) < 0] *= -1.0
    return n, tilts, good
