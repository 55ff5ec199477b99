"""Cost map of a terrain map for path planning, and its file formats. The search itself is left to a library."""

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
from graphslam.core.config import check_options
from graphslam.core.errors import DataError, FormatError
from graphslam.core.geometry import Array
from graphslam.maps.terrain.pyramid import HAZARDS, TerrainMap
from graphslam.maps.terrain.vehicle import Vehicle

_THRESHOLDS = 0.01, 0.99
"""Limits below and above which the map server reads a cell of a ``scale`` map as free and as occupied."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CostConfig:
    """Cost per metre of path in addition to its length."""

    hazard: float = 20.0
    """Factor on the probability of a hazard."""
    unknown: float = 3.0
    """In unknown cells; infinity forbids them."""
    provisional: float = 0.2
    """In cells where a hole is not yet excluded."""
    margin: float = 0.3
    """The cost decreases over this distance from the closest passable position [m]."""
    closing_bands: int | None = None
    """Hazards that only coarser bands than the first N detect have a cost but do not block: their cells can be wider
    than a gap between two hazards, and later observations are finer. None: all block, for a final map."""

    def __post_init__(self) -> None:
        ranges = {"≥ 0 or inf": "hazard unknown provisional margin", "≥ 1": "closing_bands"}
        check_options(self, "cost of terrain: ", ranges)


@dataclass(frozen=True, slots=True, eq=False)
class CostMap:
    """Cost per metre of path at every cell; infinite where the centre of the vehicle may not be.

    Parameters
    ----------
    origin : (2,)
        Lower left corner [m].
    cell : float
        [m]
    cost : (ny, nx)
    lethal : (ny, nx) bool
        Hazard cells.
    known : (ny, nx) bool
    """

    origin: Array
    cell: float
    cost: Array
    lethal: npt.NDArray[np.bool_]
    known: npt.NDArray[np.bool_]

    def index(self, point: Array) -> tuple[int, int]:
        """Row and column of the cell that contains a point ``(2,)``."""
        ix, iy = (math.floor(v) for v in (np.asarray(point, dtype=np.float64) - self.origin) / self.cell)
        ny, nx = self.cost.shape
        if not (0 <= ix < nx and 0 <= iy < ny):
            raise DataError("a place lies outside the terrain map", got=np.asarray(point).tolist())
        return iy, ix


def cost_map(found: TerrainMap, vehicle: Vehicle, config: CostConfig | None = None) -> CostMap:
    """Costs of a terrain map: hazards, inflated by half the vehicle width, are blocked."""
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


def save_cost_map(costs: CostMap, path: str | os.PathLike[str], *, mode: str = "raw") -> tuple[Path, Path]:
    """Write a cost map as ``path`` (``.yaml``) and an image for the map server of nav2.

    The server's grid then holds the values of :func:`occupancy_values`, cell by cell.

    Parameters
    ----------
    path : path
        Ending in ``.yaml``.
    mode : {"raw", "scale"}
        ``raw``: a PGM with the values 0 to 100, and 255 for unknown. ``scale``: a PNG with grey values for costs and
        transparent unknown cells, which a PGM does not support.
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
    """Values ``(ny, nx)`` of an occupancy grid: 100 hazards, 99 too near to a hazard, 0 to 98 by cost, −1 unknown."""
    finite = np.isfinite(costs.cost)
    extra = np.where(finite, costs.cost, 1.0) - 1.0
    values = np.clip(np.round(98.0 * extra / (extra + 5.0)), 0, 98).astype(np.int16)
    values[~finite] = 99
    values[costs.lethal] = 100
    values[~costs.known & finite] = -1
    return values
