"""A small world: a hall with a block in its centre, circled nearly one and a half times in about a minute.

A small counterpart of the garage: dead reckoning drifts, the route revisits places, and two corridors are parallel, so
that methods for the large worlds can be tested in seconds.
"""

from __future__ import annotations

import numpy as np

from graphslam.core.random import SeedTree
from graphslam.sim.clutter import KeepClear, scatter_obstacles
from graphslam.sim.mesh import MeshBuilder
from graphslam.sim.route import plan_route
from graphslam.sim.world import World, describe_route

_HEIGHT = 2.7
_RADIUS = 1.2
_SPEED = 0.75
_WALL = 0.3
_LOW, _HIGH = (-2.1, -2.1), (14.1, 10.1)
_BLOCK = ((1.3, 1.3), (10.7, 6.7))
# cupboards along the walls: low corner, high corner
_FIXED = (
    ((3.0, -2.1, 0.0), (3.7, -1.25, 1.1)),
    ((8.0, 0.95, 0.0), (9.1, 1.3, 2.0)),
    ((13.3, 2.3, 0.0), (14.1, 3.2, 1.7)),
    ((10.7, 5.0, 0.4), (11.1, 5.5, 1.3)),
    ((6.3, 9.3, 0.0), (7.7, 10.1, 1.9)),
    ((2.1, 6.7, 0.0), (2.4, 7.1, 2.3)),
    ((-2.1, 5.1, 0.0), (-1.3, 6.3, 1.0)),
    ((0.95, 2.8, 0.0), (1.3, 3.6, 1.5)),
)
_CORNERS = ((12.0, 0.0), (12.0, 8.0), (0.0, 8.0), (0.0, 0.0))


def ring_hall(*, seed: int = 0) -> World:
    """The world ``court``.

    Parameters
    ----------
    seed : int
        Of the movable obstacles; walls, cupboards and route do not depend on it.
    """
    mesh = MeshBuilder()
    (x0, y0), (x1, y1) = _LOW, _HIGH
    area = (x0 - _WALL, y0 - _WALL, x1 + _WALL, y1 + _WALL)
    mesh.slab(area, 0.0)
    mesh.slab(area, _HEIGHT + _WALL, thickness=_WALL)
    w = _WALL / 2
    ring = [(x0 - w, y0 - w), (x1 + w, y0 - w), (x1 + w, y1 + w), (x0 - w, y1 + w)]
    for a, b in zip(ring, ring[1:] + ring[:1]):
        mesh.wall(a, b, 0.0, _HEIGHT, thickness=_WALL)
    mesh.box((*_BLOCK[0], 0.0), (*_BLOCK[1], _HEIGHT))
    for low, high in _FIXED:
        mesh.box(low, high)
    plan = [(2.0, 0.0), *_CORNERS, *_CORNERS[:1], (12.0, 4.0)]
    waypoints = np.array([(x, y, 0.0) for x, y in plan])
    route = plan_route(waypoints, _RADIUS, where="court")
    rng = SeedTree(seed).child("court").generator()
    clear = KeepClear(route, margin=0.62)
    strips = ((x0, y0, x1, y0 + 1.2), (x0, y1 - 1.2, x1, y1), (x1 - 1.2, y0, x1, y1), (x0, y0, x0 + 1.2, y1))
    things = sum(scatter_obstacles(mesh, strip, 0.0, 3, clear, rng) for strip in strips)
    vertices, triangles = mesh.build()
    about = describe_route(route)
    # the first corridor and the third, either way round
    third = [float(route.starts[k]) for k in range(len(route.plan)) if abs(route.points[k, 1] - 8.0) < 1e-6]
    return World(
        name="court",
        vertices=vertices,
        triangles=triangles,
        waypoints=waypoints,
        corner_radius=_RADIUS,
        speed=_SPEED,
        meta={
            "kind": "court",
            "seed": seed,
            "levels": [0.0],
            "things": things,
            "parallel": [[[0.0, 8.0], [round(third[0], 2), round(third[0] + 8.0, 2)]]],
            **about,
        },
    )
