"""Routes made of straight lines and arcs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import GeometryError
from graphslam.core.geometry import Array, ArrayLike, wrap_angle

# Smaller turns [rad] are ignored: a waypoint on a straight line, where only the slope changes.
_NO_TURN = 1e-9


@dataclass(frozen=True, slots=True)
class Route:
    """Pieces of a route, each a straight line or an arc of constant slope.

    Parameters
    ----------
    starts : (m + 1,)
        Arc length, along the slope, at which each piece begins, and the total length [m].
    points : (m + 1, 3)
        Start points of the pieces, and the end.
    heading : (m,)
        Direction in the plan where each piece begins [rad].
    curvature : (m,)
        Of the piece in the plan, positive to the left [1/m]; 0 is a straight line.
    plan : (m,)
        Length of each piece in the plan [m].
    """

    starts: Array
    points: Array
    heading: Array
    curvature: Array
    plan: Array

    @property
    def length(self) -> float:
        """Length of the route along the slopes [m]."""
        return float(self.starts[-1])

    def _piece(self, s: ArrayLike) -> tuple[npt.NDArray[np.intp], Array]:
        q = np.asarray(s, dtype=np.float64)
        if not np.all((q >= -1e-9) & (q <= self.length + 1e-9)):
            raise GeometryError("arc length outside the way", got=q, wanted=f"0 … {self.length:.3f}")
        k = np.clip(np.searchsorted(self.starts, q, side="right") - 1, 0, len(self.plan) - 1)
        share = (q - self.starts[k]) / (self.starts[k + 1] - self.starts[k])
        return k, np.clip(share, 0.0, 1.0)

    def positions(self, s: ArrayLike) -> Array:
        """Points ``(..., 3)`` on the floor at arc lengths ``(...)``."""
        k, share = self._piece(s)
        u = share * self.plan[k]
        turn = self.curvature[k] * u
        # chord of an arc: length u · sinc(turn/2), direction half-way round; sinc(0) = 1 covers the lines
        chord = u * np.sinc(turn / (2.0 * np.pi))
        direction = self.heading[k] + turn / 2.0
        rise = share * (self.points[k + 1, 2] - self.points[k, 2])
        return self.points[k] + np.stack([chord * np.cos(direction), chord * np.sin(direction), rise], -1)

    def headings(self, s: ArrayLike) -> Array:
        """Directions in the plan ``(...)`` [rad] at arc lengths ``(...)``."""
        k, share = self._piece(s)
        return wrap_angle(self.heading[k] + self.curvature[k] * share * self.plan[k])

    def slopes(self, s: ArrayLike) -> Array:
        """Rise over plan length ``(...)`` at arc lengths ``(...)``; positive uphill."""
        k, _ = self._piece(s)
        return np.asarray((self.points[k + 1, 2] - self.points[k, 2]) / self.plan[k])

    def every(self, spacing: float) -> Array:
        """Arc lengths ``(n,)`` from the start to the end, evenly, at most ``spacing`` [m] apart."""
        return np.linspace(0.0, self.length, max(int(np.ceil(self.length / spacing)), 1) + 1)


def plan_route(waypoints: ArrayLike, corner_radius: float, *, where: str = "way") -> Route:
    """Connect waypoints by straight lines with rounded corners.

    Parameters
    ----------
    waypoints : (k, 3)
        z is linear between waypoints. On the arc of a corner, z is linear between the two tangent points.
    corner_radius : float
        In the plan [m].
    where : str
        For error messages.
    """
    p = np.asarray(waypoints, dtype=np.float64)
    if p.ndim != 2 or p.shape[1] != 3 or len(p) < 2 or not np.all(np.isfinite(p)):
        raise GeometryError("waypoints are impossible", where=where, got=p.shape, wanted="(k, 3), k ≥ 2, finite")
    if not (np.isfinite(corner_radius) and corner_radius > 0):
        raise GeometryError("corner radius is impossible", where=where, got=corner_radius, wanted="> 0 m")
    legs = np.diff(p, axis=0)
    plan = np.hypot(legs[:, 0], legs[:, 1])
    if np.any(plan < 1e-6):
        k = int(np.argmin(plan))
        raise GeometryError("two waypoints stand at the same place in the plan", where=f"{where}, {k} and {k + 1}")
    heading = np.arctan2(legs[:, 1], legs[:, 0])
    turn = np.concatenate([[0.0], wrap_angle(np.diff(heading)), [0.0]])
    sharp = np.abs(turn) > np.deg2rad(175.0)
    if sharp.any():
        raise GeometryError("the way turns back on itself", where=f"{where}, waypoint {int(np.argmax(sharp))}")
    tangent = np.where(np.abs(turn) > _NO_TURN, corner_radius * np.tan(np.abs(turn) / 2.0), 0.0)
    short = plan - tangent[:-1] - tangent[1:] < -1e-9
    if short.any():
        k = int(np.argmax(short))
        raise GeometryError(
            "corners do not fit a leg of the way",
            where=f"{where}, waypoints {k} and {k + 1}",
            got=f"{plan[k]:.2f} m",
            wanted=f"≥ {tangent[k] + tangent[k + 1]:.2f} m for a radius of {corner_radius:g} m",
        )
    rows: list[tuple[Array, float, float, float]] = []  # start point, heading, curvature, length in the plan
    for k in range(len(plan)):
        a = p[k] + legs[k] * (tangent[k] / plan[k])
        straight = plan[k] - tangent[k] - tangent[k + 1]
        if straight > 1e-9:
            rows.append((a, heading[k], 0.0, straight))
        if tangent[k + 1] > 0:
            b = p[k + 1] - legs[k] * (tangent[k + 1] / plan[k])
            bend = float(turn[k + 1])
            rows.append((b, heading[k], np.sign(bend) / corner_radius, corner_radius * abs(bend)))
    points = np.array([r[0] for r in rows] + [p[-1]])
    lengths = np.array([r[3] for r in rows])
    starts = np.concatenate([[0.0], np.cumsum(np.hypot(lengths, np.diff(points[:, 2])))])
    return Route(starts, points, np.array([r[1] for r in rows]), np.array([r[2] for r in rows]), lengths)
