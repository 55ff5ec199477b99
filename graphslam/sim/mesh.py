"""Triangles of simple solids, combined into one mesh.

Solids may touch or overlap: a range finder sees the nearest surface only. Neighbouring pieces of one wall or floor
share their corners exactly, so that there is no gap for a beam.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import GeometryError
from graphslam.core.geometry import Array, ArrayLike
from graphslam.sim.world import Triangles

# corners 0-3 below, 4-7 above, both counter-clockwise from above
_HEXAHEDRON = np.array(
    [
        [0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7], [0, 1, 5], [0, 5, 4],
        [1, 2, 6], [1, 6, 5], [2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7],
    ],
    dtype=np.int32,
)  # fmt: skip
Rectangle = tuple[float, float, float, float]


class MeshBuilder:
    """Collects solids; :meth:`build` returns the mesh."""

    def __init__(self) -> None:
        self._vertices: list[Array] = []
        self._triangles: list[Triangles] = []
        self._count = 0

    def add(self, vertices: ArrayLike, triangles: npt.ArrayLike) -> None:
        """Add a mesh ``(v, 3)``, ``(t, 3)``."""
        v = np.asarray(vertices, dtype=np.float64).reshape(-1, 3)
        t = np.asarray(triangles, dtype=np.int32).reshape(-1, 3)
        if not np.all(np.isfinite(v)):
            raise GeometryError("a solid has corners that are not finite")
        self._vertices.append(v)
        self._triangles.append(t + np.int32(self._count))
        self._count += len(v)

    def build(self) -> tuple[Array, Triangles]:
        """Vertices ``(v, 3)`` and triangles ``(t, 3)`` of everything added."""
        if not self._vertices:
            return np.zeros((0, 3)), np.zeros((0, 3), np.int32)
        return np.concatenate(self._vertices), np.concatenate(self._triangles)

    def hexahedron(self, corners: ArrayLike) -> None:
        """A solid of eight corners ``(8, 3)``: four below and the four above them, each counter-clockwise."""
        self.add(np.asarray(corners, dtype=np.float64).reshape(8, 3), _HEXAHEDRON)

    def box(self, low: Sequence[float], high: Sequence[float]) -> None:
        """A box along the axes between two corners, each ``(3,)``."""
        (a, b, c), (d, e, f) = low, high
        plan = [(a, b), (d, b), (d, e), (a, e)]
        self.hexahedron([(x, y, c) for x, y in plan] + [(x, y, f) for x, y in plan])

    def turned_box(self, centre: ArrayLike, size: ArrayLike, yaw: float, low: float, high: float) -> None:
        """A box turned about the vertical: ``centre`` and ``size`` in the plan ``(2,)``, between two heights."""
        c, s = np.cos(yaw), np.sin(yaw)
        half = 0.5 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.asarray(size, dtype=np.float64)
        plan = half @ np.array([[c, s], [-s, c]]) + np.asarray(centre, dtype=np.float64)
        self.hexahedron([(x, y, low) for x, y in plan] + [(x, y, high) for x, y in plan])

    def wall(
        self,
        start: Sequence[float],
        end: Sequence[float],
        low: float,
        high: float,
        *,
        thickness: float = 0.2,
        openings: Iterable[Rectangle] = (),
    ) -> None:
        """An upright wall with rectangular openings.

        Parameters
        ----------
        start, end : (2,)
            Of its centre line in the plan [m].
        low, high : float
            Heights of its foot and of its top [m].
        openings : iterable of (from, to, bottom, top)
            Distances along the wall and heights [m]: doors and windows.
        """
        a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
        length = float(np.linalg.norm(b - a))
        along = (b - a) / length
        across = 0.5 * thickness * np.array([-along[1], along[0]])
        for u0, u1, z0, z1 in _cells((0.0, length, low, high), openings):
            p, q = a + u0 * along, a + u1 * along
            plan = [p - across, q - across, q + across, p + across]
            self.hexahedron([(*c, z0) for c in plan] + [(*c, z1) for c in plan])

    def slab(self, area: Rectangle, top: float, *, thickness: float = 0.3, holes: Iterable[Rectangle] = ()) -> None:
        """A level floor or ceiling.

        Parameters
        ----------
        area : (x0, y0, x1, y1)
        top : float
            Height of the upper side [m].
        holes : iterable of (x0, y0, x1, y1)
        """
        x0, y0, x1, y1 = area
        flipped = [(h[0], h[2], h[1], h[3]) for h in holes]
        for a, b, c, d in _cells((x0, x1, y0, y1), flipped):
            self.box((a, c, top - thickness), (b, d, top))

    def ramp(self, start: Sequence[float], end: Sequence[float], width: float, base: float | None = None) -> None:
        """A sloping floor, solid down to ``base``; a plate 0.3 m thick without one.

        Parameters
        ----------
        start, end : (3,)
            Of the centre line of its surface [m].
        """
        a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
        along = (b - a)[:2] / np.linalg.norm((b - a)[:2])
        across = 0.5 * width * np.array([-along[1], along[0], 0.0])
        top = np.array([a - across, b - across, b + across, a + across])
        below = top.copy()
        below[:, 2] = top[:, 2] - 0.3 if base is None else base
        self.hexahedron(np.concatenate([below, top]))

    def ramp_sides(
        self, start: Sequence[float], end: Sequence[float], width: float, height: float, base: float,
        *, thickness: float = 0.2,
    ) -> None:  # fmt: skip
        """Walls on both sides of a ramp whose tops rise with it, ``height`` [m] above its surface."""
        a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
        along = (b - a)[:2] / np.linalg.norm((b - a)[:2])
        out = 0.5 * (width + thickness) * np.array([-along[1], along[0], 0.0]) + np.array([0.0, 0.0, height])
        for side in (out, out * np.array([-1.0, -1.0, 1.0])):
            self.ramp(a + side, b + side, thickness, base)

    def prism(self, centre: Sequence[float], radius: float, low: float, high: float, *, sides: int = 12) -> None:
        """An upright regular prism: a round pillar, a barrel, a tree's stem."""
        angle = 2.0 * np.pi * np.arange(sides) / sides
        ring = np.column_stack([centre[0] + radius * np.cos(angle), centre[1] + radius * np.sin(angle)])
        v = np.concatenate([np.column_stack([ring, np.full(sides, z)]) for z in (low, high)])
        k = np.arange(sides)
        j = (k + 1) % sides
        fan = np.column_stack([np.zeros(sides - 2, int), k[1:-1], k[2:]])
        self.add(
            v,
            np.concatenate(
                [
                    np.column_stack([k, j, j + sides]),
                    np.column_stack([k, j + sides, k + sides]),
                    fan[:, ::-1],
                    fan + sides,
                ]
            ),
        )

    def car(self, centre: Sequence[float], yaw: float, floor: float, size: Sequence[float]) -> None:
        """A parked car: body and cabin on four wheels; ``size`` length, width, height [m]."""
        length, width, height = size
        self.turned_box(centre, (length, width), yaw, floor + 0.22, floor + 0.58 * height)
        back = np.array([np.cos(yaw), np.sin(yaw)]) * -0.06 * length
        roof = np.asarray(centre, dtype=np.float64) + back
        self.turned_box(roof, (0.52 * length, 0.9 * width), yaw, floor + 0.58 * height, floor + height)
        for u in (-0.32, 0.32):
            axle = np.asarray(centre, dtype=np.float64) + u * length * np.array([np.cos(yaw), np.sin(yaw)])
            self.turned_box(axle, (0.6, 0.96 * width), yaw, floor, floor + 0.3)


def _cells(area: Rectangle, holes: Iterable[Rectangle]) -> list[Rectangle]:
    """Rectangles ``(u0, u1, v0, v1)`` that cover an area except its holes; neighbours share their corners."""
    u0, u1, v0, v1 = area
    clipped = [(max(h[0], u0), min(h[1], u1), max(h[2], v0), min(h[3], v1)) for h in holes]
    clipped = [h for h in clipped if h[0] < h[1] and h[2] < h[3]]
    if u0 >= u1 or v0 >= v1:
        raise GeometryError("a wall or floor has no extent", got=area, wanted="from < to")
    us = sorted({u0, u1, *(x for h in clipped for x in h[:2])})
    vs = sorted({v0, v1, *(x for h in clipped for x in h[2:])})
    cells = []
    for a, b in pairwise(us):
        for c, d in pairwise(vs):
            u, v = 0.5 * (a + b), 0.5 * (c + d)
            if not any(h[0] < u < h[1] and h[2] < v < h[3] for h in clipped):
                cells.append((a, b, c, d))
    return cells
