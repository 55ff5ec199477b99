"""A coal mine: 1.3 km of way through rough galleries, interlocking loops, two long galleries side by side.

The pair of parallel galleries is what a filter merges that trusts its position more than it should: they are as far
apart as dead reckoning is off after a few hundred metres, rise and fall alike, and meet at cross-cuts only.
"""

from __future__ import annotations

import itertools

import numpy as np

from graphslam.core.geometry import Array, arc_length
from graphslam.core.random import SeedTree
from graphslam.sim.clutter import KeepClear
from graphslam.sim.mesh import MeshBuilder
from graphslam.sim.route import Route, plan_route
from graphslam.sim.world import World, describe_route, layout_number
from graphslam_studies.sim.tunnels import Gallery, Rock, rock_field, surface_nets

_RADIUS = 2.5
_SPEED = 0.75
_HALF_WIDTH, _HEIGHT = 2.0, 2.7
_STUB_HALF_WIDTH, _STUB_HEIGHT = 1.2, 2.1
# Floors are level round a junction, where galleries of different slope share their floor and the robot turns [m].
_LEVEL = 5.5
# The parallel stretches begin and end this far from the cross-cuts' middle lines [m].
_APART = 4.0

# Junctions: x, y, height of the floor [m]. Primed names of the parallel pair are b, m, c.
_JUNCTIONS = {
    "S": (-27.0, 12.0, 1.0),
    "A": (0.0, 0.0, 0.0),
    "B": (40.0, 0.0, -1.0),
    "M": (100.0, 0.0, 1.6),
    "C": (160.0, 0.0, -1.2),
    "b": (40.0, 8.0, -1.0),
    "m": (100.0, 8.0, 1.6),
    "c": (160.0, 8.0, -1.2),
    "D": (164.0, 62.0, 2.0),
    "E": (104.0, 66.0, 4.5),
    "F": (44.0, 58.0, 1.5),
    "G": (158.0, -51.0, -5.0),
    "H": (94.0, -57.0, -1.0),
    "I": (30.0, -47.0, -3.0),
}
# Galleries and the bends between their two junctions (x, y); heights of bends follow the slope.
_GALLERIES: dict[str, tuple[tuple[float, float], ...]] = {
    "SA": (),
    "AB": ((20.0, 1.6),),
    "BM": ((70.0, -2.2),),
    "MC": ((130.0, 2.0),),
    "bm": ((70.0, 5.8),),
    "mc": ((130.0, 10.0),),
    "Bb": (),
    "Mm": (),
    "Cc": (),
    "cD": ((158.0, 34.0),),
    "DE": ((136.0, 60.0),),
    "EF": ((74.0, 66.0),),
    "Fb": ((38.0, 32.0),),
    "mE": ((106.0, 36.0),),
    "CG": ((163.0, -26.0),),
    "GH": ((126.0, -50.0),),
    "HI": ((62.0, -56.0),),
    "IA": ((18.0, -20.0),),
    "HM": ((100.0, -28.0),),
}
# Blind headings off the galleries: gallery, share of its length, side (1 left, -1 right), length [m]. None between the
# parallel pair, where it would open a view through.
_STUBS = (
    ("SA", 0.45, 1, 3.0), ("AB", 0.3, 1, 4.0), ("AB", 0.62, -1, 3.0), ("BM", 0.27, -1, 3.5), ("BM", 0.8, -1, 2.5),
    ("MC", 0.4, -1, 4.0), ("bm", 0.55, 1, 3.0), ("mc", 0.22, 1, 3.5), ("mc", 0.7, 1, 2.5), ("cD", 0.35, -1, 4.0),
    ("DE", 0.6, 1, 3.0), ("DE", 0.25, -1, 3.5), ("EF", 0.35, -1, 3.0), ("EF", 0.7, 1, 4.0), ("Fb", 0.3, -1, 3.5),
    ("mE", 0.65, 1, 3.0), ("CG", 0.45, 1, 3.5), ("GH", 0.3, 1, 3.0), ("GH", 0.68, -1, 4.0), ("HI", 0.28, 1, 3.0),
    ("HI", 0.6, -1, 3.0), ("IA", 0.3, -1, 4.0), ("IA", 0.72, 1, 3.0), ("HM", 0.45, -1, 3.5),
)  # fmt: skip
# S, east through the first of the pair, round the south, east through the second, round the north, and again through
# parts of both rings by way of the middle cross-cut.
_TOUR = "SABMCGHIABbmcDEFbmMHIABMmEF"
# Round once more: back to the beginning of the pair, and then as before.
_TOURS = {"once": _TOUR, "twice": _TOUR + "b" + _TOUR[2:]}
# The way ends at this bend of the gallery that it would take next.
_END = (38.0, 32.0)


def mine(layout: str = "once", *, seed: int = 0) -> World:
    """The mine world.

    Parameters
    ----------
    layout : {"once", "twice"} or "drawn-17"
        How often the tour is made, in one drive; or once, between walls that are drawn by that number.
    seed : int
        Moves timber, crates and fallen rock; galleries and way stay.
    """
    number = layout_number(layout)
    tour = _TOURS["once" if number else layout]
    galleries = [g for name in _GALLERIES for g in _pieces(name)]
    stubs = [_stub(*s) for s in _STUBS]
    rng = SeedTree(number).child("mine", "rock").generator()  # not the world's seed: walls stay
    rock = Rock()
    field, low = rock_field(galleries + stubs, rock, rng)
    mesh = MeshBuilder()
    mesh.add(*surface_nets(field, low, rock.cell))
    waypoints = _waypoints(tour)
    route = plan_route(waypoints, _RADIUS, where="mine")
    things = _clutter(mesh, galleries, KeepClear(route, margin=0.8), SeedTree(seed).child("mine", "clutter"))
    vertices, triangles = mesh.build()
    return World(
        name="mine",
        vertices=vertices,
        triangles=triangles,
        waypoints=waypoints,
        corner_radius=_RADIUS,
        speed=_SPEED,
        meta={
            "kind": "mine",
            "seed": seed,
            "levels": [],  # the floor rises and falls
            "things": things,
            "galleries": sorted(_GALLERIES),
            "tour": tour,
            "parallel": parallel_stretches(route),
            **describe_route(route),
        },
    )


def _line(name: str) -> tuple[Array, Array]:
    """Middle line of a gallery ``(k, 3)`` with its bends, and the arc length in the plan ``(k,)`` of each point."""
    a, b = (np.array(_JUNCTIONS[j]) for j in name)
    plan = np.array([a[:2], *_GALLERIES[name], b[:2]])
    t = arc_length(plan)
    level = _LEVEL if t[-1] > 2.5 * _LEVEL else 0.4 * t[-1]
    z = a[2] + np.clip((t - level) / (t[-1] - 2.0 * level), 0.0, 1.0) * (b[2] - a[2])
    return np.column_stack([plan, z]), t


def _pieces(name: str) -> list[Gallery]:
    """Straight pieces of a gallery."""
    line, t = _line(name)
    level = _LEVEL if t[-1] > 2.5 * _LEVEL else 0.4 * t[-1]
    last = len(line) - 2
    return [
        Gallery(
            start=line[k],
            end=line[k + 1],
            level=(level if k == 0 else 0.0, level if k == last else 0.0),
            half_width=_HALF_WIDTH,
            height=_HEIGHT,
        )
        for k in range(last + 1)
    ]


def _waypoints(tour: str) -> Array:
    """The tour with the bends of its galleries and the ends of their level parts."""
    points = [np.array(_JUNCTIONS[tour[0]])]
    for a, b in itertools.pairwise(tour):
        name = a + b if a + b in _GALLERIES else b + a
        stretch: list[Array] = []
        for g in _pieces(name):
            for t in (g.level[0], g.length - g.level[1]):
                if 0.0 < t < g.length and g.start[2] != g.end[2]:
                    xy = g.start[:2] + (g.end - g.start)[:2] * (t / g.length)
                    stretch.append(np.array([*xy, float(g.floor(np.array(t)))]))
            stretch.append(g.end)
        if name != a + b:
            stretch = [*stretch[-2::-1], np.array(_JUNCTIONS[b])]
        points += stretch
    line, _ = _line(tour[-1] + "b")
    return np.array([*points, _level_end(tour[-1] + "b"), line[np.argmin(np.hypot(*(line[:, :2] - _END).T))]])


def _level_end(name: str) -> Array:
    """Where the level part at the start of a gallery ends ``(3,)``."""
    g = _pieces(name)[0]
    t = g.level[0]
    return np.array([*(g.start[:2] + (g.end - g.start)[:2] * (t / g.length)), float(g.floor(np.array(t)))])


def _stub(name: str, share: float, side: int, length: float) -> Gallery:
    """A blind heading off a gallery; it begins at the wall, so that its level floor does not cut into the slope."""
    line, t = _line(name)
    at = share * t[-1]
    mouth = np.array([np.interp(at, t, line[:, k]) for k in range(2)] + [0.0])
    pieces = _pieces(name)
    k = min(int(np.searchsorted(t, at, side="right")) - 1, len(pieces) - 1)
    mouth[2] = float(pieces[k].floor(np.array(at - t[k])))
    along = (line[k + 1] - line[k])[:2] / np.linalg.norm((line[k + 1] - line[k])[:2])
    out = side * np.array([-along[1], along[0], 0.0])
    return Gallery(
        start=mouth + _HALF_WIDTH * out,
        end=mouth + (_HALF_WIDTH + length) * out,
        level=(0.0, 0.0),
        half_width=_STUB_HALF_WIDTH,
        height=_STUB_HEIGHT,
    )


def parallel_stretches(route: Route) -> list[list[list[float]]]:
    """Every drive through one of the pair of parallel galleries beside every drive through the other."""
    s = route.every(0.1)
    p = route.positions(s)
    stretches: dict[str, list[tuple[float, float]]] = {"BM": [], "MC": [], "bm": [], "mc": []}
    for name, found in stretches.items():
        line, _ = _line(name)
        on = np.abs(p[:, 1] - np.interp(p[:, 0], line[:, 0], line[:, 1])) < 1.0
        on &= (p[:, 0] > line[0, 0] + _APART) & (p[:, 0] < line[-1, 0] - _APART)
        on &= np.abs(p[:, 1] - 4.0) < 8.0
        edges = np.flatnonzero(np.diff(np.concatenate([[0], on.astype(int), [0]])))
        found += [(round(float(s[i]), 2), round(float(s[j - 1]), 2)) for i, j in zip(edges[::2], edges[1::2])]
    return [
        [list(one), list(other)]
        for first, second in (("BM", "bm"), ("MC", "mc"))
        for one in stretches[first]
        for other in stretches[second]
    ]


def _clutter(mesh: MeshBuilder, galleries: list[Gallery], clear: KeepClear, tree: SeedTree) -> int:
    """Posts, crates and fallen rock along the walls."""
    rng = tree.generator()
    placed = 0
    for g in galleries:
        across = np.array([-(g.end - g.start)[1], (g.end - g.start)[0]]) / g.length
        for _ in range(int(g.length / 3.0)):
            u, side, off, kind, a, b, turn = rng.random(7)
            t = u * g.length
            offset = (1.2 + 0.45 * off) * (1.0 if side < 0.5 else -1.0)
            centre = g.start[:2] + (g.end - g.start)[:2] * u + offset * across
            floor = float(g.floor(np.array(t)))
            size = (0.25 + 0.4 * a, 0.25 + 0.3 * b)
            if not clear.allows(tuple(centre), size, np.pi * turn, floor):
                continue
            if kind < 0.4:
                mesh.prism(tuple(centre), 0.09 + 0.05 * a, floor - 0.2, floor + _HEIGHT, sides=7)
            else:
                height = 0.3 + 0.9 * b if kind < 0.7 else 0.2 + 0.35 * b
                mesh.turned_box(centre, size, np.pi * turn, floor - 0.3, floor + height)
            placed += 1
    return placed
