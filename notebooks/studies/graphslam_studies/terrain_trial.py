"""One trial of the terrain study: drives towards every kind of target, and detections by five maps on the way."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from time import process_time
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt

from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array
from graphslam.maps.terrain.line_kernels import OVERHANG
from graphslam.maps.terrain.lines import Rows, ScanLines, lines_of_scans, observe_terrain
from graphslam.maps.terrain.pyramid import Box, Pyramid, TerrainMap
from graphslam.maps.terrain.tables import read_tables
from graphslam.maps.terrain.vehicle import CELLS, LineSensor, Vehicle
from graphslam_studies.montecarlo.trials import Measurement
from graphslam_studies.sim.street import (
    FREE,
    HOLE,
    OBSTACLE,
    TARGETS,
    Street,
    StreetDrive,
    StreetRobot,
    draw_street,
    drive_street,
)

DISTANCES = (7.5, 5.25, 3.5, 2.25)
"""Distances from the sensor to the target at which the maps are evaluated [m]."""
SINGLE = (0.2, 0.2, 0.2, 0.2)
"""Cells of the maps of a single resolution [m]."""
FINE = (0.1, 0.1, 0.1, 0.1)
"""Cells of a map as fine as the finest band [m]."""
WEIGHTS = {"single-octomap": (0.85, 0.4), "single-equal": (0.4, 0.4)}
"""Log-odds of a hit and of a miss of the maps with fixed weights; not clamped, threshold 0."""
HIT_CM = 6
"""Smallest step or depth that these maps count as a hit [cm]."""
RINGS = {"0.8-3.5": (0.8, 3.5), "3.5-7": (3.5, 7.0), "7-11": (7.0, 11.0)}
CORRIDOR = 0.5
LANE = 2.4
BOX: Box = (-5.6, -6.4, 30.4, 6.4)
"""Map area: the street and a margin, in whole cells of every band [m]."""
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class TerrainTrialConfig:
    """Targets, robot and vehicle of a trial."""

    laser: str = "panning"
    """``panning``, or ``fixed``: it points to the side, and the robot drives past the target."""
    targets: tuple[str, ...] = tuple(TARGETS)
    start: float = 16.0
    """Start distance before the target, for the panning laser [m]."""
    distances: tuple[float, ...] = DISTANCES
    robot: StreetRobot = field(default_factory=StreetRobot)
    vehicle: Vehicle = field(default_factory=Vehicle)

    def __post_init__(self) -> None:
        if self.laser not in ("panning", "fixed"):
            raise ConfigError(f"terrain study: laser = {self.laser!r}; known: panning, fixed")

    @property
    def sensor(self) -> LineSensor:
        """Model of the laser of the robot."""
        sweep = self.robot.sweep if self.laser == "panning" else 1.0 / self.robot.line_rate
        return LineSensor(height=self.robot.height, beam_step=math.radians(self.robot.beam_step), sweep_time=sweep)


@dataclass(frozen=True)
class Verdict:
    """Output of a map on cells of 0.1 m of :data:`BOX`: hazards, known cells, and probabilities if it has them."""

    hazard: Mask
    known: Mask
    probability: Array | None = None
    width: npt.NDArray[np.int64] | None = None
    """Width of the cell that is responsible there, in cells of 0.1 m; 0: none."""


class FixedGrid:
    """A map of a single resolution with fixed weights: a hit if any detector of a line has one, else a miss.

    Parameters
    ----------
    like : Pyramid
        Single-resolution pyramid that defines box and cells.
    """

    def __init__(self, like: Pyramid) -> None:
        self.first, self.shape = like.first[0], like.shapes[0]
        self.hits = np.zeros(int(self.shape.prod()), np.int64)
        self.misses = np.zeros_like(self.hits)

    def add(self, rows: Rows) -> None:
        """Add the statements of whole lines."""
        mine = rows[rows[:, 4] <= OVERHANG].astype(np.int64)
        ix, iy = mine[:, 2] - self.first[0], mine[:, 3] - self.first[1]
        inside = (ix >= 0) & (iy >= 0) & (ix < self.shape[1]) & (iy < self.shape[0])
        hit = (mine[:, 4] == OVERHANG) | (mine[:, 5] >= HIT_CM)
        key = (mine[:, 0] * len(self.hits) + iy * self.shape[1] + ix)[inside]
        looked, back = np.unique(key, return_inverse=True)
        any_hit = np.zeros(len(looked), np.bool_)
        np.logical_or.at(any_hit, back, hit[inside])
        cell = looked % len(self.hits)
        np.add.at(self.hits, cell[any_hit], 1)
        np.add.at(self.misses, cell[~any_hit], 1)

    def verdict(self, weights: tuple[float, float]) -> Verdict:
        """Hazard if the log-odds are above 0."""
        ny, nx = self.shape
        total = (weights[0] * self.hits - weights[1] * self.misses).reshape(ny, nx)
        known = (self.hits + self.misses).reshape(ny, nx) > 0
        k = round(SINGLE[0] / CELLS[0])
        return Verdict(_finer(total > 0.0, k), _finer(known, k))


def _finer(a: Mask, k: int) -> Mask:
    return a.repeat(k, axis=0).repeat(k, axis=1)


def statements(lines: ScanLines, pyramid: Pyramid) -> Rows:
    """All statements of lines in the cells of a pyramid."""
    parts = list(observe_terrain(lines, pyramid.edges, pyramid.cells, pyramid.vehicle))
    return np.concatenate(parts) if parts else np.zeros((0, 6), np.int32)


def snapshots(drive: StreetDrive, distances: tuple[float, ...]) -> list[int]:
    """Numbers of lines measured before the sensor reached each distance to the target."""
    x = drive.truth.interpolate(drive.scans.times)[:, 0]
    return [int(np.searchsorted(x, drive.street.target_at - d)) for d in distances]


@dataclass(frozen=True)
class Labelled:
    """Ground truth of the finest cells of :data:`BOX`; see :meth:`graphslam_studies.sim.street.Street.labels`."""

    x: Array
    y: Array
    labels: npt.NDArray[np.int8]
    to_hazard: Array
    """Distance to the nearest hazard [m]."""
    to_other: Array
    """Distance to the nearest cell that is not free [m]."""


def labelled(street: Street, c: TerrainTrialConfig) -> Labelled:
    """Ground-truth class of every cell of a street for the vehicle."""
    cell, v = CELLS[0], c.vehicle
    nx, ny = (round((BOX[k + 2] - BOX[k]) / cell) for k in (0, 1))
    labels = street.labels(np.array(BOX[:2]), cell, (ny, nx), step=v.climbable_step, slope=v.max_slope, height=v.height)
    x = np.asarray(BOX[0] + cell * (np.arange(nx) + 0.5), dtype=np.float64)
    y = np.asarray(BOX[1] + cell * (np.arange(ny) + 0.5), dtype=np.float64)
    return Labelled(
        x, y, labels, cell * distance_transform_edt(labels <= 0), cell * distance_transform_edt(labels == FREE)
    )


def run_terrain_trial(config: TerrainTrialConfig, seed: int) -> Iterator[Measurement]:
    """Drive towards every target and evaluate the maps.

    Yields
    ------
    Measurement
        ``seen_<target>`` (0 or 1), ``width_<target>``, ``blocked_<target>`` (``submap`` is the distance [cm]);
        ``false_<ring>``, ``false_open_<ring>`` and ``coverage`` of whole drives; ``calibration_<n|p|h>``
        (``submap`` is the decile of P); the time per line.
    """
    c, tables = config, read_tables()
    sums: dict[tuple[str, str, int], float] = {}
    spent, lines_read = 0.0, 0
    for target in c.targets:
        street = draw_street(target, seed)
        truth = labelled(street, c)
        drives: list[tuple[StreetDrive, float | None]] = []
        if c.laser == "panning":
            drives.append((drive_street(street, seed, c.robot, start=c.start), None))
        else:
            drives += [(drive_street(street, seed, c.robot, aside=d), d) for d in c.distances]
        for drive, aside in drives:
            lines = lines_of_scans(drive.scans, drive.believed, c.robot.height)
            multi = Pyramid(BOX, tables, c.vehicle, c.sensor)
            single = Pyramid(BOX, tables, c.vehicle, c.sensor, SINGLE)
            fine = Pyramid(BOX, tables, c.vehicle, c.sensor, FINE)
            fixed = FixedGrid(single)
            asked = (
                [(len(lines), aside)] if aside is not None else list(zip(snapshots(drive, c.distances), c.distances))
            )
            done = 0
            for upto, distance in asked:
                assert distance is not None
                part = lines.take(slice(done, upto))
                begin = process_time()
                multi.insert(part)
                spent += process_time() - begin
                lines_read += len(part)
                rows = statements(part, single)
                single.add(rows)
                fixed.add(rows)
                fine.add(statements(part, fine))
                done = upto
                found = multi.classify()
                verdicts = {
                    "multigrid": verdict_of(found, tables.threshold),
                    "single-learnt": _single(single.classify(), tables.threshold, found),
                    "single-fine": _single(fine.classify(), tables.threshold, found),
                    **{name: fixed.verdict(w) for name, w in WEIGHTS.items()},
                }
                for name, v in verdicts.items():
                    yield from _judged(name, v, street, target, distance, truth, c)
                    if c.laser == "panning":
                        _count(sums, name, v, target, street.target_at - distance, truth)
    for name in ("multigrid", "single-learnt", "single-fine", *WEIGHTS):
        for ring in RINGS:
            for kind in ("false", "false_open"):
                of = sums.get((name, f"{kind}_of_{ring}", -1), 0.0)
                if of:
                    yield Measurement(name, f"{kind}_{ring}", sums.get((name, f"{kind}_{ring}", -1), 0.0) / of)
        if sums.get((name, "false_flat_of", -1)):
            yield Measurement(name, "false_flat", sums[name, "false_flat", -1] / sums[name, "false_flat_of", -1])
        if sums.get((name, "ahead", -1)):
            yield Measurement(name, "coverage", sums[name, "ahead_known", -1] / sums[name, "ahead", -1])
        for k in range(10):
            for what in "nph":
                if (name, f"calibration_{what}", k) in sums:
                    yield Measurement(name, f"calibration_{what}", sums[name, f"calibration_{what}", k], k)
    if lines_read:
        yield Measurement("multigrid", "line_us", 1e6 * spent / lines_read, timing=True)
        yield Measurement("multigrid", "times_real_time", lines_read / spent / c.robot.line_rate, timing=True)


def verdict_of(found: TerrainMap, threshold: float) -> Verdict:
    """Hazards where the probability is above the threshold."""
    known = found.known
    widths = np.array([0, *(round(w / CELLS[0]) for w in CELLS)])[found.band.astype(np.int64) + 1]
    return Verdict(known & (np.nan_to_num(found.probability) > threshold), known, found.probability, widths)


def _single(found: TerrainMap, threshold: float, like: TerrainMap) -> Verdict:
    """Hazards of a map with other cells, resampled to the cells of ``like``."""
    v = verdict_of(found, threshold)
    k = round(found.cell / like.cell)
    p = found.probability.repeat(k, axis=0).repeat(k, axis=1)
    return Verdict(_finer(v.hazard, k), _finer(v.known, k), p, np.full(p.shape, k))


def _judged(
    name: str, v: Verdict, street: Street, target: str, distance: float, truth: Labelled, c: TerrainTrialConfig
) -> Iterator[Measurement]:
    """Whether a target was detected, over what share of its width, and whether the lane is blocked."""
    x, y = truth.x, truth.y
    along = (x > street.target_at - 0.25) & (x < street.target_at + 3.2)
    zone = along[None] & (np.abs(y) < CORRIDOR)[:, None]
    if np.any((truth.labels > 0) & zone):  # a real hazard: detections within one cell of it
        zone &= truth.to_hazard < 0.16
    at = round(100 * distance)
    columns = np.any(v.hazard & zone, axis=1)[np.abs(y) < CORRIDOR]
    yield Measurement(name, f"seen_{target}", float(columns.any()), at)
    yield Measurement(name, f"width_{target}", float(columns.mean()), at)
    lane = np.abs(y) < min(LANE, street.side_at - 0.1)
    closed = np.any(v.hazard & along[None], axis=1)[lane]
    widest = max((len(run) for run in "".join("x" if k else "." for k in closed).split("x")), default=0)
    yield Measurement(name, f"blocked_{target}", float(widest * CELLS[0] < c.vehicle.width), at)


def _count(
    sums: dict[tuple[str, str, int], float], name: str, v: Verdict, target: str, robot_x: float, truth: Labelled
) -> None:
    """Add up false alarms, coverage ahead, and calibration of probabilities."""

    def add(what: str, value: float, k: int = -1) -> None:
        sums[name, what, k] = sums.get((name, what, k), 0.0) + value

    x, y, labels = truth.x, truth.y, truth.labels
    r = np.hypot(x[None] - robot_x, y[:, None])
    ahead = np.broadcast_to(x[None] > robot_x, r.shape)
    free = (labels == FREE) & v.known & ahead
    apart = truth.to_other > 0.5
    for ring, (low, high) in RINGS.items():
        inside = (r > low) & (r < high)
        for kind, where in (("false", free & inside), ("false_open", free & inside & apart)):
            add(f"{kind}_of_{ring}", float(where.sum()))
            add(f"{kind}_{ring}", float((where & v.hazard).sum()))
    if target == "nothing":
        flat = free & apart & (r > 0.8) & (r < 7.0)
        add("false_flat_of", float(flat.sum()))
        add("false_flat", float((flat & v.hazard).sum()))
    bearing = np.abs(np.arctan2(np.broadcast_to(y[:, None], r.shape), x[None] - robot_x))
    seen = ahead & (r > 0.8) & (r < 8.0) & (bearing < np.deg2rad(60.0)) & (np.abs(y) < 1.7)[:, None] & (labels == FREE)
    add("ahead", float(seen.sum()))
    add("ahead_known", float((seen & v.known).sum()))
    if v.probability is None or v.width is None:
        return
    for width in {round(w / CELLS[0]) for w in CELLS}:
        mine = v.width == width  # each responsible cell once
        corner = np.zeros_like(mine)
        corner[::width, ::width] = True
        judged = mine & corner & v.known & ahead & (r < 11.0)
        own = coarser(labels, width).repeat(width, axis=0).repeat(width, axis=1)
        judged &= own >= 0
        p, h = v.probability[judged], own[judged] > 0
        tenth = np.minimum((10 * p).astype(np.int64), 9)
        for k in range(10):
            add("calibration_n", float((tenth == k).sum()), k)
            add("calibration_p", float(p[tenth == k].sum()), k)
            add("calibration_h", float(h[tenth == k].sum()), k)


def channel_labels(truth: Array) -> tuple[Array, Array]:
    """Labels of cells (1 hazard, 0 free, −1 ignored) for the step detector, which sees neither overhangs
    nor the bottom of a hole, and for the support detector."""
    step = np.where((truth == OBSTACLE) | (truth == HOLE), -1, np.where(truth > 0, 1, truth))
    support = np.where(truth == HOLE, 1, np.where(truth > 0, -1, truth))
    return step, support


def coarser(truth: npt.NDArray[Any], k: int) -> npt.NDArray[Any]:
    """Labels of cells ``k`` times as wide: hazard if any part is one, free if all parts are."""
    if k == 1:
        return truth
    ny, nx = truth.shape
    parts = truth.reshape(ny // k, k, nx // k, k)
    top, low = parts.max(axis=(1, 3)), parts.min(axis=(1, 3))
    return np.where(top > 0, top, low)
