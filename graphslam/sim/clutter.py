"""Movable obstacles: parked cars, crates, barrels; always clear of the robot's route."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from graphslam.core.geometry import Array
from graphslam.sim.mesh import MeshBuilder, Rectangle
from graphslam.sim.route import Route

# Two points belong to the same floor if their heights differ by less than this [m].
_SAME_FLOOR = 2.4


class KeepClear:
    """Tests whether an obstacle keeps clear of the route.

    Parameters
    ----------
    way : Route or (n, 3)
        The route, or closely spaced points on all routes [m].
    margin : float
        Free space on either side of the route's centre line [m].
    """

    def __init__(self, path: Route | Array, margin: float = 1.2) -> None:
        self._points = path.positions(path.every(0.25)) if isinstance(path, Route) else path
        self.margin = margin

    def distance(self, centre: Sequence[float], size: Sequence[float], yaw: float, floor: float) -> float:
        """Plan distance from the route to a box [m]; infinite if the route does not visit that floor."""
        p = self._points[np.abs(self._points[:, 2] - floor) < _SAME_FLOOR, :2]
        if len(p) == 0:
            return float("inf")
        d = p - np.asarray(centre, dtype=np.float64)
        c, s = np.cos(yaw), np.sin(yaw)
        local = np.abs(np.column_stack([c * d[:, 0] + s * d[:, 1], -s * d[:, 0] + c * d[:, 1]]))
        outside = np.maximum(local - 0.5 * np.asarray(size, dtype=np.float64), 0.0)
        return float(np.hypot(outside[:, 0], outside[:, 1]).min())

    def allows(self, centre: Sequence[float], size: Sequence[float], yaw: float, floor: float) -> bool:
        """Whether a box is clear of the route."""
        return self.distance(centre, size, yaw, floor) > self.margin


def park_cars(
    mesh: MeshBuilder,
    bays: Array,
    floor: float,
    occupied: float,
    clear: KeepClear,
    rng: np.random.Generator,
) -> int:
    """Park cars in some of the bays ``(n, 3)``: x, y, yaw. Returns how many.

    Every bay consumes the same random numbers whether occupied or not, so that an additional bay changes no other.
    """
    count = 0
    for x, y, yaw in bays:
        chance, du, dv, turn, length, width, height, reverse = rng.random(8)
        size = (3.7 + 1.0 * length, 1.65 + 0.2 * width, 1.35 + 0.45 * height)
        heading = yaw + np.deg2rad(4.0) * (turn - 0.5) + (np.pi if reverse < 0.5 else 0.0)
        centre = (x + 0.3 * (du - 0.5), y + 0.5 * (dv - 0.5))
        if chance < occupied and clear.allows(centre, size[:2], heading, floor):
            mesh.car(centre, heading, floor, size)
            count += 1
    return count


def scatter_obstacles(
    mesh: MeshBuilder,
    area: Rectangle,
    floor: float,
    count: int,
    clear: KeepClear,
    rng: np.random.Generator,
    *,
    tallest: float = 1.6,
    forbidden: Sequence[Rectangle] = (),
) -> int:
    """Place crates, barrels and boards in an area ``(x0, y0, x1, y1)``, clear of the route and of forbidden rectangles.

    Returns how many of ``count`` were placed; each is tried once.
    """
    placed = 0
    for _ in range(count):
        u, v, kind, a, b, h, turn = rng.random(7)
        centre = (area[0] + u * (area[2] - area[0]), area[1] + v * (area[3] - area[1]))
        yaw, height = np.pi * turn, 0.4 + (tallest - 0.4) * h
        size = (0.4 + 0.9 * a, 0.4 + 0.5 * b) if kind < 0.7 else (0.7, 0.7)
        reach = 0.5 * float(np.hypot(*size))
        inside = any(
            f[0] - reach < centre[0] < f[2] + reach and f[1] - reach < centre[1] < f[3] + reach for f in forbidden
        )
        if inside or not clear.allows(centre, size, yaw, floor):
            continue
        if kind < 0.7:
            mesh.turned_box(centre, size, yaw, floor, floor + height)
        elif kind < 0.85:
            mesh.prism(centre, 0.3, floor, floor + 0.9)
        else:
            mesh.turned_box(centre, (1.2, 0.06), yaw, floor, floor + 0.8 + 0.5 * h)
        placed += 1
    return placed
