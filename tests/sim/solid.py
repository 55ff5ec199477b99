"""Ray casts into a world's mesh, by Open3D: what the tests of worlds look with."""

from __future__ import annotations

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.heavy import import_open3d
from graphslam.sim.world import World


class Solid:
    """The mesh of a world as a ray-casting scene."""

    def __init__(self, world: World) -> None:
        self._o3d = import_open3d()
        self._scene = self._o3d.t.geometry.RaycastingScene()
        tensor = self._o3d.core.Tensor
        self._scene.add_triangles(tensor(world.vertices.astype(np.float32)), tensor(world.triangles.astype(np.uint32)))

    def cast(self, origins: Array, directions: Array) -> Array:
        """Distances ``(n,)`` to the first surface, in units of ``directions (n, 3)``; inf where there is none."""
        rays = np.concatenate(np.broadcast_arrays(origins, directions), axis=-1).astype(np.float32)
        return self._scene.cast_rays(self._o3d.core.Tensor(rays))["t_hit"].numpy().astype(np.float64)

    def distance(self, points: Array) -> Array:
        """Distances ``(n,)`` from points ``(n, 3)`` to the nearest surface [m]."""
        return self._scene.compute_distance(self._o3d.core.Tensor(points.astype(np.float32))).numpy().astype(np.float64)

    def sees(self, a: Array, b: Array) -> np.ndarray:
        """Whether nothing stands between points ``(n, 3)`` and ``(n, 3)``."""
        return self.cast(a, b - a) > 1.0
