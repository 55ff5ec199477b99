"""Ray casting into a triangle mesh."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array, ArrayLike
from graphslam.core.mesh import check_mesh
from graphslam.sim.raycast_kernels import build_kernel, distances_kernel, ranges_kernel

if TYPE_CHECKING:
    from graphslam.sim.world import World


class RayCaster:
    """A triangle mesh that rays are cast into, in double precision, on one core.

    Coordinates are relative to the centre of the mesh, so that a mesh far from the origin loses no precision.

    Parameters
    ----------
    vertices : (v, 3)
        [m]
    triangles : (t, 3)
        Rows of ``vertices``; either side of a triangle stops a ray.

    Examples
    --------
    >>> wall = RayCaster([[2, -1, -1], [2, 1, -1], [2, 0, 2]], [[0, 1, 2]])
    >>> wall.ranges([[0, 0, 0, 1, 0, 0], [0, 0, 0, -1, 0, 0]])
    array([ 2., nan])
    >>> wall.distances([[5, 0, 0]])
    array([3.])
    """

    def __init__(self, vertices: ArrayLike, triangles: npt.ArrayLike) -> None:
        points, faces = check_mesh(vertices, triangles)
        if not len(faces):
            raise DataError("mesh without a triangle", got=faces.shape, wanted="(t, 3), t > 0")
        self._centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
        corners = (points - self._centre)[faces]
        n = len(faces)
        boxes, first, count = np.empty((2 * n, 6)), np.empty(2 * n, np.int64), np.empty(2 * n, np.int64)
        order = np.arange(n)
        made = build_kernel(corners.min(axis=1), corners.max(axis=1), boxes, first, count, order)
        edges = np.concatenate([corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=1)
        self._tree = (boxes[:made].copy(), first[:made].copy(), count[:made].copy(), edges[order])

    @classmethod
    def of(cls, world: World) -> RayCaster:
        """Ray caster of the mesh of a world."""
        return cls(world.vertices, world.triangles)

    def ranges(self, rays: ArrayLike) -> Array:
        """Distances to the first triangle ``(n,)`` [m], NaN where a ray hits none.

        Parameters
        ----------
        rays : (n, 6)
            Origin [m] and unit direction.
        """
        r = np.asarray(rays, dtype=np.float64)
        if r.ndim != 2 or r.shape[1] != 6:
            raise DataError("rays have the wrong shape", got=r.shape, wanted="(n, 6)")
        if not np.all(np.isfinite(r)):
            bad = int(np.argwhere(~np.isfinite(r))[0][0])
            raise DataError(f"ray {bad} is not finite", got=r[bad])
        out = np.empty(len(r))
        ranges_kernel(r - np.concatenate([self._centre, np.zeros(3)]), *self._tree, out)
        out[~np.isfinite(out)] = np.nan
        return out

    def distances(self, points: ArrayLike) -> Array:
        """Distances of points ``(n, 3)`` to the nearest point of the mesh ``(n,)`` [m]."""
        p = np.asarray(points, dtype=np.float64)
        out = np.empty(len(p))
        distances_kernel(p - self._centre, *self._tree, out)
        return out
