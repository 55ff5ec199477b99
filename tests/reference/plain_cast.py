"""A ray through a grid, one voxel after the other: what the compiled caster must find, ties included."""

from __future__ import annotations

import math
from collections.abc import Mapping

Voxel = tuple[int, int, int]


def plain_cast(
    values: Mapping[Voxel, int],
    origin: tuple[float, float, float],
    direction: tuple[float, float, float],
    reach: float,
    threshold: int,
    half: int,
    *,
    ignore_unknown: bool = True,
) -> tuple[int, float, Voxel]:
    """(status, range, voxel) in voxel units; ``origin`` counts from the cube's corner, ``values`` from its centre.

    A plane k is crossed at (k - o) / d; of planes crossed at once, z comes before y before x. Statuses as in the
    library: 0 maximum range, 1 hit, 2 began inside, 3 left the cube, 5 unknown.
    """
    voxel = [math.floor(o) for o in origin]
    steps = [1 if d >= 0 else -1 for d in direction]
    inverse = [1.0 / d if abs(d) > 1e-200 else 1e300 for d in direction]

    def crossing(axis: int) -> float:
        return (voxel[axis] + (steps[axis] > 0) - origin[axis]) * inverse[axis]

    t = 0.0
    first = True
    while True:
        here = (voxel[0] - half, voxel[1] - half, voxel[2] - half)
        if t > reach:
            return 0, reach, here
        if not all(0 <= i < 2 * half for i in voxel):
            return 3, t, here
        value = values.get(here)
        times = [crossing(axis) for axis in range(3)]
        if value is not None and value >= threshold:
            return (2, 0.0, here) if first else (1, min(0.5 * (t + min(times)), reach), here)
        if value is None and not ignore_unknown:
            return 5, t, here
        axis = min((2, 1, 0), key=lambda a: times[a])
        t = times[axis]
        voxel[axis] += steps[axis]
        first = False
