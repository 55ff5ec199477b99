"""Small worlds of triangles, and ray casting one triangle at a time in double precision."""

from __future__ import annotations

from typing import Any

import numpy as np

from graphslam.core.geometry import Array
from graphslam.sim.world import World

BOX = np.array(
    [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7], [0, 1, 5], [0, 5, 4]]
    + [[1, 2, 6], [1, 6, 5], [2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7]]
)


def box(low: Any, high: Any) -> tuple[Array, np.ndarray]:
    """A box along the axes."""
    (a, b, c), (d, e, f) = low, high
    corners = [[a, b, c], [d, b, c], [d, e, c], [a, e, c], [a, b, f], [d, b, f], [d, e, f], [a, e, f]]
    return np.array(corners, dtype=np.float64), BOX


def quad(*corners: Any) -> tuple[Array, np.ndarray]:
    """A flat piece of four corners, in order."""
    return np.array(corners, dtype=np.float64), np.array([[0, 1, 2], [0, 2, 3]])


def merge(*parts: tuple[Array, np.ndarray]) -> tuple[Array, np.ndarray]:
    """Several meshes as one."""
    counts = np.cumsum([0] + [len(v) for v, _ in parts])
    return np.concatenate([v for v, _ in parts]), np.concatenate([t + k for (_, t), k in zip(parts, counts)])


def hall(waypoints: Any = None, **changes: Any) -> World:
    """A hall of 20 m × 12 m with a ramp of 0.5 m between x = 6 and x = 10, some boxes, and a way around it."""
    shell = box([-2, -6, -1], [18, 6, 4])
    floor = [
        quad([-2, -6, 0], [6, -6, 0], [6, 6, 0], [-2, 6, 0]),
        quad([6, -6, 0], [10, -6, 0.5], [10, 6, 0.5], [6, 6, 0]),
        quad([10, -6, 0.5], [18, -6, 0.5], [18, 6, 0.5], [10, 6, 0.5]),
    ]
    things = [box([3, 3.5, 0], [4, 4.5, 1]), box([12, -5.5, 0.5], [13, -4.5, 2]), box([15.5, 2, 0.5], [16, 3, 1.5])]
    vertices, triangles = merge(shell, *floor, *things)
    route = [[0, 0, 0], [6, 0, 0], [10, 0, 0.5], [14, 0, 0.5], [14, 2.5, 0.5], [10, 2.5, 0.5], [6, 2.5, 0], [1, 2.5, 0]]
    given: dict[str, Any] = {"name": "hall", "corner_radius": 1.0, "speed": 0.75, "meta": {}}
    return World(
        vertices=vertices,
        triangles=triangles,
        waypoints=route if waypoints is None else waypoints,
        **{**given, **changes},
    )


def plain_ranges(vertices: Array, triangles: np.ndarray, rays: Array) -> Array:
    """Distance to the nearest triangle ``(n,)`` of rays ``(n, 6)``, NaN where none is met (Möller & Trumbore 1997)."""
    best = np.full(len(rays), np.inf)
    o, d = rays[:, :3], rays[:, 3:]
    for a, b, c in vertices[triangles]:
        e1, e2 = b - a, c - a
        p = np.cross(d, e2)
        det = p @ e1
        with np.errstate(divide="ignore", invalid="ignore"):
            s = o - a
            u = np.sum(s * p, axis=1) / det
            q = np.cross(s, e1)
            v = np.sum(d * q, axis=1) / det
            t = q @ e2 / det
        hit = (np.abs(det) > 1e-12) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        best = np.where(hit & (t < best), t, best)
    return np.where(np.isfinite(best), best, np.nan)
