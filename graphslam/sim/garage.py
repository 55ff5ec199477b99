"""A parking garage of two levels: in below, up a ramp, out above, down a road outside and in below again.

Pillars and ceiling beams have the same period on both levels, so that a map shifted by a period or by a level looks
similar; parked cars distinguish the places.
"""

from __future__ import annotations

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.random import SeedTree
from graphslam.sim.clutter import KeepClear, park_cars, scatter_obstacles
from graphslam.sim.garage_layouts import CORNER_RADIUS, SLAB, STOREY, GarageLayout, garage_layout
from graphslam.sim.mesh import MeshBuilder, Rectangle
from graphslam.sim.route import plan_route
from graphslam.sim.world import World, describe_route

_WALL = 0.3
_DOOR_WIDTH, _DOOR_HEIGHT = 5.4, 2.5
_PILLAR = 0.5
_BEAM_WIDTH, _BEAM_DEPTH = 0.4, 0.35
_RAIL = 1.0
_ROAD_WIDTH = 5.4
_SPEED = 0.75


def garage(layout: str = "A", *, seed: int = 0) -> World:
    """A garage world.

    Parameters
    ----------
    layout : str
        "A", "B" or "C"; "D" is held out for tests: nothing was tuned on it; "drawn-17" is generated from that number.
    seed : int
        Of parked cars and clutter; building and route do not depend on it.
    """
    g = garage_layout(layout)
    mesh = MeshBuilder()
    _shell(mesh, g)
    _levels(mesh, g)
    _inner_ramp(mesh, g)
    _road(mesh, g)
    _surroundings(mesh, g)
    waypoints = np.array(g.waypoints())
    route = plan_route(waypoints, CORNER_RADIUS, where=f"garage {layout}")
    clear = KeepClear(route)
    tree = SeedTree(seed).child("garage", layout)
    cars = 0
    for level, share in ((0, 0.6), (1, 0.5)):
        rng = tree.child("cars", level).generator()
        cars += park_cars(mesh, _bays(g), level * STOREY, share, clear, rng)
    rng = tree.child("yard").generator()
    cars += park_cars(mesh, _yard_bays(g), 0.0, 0.5, clear, rng)
    things = _clutter(mesh, g, clear, tree)
    vertices, triangles = mesh.build()
    return World(
        name=f"garage-{layout}",
        vertices=_placed(vertices, g),
        triangles=triangles,
        waypoints=_placed(waypoints, g),
        corner_radius=CORNER_RADIUS,
        speed=_SPEED,
        meta={
            "kind": "garage",
            "layout": layout,
            "seed": seed,
            "levels": [0.0, STOREY],
            "pillar_period": g.pitch,
            "cars": cars,
            "things": things,
            "parallel": [],
            **describe_route(route),
        },
    )


def _placed(points: Array, g: GarageLayout) -> Array:
    """Points mirrored and turned as specified by the layout."""
    x, y, z = points.T
    if g.mirrored:
        y = g.width - y
    if g.turned:
        x, y = -y, x
    return np.column_stack([x, y, z])


def _ramp_rectangle(g: GarageLayout, margin: float = 0.0) -> Rectangle:
    foot, top, y = g.ramp
    half = g.ramp_width / 2 + margin
    return (top, y - half, foot, y + half)


def _shell(mesh: MeshBuilder, g: GarageLayout) -> None:
    """Ground, outer walls with both doors, the roof."""
    L, W, top = g.length, g.width, 2 * STOREY
    mesh.slab((-34.0, g.yard - 24.0, L + 12.0, W + 16.0), 0.0)
    half, w = _DOOR_WIDTH / 2, _WALL / 2
    door_in = (g.west - half + w, g.west + half + w, 0.0, _DOOR_HEIGHT)
    door_out = (g.last_aisle - half + w, g.last_aisle + half + w, STOREY, STOREY + _DOOR_HEIGHT)
    mesh.wall((-w, 0.0), (L + w, 0.0), 0.0, top, thickness=_WALL, openings=[door_in])
    mesh.wall((-w, W), (L + w, W), 0.0, top, thickness=_WALL)
    mesh.wall((0.0, -w), (0.0, W + w), 0.0, top, thickness=_WALL, openings=[door_out])
    mesh.wall((L, -w), (L, W + w), 0.0, top, thickness=_WALL)
    mesh.slab((0.0, 0.0, L, W), top, thickness=SLAB)


def _levels(mesh: MeshBuilder, g: GarageLayout) -> None:
    """Upper floor, pillars, beams and stairwells, the same on both levels."""
    x0, y0, x1, y1 = _ramp_rectangle(g, 0.2)
    mesh.slab((0.0, 0.0, g.length, g.width), STOREY, thickness=SLAB, holes=[(x0, y0, x1, y1)])
    half = _PILLAR / 2
    for level in (0, 1):
        floor, ceiling = level * STOREY, (level + 1) * STOREY - SLAB
        for x in g.columns:
            for y in g.rows:
                mesh.box((x - half, y - half, floor), (x + half, y + half, ceiling))
            # a beam of the lower level would obstruct the robot's route where the ramp comes through the ceiling
            cut = level == 0 and x0 - 0.5 < x < x1 + 0.5
            for a, b in [(0.0, y0), (y1, g.width)] if cut else [(0.0, g.width)]:
                if b > a:
                    low = (x - _BEAM_WIDTH / 2, a, ceiling - _BEAM_DEPTH)
                    mesh.box(low, (x + _BEAM_WIDTH / 2, b, ceiling))
        for a, b, c, d in g.cores:
            mesh.box((a, b, floor), (c, d, ceiling))


def _inner_ramp(mesh: MeshBuilder, g: GarageLayout) -> None:
    foot, top, y = g.ramp
    start, end = (foot, y, 0.0), (top, y, STOREY)
    # the surface is as wide as the hole: no gap for a beam between ramp and parapet
    mesh.ramp(start, end, g.ramp_width, 0.0)
    mesh.ramp_sides(start, end, g.ramp_width, _RAIL, 0.0, thickness=0.2)
    x0, y0, x1, y1 = _ramp_rectangle(g, 0.3)
    for rail in (((x0, y0), (x1, y0)), ((x0, y1), (x1, y1)), ((x1, y0), (x1, y1))):
        mesh.wall(*rail, STOREY, STOREY + _RAIL, thickness=0.2)


def _road(mesh: MeshBuilder, g: GarageLayout) -> None:
    """From the upper exit round the corner and down along the west wall."""
    half, h = _ROAD_WIDTH / 2, STOREY
    west, east = g.road - half, g.road + half
    south, north = g.road_top, g.last_aisle + half + 0.3
    mesh.box((west, south, 0.0), (-0.1, north, h))  # the landing before the exit
    top, foot = (g.road, south, h), (g.road, g.road_foot, 0.0)
    mesh.ramp(top, foot, _ROAD_WIDTH, 0.0)
    mesh.ramp_sides(top, foot, _ROAD_WIDTH, _RAIL, 0.0, thickness=0.3)
    mesh.wall((west - 0.15, south - 0.15), (west - 0.15, north + 0.3), 0.0, h + _RAIL, thickness=0.3)
    mesh.wall((west, north + 0.15), (-0.1, north + 0.15), 0.0, h + _RAIL, thickness=0.3)
    mesh.wall((east, south - 0.15), (-0.1, south - 0.15), 0.0, h + _RAIL, thickness=0.3)


def _surroundings(mesh: MeshBuilder, g: GarageLayout) -> None:
    """Structures visible from the road and the yard: a façade with buttresses, a fence, masts, trees, a kiosk."""
    south, west = g.yard - 9.0, g.road - 12.0
    mesh.wall((west, south), (34.0, south), 0.0, 7.5, thickness=0.4, openings=[(8.0, 10.0, 0.0, 2.3)])
    for k, x in enumerate((-13.0, -7.5, 1.0, 4.5, 12.0, 21.5, 27.0)):
        depth = 0.6 + 0.35 * (k % 3)
        mesh.box((x, south + 0.2, 0.0), (x + 0.9, south + 0.2 + depth, 6.0))
    mesh.wall((west, south), (west, g.width + 10.0), 0.0, 1.8, thickness=0.15)
    mesh.wall((west, g.width + 10.0), (-0.5, g.width + 10.0), 0.0, 4.0, thickness=0.3)
    for x, y, r in ((-3.4, g.yard - 4.5, 0.12), (11.0, g.yard + 2.0, 0.12), (23.0, g.yard - 3.5, 0.12)):
        mesh.prism((x, y), r, 0.0, 6.5, sides=8)
    trees = ((-5.0, 0.25), (3.5, 0.2), (9.0, 0.3), (17.0, 0.22), (29.0, 0.28))
    for k, (dy, r) in enumerate(trees):
        x, y = west + 2.5 + 1.3 * (k % 2), g.yard + dy + 1.0
        mesh.prism((x, y), r, 0.0, 2.2, sides=8)
        mesh.prism((x, y), 1.3 + 0.2 * (k % 3), 2.2, 5.0, sides=7)
    mesh.box((15.0, g.yard - 2.0, 0.0), (18.2, g.yard + 1.2, 2.7))
    mesh.box((-0.9, -0.6, 0.0), (-0.2, 2.2, 1.3))  # a plant trough beside the wall


def _bays(g: GarageLayout) -> Array:
    """Parking bays ``(n, 3)``: three between two pillars, none in the cross aisles or where the ramp is."""
    pillars, width = g.columns, (g.pitch - _PILLAR) / 3
    # free space for the ramp: its rectangle enlarged by half a car's length
    x0, y0, x1, y1 = _ramp_rectangle(g, 2.4)
    bays = []
    for y in g.bays:
        for a in pillars[:-1]:
            for x in a + _PILLAR / 2 + width * (np.arange(3) + 0.5):
                in_aisle = min(abs(x - g.west), abs(x - g.east), abs(x - g.turn)) < 3.2
                on_ramp = x0 - 1.0 < x < x1 + 5.0 and y0 < y < y1
                in_core = any(c[0] - 1.2 < x < c[2] + 1.2 and c[1] - 2.5 < y < c[3] + 2.5 for c in g.cores)
                if not (in_aisle or on_ramp or in_core):
                    bays.append((x, y, np.pi / 2))
    return np.array(bays)


def _yard_bays(g: GarageLayout) -> Array:
    """Along the façade opposite."""
    xs = np.arange(-11.0, 26.0, 2.8)
    return np.column_stack([xs, np.full(len(xs), g.yard - 5.4), np.full(len(xs), np.pi / 2)])


def _clutter(mesh: MeshBuilder, g: GarageLayout, clear: KeepClear, tree: SeedTree) -> int:
    """Crates and barrels near the walls of both levels, and in the yard."""
    hole = _ramp_rectangle(g, 0.6)
    count = 0
    for level in (0, 1):
        rng = tree.child("clutter", level).generator()
        for strip in (
            (0.4, 0.4, 2.2, g.width - 0.4),
            (g.length - 2.0, 6.0, g.length - 0.5, g.width - 6.0),
            (0.4, 0.4, g.length - 0.4, 1.0),
            (0.4, g.width - 1.0, g.length - 0.4, g.width - 0.4),
        ):
            floor = level * STOREY
            count += scatter_obstacles(mesh, strip, floor, 6, clear, rng, forbidden=[hole, *g.cores])
    rng = tree.child("clutter", "yard").generator()
    count += scatter_obstacles(mesh, (g.road - 9.0, g.yard - 4.0, 14.0, -0.6), 0.0, 8, clear, rng)
    return count
