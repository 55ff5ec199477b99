"""A building of three levels under construction: a star of corridors on each, driven out and back, and a stairwell.

A hall in the middle of every level; corridors lead from it to the east, north and west, with rooms on both sides and a
larger room at the end, which the robot goes round; to the south flights of ramps, one above the other, join the levels.
Corridors come back along the line they went out on, seen from the other end.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from graphslam.core.random import SeedTree
from graphslam.sim.clutter import KeepClear, scatter_obstacles
from graphslam.sim.mesh import MeshBuilder, Rectangle
from graphslam.sim.route import plan_route
from graphslam.sim.world import World, describe_route, layout_number

STOREY = 3.6
_LEVELS = 3
_SLAB = 0.3
_RADIUS = 1.2
_SPEED = 0.65
_WALL = 0.15
# walls reach so far into floor and ceiling [m]: no beam slips through
_SEAT = 0.05
_HALL = 7.0  # half its width
_CORRIDOR = 1.4  # half its width
_ROOM_DEPTH = 5.0
_SHORTEST = 2.0  # of a room, along its corridor
_END_LENGTH, _END_HALF = 9.0, 4.6  # of the room at the end of a corridor
_ROUND = 1.8, 2.6  # the way round it: distance from its front and rear wall, half width
_DOOR, _END_DOOR, _DOOR_HEIGHT = 0.95, 1.5, 2.1
# stairwell: middle line of a lane, half width of the well, where flights begin and end, end of the landing (y)
_LANE, _WELL, _FOOT, _HEAD, _LANDING = 1.6, 3.1, -9.0, -23.0, -27.0
_RAIL = 1.1


@dataclass(frozen=True, slots=True)
class _Leg:
    """A corridor: level, quarter turns of its direction from east, length from the hall to the room at its end [m]."""

    level: int
    turns: int
    length: float

    @property
    def end(self) -> float:
        """Distance of the room's front wall from the middle of the hall [m]."""
        return _HALL + self.length

    def place(self, u: float, v: float) -> tuple[float, float]:
        """A point u along the corridor, from the middle of the hall, and v to its left, in the world."""
        for _ in range(self.turns):
            u, v = -v, u
        return u, v

    def rectangle(self, u0: float, v0: float, u1: float, v1: float) -> Rectangle:
        """A rectangle in the corridor's frame, in the world."""
        (a, b), (c, d) = self.place(u0, v0), self.place(u1, v1)
        return (min(a, c), min(b, d), max(a, c), max(b, d))

    def points(self) -> list[tuple[float, float, float]]:
        """Out, round the room at the end, and back."""
        near, far, half = self.end + _ROUND[0], self.end + _END_LENGTH - _ROUND[0], _ROUND[1]
        corners = [(near, 0.0), (near, -half), (far, -half), (far, half), (near, half), (near, 0.0)]
        return [(*self.place(u, v), self.level * STOREY) for u, v in corners]


_EAST, _NORTH, _WEST = 0, 1, 2
_LEGS = (
    _Leg(0, _EAST, 26.0), _Leg(0, _NORTH, 18.0), _Leg(0, _WEST, 20.0),
    _Leg(1, _EAST, 20.0), _Leg(1, _NORTH, 24.0), _Leg(1, _WEST, 14.0),
    _Leg(2, _EAST, 16.0), _Leg(2, _NORTH, 20.0), _Leg(2, _WEST, 16.0),
)  # fmt: skip


def building(layout: str = "usual", *, seed: int = 0) -> World:
    """The building world.

    Parameters
    ----------
    layout : str
        Of rooms and doors: "usual", or "drawn-17" by that number; corridors, stairs and way stay.
    seed : int
        Moves crates, boards and barrels; walls, doors and way stay.
    """
    mesh = MeshBuilder()
    _floors(mesh)
    _halls(mesh)
    _stairwell(mesh)
    fixed = SeedTree(layout_number(layout)).child("building")  # not the world's seed: rooms stay
    for leg in _LEGS:
        _corridor(mesh, leg, fixed.child("rooms", leg.level, leg.turns).generator())
    waypoints = np.array(_waypoints())
    route = plan_route(waypoints, _RADIUS, where="building")
    things = _clutter(mesh, KeepClear(route, margin=0.62), SeedTree(seed).child("building"))
    vertices, triangles = mesh.build()
    return World(
        name="building",
        vertices=vertices,
        triangles=triangles,
        waypoints=waypoints,
        corner_radius=_RADIUS,
        speed=_SPEED,
        meta={
            "kind": "building",
            "seed": seed,
            "levels": [STOREY * k for k in range(_LEVELS)],
            "things": things,
            "parallel": [],
            **describe_route(route),
        },
    )


def _ceiling(level: int) -> float:
    return (level + 1) * STOREY - _SLAB


def _upright(
    mesh: MeshBuilder,
    start: tuple[float, float],
    end: tuple[float, float],
    level: int,
    openings: tuple[Rectangle, ...] = (),
) -> None:
    """A wall from floor to ceiling; openings with heights above the floor."""
    floor = level * STOREY
    # an opening at the foot goes down into the floor, or a sill would stand in the door
    lifted = [(a, b, floor + c - (_SEAT if c == 0.0 else 0.0), floor + d) for a, b, c, d in openings]
    mesh.wall(start, end, floor - _SEAT, _ceiling(level) + _SEAT, thickness=_WALL, openings=lifted)


def _floors(mesh: MeshBuilder) -> None:
    reach = max(leg.end for leg in _LEGS) + _END_LENGTH + 1.0
    area = (-reach, _LANDING - 1.0, reach, reach)
    mesh.slab(area, 0.0, thickness=_SLAB)
    for level in range(1, _LEVELS):
        mesh.slab(area, level * STOREY, thickness=_SLAB, holes=[(-_WELL, _LANDING, _WELL, _FOOT)])
    mesh.slab(area, _LEVELS * STOREY, thickness=_SLAB)


def _halls(mesh: MeshBuilder) -> None:
    """Walls of the halls with the mouths of corridors and stairwell, pillars, a desk and a bench."""
    for level in range(_LEVELS):
        for turns in range(4):
            frame = _Leg(level, turns, 0.0)
            width = _WELL if turns == 3 else _CORRIDOR
            opening = (_HALL - width, _HALL + width, 0.0, 2.6)
            _upright(mesh, frame.place(_HALL, -_HALL), frame.place(_HALL, _HALL), level, (opening,))
        for x, y in ((-4.2, -4.2), (4.2, -4.2), (4.2, 4.2), (-4.2, 4.2)):
            mesh.prism((x, y), 0.35, level * STOREY, _ceiling(level), sides=16)
        desk = _Leg(level, level, 0.0)
        x0, y0, x1, y1 = desk.rectangle(4.9, 2.2, 5.7, 3.6)
        mesh.box((x0, y0, level * STOREY), (x1, y1, level * STOREY + 1.1))
        x0, y0, x1, y1 = desk.rectangle(-6.8, -5.6, -6.2, -3.2)
        mesh.box((x0, y0, level * STOREY), (x1, y1, level * STOREY + 0.45))


def _stairwell(mesh: MeshBuilder) -> None:
    """Two lanes of ramps round a wall, a landing half-way up each storey."""
    top = _LEVELS * STOREY - _SLAB + _SEAT
    out = _WELL + _WALL / 2
    mesh.wall((-out, _LANDING - _WALL), (-out, -_HALL), -_SEAT, top, thickness=_WALL)
    mesh.wall((out, _LANDING - _WALL), (out, -_HALL), -_SEAT, top, thickness=_WALL)
    mesh.wall((-out, _LANDING - _WALL / 2), (out, _LANDING - _WALL / 2), -_SEAT, top, thickness=_WALL)
    mesh.wall((0.0, _HEAD), (0.0, _FOOT), -_SEAT, top, thickness=0.2)
    width = 2.0 * (_WELL - _LANE) + 0.1  # into the walls on both sides
    for level in range(_LEVELS - 1):
        z, half, full = level * STOREY, (level + 0.5) * STOREY, (level + 1) * STOREY
        mesh.ramp((-_LANE, _FOOT, z), (-_LANE, _HEAD, half), width)
        mesh.ramp((_LANE, _HEAD, half), (_LANE, _FOOT, full), width)
        mesh.slab((-_WELL - 0.05, _LANDING - 0.05, _WELL + 0.05, _HEAD), half, thickness=_SLAB)
    last = (_LEVELS - 1) * STOREY  # nothing leads on from the highest level
    mesh.wall((-_WELL, _FOOT + 0.05), (0.0, _FOOT + 0.05), last, last + _RAIL, thickness=0.1)


def _corridor(mesh: MeshBuilder, leg: _Leg, rng: np.random.Generator) -> None:
    """A corridor, the rooms on both sides with open or closed doors, and the room at its end."""
    floor, back = leg.level * STOREY, _CORRIDOR + _ROOM_DEPTH

    def upright(u0: float, v0: float, u1: float, v1: float, *openings: Rectangle) -> None:
        _upright(mesh, leg.place(u0, v0), leg.place(u1, v1), leg.level, openings)

    for side in (-1.0, 1.0):
        edges = [_HALL]
        while leg.end - edges[-1] > 7.0:
            edges.append(min(edges[-1] + rng.uniform(3.2, 5.2), leg.end - _SHORTEST))
        edges.append(leg.end)
        doors = []
        for a, b in pairwise(edges):
            door = a + rng.uniform(0.5, b - a - 0.5 - _DOOR)
            opened, swing = rng.random() < 0.75, rng.uniform(0.9, 1.6)
            # furniture: a cupboard at the rear wall, a table
            cupboard, table = a + rng.uniform(0.8, b - a - 0.8), rng.uniform(0.35, 0.65)
            x0, y0, x1, y1 = leg.rectangle(cupboard - 0.6, side * (back - 0.55), cupboard + 0.6, side * (back - 0.1))
            mesh.box((x0, y0, floor), (x1, y1, floor + 1.9))
            middle = a + table * (b - a)
            x0, y0, x1, y1 = leg.rectangle(middle - 0.7, side * 3.6, middle + 0.7, side * 4.4)
            mesh.box((x0, y0, floor + 0.68), (x1, y1, floor + 0.75))
            for u, v in ((middle - 0.62, 3.66), (middle + 0.62, 3.66), (middle - 0.62, 4.34), (middle + 0.62, 4.34)):
                mesh.prism(leg.place(u, side * v), 0.03, floor, floor + 0.7, sides=5)
            if opened:
                doors.append((door - _HALL, door - _HALL + _DOOR, 0.0, _DOOR_HEIGHT))
                tip = (door + _DOOR * np.cos(swing), side * (_CORRIDOR + _DOOR * np.sin(swing)))
                hinge, leaf = leg.place(door, side * _CORRIDOR), leg.place(*tip)
                mesh.wall(hinge, leaf, floor, floor + _DOOR_HEIGHT, thickness=0.05)
            upright(b, side * _CORRIDOR, b, side * back)
        upright(_HALL, side * _CORRIDOR, leg.end, side * _CORRIDOR, *doors)
        upright(_HALL, side * back, leg.end, side * back)
        upright(_HALL, side * _CORRIDOR, _HALL, side * back)
    far = leg.end + _END_LENGTH
    gap = (_END_HALF - _END_DOOR / 2, _END_HALF + _END_DOOR / 2, 0.0, _DOOR_HEIGHT)
    upright(leg.end, -_END_HALF, leg.end, _END_HALF, gap)
    upright(leg.end, -_END_HALF, far, -_END_HALF)
    upright(leg.end, _END_HALF, far, _END_HALF)
    upright(far, -_END_HALF, far, _END_HALF)
    # an island to go round, benches along the walls: where they stand tells one end room from another
    long, deep, shift = rng.uniform(1.0, 2.4), rng.uniform(1.0, 2.2), rng.uniform(-0.4, 0.4)
    u = leg.end + _END_LENGTH / 2 + shift
    x0, y0, x1, y1 = leg.rectangle(u - long / 2, -deep / 2, u + long / 2, deep / 2)
    mesh.box((x0, y0, floor), (x1, y1, floor + rng.uniform(0.75, 1.5)))
    for side in (-1.0, 1.0):
        a, length, depth = leg.end + rng.uniform(0.3, 3.5), rng.uniform(1.5, 4.5), rng.uniform(0.4, 0.8)
        x0, y0, x1, y1 = leg.rectangle(a, side * (_END_HALF - depth), a + length, side * (_END_HALF - 0.05))
        mesh.box((x0, y0, floor), (x1, y1, floor + rng.uniform(0.6, 2.0)))


def _waypoints() -> list[tuple[float, float, float]]:
    """Up through the levels with all their corridors, down again, and out to where the first corridor begins."""
    points: list[tuple[float, float, float]] = [(_LANE, -6.0, 0.0)]
    for level in range(_LEVELS):
        z = level * STOREY
        east, north, west = (leg for leg in _LEGS if leg.level == level)
        points += [(_LANE, 0.0, z), *east.points(), (0.0, 0.0, z), *north.points(), (0.0, 0.0, z), *west.points()]
        if level < _LEVELS - 1:
            points += [(-_LANE, 0.0, z), *_climb(level)]
    for level in range(_LEVELS - 2, -1, -1):
        points += [(_LANE, 0.0, (level + 1) * STOREY), *_climb(level)[::-1], (-_LANE, 0.0, level * STOREY)]
    return [*points, (16.5, 0.0, 0.0)]


def _climb(level: int) -> list[tuple[float, float, float]]:
    """From one level to the next."""
    z, half, full = level * STOREY, (level + 0.5) * STOREY, (level + 1) * STOREY
    turn = 0.5 * (_HEAD + _LANDING)
    return [
        (-_LANE, _FOOT, z),
        (-_LANE, _HEAD, half),
        (-_LANE, turn, half),
        (_LANE, turn, half),
        (_LANE, _HEAD, half),
        (_LANE, _FOOT, full),
    ]


def _clutter(mesh: MeshBuilder, clear: KeepClear, tree: SeedTree) -> int:
    """What a building site leaves about in halls, corridors and rooms."""
    count = 0
    for level in range(_LEVELS):
        rng = tree.child("hall", level).generator()
        inner = _HALL - 0.6
        count += scatter_obstacles(mesh, (-inner, -inner, inner, inner), level * STOREY, 10, clear, rng)
    for leg in _LEGS:
        rng = tree.child("corridor", leg.level, leg.turns).generator()
        floor, back = leg.level * STOREY, _CORRIDOR + _ROOM_DEPTH - 0.5
        areas: list[tuple[Rectangle, int]] = []
        for side in (-1.0, 1.0):
            areas += [
                (leg.rectangle(_HALL + 0.3, side * 1.05, leg.end - 0.5, side * 1.3), 14),
                (leg.rectangle(_HALL + 0.5, side * 2.2, leg.end - 0.5, side * back), 8),
            ]
        areas.append((leg.rectangle(leg.end + 0.6, 0.6 - _END_HALF, leg.end + _END_LENGTH - 0.6, _END_HALF - 0.6), 8))
        for area, tries in areas:
            count += scatter_obstacles(mesh, area, floor, tries, clear, rng, tallest=1.9)
    return count
