"""Ways over a terrain map, and its cost map as a file: the search itself is a library's."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image
from scipy.ndimage import distance_transform_edt

from graphslam.core.atomic import atomic_open
from graphslam.core.errors import ConfigError, DataError, FormatError
from graphslam.core.extras import import_extra
from graphslam.core.geometry import Array
from graphslam.maps.terrain.pyramid import HAZARDS, TerrainMap
from graphslam.maps.terrain.vehicle import Vehicle

_THRESHOLDS = 0.01, 0.99
"""Below and above which the map server takes a cell of a ``scale`` map for free and occupied."""
_LEAVE = 0.5
"""A vehicle that stands in closed cells goes so far to an open one [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CostConfig:
    """What a metre of way costs besides its length."""

    hazard: float = 20.0
    """Times the probability of a hazard."""
    unknown: float = 3.0
    """Where nothing is known; infinity forbids it."""
    provisional: float = 0.2
    """Where a hole is not yet excluded."""
    margin: float = 0.3
    """Cost falls off over this distance from where the vehicle just fits [m]."""
    closing_bands: int | None = None
    """Hazards that only coarser bands than the first so many know cost, but do not close: their cells may be wider than
    a gap between two of them, and a nearer look will tell. None: all close, as in a map that is not looked at again."""

    def __post_init__(self) -> None:
        for name in ("hazard", "unknown", "provisional", "margin"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"cost of terrain: {name} = {getattr(self, name)}; wanted ≥ 0")
        if self.closing_bands is not None and self.closing_bands < 1:
            raise ConfigError(f"cost of terrain: closing_bands = {self.closing_bands}; wanted ≥ 1, or none")


@dataclass(frozen=True, slots=True, eq=False)
class CostMap:
    """Cost of a metre of way at every cell; infinite where the vehicle's middle may not be.

    Parameters
    ----------
    origin : (2,)
        Lower left corner [m].
    cell : float
        [m]
    cost : (ny, nx)
    lethal : (ny, nx) bool
        Hazards themselves.
    known : (ny, nx) bool
    """

    origin: Array
    cell: float
    cost: Array
    lethal: npt.NDArray[np.bool_]
    known: npt.NDArray[np.bool_]

    def index(self, point: Array) -> tuple[int, int]:
        """Row and column of the cell of a point ``(2,)``."""
        ix, iy = (math.floor(v) for v in (np.asarray(point, dtype=np.float64) - self.origin) / self.cell)
        ny, nx = self.cost.shape
        if not (0 <= ix < nx and 0 <= iy < ny):
            raise DataError("a place lies outside the terrain map", got=np.asarray(point).tolist())
        return iy, ix


def cost_map(found: TerrainMap, vehicle: Vehicle, config: CostConfig | None = None) -> CostMap:
    """Costs of a terrain map: hazards grown by half the width of the vehicle are closed."""
    c = config or CostConfig()
    lethal = np.isin(found.classes, [int(k) for k in HAZARDS])
    if c.closing_bands is not None:
        lethal &= found.band < c.closing_bands
    known = found.known
    cost = 1.0 + c.hazard * np.nan_to_num(found.probability) + c.provisional * found.provisional
    cost = np.where(known, cost, 1.0 + c.unknown)
    if lethal.any():
        away = distance_transform_edt(~lethal) * found.cell - 0.5 * vehicle.width
        if c.margin > 0:
            cost = cost + c.hazard * 0.1 * np.clip(1.0 - away / c.margin, 0.0, 1.0)
        cost = np.where(away < 0.0, np.inf, cost)
    return CostMap(found.origin, found.cell, cost, lethal, known)


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
    a = _way_out(costs, costs.index(start))
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


def _way_out(costs: CostMap, a: tuple[int, int]) -> tuple[int, int] | None:
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


def save_cost_map(costs: CostMap, path: str | os.PathLike[str], *, mode: str = "raw") -> tuple[Path, Path]:
    """Write a cost map as ``path`` (``.yaml``) and the image beside it, as nav2's map server reads them.

    The server's grid then holds the values of :func:`occupancy_values`, cell by cell.

    Parameters
    ----------
    path : path
        Ending in ``.yaml``.
    mode : {"raw", "scale"}
        ``raw``: a PGM, whose bytes are the values, 0 to 100, and 255, unknown. ``scale``: a PNG, a grey a cost, where
        what is unknown is transparent; a PGM cannot say that in this mode.
    """
    target = Path(path)
    if target.suffix != ".yaml":
        raise FormatError("unknown ending of a cost map", where=str(path), got=target.suffix, wanted=".yaml")
    if mode not in ("scale", "raw"):
        raise FormatError("unknown mode of a cost map", where=str(path), got=mode, wanted="scale or raw")
    values = occupancy_values(costs)[::-1]  # the first row of an image is its top
    image = target.with_suffix(".pgm" if mode == "raw" else ".png")
    low, high = _THRESHOLDS
    with atomic_open(image) as stream:
        if mode == "raw":
            stream.write(f"P5\n{values.shape[1]} {values.shape[0]}\n255\n".encode("ascii"))
            stream.write(np.where(values < 0, 255, values).astype(np.uint8).tobytes())
        else:
            occupied = low + (high - low) * values / 100.0
            occupied[values == 0], occupied[values == 100] = 0.0, 1.0
            grey = np.round(255.0 * (1.0 - occupied))
            Image.fromarray(np.stack([grey, np.where(values < 0, 0, 255)], axis=-1).astype(np.uint8)).save(
                stream, "PNG"
            )
    x, y = (float(v) for v in costs.origin)
    name = image.name.replace("'", "''")
    with atomic_open(target, "w") as stream:
        stream.write(
            f"image: '{name}'\nmode: {mode}\nresolution: {costs.cell:.6f}\norigin: [{x:.6f}, {y:.6f}, 0.0]\n"
            f"negate: 0\noccupied_thresh: {high}\nfree_thresh: {low}\n"
        )
    return target, image


def occupancy_values(costs: CostMap) -> npt.NDArray[np.int16]:
    """Values ``(ny, nx)`` of an occupancy grid: 100 hazards, 99 too near to one, 0 to 98 by cost, −1 unknown."""
    finite = np.isfinite(costs.cost)
    extra = np.where(finite, costs.cost, 1.0) - 1.0
    values = np.clip(np.round(98.0 * extra / (extra + 5.0)), 0, 98).astype(np.int16)
    values[~finite] = 99
    values[costs.lethal] = 100
    values[~costs.known & finite] = -1
    return values
