"""Paths of a vehicle over a cost map."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from graphslam.core.extras import import_extra
from graphslam.core.geometry import Array
from graphslam.maps.terrain.plan import CostMap

_LEAVE = 0.5
"""A vehicle that stands in closed cells goes so far to an open one [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class PlannedPath:
    """A way ``(k, 2)`` [m] from cell to cell, what it costs, and how long it is [m]."""

    points: Array
    cost: float
    length: float


def plan_vehicle_path(costs: CostMap, start: Array, goal: Array) -> PlannedPath | None:
    """The cheapest way from a place to another one, or to one of several; None where there is none.

    Moves go to the eight neighbours; the cost of a move is its length times the mean cost of both cells.

    Parameters
    ----------
    start : (2,)
        [m]. It may lie in closed cells, because a vehicle stands where it stands: then the way begins with a straight
        line to the nearest open cell, if that is within 0.5 m and no hazard lies on it.
    goal : (2,) or (k, 2)
        [m]

    Raises
    ------
    DataError
        A place outside the map.
    MissingExtraError
        The extra ``surface`` is not installed.
    """
    graph = import_extra("skimage.graph", "a way over terrain")
    ends = [costs.index(g) for g in np.atleast_2d(goal)]
    ends = [b for b in ends if np.isfinite(costs.cost[b])]
    a = _nearest_open(costs, costs.index(start))
    if not ends or a is None:
        return None
    search = graph.MCP_Geometric(np.where(np.isfinite(costs.cost), costs.cost, -1.0))
    totals = search.find_costs([a], ends, find_all_ends=False)[0]  # it ends at the cheapest one
    b = min(ends, key=lambda end: totals[end])
    if not np.isfinite(totals[b]):
        return None
    iy, ix = np.array(search.traceback(b)).T
    points = costs.origin + costs.cell * (np.column_stack([ix, iy]) + 0.5)
    if a != costs.index(start):
        points = np.vstack([start, points])
    length = float(np.sum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    return PlannedPath(points, float(totals[b]) * costs.cell, length)


def _nearest_open(costs: CostMap, a: tuple[int, int]) -> tuple[int, int] | None:
    """The open cell nearest to a cell, itself if it is open."""
    if np.isfinite(costs.cost[a]):
        return a
    k = math.floor(_LEAVE / costs.cell)
    low = max(a[0] - k, 0), max(a[1] - k, 0)
    iy, ix = np.nonzero(np.isfinite(costs.cost[low[0] : a[0] + k + 1, low[1] : a[1] + k + 1]))
    iy, ix = iy + low[0], ix + low[1]
    far = np.hypot(iy - a[0], ix - a[1])
    if not len(far) or far.min() * costs.cell > _LEAVE:
        return None
    best = int(np.argmin(far))
    share = np.linspace(0.0, 1.0, 2 * k + 1)
    on = tuple(np.round(p + share * (q[best] - p)).astype(np.int64) for p, q in zip(a, (iy, ix)))
    return None if np.any(costs.lethal[on]) else (int(iy[best]), int(ix[best]))
