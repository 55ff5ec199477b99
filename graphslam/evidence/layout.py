"""Memory layout of evidence grids: constants that all modules of the package use.

A grid is a persistent tree whose leaves are bricks. A *brick* holds 8³ voxels as int16 log-odds. A *node* has 4³
children, which equals two levels of an octree. Parents of bricks are nodes of level 0; the root is a node of level
``levels - 1``. Voxel coordinates are signed integers: voxel (i, j, k) covers ``[i v, (i + 1) v) × …`` in the grid
frame, with voxel size v. This is the lattice of OctoMap, whose key is i + 32768.
"""

from __future__ import annotations

BRICK_EDGE = 8
BRICK_VOXELS = BRICK_EDGE**3
FAN = 4
CHILDREN = FAN**3

UNKNOWN = -32768
"""Value of a voxel that was never observed; this differs from a known voxel with log-odds 0."""
SMALLEST_VOXEL, LARGEST_VOXEL = 1e-6, 1e6
"""Limits of the voxel edge in a file [m]; outside them, coordinates overflow."""
LIMIT = 32767
"""Largest absolute value of a known voxel, in units of `STEP`."""
STEP = 1.0 / 2048.0
"""Log-odds of one unit; a power of two, so that float32 holds every value exactly. The range is ±16."""


FREE, HIT = 1, 2
"""Marks of a scan on a voxel; a hit overrides a free mark."""

DEFAULT_LEVELS = 5
MAX_LEVELS = 7


def half_edge(levels: int) -> int:
    """Voxels from the centre of the addressable cube to its faces."""
    return int(BRICK_EDGE * FAN**levels // 2)
