"""The memory layout every part of the package agrees on.

A grid is a persistent wide tree over bricks. A *brick* holds 8³ voxels as int16 log-odds; a *node* has 4³ children,
which is two levels of an octree in one; parents of bricks are nodes of level 0, the root is a node of level
``levels - 1``. Coordinates of voxels are signed integers: voxel (i, j, k) covers ``[i v, (i + 1) v) × …`` of the grid's
own frame, v the voxel size. That is the lattice of OctoMap, whose key is i + 32768.
"""

from __future__ import annotations

BRICK_EDGE = 8
BRICK_VOXELS = BRICK_EDGE**3
FAN = 4
CHILDREN = FAN**3

UNKNOWN = -32768
"""Value of a voxel that was never observed; a known voxel of log-odds 0 is another thing."""
SMALLEST_VOXEL, LARGEST_VOXEL = 1e-6, 1e6
"""Edge of a voxel in a file [m]: beyond these, places overflow."""
LIMIT = 32767
"""Largest magnitude of a known value."""
STEP = 1.0 / 2048.0
"""Log-odds of one unit; a power of two, so that float32 holds every value exactly. The range is ±16."""


FREE, HIT = 1, 2
"""Marks a scan leaves on a voxel; a hit wins."""

DEFAULT_LEVELS = 5
MAX_LEVELS = 7


def half_edge(levels: int) -> int:
    """Voxels from the centre of the addressable cube to its faces."""
    return int(BRICK_EDGE * FAN**levels // 2)
