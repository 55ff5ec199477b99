"""One map per range band, coarser with range; per channel, the finest band that knows a cell is used.

Distant observations are coarse and uncertain, but early: all bands are used for planning, and bands are never summed.
So distant evidence, however much, cannot override one near observation.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import ConfigError, GridError
from graphslam.core.geometry import Array
from graphslam.maps.terrain.line_kernels import ABOVE, OVERHANG, STEP, SUPPORT, add_rows
from graphslam.maps.terrain.lines import DetectorConfig, Rows, ScanLines, observe_terrain
from graphslam.maps.terrain.tables import SCALE, TerrainWeights, calibrate_probability, hazard_factors
from graphslam.maps.terrain.vehicle import CELLS, LineSensor, Vehicle

Box = tuple[float, float, float, float]
MOST_CELLS = 1 << 26


class TerrainClass(IntEnum):
    """Class of a cell for the vehicle."""

    UNKNOWN = 0
    FREE = 1
    ABOVE_REACH = 2
    STEP = 3
    STEEP = 4
    OBSTACLE = 5
    HOLE = 6


HAZARDS = (TerrainClass.STEP, TerrainClass.STEEP, TerrainClass.OBSTACLE, TerrainClass.HOLE)


@dataclass(frozen=True, slots=True, eq=False)
class TerrainMap:
    """Classified map of a pyramid on its finest cells; rows are y, columns x, from the lower left corner.

    Parameters
    ----------
    origin : (2,)
        Lower left corner [m].
    cell : float
        [m]
    probability : (ny, nx)
        Probability of a hazard; NaN if unknown.
    classes : (ny, nx) int8
        `TerrainClass`.
    ground : (ny, nx)
        Height of the ground [m]; NaN if not observed.
    roughness : (ny, nx)
        Mean deviation of the ground from a straight line between its neighbours on the line [m], including range noise.
    band : (ny, nx) int8
        Band that is used for steps; −1 none.
    provisional : (ny, nx) bool
        Free so far, but support was not yet observed from near enough to exclude a hole.
    """

    origin: Array
    cell: float
    probability: Array
    classes: npt.NDArray[np.int8]
    ground: Array
    roughness: Array
    band: npt.NDArray[np.int8]
    provisional: npt.NDArray[np.bool_]

    def centres(self) -> tuple[Array, Array]:
        """x ``(nx,)`` and y ``(ny,)`` of the centres of the cells [m]."""
        ny, nx = self.probability.shape
        return (
            self.origin[0] + self.cell * (np.arange(nx) + 0.5),
            self.origin[1] + self.cell * (np.arange(ny) + 0.5),
        )

    @property
    def known(self) -> npt.NDArray[np.bool_]:
        """Mask of the known cells."""
        return np.isfinite(self.probability)


@dataclass(frozen=True, slots=True, eq=False)
class ClassGrid:
    """Classes of a stored terrain map, in the frame of its run.

    Parameters
    ----------
    origin : (2,)
        Lower left corner, level frame [m].
    cell : float
        [m]
    classes : (ny, nx) int8
    rotation : (3, 3)
        From the frame of the run to the level one.
    """

    origin: Array
    cell: float
    classes: npt.NDArray[np.int8]
    rotation: Array

    def at(self, points: Array) -> npt.NDArray[np.int8]:
        """Classes ``(n,)`` of the cells below or above points ``(n, 3)`` of the run [m]; unknown outside."""
        index = np.floor(((points @ self.rotation.T)[:, :2] - self.origin) / self.cell).astype(np.int64)
        ny, nx = self.classes.shape
        inside = np.all((index >= 0) & (index < (nx, ny)), axis=1)
        out = np.full(len(points), TerrainClass.UNKNOWN, np.int8)
        out[inside] = self.classes[index[inside, 1], index[inside, 0]]
        return out


class Pyramid:
    """Evidence of the terrain in all range bands.

    Parameters
    ----------
    box : (x0, y0, x1, y1)
        Covered area [m]; enlarged to whole cells of the coarsest band.
    cells : tuple of float, optional
        Widths of the cells of the bands [m]; if all are equal, it is a map with a single resolution in which all bands
        are *summed*.
    """

    def __init__(
        self, box: Box, tables: TerrainWeights, vehicle: Vehicle, sensor: LineSensor, cells: tuple[float, ...] = CELLS
    ) -> None:
        if len(cells) != tables.bands:
            raise ConfigError(f"terrain: {len(cells)} widths of cells, tables of {tables.bands} bands")
        if min(cells) <= 0 or any(b < a for a, b in pairwise(cells)):
            raise ConfigError(f"terrain: widths of cells {cells}; wanted above 0 and not falling")
        x0, y0, x1, y1 = box
        if not (np.all(np.isfinite(box)) and x0 < x1 and y0 < y1):
            raise GridError("impossible box of a terrain map", got=box, wanted="x0 < x1, y0 < y1")
        self.tables, self.vehicle, self.sensor = tables, vehicle, sensor
        self.edges, self.cells = sensor.band_edges(), np.array(cells)
        if len(self.edges) != len(cells):
            self.edges = sensor.band_edges(cells)
        self.single = len(set(cells)) == 1
        widths = self.cells[:1] if self.single else self.cells
        coarse = widths[-1]
        low = np.floor(np.array([x0, y0]) / coarse + 1e-9)
        high = np.ceil(np.array([x1, y1]) / coarse - 1e-9)
        ratio = np.round(coarse / widths).astype(np.int64)
        if np.any(np.abs(ratio * widths - coarse) > 1e-9):
            raise ConfigError(f"terrain: widths of cells {cells}; each must divide the coarsest")
        self.first = (low[None] * ratio[:, None]).astype(np.int64)
        self.shapes = ((high - low)[None, ::-1] * ratio[:, None]).astype(np.int64)
        sizes = self.shapes.prod(axis=1)
        if int(sizes.sum()) > MOST_CELLS:
            raise GridError("a terrain map has too many cells", got=int(sizes.sum()), wanted=f"at most {MOST_CELLS}")
        self.offsets = np.concatenate([[0], np.cumsum(sizes)])
        total = int(self.offsets[-1])
        self.ratios = np.zeros((2, total), np.int32)
        self.counts = np.zeros((4, total), np.int32)
        self.heights = np.zeros((3, total), np.int64)
        self.votes = np.zeros((2, total), np.int32)
        self.lines = 0
        self.outside = 0
        if self.single:  # all bands lie in the same cells
            self.first, self.shapes = np.repeat(self.first, len(cells), 0), np.repeat(self.shapes, len(cells), 0)
            self.offsets = np.zeros(len(cells) + 1, np.int64)
        self.bands = 1 if self.single else len(cells)

    def insert(self, lines: ScanLines, config: DetectorConfig | None = None) -> int:
        """Process lines; returns the number of detections."""
        count = 0
        for rows in observe_terrain(lines, self.edges, self.cells, self.vehicle, config):
            self.add(rows)
            count += len(rows)
        self.lines += len(lines)
        return count

    def add(self, rows: Rows) -> None:
        """Add detections; those outside the box are counted and ignored."""
        self.outside += int(
            add_rows(
                rows, self.first, self.shapes, self.offsets, self.tables.ratios, self.ratios, self.counts, self.heights
            )
        )

    def merge(self, other: Pyramid) -> None:
        """Add the evidence of another pyramid with the same box and bands; the order of such sums does not matter."""
        same = np.array_equal(self.first, other.first) and np.array_equal(self.shapes, other.shapes)
        if not same or not np.array_equal(self.cells, other.cells):
            raise GridError("terrain maps of different boxes or cells cannot be added")
        self.ratios += other.ratios
        self.counts += other.counts
        self.heights += other.heights
        self.votes += other.votes
        self.lines += other.lines
        self.outside += other.outside

    def band_of(self, values: npt.NDArray[Any], b: int) -> npt.NDArray[Any]:
        """Values ``(..., c)`` of all cells: those of band ``b`` as ``(..., ny, nx)``."""
        ny, nx = self.shapes[b]
        start = self.offsets[b]
        return values[..., start : start + ny * nx].reshape(*values.shape[:-1], ny, nx)

    def _fine(self, values: npt.NDArray[Any], b: int) -> npt.NDArray[Any]:
        """Band ``b`` of the values, on the finest cells."""
        own = self.band_of(values, b)
        k = round(float(self.cells[b] / self.cells[0]))
        return own if k == 1 else own.repeat(k, axis=-2).repeat(k, axis=-1)

    def weights_of(self, b: int) -> Array:
        """Weights ``(9,)`` of band ``b``, or of a map of a single resolution."""
        return self.tables.single if self.single else self.tables.weights[b]

    def classify(self, threshold: float | None = None) -> TerrainMap:
        """The map on the finest cells.

        For steps and support the finest band that knows the cell is used. Overhangs of all bands are used, because a
        near band may have observed only the ground; if a finer band has an overhang in the cell of a coarser one, it
        replaces it. Overhangs of pieces (see :mod:`graphslam.maps.terrain.layer`) count as moved away if more than
        twice as many pieces, of all bands, observed only ground.

        Parameters
        ----------
        threshold : float, optional
            Probability above which a cell is a hazard; default that of the tables.
        """
        limit = self.tables.threshold if threshold is None else threshold
        ny, nx = self.shapes[0]
        free = np.ones((3, ny, nx))  # probability that no hazard of each kind is there
        known = np.zeros((3, ny, nx), bool)
        band = np.full((ny, nx), -1, np.int8)
        support_band = np.full((ny, nx), -1, np.int8)
        ground, rough = np.full((ny, nx), np.nan), np.full((ny, nx), np.nan)
        above = np.zeros((ny, nx), bool)
        votes = np.sum([self._fine(self.votes, b) for b in range(self.bands)], axis=0)
        stays = votes[1] <= 2 * votes[0]
        for b in range(self.bands):
            counts = self._fine(self.counts, b)
            ratios = self._fine(self.ratios, b) / SCALE
            observed = np.stack([counts[STEP] > 0, counts[SUPPORT] > 0])
            factors = hazard_factors(ratios, counts[: OVERHANG + 1], self.weights_of(b))
            for channel in (STEP, SUPPORT):
                fresh = observed[channel] & ~known[channel]
                free[channel][fresh] = factors[channel][fresh]
                known[channel] |= fresh
                (band if channel == STEP else support_band)[fresh] = b
            overhanging = (counts[OVERHANG] > 0) & stays
            if b:  # a finer band with an overhang within the cell locates it better
                k = round(float(self.cells[b] / self.cells[0]))
                within = known[2].reshape(ny // k, k, nx // k, k).any(axis=(1, 3))
                overhanging &= ~within.repeat(k, axis=0).repeat(k, axis=1)
            free[2] = np.where(overhanging, factors[2], free[2])
            known[2] |= overhanging
            above |= counts[ABOVE] > 0
            number, height, bend = self._fine(self.heights, b)
            fresh = (number > 0) & ~np.isfinite(ground)
            ground[fresh] = height[fresh] / number[fresh] / 1000.0
            rough[fresh] = bend[fresh] / number[fresh] / 1000.0
        # observations only high above a cell give no information on its ground
        any_known = known.any(axis=0)
        speaks = np.where(band >= 0, band, np.where(support_band >= 0, support_band, self.bands - 1))
        u, v = np.array([self.weights_of(b)[-2:] for b in range(self.bands)]).T
        probability = np.where(any_known, calibrate_probability(1.0 - free.prod(axis=0), u[speaks], v[speaks]), np.nan)
        classes = np.full((ny, nx), TerrainClass.UNKNOWN, np.int8)
        classes[any_known] = TerrainClass.FREE
        classes[any_known & above] = TerrainClass.ABOVE_REACH
        hazard = any_known & (np.nan_to_num(probability) > limit)
        kind = np.argmin(free, axis=0)
        classes[hazard & (kind == 0)] = TerrainClass.STEP
        classes[hazard & (kind == 0) & self._steep(ground)] = TerrainClass.STEEP
        classes[hazard & (kind == 1)] = TerrainClass.HOLE
        classes[hazard & (kind == 2)] = TerrainClass.OBSTACLE
        reach = self.sensor.hole_reach(self.vehicle, self.vehicle.clearance)
        far = np.concatenate([[0.0], self.edges[:-1]])  # where each band begins
        near = (support_band >= 0) & (far[np.maximum(support_band, 0)] < reach)
        provisional = any_known & ~hazard & ~near
        return TerrainMap(
            self.first[0] * self.cells[0], float(self.cells[0]), probability, classes, ground, rough, band, provisional
        )

    def _steep(self, ground: Array) -> npt.NDArray[np.bool_]:
        """Mask of ground with a uniform slope above the vehicle's limit: over 0.2 m about as steep as over 0.6 m."""
        limit = np.tan(self.vehicle.max_slope)
        out = np.zeros(ground.shape, bool)
        wide, narrow = max(round(float(0.3 / self.cells[0])), 1), 1
        for axis in (0, 1):
            with np.errstate(invalid="ignore"):
                over = np.abs(_difference(ground, wide, axis)) / (2 * wide * self.cells[0])
                inner = np.abs(_difference(ground, narrow, axis)) / (2 * narrow * self.cells[0])
                out |= (over > limit) & (np.abs(inner - over) < 0.5 * over)
        return out


def _difference(a: Array, k: int, axis: int) -> Array:
    """``a[i + k] − a[i − k]``; NaN at the border."""
    out = np.full(a.shape, np.nan)
    if a.shape[axis] > 2 * k:
        b, o = np.moveaxis(a, axis, 0), np.moveaxis(out, axis, 0)
        o[k:-k] = b[2 * k :] - b[: -2 * k]
    return out
