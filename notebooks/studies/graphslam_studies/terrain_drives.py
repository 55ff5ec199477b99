"""The study ``terrain-drives``: closed-loop drives. A robot plans a path on its own map, drives, and plans again.

Every trial has a random street with one target and drives through it with each of six maps and the same random errors.
In half of the streets, a target across the full width has a passage. Maps:

* ``bands``: one map per range band; speed limited by the detection range of falls and by the known free path ahead;
* ``bands, no bound``: the same map, always 1 m/s;
* ``bands, forgets``: as ``bands``, but cells that two successive sweeps saw free keep these two sweeps only;
* ``one grid, learnt``: one grid of 0.2 m with the same learnt weights, all ranges added, with both speed limits;
* ``one grid, OctoMap``: one grid of 0.2 m, log-odds +0.85 for a hit and −0.4 for a miss, with both limits;
* ``one grid, equal``: the same with ±0.4.

The robot adds the lines measured so far and plans the cheapest path to a line 6 m behind the target, once per reaction
time; a command takes effect one reaction time later. A drive ends at the goal, at the first harm, after standing still
for 7 s, or after 90 s.

In the worlds ``people`` (0.6 to 1.6 m/s) and ``fast`` (2 to 4 m/s) two persons cross the street to and fro. They do not
avoid the robot.

Quantities
----------
``fall``, ``curb``, ``crash``, ``steep``: 1 if a circle as wide as the vehicle touched a fall, a step up, an obstacle,
or ground that is too steep; ``struck``: 1 if it touched a person while the robot moved. ``ghost``: share of hazards
among the free cells in view that a person covered and left at least three sweeps ago, ``beside``: among the others,
means over the same plans. ``arrived``; ``way``: 1 if a path exists on the true map; ``right``: 1 if it arrived and a
path exists, or did not arrive, without harm, and none exists. ``coverage``: known share of the free lane 0.8–8 m
ahead, within ±60°, mean over plans. ``speed``: mean while there was a plan [m/s]. ``detour``: if arrived, length
driven over the length of the best path on the true map; ``cost``: ratio of the costs of these paths on that map.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import process_time

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy.ndimage import binary_closing, distance_transform_edt

from graphslam.core.geometry import Array
from graphslam.core.random import SeedTree
from graphslam.maps.terrain.line_kernels import OVERHANG, SUPPORT
from graphslam.maps.terrain.lines import Rows, ScanLines, lines_of_scans
from graphslam.maps.terrain.plan import CostConfig, CostMap, cost_map
from graphslam.maps.terrain.pyramid import HAZARDS, Pyramid, TerrainClass, TerrainMap
from graphslam.maps.terrain.tables import SCALE, noisy_or, read_tables
from graphslam.maps.terrain.vehicle import CELLS, Vehicle
from graphslam_studies.maps.plan import PlannedPath, plan_vehicle_path
from graphslam_studies.montecarlo.trials import Measurement
from graphslam_studies.montecarlo.worlds_study import WorldsStudy
from graphslam_studies.sim.movers import Mover, clear_of, person
from graphslam_studies.sim.street import (
    BEGIN,
    END,
    HALF_WIDTH,
    HOLE,
    OBSTACLE,
    PASSAGE,
    STEEP,
    STEP,
    TARGETS,
    Street,
    draw_street,
)
from graphslam_studies.sim.street_rover import Command, RoverState, StreetRover
from graphslam_studies.terrain_trial import (
    BOX,
    SINGLE,
    FixedGrid,
    Mask,
    TerrainTrialConfig,
    labelled,
    statements,
)

FIXED = {"one grid, OctoMap": (0.85, 0.4), "one grid, equal": (0.4, 0.4)}
"""Maps with fixed weights: log-odds of a hit and of a miss."""
FORGETTING = ("bands", "bands, forgets")
"""Maps of the worlds in which something moves."""
CLOSING = 2
"""Number of bands whose hazards block paths: those with cells narrower than half the vehicle."""
HARMS = ("fall", "curb", "crash", "steep", "struck")
PATIENCE = 7.0
"""A drive ends after standing still for this time: three sweeps and one plan [s]."""


@dataclass(frozen=True, kw_only=True)
class DriveTrialConfig:
    """Settings of the drives."""

    maps: tuple[str, ...] = ("bands", "bands, no bound", "bands, forgets", "one grid, learnt", *FIXED)
    targets: tuple[str, ...] = tuple(TARGETS)
    fastest: float = 1.0
    """[m/s]"""
    begin: float = 8.0
    """Start distance before the target [m]."""
    beyond: float = 6.0
    """Distance of the goal behind the beginning of the target [m]."""
    spare: float = 0.1
    """Safety margin on either side of the vehicle when planning, for errors of pose and cells [m]."""
    longest: float = 90.0
    """[s]"""
    movers: int = 0
    """Number of people who cross the street."""
    pace: tuple[float, float] = (0.6, 1.6)
    """Their lowest and highest speed [m/s]."""
    trial: TerrainTrialConfig = field(default_factory=TerrainTrialConfig)


@dataclass(frozen=True)
class Course:
    """A street with its ground truth."""

    street: Street
    start: Array
    goal: float
    """Along x [m]."""
    hazards: dict[str, Array]
    """Distance to the nearest hazard of each kind, on cells of 0.05 m [m]."""
    best: PlannedPath | None
    """Best path on the true map."""
    costs: CostMap
    """Costs of the true map."""
    free_lane: Mask
    """Free cells of 0.1 m in the lane."""
    movers: tuple[Mover, ...] = ()


def draw_course(seed: int, config: DriveTrialConfig) -> Course:
    """Street, start and goal of a seed."""
    c, rng = config, SeedTree(int(seed)).child("course").generator()
    street = draw_street(str(rng.choice(np.array(c.targets))), seed)
    opened, side = rng.random() < 0.5, float(rng.uniform(-1.2, 1.2))
    v, fine = c.trial.vehicle, 0.05
    if opened and _closes(street, v):
        street = replace(street, passage=side)
    shape = (round((BOX[3] - BOX[1]) / fine), round((BOX[2] - BOX[0]) / fine))
    labels = street.labels(np.array(BOX[:2]), fine, shape, step=v.climbable_step, slope=v.max_slope, height=v.height)
    x, y = (BOX[k] + fine * (np.arange(shape[1 - k]) + 0.5) for k in (0, 1))
    down = street.raised(x[None] + 0 * y[:, None], y[:, None] + 0 * x[None]) < -v.climbable_step
    fall = (labels == HOLE) | ((labels == STEP) & _near(down))
    kinds = {"fall": fall, "curb": (labels == STEP) & ~fall, "crash": labels == OBSTACLE, "steep": labels == STEEP}
    away = {k: fine * distance_transform_edt(~m) if m.any() else np.full(shape, np.inf) for k, m in kinds.items()}
    truth = labelled(street, c.trial)
    inside = (np.abs(truth.y) < HALF_WIDTH)[:, None] & (truth.x > BEGIN)[None] & (truth.x < END)[None]
    classes = np.where((truth.labels > 0) | ~inside, TerrainClass.OBSTACLE, TerrainClass.FREE).astype(np.int8)
    wanted = replace(v, width=v.width + 2.0 * c.spare)
    costs = cost_map(_plain_map(np.array(BOX[:2]), CELLS[0], classes), wanted)
    start = np.array([street.target_at - c.begin, 0.0])
    best = _plan(costs, start, street.target_at + c.beyond)
    lane = (truth.labels == 0) & (np.abs(truth.y) < 1.7)[:, None]
    return Course(street, start, street.target_at + c.beyond, away, best, costs, lane, draw_people(street, c, seed))


def draw_people(street: Street, c: DriveTrialConfig, seed: int) -> tuple[Mover, ...]:
    """People who cross the street between start and goal, from behind one wall to behind the other."""
    rng, out = SeedTree(int(seed)).child("people").generator(), []
    for _ in range(c.movers):
        x, far = street.target_at + float(rng.uniform(2.0 - c.begin, c.beyond - 1.0)), HALF_WIDTH + 3.0
        leg, speed = np.array([[x, -far], [x, far]]), float(rng.uniform(*c.pace))
        where, floor = float(rng.uniform(0.0, 4.0 * far)), float(street.height(x, 0.0))
        boxes = person(rng)
        out.append(Mover(kind="person", start=leg[0], end=leg[1], floor=floor, speed=speed, phase=where, boxes=boxes))
    return tuple(out)


def _closes(street: Street, v: Vehicle) -> bool:
    """Whether a curb, stairs, a drop or a ramp across the street is not drivable for the vehicle."""
    f = street.figures
    step = street.kind in ("curb", "stairs") and abs(f["height"]) > v.climbable_step
    return step or (street.kind == "ramp" and abs(math.radians(f["angle"])) > v.max_slope)


def _near(mask: Mask) -> Mask:
    """A mask dilated by its neighbouring cells."""
    return np.asarray(distance_transform_edt(~mask) < 2.0) if mask.any() else mask


def _plain_map(origin: Array, cell: float, classes: npt.NDArray[np.int8]) -> TerrainMap:
    """A terrain map with certain classes."""
    known = classes != TerrainClass.UNKNOWN
    p = np.where(known, (classes > TerrainClass.ABOVE_REACH).astype(np.float64), np.nan)
    nothing, nowhere = np.full(p.shape, np.nan), np.zeros(p.shape, np.bool_)
    return TerrainMap(origin, cell, p, classes, nothing, nothing, np.where(known, 0, -1).astype(np.int8), nowhere)


class Sweeps:
    """The last sweeps of the laser apart, so that a map can forget what left.

    Parameters
    ----------
    pyramid : Pyramid
        The map; a cell that two successive sweeps saw free keeps the evidence of these two only.
    lines : int
        Number of lines of a sweep.
    """

    def __init__(self, pyramid: Pyramid, lines: int) -> None:
        self.pyramid, self.lines, self.count = pyramid, lines, 0
        self.last, self.current = (pyramid_like(pyramid) for _ in range(2))

    def add(self, rows: Rows, lines: int) -> None:
        """Detections of some more lines, which the map has already."""
        self.current.add(rows)
        self.count += lines
        if self.count >= self.lines:
            free = self._free(self.last) & self._free(self.current)
            for name in ("ratios", "counts", "heights"):
                last, current = getattr(self.last, name), getattr(self.current, name)
                getattr(self.pyramid, name)[:, free] = last[:, free] + current[:, free]
            self.last, self.current, self.count = self.current, pyramid_like(self.pyramid), 0

    @staticmethod
    def _free(sweep: Pyramid) -> Mask:
        """Flat cells in which a sweep saw ground and no hazard, in their band or in most of their finer cells."""
        out = np.zeros(sweep.counts.shape[1], np.bool_)
        finer: tuple[Mask, Mask] = (out, out)
        for b in range(sweep.bands):
            counts, ratios = sweep.band_of(sweep.counts, b), sweep.band_of(sweep.ratios, b) / SCALE
            seen = counts[SUPPORT] > 0
            hazard = seen & (noisy_or(ratios, counts[: OVERHANG + 1], sweep.weights_of(b)) > sweep.tables.threshold)
            hazard |= counts[OVERHANG] > 0
            if b:
                k = round(float(sweep.cells[b] / sweep.cells[b - 1]))
                ny, nx = seen.shape
                seen = seen | (finer[0].reshape(ny, k, nx, k).mean(axis=(1, 3)) > 0.5)
                hazard = hazard | finer[1].reshape(ny, k, nx, k).any(axis=(1, 3))
            sweep.band_of(out, b)[:] = seen & ~hazard
            finer = seen, hazard
        return out


def pyramid_like(p: Pyramid) -> Pyramid:
    """An empty map with the box and the bands of another one."""
    return Pyramid(BOX, p.tables, p.vehicle, p.sensor, tuple(p.cells))


class Navigator:
    """One of the compared maps, and path planning on it.

    Parameters
    ----------
    name : str
        Name of the map, see the module.
    start : (2,)
        Start position [m]; the ground under the robot is assumed free.
    """

    def __init__(self, name: str, config: DriveTrialConfig, start: Array) -> None:
        c, tables = config.trial, read_tables()
        cells = CELLS if name.startswith("bands") else SINGLE
        self.config, self.bound = config, "no bound" not in name
        self.pyramid = Pyramid(BOX, tables, c.vehicle, c.sensor, cells)
        self.sweeps = Sweeps(self.pyramid, round(c.robot.sweep * c.robot.line_rate)) if "forgets" in name else None
        self.weights = FIXED.get(name)
        self.fixed = FixedGrid(self.pyramid)
        self.vehicle: Vehicle = replace(c.vehicle, width=c.vehicle.width + 2.0 * config.spare)
        self.start = start
        self.sensor_bound = min(config.fastest, c.sensor.speed_bound(self.vehicle))
        self.found: TerrainMap | None = None

    def read(self, lines: ScanLines) -> None:
        """Add lines."""
        rows = statements(lines, self.pyramid)
        if self.weights is None:
            self.pyramid.add(rows)
            if self.sweeps is not None:
                self.sweeps.add(rows, len(lines))
        else:
            self.fixed.add(rows)

    def plan(self, place: Array, goal: float) -> Command | None:
        """Path from a place to the goal and its speed; None if there is no path."""
        found = self._map()
        x, y = found.centres()
        under = np.hypot(x[None] - self.start[0], y[:, None] - self.start[1]) < 1.5
        fresh = under & ~found.known
        classes = np.where(fresh, np.int8(TerrainClass.FREE), found.classes)
        p = np.where(fresh, 0.0, found.probability)
        found = self.found = replace(found, classes=classes, probability=p, provisional=found.provisional & ~under)
        costs = cost_map(found, self.vehicle, CostConfig(closing_bands=CLOSING))
        outside = (np.abs(y) > HALF_WIDTH)[:, None] | ((x < BEGIN) | (x > END))[None]
        costs = replace(costs, cost=np.where(outside, np.inf, costs.cost))
        planned = _plan(costs, place, goal)
        if planned is None:
            return None
        points = _smooth(planned.points, costs)
        points = np.vstack([place, points[1:]]) if len(points) > 1 else np.vstack([place, place])
        speed = self._speed(points, found) if self.bound else self.config.fastest
        return Command(points, speed)

    def _map(self) -> TerrainMap:
        if self.weights is None:
            return self.pyramid.classify()
        verdict = self.fixed.verdict(self.weights)
        classes = np.where(verdict.known, TerrainClass.FREE, TerrainClass.UNKNOWN).astype(np.int8)
        classes[verdict.hazard & verdict.known] = TerrainClass.OBSTACLE
        return _plain_map(np.array(BOX[:2]), CELLS[0], classes)

    def _speed(self, path: Array, found: TerrainMap) -> float:
        """Speed limit [m/s]: detection range of falls, and stopping before unknown ground or possible falls."""
        confirmed = found.known & ~found.provisional
        confirmed = binary_closing(confirmed, np.ones((3, 3), np.bool_), border_value=0) | confirmed
        room = distance_transform_edt(confirmed) * found.cell
        at = np.floor((path - found.origin) / found.cell).astype(np.int64)
        open_ = room[at[:, 1], at[:, 0]] > 0.5 * self.config.trial.vehicle.width
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
        ends = np.flatnonzero(~open_ & (length > found.cell))
        seen = float(length[ends[0]]) - found.cell if len(ends) else math.inf
        return min(self.sensor_bound, self.vehicle.safe_speed(seen))


def _plan(costs: CostMap, place: Array, goal: float) -> PlannedPath | None:
    """Cheapest path to the line x = ``goal``."""
    y = costs.origin[1] + costs.cell * (np.arange(len(costs.cost)) + 0.5)
    return plan_vehicle_path(costs, place, np.column_stack([np.full(len(y), goal), y]))


def _smooth(points: Array, costs: CostMap) -> Array:
    """Smooth a cell path by a moving average, unless the result crosses a blocked cell."""
    for reach in (3, 1):
        k = 2 * reach + 1
        ends = np.repeat(points[:1], reach, 0), np.repeat(points[-1:], reach, 0)
        wide = np.vstack([ends[0], points, ends[1]])
        mean = np.column_stack([np.convolve(wide[:, a], np.full(k, 1.0 / k), mode="valid") for a in (0, 1)])
        at = np.floor((mean - costs.origin) / costs.cell).astype(np.int64)
        if np.all(np.isfinite(costs.cost[at[reach:, 1], at[reach:, 0]])):
            return mean
    return points


def run_drive_trial(config: DriveTrialConfig, seed: int) -> Iterator[Measurement]:
    """Drive through the street of a seed with each map; the module lists the quantities."""
    course = draw_course(seed, config)
    for name in config.maps:
        yield from _drive(name, config, course, seed)


def _drive(name: str, c: DriveTrialConfig, course: Course, seed: int) -> Iterator[Measurement]:
    v = c.trial.vehicle
    tick = v.reaction_time
    rover = StreetRover(
        course.street, seed, c.trial.robot, acceleration=v.deceleration, longest=c.longest + 5.0, movers=course.movers
    )
    navigator = Navigator(name, c, course.start)
    state = RoverState(place=course.start)
    command = Command(np.vstack([course.start, course.start + [0.1, 0.0]]), 0.0)
    harm, stood, driven = "", 0.0, [course.start[None]]
    covered: list[float] = []
    ghosts: list[tuple[float, float]] = []
    people = np.full(course.free_lane.shape, -np.inf)
    speeds: list[float] = []
    spent, plans = 0.0, 0
    while state.time < c.longest and not harm and state.place[0] < course.goal - 0.5 and stood < PATIENCE:
        planned = None
        if state.time + 1e-9 >= c.trial.robot.sweep:  # it stands still for the first sweep
            begin = process_time()
            planned = navigator.plan(rover.after(state, command, tick).place, course.goal)
            spent, plans = spent + process_time() - begin, plans + 1
            found, view = navigator.found, _in_view(course, state.place)
            assert found is not None
            covered.append(_share(found.known, found, view))
            left = view & np.isfinite(people) & (people < state.time - 3.0 * c.trial.robot.sweep)
            hazard = np.isin(found.classes, HAZARDS)
            if left.any():
                ghosts.append((_share(hazard, found, left), _share(hazard, found, view & ~np.isfinite(people))))
        # the new command takes effect one reaction time later; until then the old one is driven
        there, at = state.place, state.time
        state, scans, believed, places = rover.drive(state, command, tick)
        _mark_people(people, course.movers, at, state.time)
        navigator.read(lines_of_scans(scans, believed, c.trial.robot.height))
        driven.append(places)
        harm = harm_of(places, course, v) or ("struck" if struck(places, at, course.movers, v) else "")
        stood = stood + tick if float(np.linalg.norm(state.place - there)) < 0.02 else 0.0
        if planned is None:
            command = Command(command.path, 0.0)
        else:
            command, state.along = planned, 0.0
            speeds.append(state.speed)
    track = np.concatenate(driven)
    arrived = not harm and state.place[0] > course.goal - 0.5
    for kind in HARMS:
        yield Measurement(name, kind, float(harm == kind))
    yield Measurement(name, "arrived", float(arrived))
    yield Measurement(name, "right", float(not harm and arrived == (course.best is not None)))
    yield Measurement(name, "way", float(course.best is not None))
    if covered:
        yield Measurement(name, "coverage", float(np.mean(covered)))
    if speeds:
        yield Measurement(name, "speed", float(np.mean(speeds)))
    if ghosts:
        yield Measurement(name, "ghost", float(np.mean(ghosts, axis=0)[0]))
        yield Measurement(name, "beside", float(np.mean(ghosts, axis=0)[1]))
    if arrived and course.best is not None:
        track = track[::25]  # subsampled, so that white pose errors do not add to the length
        steps = np.linalg.norm(np.diff(track, axis=0), axis=1)
        cells = np.floor((track[1:] - course.costs.origin) / course.costs.cell).astype(np.int64)
        cost = course.costs.cost[cells[:, 1], cells[:, 0]]
        worst = float(cost[np.isfinite(cost)].max())  # used where pose errors lead into the safety margin
        yield Measurement(name, "detour", float(steps.sum()) / course.best.length)
        yield Measurement(name, "cost", float(steps @ np.where(np.isfinite(cost), cost, worst)) / course.best.cost)
    if plans:
        yield Measurement(name, "plan_ms", 1e3 * spent / plans, timing=True)


def harm_of(places: Array, course: Course, v: Vehicle) -> str:
    """Kind of hazard that the circle of the vehicle touched first; empty: none."""
    at = np.floor((places - np.array(BOX[:2])) / 0.05).astype(np.int64)
    first = {k: np.flatnonzero(away[at[:, 1], at[:, 0]] < 0.5 * v.width) for k, away in course.hazards.items()}
    hit = {k: int(n[0]) for k, n in first.items() if len(n)}
    return min(hit, key=lambda k: hit[k]) if hit else ""


def struck(places: Array, begin: float, movers: tuple[Mover, ...], v: Vehicle) -> bool:
    """Whether the circle of the vehicle touched somebody while it was moving; places ``(n, 2)`` every 0.01 s."""
    moves = np.flatnonzero(np.linalg.norm(np.gradient(places, 0.01, axis=0), axis=1) > 0.05)
    if not len(moves):
        return False
    times = begin + 0.01 * np.asarray(moves, np.float64)
    x, y = places[moves].T
    return any(not clear_of(m, times, np.column_stack([x, y, x * 0 + m.floor]), 0.5 * v.width) for m in movers)


def _mark_people(covered: Array, movers: tuple[Mover, ...], begin: float, end: float) -> None:
    """Write the last time at which somebody covered each cell of 0.1 m into ``covered``."""
    for t in np.arange(begin, end, 0.05):
        for mover in movers:
            at, radius = mover.state(np.array([t]))[0][0] - np.array(BOX[:2]), mover.radius
            low = np.maximum(np.floor((at - radius) / CELLS[0]).astype(np.int64), 0)
            high = np.maximum(np.ceil((at + radius) / CELLS[0]).astype(np.int64), 0)
            covered[low[1] : high[1], low[0] : high[0]] = t


def _in_view(course: Course, place: Array) -> Mask:
    """Free cells of the lane ahead, 0.8 to 8 m away and within ±60°."""
    ny, nx = course.free_lane.shape
    x, y = (BOX[a] + CELLS[0] * (np.arange(n) + 0.5) - place[a] for a, n in ((0, nx), (1, ny)))
    r, bearing = np.hypot(x[None], y[:, None]), np.arctan2(np.abs(y)[:, None], x[None])
    return np.asarray(course.free_lane & (r > 0.8) & (r < 8.0) & (bearing < np.deg2rad(60.0)))


def _share(cells: Mask, found: TerrainMap, among: Mask) -> float:
    """Share of some cells of a map among cells of 0.1 m."""
    k = round(found.cell / CELLS[0])
    ny, nx = among.shape
    return float((cells.repeat(k, axis=0).repeat(k, axis=1)[:ny, :nx] & among).sum() / max(among.sum(), 1))


class DrivesStudy(WorldsStudy[DriveTrialConfig]):
    """Harm, arrival, coverage and cost of drives in closed loop."""

    run_one: Callable[[DriveTrialConfig, int], Iterable[Measurement]] = staticmethod(run_drive_trial)

    def report(self, table: pd.DataFrame, timings: pd.DataFrame) -> dict[str, pd.DataFrame]:
        """See :class:`~graphslam_studies.montecarlo.definition.StudyDefinition`."""
        out: dict[str, pd.DataFrame] = {}
        wide = table.pivot_table(index=["world", "algorithm"], columns="quantity", values="value", sort=False)
        drives = table[table["quantity"] == "right"].groupby(["world", "algorithm"], sort=False)["value"].count()
        counts = table[table["quantity"].isin([*HARMS, "arrived", "right", "way"])]
        sums = counts.pivot_table(
            index=["world", "algorithm"], columns="quantity", values="value", aggfunc="sum", sort=False
        )
        out["drives in closed loop: how they ended"] = sums.astype(int).assign(drives=drives).reset_index()
        means = [q for q in ("coverage", "speed", "detour", "cost", "ghost", "beside") if q in wide]
        out["means over drives"] = wide[means].reset_index()
        c = next(iter(self.full.values()))
        v, s = c.trial.vehicle, c.trial.sensor
        facts = {
            "threshold": read_tables().threshold,
            "climbable step [m]": v.climbable_step,
            "steepest [deg]": math.degrees(v.max_slope),
            "sweep [s]": s.sweep_time,
            "reaction [s]": v.reaction_time,
            "braking [m/s²]": v.deceleration,
            "spare room at either side [m]": c.spare,
            "passage [m]": PASSAGE,
            "speed bound [m/s]": s.speed_bound(replace(v, width=v.width + 2.0 * c.spare)),
        }
        out["what the figures hold for"] = pd.DataFrame([facts])
        if len(timings):
            out["time of a plan [ms]"] = timings.groupby("algorithm", sort=False)["value"].median().reset_index()
        return out

    def figures(self, table: pd.DataFrame, timings: pd.DataFrame, folder: Path) -> list[Path]:
        """See :class:`~graphslam_studies.montecarlo.definition.StudyDefinition`; no plots."""
        return []


STUDY = DrivesStudy(
    "terrain-drives",
    "Drives in closed loop through streets with obstacles, edges and holes, on the map that is made on the way.",
    {
        "streets": DriveTrialConfig(),
        "people": DriveTrialConfig(maps=FORGETTING, movers=2),
        "fast": DriveTrialConfig(maps=FORGETTING, movers=2, pace=(2.0, 4.0)),
    },
    {"quick": DriveTrialConfig(maps=("bands",), targets=("hole-1.0",), begin=4.0, beyond=2.5, longest=25.0)},
    trials=100,
)
