"""Ranges from points of view inside a mesh."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array, ArrayLike
from graphslam.core.heavy import import_open3d
from graphslam.core.mesh import check_mesh

if TYPE_CHECKING:
    from graphslam.sim.world import World

_CHUNK = 1 << 19


class RayCaster:
    """A triangle mesh that rays are cast into.

    Open3D casts in single precision: coordinates are taken from the middle of the mesh, so that 1 km of mesh costs
    less than 0.1 mm.

    Parameters
    ----------
    vertices : (v, 3)
        [m]
    triangles : (t, 3)
        Rows of ``vertices``; either side of a triangle stops a ray.

    Raises
    ------
    DataError, GeometryError
        No triangle, a vertex that is not finite, or a triangle that names none.
    GraphSlamError
        Open3D is not there.
    """

    def __init__(self, vertices: ArrayLike, triangles: npt.ArrayLike) -> None:
        points, faces = check_mesh(vertices, triangles)
        if not len(faces):
            raise DataError("mesh without a triangle", got=faces.shape, wanted="(t, 3), t > 0")
        o3d = import_open3d()
        self._tensor = o3d.core.Tensor
        self._centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._tensor(np.ascontiguousarray(points - self._centre, dtype=np.float32)),
            self._tensor(np.ascontiguousarray(faces, dtype=np.uint32)),
        )

    @classmethod
    def of(cls, world: World) -> RayCaster:
        """Into the mesh of a world."""
        return cls(world.vertices, world.triangles)

    def ranges(self, rays: ArrayLike) -> Array:
        """Distances to the first triangle ``(n,)`` [m], NaN where a ray meets none.

        Parameters
        ----------
        rays : (n, 6)
            Origin [m] and unit direction.

        Raises
        ------
        DataError
            A ray that is not finite.
        """
        r = np.asarray(rays, dtype=np.float64)
        if r.ndim != 2 or r.shape[1] != 6:
            raise DataError("rays have the wrong shape", got=r.shape, wanted="(n, 6)")
        out = np.empty(len(r))
        for k in range(0, len(r), _CHUNK):
            part = r[k : k + _CHUNK] - np.concatenate([self._centre, np.zeros(3)])
            if not np.all(np.isfinite(part)):
                bad = k + int(np.argwhere(~np.isfinite(part))[0][0])
                raise DataError(f"ray {bad} is not finite", got=r[bad])
            hit = self._scene.cast_rays(self._tensor(part.astype(np.float32)))["t_hit"].numpy()
            out[k : k + _CHUNK] = hit
        out[~np.isfinite(out)] = np.nan
        return out

    def distances(self, points: ArrayLike) -> Array:
        """Distances of points ``(n, 3)`` to the nearest place of the mesh ``(n,)`` [m]."""
        p = np.asarray(points, dtype=np.float64)
        out = np.empty(len(p))
        for k in range(0, len(p), _CHUNK):
            part = (p[k : k + _CHUNK] - self._centre).astype(np.float32)
            out[k : k + _CHUNK] = self._scene.compute_distance(self._tensor(part)).numpy()
        return out
