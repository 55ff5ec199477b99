"""Ray casts into a world's mesh: what the tests of worlds look with."""

from __future__ import annotations

import numpy as np

from graphslam.core.geometry import Array
from graphslam.sim.raycast import RayCaster
from graphslam.sim.world import World


class Solid:
    """The mesh of a world as a ray-casting scene."""

    def __init__(self, world: World) -> None:
        self._caster = RayCaster.of(world)

    def cast(self, origins: Array, directions: Array) -> Array:
        """Distances ``(n,)`` to the first surface, in units of ``directions (n, 3)``; inf where there is none."""
        found = self._caster.ranges(np.concatenate(np.broadcast_arrays(origins, directions), axis=-1))
        return np.where(np.isnan(found), np.inf, found)

    def distance(self, points: Array) -> Array:
        """Distances ``(n,)`` from points ``(n, 3)`` to the nearest surface [m]."""
        return self._caster.distances(points)

    def sees(self, a: Array, b: Array) -> np.ndarray:
        """Whether nothing stands between points ``(n, 3)`` and ``(n, 3)``."""
        return self.cast(a, b - a) > 1.0
