"""Planes (in 2-D lines) through the neighbourhoods of points: surface test and normals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from graphslam.core.geometry import Array
from graphslam.registration.plane_kernels import fit_surfaces

Index = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class SurfaceFitConfig:
    """Criteria of a surface."""

    radius: float = 0.8
    """Radius of neighbourhoods [m]."""
    spacing: float = 0.1
    """Points of one chunk nearer together than this are merged [m]."""
    neighbours: int = 12
    """Most neighbours of a fit."""
    thickness: float = 0.06
    """Largest RMS distance from the plane [m]."""
    flatness: float = 0.15
    """Largest ratio of the smallest eigenvalue to the middle one (in 2-D: to the largest)."""
    extent: float = 0.045
    """Least RMS extent along the middle axis [m]."""


SURFACE = SurfaceFitConfig()
"""For the refinement and scan-to-window odometry: walls, floors and ground at robot scale."""


def thin_places(W: Array, a: int, b: int, spacing: float, stands: Index) -> Index:
    """Representative rows of the points ``a:b``; writes the representative of each point to ``stands``."""
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


def fit_places(
    W: Array, origins: Array, own: Index, near: Index, config: SurfaceFitConfig, tree: cKDTree | None = None
) -> tuple[Array, Array, Flags]:
    """Planes of places among their neighbours.

    Parameters
    ----------
    W : (q, d)
        Points, world [m].
    origins : (k, d)
        Origins of the beams of the places to fit, world [m].
    own : (k,)
        Rows of the places to fit.
    near : (m,)
        Rows of the possible neighbours, including ``own``.
    tree : cKDTree, optional
        Of the points of ``near``, if it is already there.

    Returns
    -------
    normals : (k, d)
        World, towards the sensor.
    tilts : (k, d - 1, d)
        Axes of the surfaces, world, scaled with the σ of the normal's tilt towards them [rad].
    flat : (k,) bool
        Whether it is a surface.
    """
    d = W.shape[1]
    k = min(config.neighbours, len(near))
    _, at = (tree or cKDTree(W[near])).query(W[own], k=k, distance_upper_bound=config.radius)
    at = at.reshape(len(own), k).astype(np.int64)
    rows = near.take(at, mode="clip")
    rows[at == len(near)] = -1  # no neighbour
    n, w, tilts = np.zeros((len(own), d)), np.zeros((len(own), 3)), np.zeros((len(own), d - 1, d))
    fit_surfaces(W, rows, 2 * d, n, w, tilts)
    middle = w[:, 1 if d == 3 else 2]
    with np.errstate(invalid="ignore"):
        good = (w[:, 0] <= config.thickness**2) & (middle >= config.extent**2)
        good &= w[:, 0] <= config.flatness * middle
    n[np.einsum("ki,ki->k", n, origins - W[own]) < 0] *= -1.0
    return n, tilts, good
