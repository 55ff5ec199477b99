"""Where streets, blocks and ways through buildings lie on a campus, and the way of a session over them.

Streets form a grid. A block with an open building has a *passage*: from the street on one side up a ramp, through a
door, along a corridor that turns at a right angle, out of another door, and down a ramp to a street on the next side.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array
from graphslam.core.random import SeedTree
from graphslam.sim.mesh import Rectangle
from graphslam_studies.sim.campus_config import CampusConfig

MARGIN = 10.0
"""From the edge of a block to its building [m]."""
DEPTH = 14.0
"""Of a wing of an open building [m]."""
CORRIDOR = 1.5
"""Half the width of a corridor [m]."""
LANDING = 1.5
"""Level ground before a door [m]."""
RAMP = 5.5
"""Length of a ramp up to a door [m]."""
FAR_ROWS = 1
"""Rows of blocks in the north that only a far session drives round; one more row lies between."""
Node = tuple[str, int, int]


@dataclass(frozen=True, slots=True)
class Block:
    """A block between four streets.

    Parameters
    ----------
    area : (x0, y0, x1, y1)
        Without the streets [m].
    open : bool
        Its building has an interior.
    flip : (bool, bool)
        The plan is mirrored east–west, and north–south.
    floor : float
        Height of its floor over the street [m].
    """

    column: int
    row: int
    area: Rectangle
    open: bool
    flip: tuple[bool, bool]
    floor: float

    @property
    def width(self) -> float:
        """East to west [m]."""
        return self.area[2] - self.area[0]

    @property
    def height(self) -> float:
        """North to south [m]."""
        return self.area[3] - self.area[1]

    def place(self, u: float, v: float) -> tuple[float, float]:
        """A point of the plan: door A in the west, door B in the north, the corridor's corner in the south-east."""
        x0, y0, x1, y1 = self.area
        return (x1 - u if self.flip[0] else x0 + u), (y1 - v if self.flip[1] else y0 + v)

    def rectangle(self, u0: float, v0: float, u1: float, v1: float) -> Rectangle:
        """A rectangle of the plan, in the world."""
        (a, b), (c, d) = self.place(u0, v0), self.place(u1, v1)
        return min(a, c), min(b, d), max(a, c), max(b, d)

    @property
    def corner(self) -> tuple[float, float]:
        """Where the middle lines of the two corridors meet, in the plan [m]."""
        return self.width - MARGIN - DEPTH / 2, MARGIN + DEPTH / 2

    def wings(self) -> tuple[Rectangle, Rectangle]:
        """The two wings of an open building, in the world; they share the corner."""
        w, h = self.width, self.height
        return (
            self.rectangle(MARGIN, MARGIN, w - MARGIN, MARGIN + DEPTH),
            self.rectangle(w - MARGIN - DEPTH, MARGIN, w - MARGIN, h - MARGIN),
        )

    def passage(self, street: float) -> Array:
        """Points ``(8, 3)`` from the street at door A to the street at door B."""
        uc, vc = self.corner
        h, foot, top = self.height, MARGIN - LANDING - RAMP, MARGIN - LANDING
        plan = [(-street / 2, vc, 0.0), (foot, vc, 0.0), (top, vc, self.floor), (uc, vc, self.floor)]
        plan += [(uc, h - top, self.floor), (uc, h - foot, 0.0), (uc, h + street / 2, 0.0)]
        return np.array([(*self.place(u, v), z) for u, v, z in plan])


@dataclass(frozen=True, slots=True)
class Campus:
    """Streets and blocks; see :func:`plan_campus`.

    Parameters
    ----------
    xs, ys : (m,), (n,)
        Middle lines of the streets [m].
    street : float
        Width of a street [m].
    """

    xs: Array
    ys: Array
    street: float
    blocks: tuple[Block, ...]

    def streets(self) -> list[tuple[Array, Array]]:
        """Ends of the middle lines, ``(2,)`` each."""
        x, y = self.xs, self.ys
        lines = [(np.array([x[0], b]), np.array([x[-1], b])) for b in y]
        return lines + [(np.array([a, y[0]]), np.array([a, y[-1]])) for a in x]

    def inside(self, points: Array) -> np.ndarray:
        """Which points ``(n, 2 | 3)`` are under the roof of an open building."""
        out = np.zeros(len(points), dtype=bool)
        for b in self.blocks:
            if b.open:
                for x0, y0, x1, y1 in b.wings():
                    p = points
                    out |= (p[:, 0] > x0) & (p[:, 0] < x1) & (p[:, 1] > y0) & (p[:, 1] < y1)
        return out


def plan_campus(config: CampusConfig, seed: int) -> Campus:
    """Draw streets and blocks of a world."""
    tree = SeedTree(seed).child("campus", "plan")
    rng = tree.generator()
    lines = []
    for size in config.size:
        n = max(round((size - config.street) / config.block), 1)
        gaps = 1.0 + (0.15 * rng.uniform(-1.0, 1.0, n) if n > 1 else np.zeros(1))
        at = np.concatenate([[0.0], np.cumsum(gaps)])
        lines.append(config.street / 2 + at / at[-1] * (size - config.street))
    xs, ys = lines
    half = config.street / 2
    blocks = []
    for i in range(len(xs) - 1):
        for j in range(len(ys) - 1):
            draw = tree.child("block", i, j).generator()
            area = (xs[i] + half, ys[j] + half, xs[i + 1] - half, ys[j + 1] - half)
            area = tuple(float(v) for v in area)  # type: ignore[assignment]
            big = min(area[2] - area[0], area[3] - area[1]) >= 2 * MARGIN + DEPTH + 6.0
            opened = bool(draw.random() < config.open_share) and big
            flip = (bool(draw.random() < 0.5), bool(draw.random() < 0.5))
            blocks.append(Block(i, j, area, opened, flip, float(draw.uniform(0.2, 0.45))))
    return Campus(xs, ys, config.street, tuple(blocks))


def plan_session(campus: Campus, config: CampusConfig, seed: int) -> tuple[Array, list[Block]]:
    """Way of a session: points ``(k, 3)`` that it drives over, and the blocks whose buildings it goes through."""
    rows = len(campus.ys) - 1
    if config.far:
        mine = range(rows - FAR_ROWS, rows)
    else:  # a campus of one or two rows has no far part
        mine = range(rows if rows < FAR_ROWS + 2 else rows - FAR_ROWS - 1)
    blocks = [b for b in campus.blocks if b.row in mine and b.open]
    if not blocks and config.visits:
        raise ConfigError("campus: no block with an open building where the session drives; raise open_share")
    rng = SeedTree(seed).child("campus", "far" if config.far else "session", config.session).generator()
    net = _Net(campus, mine)
    crossings = [n for n in net.places if n[0] == "crossing"]
    here: list[Node] = [crossings[int(rng.integers(len(crossings)))]]
    goal = here[0]
    visited: list[Block] = []
    for _ in range(config.visits):
        left = [b for b in blocks if b not in visited] or blocks
        block = left[int(rng.integers(len(left)))]
        visited.append(block)
        i, j = block.column, block.row
        ring: list[Node] = [("crossing", *c) for c in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1))]
        if rng.random() < 0.5:
            ring.reverse()
        doors: list[Node] = [("A", i, j), ("B", i, j)]
        if rng.random() < 0.5:
            doors.reverse()
        if config.round or config.visits == 0:
            first = min(range(4), key=lambda k: net.distance(here[-1], ring[k]))
            for k in range(5):
                net.go(here, ring[(first + k) % 4])
        net.go(here, doors[0])
        here.append(doors[1])
    net.go(here, goal)
    if len(here) < 3:
        raise ConfigError(f"campus: the session goes nowhere with visits = {config.visits}")
    points: list[Array] = []
    for a, b in pairwise(here):
        if a[0] != "crossing" and b[0] != "crossing" and a[1:] == b[1:]:
            block = next(x for x in blocks if (x.column, x.row) == a[1:])
            path = block.passage(campus.street)
            points.extend((path if a[0] == "A" else path[::-1])[:-1])
        else:
            points.append(np.append(net.places[a], 0.0))
    points.append(np.append(net.places[here[-1]], 0.0))
    path = np.array(points)
    # doors of two blocks may face each other across a street, at one place on its middle line
    moved = np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1) > 1e-6
    return path[np.append(True, moved)], visited


class _Net:
    """Crossings, doors on the streets, and the pieces of street between them."""

    def __init__(self, campus: Campus, rows: range) -> None:
        low, high = rows.start, rows.stop
        self.places: dict[Node, Array] = {
            ("crossing", i, j): np.array([x, campus.ys[j]])
            for i, x in enumerate(campus.xs)
            for j in range(low, high + 1)
        }
        for b in campus.blocks:
            if b.open and b.row in rows:
                path = b.passage(campus.street)
                self.places["A", b.column, b.row] = path[0, :2]
                self.places["B", b.column, b.row] = path[-1, :2]
        self.next: dict[Node, list[Node]] = {n: [] for n in self.places}
        for axis, lines in ((0, campus.xs), (1, campus.ys[low : high + 1])):
            for at in lines:
                on = [n for n, p in self.places.items() if abs(p[axis] - at) < 1e-9]
                on.sort(key=lambda n: float(self.places[n][1 - axis]))
                for one, two in pairwise(on):
                    self.next[one].append(two)
                    self.next[two].append(one)

    def distance(self, a: Node, b: Node) -> float:
        """As the crow flies [m]."""
        return float(np.linalg.norm(self.places[a] - self.places[b]))

    def go(self, path: list[Node], goal: Node) -> None:
        """Lengthen a way to a goal along the streets without turning back on itself."""
        if path[-1] == goal:
            return
        before = path[-2] if len(path) > 1 else None
        # out of a door the way may go to either side of the street
        came = before if before is not None and path[-1] in self.next.get(before, []) else None
        start = (path[-1], came)
        queue: list[tuple[float, int, Node, Node | None]] = [(0.0, 0, *start)]
        best: dict[tuple[Node, Node | None], float] = {start: 0.0}
        parent: dict[tuple[Node, Node | None], tuple[Node, Node | None]] = {}
        count = 0
        while queue:
            d, _, node, last = heapq.heappop(queue)
            if node == goal:
                found: list[Node] = []
                state: tuple[Node, Node | None] = (node, last)
                while state != start:
                    found.append(state[0])
                    state = parent[state]
                path.extend(found[::-1])
                return
            if d > best[node, last]:
                continue
            for n in self.next[node]:
                if n == last:
                    continue
                cost, key = d + self.distance(node, n), (n, node)
                if cost < best.get(key, np.inf):
                    best[key], parent[key] = cost, (node, last)
                    count += 1
                    heapq.heappush(queue, (cost, count, n, node))
        raise ConfigError(f"campus: no way from {path[-1]} to {goal} without turning back")
