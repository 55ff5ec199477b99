"""Maps for the tests of files: dictionaries of voxels, and grids of them."""

from __future__ import annotations

import itertools

import numpy as np

from graphslam.evidence.beams import BeamModel
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.layout import UNKNOWN
from graphslam.evidence.pool import GridPool

Map = dict[tuple[int, int, int], int]


def cube(corner: tuple[int, int, int], edge: int, value: int) -> Map:
    """All voxels of a cube with one value."""
    return dict.fromkeys(itertools.product(*(range(c, c + edge) for c in corner)), value)  # type: ignore[misc]


def random_map(rng: np.random.Generator, reach: int) -> Map:
    """Single voxels, aligned cubes of several sizes, cubes with a hole or a bump, around the origin and far from it."""
    out: Map = {}
    for edge in (16, 8, 8, 4, 2, 2, 1, 1, 1, 1):
        for _ in range(3):
            corner = tuple((rng.integers(-40, 40, 3) // edge * edge).tolist())
            out |= cube(corner, edge, int(rng.choice([-900, -1, 0, 1, 700, 32767, -32767])))  # type: ignore[arg-type]
    for v in list(out)[:: len(out) // 12]:
        if rng.random() < 0.5:
            del out[v]
        else:
            out[v] = int(rng.integers(-32767, 32768))
    for corner in rng.integers(-reach, reach, (6, 3)).tolist():
        out[tuple(corner)] = int(rng.integers(-32767, 32768))
    for face in (-reach, reach - 1):
        out[face, 0, 0] = out[0, face, 1] = out[-1, -1, face] = 5
    return out


def grid_of_map(
    voxels: Map,
    *,
    voxel_size: float = 0.1,
    levels: int = 5,
    model: BeamModel | None = None,
    pool: GridPool | None = None,
) -> EvidenceGrid:
    """A grid of a dictionary, brick by brick."""
    grid = EvidenceGrid(voxel_size, pool=GridPool(levels) if pool is None else pool, model=model)
    bricks: dict[tuple[int, ...], np.ndarray] = {}
    for v, value in voxels.items():
        row = bricks.setdefault(tuple(i >> 3 for i in v), np.full(512, UNKNOWN, np.int16))
        row[(v[2] & 7) * 64 + (v[1] & 7) * 8 + (v[0] & 7)] = value
    grid.write_bricks(
        np.array(list(bricks), np.int64).reshape(-1, 3), np.array(list(bricks.values()), np.int16).reshape(-1, 512)
    )
    return grid


def map_of_grid(grid: EvidenceGrid) -> Map:
    """Every known voxel of a grid, as a dictionary."""
    out: Map = {}
    for b, row in zip(grid.brick_coordinates().tolist(), grid.brick_values()):
        for j in np.flatnonzero(row != UNKNOWN).tolist():
            out[8 * b[0] + (j & 7), 8 * b[1] + (j >> 3 & 7), 8 * b[2] + (j >> 6)] = int(row[j])
    return out


def scanned_grid(
    rng: np.random.Generator, *, scans: int = 4, dim: int = 3, pool: GridPool | None = None
) -> EvidenceGrid:
    """A grid as scans make it."""
    grid = EvidenceGrid(0.2, dim=dim, pool=pool)
    for _ in range(scans):
        grid.insert_scan(rng.normal(0, 3, (60, dim)), rng.normal(0, 1, dim))
    return grid
