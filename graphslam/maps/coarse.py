"""Coarser copies of maps that are too large for their lattice, a file format or an image.

A coarse voxel gets the maximum of its fine voxels: occupied if one is, unknown if all are. No occupied voxel is lost,
and walls become up to one voxel thicker.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from graphslam.evidence.formats import known_bounds
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.layout import BRICK_EDGE, BRICK_VOXELS, DEFAULT_LEVELS, MAX_LEVELS, UNKNOWN, half_edge
from graphslam.evidence.octomap import OCTOMAP_HALF
from graphslam.evidence.pool import GridPool
from graphslam.maps.pieces import Piece

Ints = npt.NDArray[np.int64]
Steps = npt.NDArray[np.int16]

PIXELS = 1 << 25
"""Most pixels of a floor plan or image: about a square kilometre of 0.2 m voxels. Drawing takes 20 bytes per pixel."""


def pool_levels(reach: float) -> int:
    """Levels of a pool that contains voxels up to ``reach`` from its origin, limited to the maximum."""
    return next((k for k in range(DEFAULT_LEVELS, MAX_LEVELS) if half_edge(k) > reach), MAX_LEVELS)


def coarse_bricks(coordinates: Ints, values: Steps, dim: int) -> tuple[Ints, Steps]:
    """Bricks of voxels of twice the edge, ascending by their coordinates.

    Parameters
    ----------
    coordinates : (n, 3)
        Signed; each once.
    values : (n, 512)
    dim : {2, 3}
        In 2-D there is still one layer.
    """
    halved = np.array([1, 1, dim - 2])
    up, row = np.unique(coordinates >> halved, axis=0, return_inverse=True)
    v = np.ascontiguousarray(values).reshape(-1, BRICK_EDGE, 4, 2, 4, 2).max(axis=(3, 5))  # z, y, x
    if dim == 3:
        v = v.reshape(-1, 4, 2, 4, 4).max(axis=2)
    out = np.full((len(up), BRICK_EDGE, BRICK_EDGE, BRICK_EDGE), UNKNOWN, np.int16)
    octant = 4 * (coordinates & halved)
    for x, y, z in np.unique(octant, axis=0).tolist():
        here = (octant == (x, y, z)).all(axis=1)
        out[row.ravel()[here], z : z + v.shape[1], y : y + 4, x : x + 4] = v[here]
    return up, out.reshape(-1, BRICK_VOXELS)


def coarse_piece(piece: Piece) -> Piece:
    """A piece of voxels of twice the edge."""
    bricks, values = coarse_bricks(piece.coordinates, piece.values, piece.dim)
    return Piece(2.0 * piece.voxel_size, piece.dim, bricks, values, piece.T_base_node)


def coarse_grid(grid: EvidenceGrid) -> EvidenceGrid:
    """A map of voxels of twice the edge."""
    bricks, values = coarse_bricks(grid.brick_coordinates(), grid.brick_values(), grid.dim)
    out = EvidenceGrid(2.0 * grid.voxel_size, model=grid.model, dim=grid.dim, pool=GridPool(grid.pool.levels))
    out.write_bricks(bricks, values)
    return out


def drawable_map(grid: EvidenceGrid) -> EvidenceGrid:
    """The map, or the first coarser one whose top and side views have at most :data:`PIXELS`."""
    while True:
        low, high = known_bounds(grid)
        edges = np.sort(high - low)
        if int(edges[1]) * int(edges[2]) <= PIXELS:
            return grid
        grid = coarse_grid(grid)


def fit_octomap(grid: EvidenceGrid) -> EvidenceGrid:
    """The map, or the first coarser one that fits into an OctoMap file."""
    while max(-int(known_bounds(grid)[0].min()), int(known_bounds(grid)[1].max())) > OCTOMAP_HALF:
        grid = coarse_grid(grid)
    return grid
