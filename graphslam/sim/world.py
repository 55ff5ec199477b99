"""A simulated place: its geometry and the route of a robot through it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import GeometryError
from graphslam.core.geometry import Array, wrap_angle
from graphslam.sim.route import Route, plan_route

DRAWN = "drawn-"
"""Prefix of the names of generated layouts; the rest is their number, from 1 on."""


def layout_number(layout: str) -> int:
    """The number of a generated layout such as ``drawn-17``; 0 for every other."""
    number = layout.removeprefix(DRAWN)
    return int(number) if layout.startswith(DRAWN) and number.isdecimal() else 0


# An earlier visit is tracked while its matched arc length changes by no more than _JUMP from one point to the next [m].
_STEP = 0.5  # between the tested points of a route [m]
_JUMP = 3.0

Triangles = npt.NDArray[np.int32]


@dataclass(frozen=True, slots=True, kw_only=True)
class World:
    """Geometry of a place and the route through it; world frame, z up, metres.

    Parameters
    ----------
    vertices : (v, 3)
    triangles : (t, 3) int32
        Rows of ``vertices``. Not watertight and with arbitrary winding, but without gaps between neighbouring surfaces.
    waypoints : (k, 3)
        Points on the floor that the robot drives over, in order; z is the height of the floor there.
    corner_radius : float
        Waypoints are connected by straight lines with corners rounded by arcs of this radius [m].
    speed : float
        Along the route [m/s].
    meta : mapping
        JSON: ``length`` of the route [m]; ``levels``, heights of the floors [m]; ``loops``, pairs ``[s1, s2]`` of arc
        lengths at the same place; ``revisits``, the corresponding stretches (see :func:`find_revisits`); ``parallel``,
        pairs of stretches ``[[s1a, s1b], [s2a, s2b]]`` that are different places and must not be confused; and further
        descriptions of the world.
    """

    name: str
    vertices: Array
    triangles: Triangles
    waypoints: Array
    corner_radius: float
    speed: float
    meta: Mapping[str, Any]

    def __post_init__(self) -> None:
        where = f"world {self.name}"
        for name, kind in (("vertices", np.float64), ("triangles", np.int32), ("waypoints", np.float64)):
            a = np.ascontiguousarray(getattr(self, name), dtype=kind)
            if a.ndim != 2 or a.shape[1] != 3 or len(a) == 0:
                raise GeometryError(f"{name} have the wrong shape", where=where, got=a.shape, wanted="(n, 3), n > 0")
            if not np.all(np.isfinite(a)):
                k = int(np.argwhere(~np.isfinite(a))[0, 0])
                raise GeometryError(f"{name} are not finite", where=f"{where}, row {k}", got=a[k])
            object.__setattr__(self, name, a)
        if self.triangles.min() < 0 or self.triangles.max() >= len(self.vertices):
            raise GeometryError(
                "a triangle names a vertex that is not there",
                where=where,
                got=(int(self.triangles.min()), int(self.triangles.max())),
                wanted=f"0 … {len(self.vertices) - 1}",
            )
        if not (np.isfinite(self.speed) and self.speed > 0):
            raise GeometryError("speed is impossible", where=where, got=self.speed, wanted="> 0 m/s")
        plan_route(self.waypoints, self.corner_radius, where=where)

    def route(self) -> Route:
        """The route as straight lines and arcs."""
        return plan_route(self.waypoints, self.corner_radius, where=f"world {self.name}")


def find_revisits(route: Route, *, shortest: float = 0.0) -> list[dict[str, Any]]:
    """Stretches of a route that revisit an earlier part of it: within a metre, and at least 20 m of driving later.

    Parameters
    ----------
    shortest : float
        Stretches shorter than this are left out (mere crossings) [m].

    Returns
    -------
    list of dict
        In the order driven: ``first`` and ``again``, arc lengths ``[from, to]`` [m] of the earlier and of the later
        visit, where ``again[0]`` and ``first[0]`` (and the two ends) are the same place; ``same_heading``.
    """
    s = np.linspace(0.0, route.length, max(round(route.length / _STEP), 1) + 1)
    p, h = route.positions(s), route.headings(s)
    match = np.full(len(s), -1)
    for k in range(len(s)):
        d = np.linalg.norm(p[s < s[k] - 20.0] - p[k], axis=1)
        near = np.flatnonzero(d < 1.0)
        if len(near):
            before = match[k - 1]
            # of several earlier visits the one being tracked, else one in the same direction, else the nearest
            follows = near[np.abs(near - before) * _STEP <= _JUMP] if before >= 0 else near[:0]
            alike = near[np.cos(h[near] - h[k]) > 0.0]
            choice = follows if len(follows) else alike if len(alike) else near
            match[k] = choice[d[choice].argmin()]
    found: list[dict[str, Any]] = []
    begin = 0
    for k in range(1, len(s) + 1):
        # a stretch ends where the place is new, or where the earlier visit is another one
        steps_on = k < len(s) and match[k] >= 0 and match[k - 1] >= 0 and abs(match[k] - match[k - 1]) * _STEP <= _JUMP
        if steps_on:
            continue
        if match[begin] >= 0 and s[k - 1] - s[begin] >= shortest:
            i, j = match[begin], match[k - 1]
            middle = (begin + k - 1) // 2
            turned = abs(float(wrap_angle(h[middle] - h[match[middle]])))
            found.append(
                {
                    "first": [round(float(s[i]), 2), round(float(s[j]), 2)],
                    "again": [round(float(s[begin]), 2), round(float(s[k - 1]), 2)],
                    "same_heading": bool(turned < np.pi / 2),
                }
            )
        begin = k
    return found


def describe_route(route: Route) -> dict[str, Any]:
    """``length``, ``revisits`` and ``loops`` of a world's meta.

    A loop closes at the beginning of a revisited stretch.
    """
    revisits = find_revisits(route, shortest=3.0)
    return {
        "length": round(route.length, 3),
        "revisits": revisits,
        "loops": [[r["first"][0], r["again"][0]] for r in revisits],
    }
