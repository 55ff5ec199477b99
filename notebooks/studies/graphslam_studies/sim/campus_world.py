"""The campus as triangles: ground, buildings with and without an interior, ramps, trees, poles and parked cars."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.random import SeedTree
from graphslam.sim.clutter import KeepClear, park_cars
from graphslam.sim.mesh import MeshBuilder, Rectangle
from graphslam.sim.route import plan_route
from graphslam.sim.world import World, describe_route
from graphslam_studies.sim.campus_config import CampusConfig
from graphslam_studies.sim.campus_plan import (
    CORRIDOR,
    DEPTH,
    LANDING,
    MARGIN,
    RAMP,
    Block,
    Campus,
    plan_campus,
    plan_session,
)

CORNER_RADIUS = 1.2
CEILING = 2.8
"""Of the ground floor of an open building, above its floor [m]."""
_WALL = 0.2
_SEAT = 0.05  # m that walls reach into floor and ceiling: no beam slips through
_DOOR = (1.8, 2.3)  # width and height of the doors to the outside
_ROOM_DOOR = (1.0, 2.1)
_CLEAR = 1.0  # m on either side of a way that nothing fixed stands on


def campus(config: CampusConfig, *, seed: int = 0) -> World:
    """The campus with the way of one session.

    Parameters
    ----------
    seed : int
        Of the place; sessions of one seed share it.

    Returns
    -------
    World
        ``meta`` holds ``corridors``: the corner ``[x, y]`` of each corridor driven and the ends of its two legs; and
        ``roofs``, rectangles ``[x0, y0, x1, y1]`` of the interiors.
    """
    plan = plan_campus(config, seed)
    tree = SeedTree(seed).child("campus", "things")
    mesh = MeshBuilder()
    edge = 30.0
    mesh.box((-edge, -edge, -1.0), (config.size[0] + edge, config.size[1] + edge, 0.0))
    paths = _drivable(plan)
    for b in plan.blocks:
        rng = tree.child("block", b.column, b.row).generator()
        if b.open:
            _open_building(mesh, b, rng)
        else:
            _closed_buildings(mesh, b, rng)
    for k, (a, c) in enumerate(plan.streets()):
        near = np.abs((paths[:, :2] - a) @ np.array([a[1] - c[1], c[0] - a[0]])) < config.street * np.linalg.norm(c - a)
        _street(mesh, a, c, config, KeepClear(paths[near], _CLEAR), tree.child("street", k).generator())
    waypoints, visited = plan_session(plan, config, seed)
    route = plan_route(waypoints, CORNER_RADIUS, where="campus")
    vertices, triangles = mesh.build()
    return World(
        name="campus" + (f"-far{config.session}" if config.far else f"-{config.session}" if config.session else ""),
        vertices=vertices,
        triangles=triangles,
        waypoints=waypoints,
        corner_radius=CORNER_RADIUS,
        speed=config.speed,
        meta={
            "kind": "campus",
            "seed": seed,
            "size": list(config.size),
            "levels": [0.0],
            "parallel": [],
            "corridors": [_corridor_of(b) for b in visited],
            "roofs": [list(r) for b in plan.blocks if b.open for r in b.wings()],
            **describe_route(route),
        },
    )


def _corridor_of(b: Block) -> dict[str, object]:
    uc, vc = b.corner
    ends = [b.place(MARGIN, vc), b.place(uc, b.height - MARGIN)]
    return {"corner": list(b.place(uc, vc)), "ends": [list(e) for e in ends], "angle": np.pi / 2, "floor": b.floor}


def _drivable(plan: Campus) -> Array:
    """Points close together on everything a robot may drive over ``(n, 3)``."""
    lines = [np.array([[*a, 0.0], [*b, 0.0]]) for a, b in plan.streets()]
    lines += [b.passage(plan.street) for b in plan.blocks if b.open]
    out = []
    for line in lines:
        for a, b in pairwise(line):
            n = max(int(np.linalg.norm(b - a) / 0.25), 1)
            out.append(a + np.linspace(0.0, 1.0, n + 1)[:, None] * (b - a))
    return np.concatenate(out)


def _street(
    mesh: MeshBuilder, start: Array, end: Array, config: CampusConfig, clear: KeepClear, rng: np.random.Generator
) -> None:
    """Parked cars at both kerbs, trees and poles behind them."""
    length = float(np.linalg.norm(end - start))
    along = (end - start) / length
    left = np.array([-along[1], along[0]])
    yaw = float(np.arctan2(along[1], along[0]))
    half = config.street / 2
    for side in (-1.0, 1.0):
        at = np.arange(half + 3.0, length - half - 3.0, 6.0)
        at = at[rng.random(len(at)) < 0.9]
        bays = np.array([(*(start + s * along + side * (half - 1.1) * left), yaw) for s in at]).reshape(-1, 3)
        park_cars(mesh, bays, 0.0, min(0.4 * config.clutter, 1.0), clear, rng)
        s = half + 1.0
        while s < length - half:
            s += float(rng.uniform(5.0, 14.0)) / max(config.clutter, 1e-3)
            kind, radius, tall, spread, off = rng.random(5)
            centre = start + s * along + side * (half + 0.8 + 0.8 * off) * left
            if s > length - half or not clear.allows(tuple(centre), (1.0, 1.0), 0.0, 0.0):
                continue
            if kind < 0.6:
                top = 2.4 + 1.2 * tall
                mesh.prism(tuple(centre), 0.1 + 0.2 * radius, 0.0, top, sides=8)
                mesh.prism(tuple(centre), 0.9 + 0.9 * spread, top - 0.2, top + 2.0 + 2.0 * tall, sides=7)
            else:
                mesh.prism(tuple(centre), 0.05 + 0.08 * radius, 0.0, 3.0 + 3.0 * tall, sides=6)


def _pilasters(
    mesh: MeshBuilder,
    start: Array,
    end: Array,
    top: float,
    rng: np.random.Generator,
    free: tuple[float, float] = (0, 0),
) -> None:
    """Pillars, bays and gutters on the right of a façade, so that one stretch of it is not like the next.

    ``free``: middle and half width of a stretch that stays clear, along the façade.
    """
    length = float(np.linalg.norm(end - start))
    along = (end - start) / length
    out = np.array([along[1], -along[0]])
    s = float(rng.uniform(1.0, 4.0))
    while s < length - 1.0:
        wide, deep, high = rng.uniform(0.3, 2.2), rng.uniform(0.1, 0.6), rng.uniform(2.0, top)
        low = 0.0 if rng.random() < 0.7 else min(rng.uniform(0.5, 2.5), high - 0.5)
        if abs(s - free[0]) > free[1] + wide / 2 or free[1] == 0:
            centre = start + s * along + 0.5 * deep * out
            mesh.turned_box(centre, (wide, deep), float(np.arctan2(along[1], along[0])), low, high)
        s += float(rng.uniform(3.0, 9.0))


def _closed_buildings(mesh: MeshBuilder, b: Block, rng: np.random.Generator) -> None:
    """One to four solid houses with gaps between them, set back differently; or a park."""
    x0, y0, x1, y1 = b.area
    if rng.random() < 0.15:
        for _ in range(int(b.width * b.height / 80.0)):
            x, y, r, h = rng.uniform(x0 + 3, x1 - 3), rng.uniform(y0 + 3, y1 - 3), rng.random(), rng.random()
            mesh.prism((x, y), 0.1 + 0.2 * r, 0.0, 2.5 + h, sides=8)
            mesh.prism((x, y), 1.0 + r, 2.3 + h, 5.0 + 2.0 * h, sides=7)
        return
    split = rng.uniform(0.4, 0.6, 2)
    xs = [x0, x0 + split[0] * b.width, x1] if rng.random() < 0.6 else [x0, x1]
    ys = [y0, y0 + split[1] * b.height, y1] if rng.random() < 0.6 else [y0, y1]
    for a, c in pairwise(xs):
        for d, e in pairwise(ys):
            back = rng.uniform(0.5, 1.0, 4) * (MARGIN - 2.0)
            low, high = (a + back[0], d + back[1]), (c - back[2], e - back[3])
            top = float(rng.uniform(5.0, 18.0))
            mesh.box((*low, 0.0), (*high, top))
            ring = [np.array(p) for p in (low, (high[0], low[1]), high, (low[0], high[1]))]
            for p, q in zip(ring, ring[1:] + ring[:1]):
                _pilasters(mesh, p, q, top, rng)


def _open_building(mesh: MeshBuilder, b: Block, rng: np.random.Generator) -> None:
    """Two wings at a right angle, each with a corridor between rooms; storeys above that are solid."""
    w, h, m, d, f = b.width, b.height, MARGIN, DEPTH, b.floor
    uc, vc = b.corner
    low, high = f - _SEAT, f + CEILING + _SEAT
    top = f + CEILING + float(rng.uniform(3.0, 12.0))

    def wall(u0: float, v0: float, u1: float, v1: float, *openings: tuple[float, float, float]) -> None:
        """Upright; openings: from, to, height."""
        holes = [(a, c, low, f + z) for a, c, z in openings]
        mesh.wall(b.place(u0, v0), b.place(u1, v1), low, high, thickness=_WALL, openings=holes)

    def box(area: Rectangle, bottom: float, above: float) -> None:
        x0, y0, x1, y1 = b.rectangle(*area)
        mesh.box((x0, y0, bottom), (x1, y1, above))

    for wing in ((m, m, w - m, m + d), (w - m - d, m, w - m, h - m)):
        grown = (wing[0] - _WALL / 2, wing[1] - _WALL / 2, wing[2] + _WALL / 2, wing[3] + _WALL / 2)
        box(grown, -0.5, f)
        box(grown, f + CEILING, top)
    # landings and ramps
    for u, v, du, dv in ((m, vc, -1.0, 0.0), (uc, h - m, 0.0, 1.0)):
        side = (0.0 if du else 1.3, 0.0 if dv else 1.3)
        box((u - side[0], v - side[1], u + side[0] + du * LANDING, v + side[1] + dv * LANDING), -0.5, f)
        begin = b.place(u + du * (LANDING + RAMP), v + dv * (LANDING + RAMP))
        mesh.ramp((*begin, 0.0), (*b.place(u + du * LANDING, v + dv * LANDING), f), 2.6, -0.5)
    # outer walls
    half = _DOOR[0] / 2
    wall(m, m, w - m, m)
    wall(w - m, m, w - m, h - m)
    wall(w - m - d, h - m, w - m, h - m, (d / 2 - half, d / 2 + half, _DOOR[1]))
    wall(w - m - d, m + d, w - m - d, h - m)
    wall(m, m + d, w - m - d, m + d)
    wall(m, m, m, m + d, (d / 2 - half, d / 2 + half, _DOOR[1]))
    ring = [(m, m), (w - m, m), (w - m, h - m), (w - m - d, h - m), (w - m - d, m + d), (m, m + d)]
    turned = b.flip[0] != b.flip[1]  # mirrored: the outside is on the other side of each façade
    for k, (p, q) in enumerate(zip(ring, ring[1:] + ring[:1])):
        a, c = np.array(b.place(*p)), np.array(b.place(*q))
        door = (d / 2, 2.2) if k in (2, 5) else (0.0, 0.0)
        _pilasters(mesh, c if turned else a, a if turned else c, f + CEILING, rng, door)
    # corridors: the outer side, then the inner side
    half = CORRIDOR
    legs: list[tuple[tuple[float, float], tuple[float, float], tuple[float, float]]] = [
        ((m, vc - half), (uc + half, vc - half), (0.0, -1.0)),
        ((uc + half, vc - half), (uc + half, h - m), (1.0, 0.0)),
        ((m, vc + half), (uc - half, vc + half), (0.0, 1.0)),
        ((uc - half, vc + half), (uc - half, h - m), (-1.0, 0.0)),
    ]
    for (u0, v0), (u1, v1), out in legs:
        _rooms(mesh, b, (u0, v0, u1, v1), out, (d - 2 * half) / 2, wall, box, rng)


def _rooms(
    mesh: MeshBuilder,
    b: Block,
    leg: Rectangle,
    out: tuple[float, float],
    deep: float,
    wall: Callable[..., None],
    box: Callable[[Rectangle, float, float], None],
    rng: np.random.Generator,
) -> None:
    """The wall of a corridor with doors, and the rooms ``deep`` metres deep behind it, to the side ``out``."""
    u0, v0, u1, v1 = leg
    length = float(np.hypot(u1 - u0, v1 - v0))
    du, dv = (u1 - u0) / length, (v1 - v0) / length
    f, cuts = b.floor, [0.0]
    while length - cuts[-1] > 8.0:
        cuts.append(cuts[-1] + float(rng.uniform(3.5, 6.5)))
    cuts.append(length)
    if len(cuts) > 2 and cuts[-1] - cuts[-2] < 0.6 + _ROOM_DOOR[0]:
        del cuts[-2]  # no room for a door
    doors = []

    def at(s: float, t: float) -> tuple[float, float]:
        return u0 + s * du + t * out[0], v0 + s * dv + t * out[1]

    def block(s: float, t: float, ds: float, dt: float, low: float, high: float) -> None:
        (a, c), (e, g) = at(s - ds / 2, t - dt / 2), at(s + ds / 2, t + dt / 2)
        box((min(a, e), min(c, g), max(a, e), max(c, g)), low, high)

    for k, (a, e) in enumerate(pairwise(cuts)):
        room = e - a
        door = a + float(rng.uniform(0.3, room - 0.3 - _ROOM_DOOR[0]))
        opened, swing, side = rng.random() < 0.6, float(rng.uniform(0.6, 1.5)), rng.random(6)
        if opened:
            doors.append((door, door + _ROOM_DOOR[0], _ROOM_DOOR[1]))
            hinge = at(door, 0.0)
            tip = at(door + _ROOM_DOOR[0] * np.cos(swing), _ROOM_DOOR[0] * np.sin(swing))
            mesh.wall(b.place(*hinge), b.place(*tip), f, f + _ROOM_DOOR[1], thickness=0.05)
        else:
            block(door + _ROOM_DOOR[0] / 2, -0.06, _ROOM_DOOR[0], 0.12, f, f + _ROOM_DOOR[1])
        # a cupboard at the back, a table, and sometimes a bench in the corridor
        block(a + 0.6 + side[0] * (room - 1.2), deep - 0.4, 1.0, 0.5, f, f + 1.2 + 0.8 * side[1])
        block(a + 0.8 + side[2] * (room - 1.6), 1.6 + 1.5 * side[3], 1.2, 0.7, f + 0.68, f + 0.74)
        if side[4] < 0.3:
            block(a + 0.7 + side[5] * (room - 1.4), -0.15, 0.9, 0.3, f, f + 0.5 + 1.2 * side[5])
        if k:
            wall(*at(a, 0.0), *at(a, deep))
    wall(u0, v0, u1, v1, *doors)
