"""A street with one thing in it that a vehicle must see: a curb, stairs, a drop, a ramp, a hole, a wire, a car.

Each street is drawn from its seed. A robot with an upright line laser drives towards the target while the laser pans
from side to side, or across the street past it while the laser looks at it, fixed. Every cell of the street has a
label: what it is to a vehicle.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import maximum_filter, minimum_filter

from graphslam.core import se3
from graphslam.core.errors import ConfigError, UnknownNameError
from graphslam.core.geometry import Array
from graphslam.core.log import SensorLog, Truth
from graphslam.core.random import SeedTree
from graphslam.core.range_scans import RangeScans
from graphslam.core.records import Stream
from graphslam.core.trajectory import Trajectory
from graphslam.sim.crawler_config import CrawlerConfig
from graphslam.sim.crawler_sensors import cast_scans, ornstein_uhlenbeck
from graphslam.sim.drive import DriveConfig, SampledRoute
from graphslam.sim.mesh import MeshBuilder
from graphslam.sim.raycast import RayCaster
from graphslam_studies.sim.campus import PANNING_MOUNT, Balancing

HALF_WIDTH = 5.0
"""From the middle of the lane to the walls [m]."""
BEGIN, END = -5.0, 30.0
"""Of the street along x [m]."""
WIRE = 0.012
"""Thickness of a wire [m]."""
RAMP_LENGTH = 3.0
"""Of a ramp along the street [m]."""
PASSAGE = 2.0
"""Width of a passage through a target that reaches across the street [m]."""
FALL = 0.4
"""Beyond the edge of a drop or of stairs down so much of the ground counts as the hazard [m]."""
_FINE = 0.025

FREE, STEP, STEEP, OBSTACLE, HOLE, NEITHER = 0, 3, 4, 5, 6, -1
"""Labels of cells; a cell that is neither free nor a hazard is not judged."""

TARGETS: dict[str, tuple[str, Mapping[str, float]]] = {
    "nothing": ("nothing", {}),
    "curb-5": ("curb", {"height": 0.05}),
    "curb-10": ("curb", {"height": 0.10}),
    "curb-15": ("curb", {"height": 0.15}),
    "stairs-up": ("stairs", {"height": 0.17}),
    "stairs-down": ("stairs", {"height": -0.17}),
    "drop": ("curb", {"height": -0.30}),
    "ramp-10": ("ramp", {"angle": 10.0}),
    "ramp-25": ("ramp", {"angle": 25.0}),
    "ramp-down-10": ("ramp", {"angle": -10.0}),
    "hole-1.0": ("hole", {"length": 1.0, "depth": 0.6}),
    "hole-0.5": ("hole", {"length": 0.5, "depth": 0.4}),
    "wire-1.2": ("wire", {"height": 1.2}),
    "wire-2.5": ("wire", {"height": 2.5}),
    "car": ("car", {}),
}
"""By name: kind, and its figures [m, degrees]."""
KINDS = ("nothing", "curb", "stairs", "ramp", "hole", "wire", "car")


@dataclass(frozen=True, slots=True, kw_only=True)
class Street:
    """A street along x; the lane is 5 m wide, its middle is y = 0.

    Heights are ``waves + long_slope · x + cross_slope · y + side curb + target``.
    """

    kind: str
    figures: Mapping[str, float]
    target_at: float = 16.0
    """Where the target begins [m]."""
    side: float = 1.0
    """On which side the curb runs along the lane, +1 left or −1 right …"""
    side_at: float = 2.5
    """… how far from the middle [m] …"""
    side_height: float = 0.1
    """… and how high it is [m]."""
    cross_slope: float = 0.0
    long_slope: float = 0.0
    waves: tuple[tuple[float, float, float, float], ...] = ()
    """Amplitude [m], wave numbers along x and y [rad/m], phase."""
    parked: tuple[float, float] = (8.0, 3.9)
    """A parked car: along x, and distance from the middle on the side without a curb [m]."""
    passage: float | None = None
    """Middle along y of a passage through curbs, stairs, drops and ramps, where the ground goes on level [m]."""

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise UnknownNameError("target of a street", self.kind, KINDS)

    def base(self, x: Array, y: Array) -> Array:
        """Height of the ground without curbs and targets."""
        z = self.long_slope * x + self.cross_slope * y
        for a, kx, ky, phase in self.waves:
            z = z + a * np.sin(kx * x + ky * y + phase)
        return z

    def raised(self, x: Array, y: Array) -> Array:
        """What curb and target add to it."""
        u, f = x - self.target_at, self.figures
        target: Array = np.zeros(np.broadcast(x, y).shape)
        if self.kind == "curb":
            target = np.where(u > 0, f["height"], 0.0)
        elif self.kind == "stairs":
            target = f["height"] * np.clip(np.ceil(u / 0.28), 0, 8)
        elif self.kind == "ramp":
            target = np.tan(np.deg2rad(f["angle"])) * np.clip(u, 0.0, RAMP_LENGTH)
        elif self.kind == "hole":
            target = -np.where((u > 0) & (u < f["length"]) & (np.abs(y) < 0.8), f["depth"], 0.0)
        return np.asarray(np.where(self.side * y > self.side_at, self.side_height, 0.0) + self._across(y) * target)

    def _across(self, y: Array) -> npt.NDArray[np.bool_]:
        """Where along y a target that reaches across the street is."""
        if self.passage is None:
            return np.ones(np.shape(y), np.bool_)
        return np.asarray(np.abs(y - self.passage) > 0.5 * PASSAGE)

    def height(self, x: Any, y: Any) -> Array:
        """Of the ground [m]."""
        x, y = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
        return np.asarray(self.base(x, y) + self.raised(x, y))

    def cars(self) -> list[tuple[float, float, float]]:
        """Centre and yaw of the cars: the parked one, and the target."""
        out = [(self.parked[0], -self.side * self.parked[1], 0.0)]
        if self.kind == "car":
            out.append((self.target_at + 0.9, 0.0, 0.5 * np.pi))
        return out

    def breaks(self) -> tuple[Array, Array]:
        """Where along x and along y the ground is broken [m]."""
        x = [self.target_at]
        f = self.figures
        if self.kind == "stairs":
            x += [self.target_at + 0.28 * k for k in range(1, 8)]
        if self.kind == "ramp":
            x.append(self.target_at + RAMP_LENGTH)
        if self.kind == "hole":
            x.append(self.target_at + f["length"])
        y = [self.side * self.side_at] + ([-0.8, 0.8] if self.kind == "hole" else [])
        if self.passage is not None:
            y += [self.passage - 0.5 * PASSAGE, self.passage + 0.5 * PASSAGE]
        return np.array(x), np.array(y)

    def mesh(self) -> tuple[Array, npt.NDArray[np.int32]]:
        """Vertices and triangles of the ground, walls, cars and wires."""
        mesh = MeshBuilder()
        bx, by = self.breaks()
        xs = np.unique(np.concatenate([np.arange(BEGIN, END + 0.1, 0.25), bx]))
        ys = np.unique(np.concatenate([np.arange(-HALF_WIDTH, HALF_WIDTH + 0.1, 0.5), by]))
        inset = 1e-6  # which side of a break a corner belongs to
        corners = []
        for i, j in ((0, 0), (1, 0), (1, 1), (0, 1)):
            x, y = xs[i : len(xs) - 1 + i, None], ys[None, j : len(ys) - 1 + j]
            inside = self.raised(x + inset * (1 - 2 * i) + 0 * y, y + inset * (1 - 2 * j) + 0 * x)
            corners.append(np.stack([x + 0 * y, y + 0 * x, self.base(x, y) + inside], axis=-1))
        c = np.stack(corners, axis=2)  # cells along x, along y, corner, coordinate
        quads = [c.reshape(-1, 4, 3)]
        for left, right in ((c[:-1, :, [1, 2]], c[1:, :, [0, 3]]), (c[:, :-1, [3, 2]], c[:, 1:, [0, 1]])):
            wall = np.concatenate([left, right[:, :, ::-1]], axis=2).reshape(-1, 4, 3)
            quads.append(wall[np.abs(wall[:, 0, 2] - wall[:, 3, 2]) + np.abs(wall[:, 1, 2] - wall[:, 2, 2]) > 1e-4])
        q = np.concatenate(quads)
        first = 4 * np.arange(len(q))[:, None]
        mesh.add(q.reshape(-1, 3), np.concatenate([first + [0, 1, 2], first + [0, 2, 3]]))
        for wall_y in (-HALF_WIDTH, HALF_WIDTH):
            mesh.box((BEGIN, min(wall_y, wall_y * 1.04), -5.0), (END, max(wall_y, wall_y * 1.04), 5.0))
        mesh.box((END - 0.2, -HALF_WIDTH, -5.0), (END, HALF_WIDTH, 5.0))
        for cx, cy, yaw in self.cars():
            mesh.car((cx, cy), yaw, float(self.height(cx, cy)), (4.2, 1.8, 1.5))
        if self.kind == "wire":
            z = float(self.height(self.target_at, 0.0)) + self.figures["height"]
            half = 0.5 * WIRE
            mesh.box((self.target_at - half, -HALF_WIDTH, z - half), (self.target_at + half, HALF_WIDTH, z + half))
        return mesh.build()

    def labels(
        self, origin: Array, cell: float, shape: tuple[int, int], *, step: float, slope: float, height: float
    ) -> npt.NDArray[np.int8]:
        """What every cell is to a vehicle.

        Parameters
        ----------
        origin : (2,)
            Lower left corner [m].
        cell : float
            A multiple of 0.025 m.
        shape : (ny, nx)
        step, slope, height : float
            Highest step [m] and steepest ground [rad] that it drives, and its height [m].

        Returns
        -------
        (ny, nx) int8
            `FREE`, a hazard, or `NEITHER`: outside the street, free cells nearer than 0.15 m to a hazard, and steps
            between half of what the vehicle climbs and all of it: those may be called either.
        """
        k = round(cell / _FINE)
        if abs(k * _FINE - cell) > 1e-9:
            raise ConfigError(f"labels of cells of {cell} m; wanted a multiple of {_FINE} m")
        ny, nx = shape
        x = origin[0] + _FINE * (np.arange(nx * k) + 0.5)
        y = origin[1] + _FINE * (np.arange(ny * k) + 0.5)
        X, Y = np.meshgrid(x, y)
        z = self.raised(X, Y)
        fine = np.zeros(z.shape, np.int8)
        u = X - self.target_at
        rise = maximum_filter(z, 3) - minimum_filter(z, 3)
        edge = rise > step
        fine[edge] = STEP
        small = (rise > 0.5 * step) & ~edge
        reaches = self._across(Y)
        if self.kind in ("curb", "stairs") and self.figures["height"] < -step:
            fine[(edge & (u > -0.2)) | (reaches & (u > 0) & (u < FALL))] = HOLE
        if self.kind == "hole":
            inside = (u > 0) & (u < self.figures["length"]) & (np.abs(Y) < 0.8)
            fine[(maximum_filter(inside.astype(np.int8), 3) > 0) & (self.figures["depth"] > step)] = HOLE
        if self.kind == "ramp" and abs(np.deg2rad(self.figures["angle"])) > slope:
            fine[reaches & (u > 0) & (u < RAMP_LENGTH)] = STEEP
        if self.kind == "wire" and self.figures["height"] < height:
            fine[np.abs(u) < 0.5 * WIRE + 0.5 * _FINE] = OBSTACLE
        for cx, cy, yaw in self.cars():
            along = np.abs(np.cos(yaw) * (X - cx) + np.sin(yaw) * (Y - cy))
            across = np.abs(-np.sin(yaw) * (X - cx) + np.cos(yaw) * (Y - cy))
            fine[(along < 2.1) & (across < 0.9)] = OBSTACLE
        beyond = (np.abs(Y) > HALF_WIDTH) | (X < BEGIN) | (X > END - 0.2)
        fine[(np.abs(Y) > HALF_WIDTH - 0.05) & ~beyond] = OBSTACLE
        parts = fine.reshape(ny, k, nx, k)
        out = parts.max(axis=(1, 3)).astype(np.int8)
        near = maximum_filter(out, 2 * math.ceil(0.15 / cell) + 1) > 0
        out[(out == 0) & near] = NEITHER
        unsure = maximum_filter(small.reshape(ny, k, nx, k).any(axis=(1, 3)).astype(np.int8), 3) > 0
        out[(out == 0) & unsure] = NEITHER
        if self.kind in ("curb", "stairs") and self.figures["height"] < -step:
            # level again below a fall, but not to be reached, and hidden in part: not judged
            below = np.sum((reaches & (u > 0)).reshape(ny, k, nx, k), axis=(1, 3)) > 0
            out[(out == 0) & below] = NEITHER
        out[beyond.reshape(ny, k, nx, k).any(axis=(1, 3))] = NEITHER
        return out


def draw_street(target: str, seed: int, *, teaching: bool = False) -> Street:
    """A street with a target of :data:`TARGETS`.

    Parameters
    ----------
    teaching : bool
        Another street, to learn tables on: all sizes of the target, the place of the curb and the car, and the waves
        of the ground are drawn from other and wider ranges.
    """
    if target not in TARGETS:
        raise UnknownNameError("target of a street", target, TARGETS)
    kind, figures = TARGETS[target]
    r = SeedTree(int(seed)).child("street", "teaching" if teaching else "test", target).generator()
    side = float(r.choice([-1.0, 1.0]))
    waves = tuple(
        (float(r.uniform(0.005, 0.018 if teaching else 0.015)), *(r.uniform(0.3, 1.5, 2)), float(r.uniform(0, 6.28)))
        for _ in range(3)
    )
    common: dict[str, Any] = {
        "side": side,
        "cross_slope": float(r.uniform(-0.02, 0.02)),
        "long_slope": float(r.uniform(-0.02, 0.02)),
        "waves": waves,
    }
    if not teaching:
        height = float(r.choice([0.05, 0.10, 0.15]))
        parked = (float(r.uniform(5.0, 12.0)), 3.9)
        return Street(kind=kind, figures=dict(figures), side_height=height, parked=parked, **common)
    f = dict(figures)
    for name in f:
        f[name] *= float(r.uniform(0.8, 1.25))
    return Street(
        kind=kind,
        figures=f,
        target_at=float(r.uniform(11.0, 15.0)),
        side_at=float(r.uniform(1.8, 3.2)),
        side_height=float(r.uniform(0.04, 0.18)),
        parked=(float(r.uniform(3.0, 9.0)), 3.8),
        **common,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class StreetRobot:
    """The robot, its laser, and how well its pose is known."""

    height: float = 1.1
    """Of the laser above the ground [m]."""
    beams: int = 181
    lowest: float = -65.0
    """Elevation of the lowest beam [deg]."""
    beam_step: float = 0.5
    """Between beams [deg]."""
    line_rate: float = 75.0
    """Lines per second [Hz]."""
    pan: float = 60.0
    """The panning laser looks so far to either side [deg] …"""
    sweep: float = 2.0
    """… and takes so long from one side to the other [s]."""
    speed: float = 1.0
    """[m/s]"""
    lean: float = 3.0
    """Largest pitch while it balances [deg], at about 1 Hz."""
    stand: float = 0.0
    """Time at rest before it starts [s]."""
    range_sigma: float = 0.025
    """[m]"""
    drop_out: float = 0.01
    """Share of beams without a reading."""
    max_range: float = 30.0
    """[m]"""
    pose_scale: float = 1.0
    """Every error of the pose is multiplied by it: roll, pitch and yaw 0.1°, 0.2°, 0.2°; x, y 2 cm, z 1 cm, over
    seconds; and white ones of 0.05° and 2 mm."""

    def __post_init__(self) -> None:
        for f in dataclasses.fields(self):
            value = getattr(self, f.name)
            if not (isinstance(value, int | float) and math.isfinite(value)):
                raise ConfigError(f"street robot: {f.name} = {value}; wanted a number")
        for name in ("height", "beam_step", "line_rate", "sweep", "speed", "range_sigma", "max_range"):
            if getattr(self, name) <= 0:
                raise ConfigError(f"street robot: {name} = {getattr(self, name)}; wanted > 0")
        if self.beams < 2 or not 0 <= self.drop_out < 1 or self.pose_scale < 0 or self.stand < 0:
            raise ConfigError(
                f"street robot: beams {self.beams}, drop_out {self.drop_out}, pose_scale {self.pose_scale}, "
                f"stand {self.stand}; wanted ≥ 2, in [0, 1), ≥ 0, ≥ 0"
            )

    def scans(self, times: Array, *, panning: bool = True) -> RangeScans:
        """Lines of the laser at times ``(n,)`` [s], not yet measured; one that does not pan looks to the left."""
        elevation = np.deg2rad(self.lowest + self.beam_step * np.arange(self.beams))
        zeros = np.zeros(self.beams)
        if panning:
            phase = np.mod(times / self.sweep + 0.5, 2.0)
            spin = math.radians(self.pan) * (1.0 - 2.0 * np.abs(phase - 1.0))
            rate = np.where(phase < 1.0, 2.0, -2.0) * math.radians(self.pan) / self.sweep
            mount = np.array([0.0, 0.0, self.height, *PANNING_MOUNT[3:]])
            directions = np.column_stack([np.sin(elevation), np.cos(elevation), zeros])
        else:
            spin = rate = np.zeros(len(times))
            mount = np.array([0.0, 0.0, self.height, 0.0, 0.0, 0.0, 1.0])
            directions = np.column_stack([zeros, np.cos(elevation), np.sin(elevation)])
        return RangeScans(
            times=times,
            ranges=np.zeros((len(times), self.beams), np.float32),
            directions=directions,
            beam_times=np.linspace(0.0, 0.8 / self.line_rate, self.beams),
            max_range=self.max_range,
            sigma=self.range_sigma,
            T_base_mount=mount,
            spin=spin,
            spin_rate=rate,
        )

    def noise(self) -> CrawlerConfig:
        """How the laser measures."""
        return CrawlerConfig(range_sigma=self.range_sigma, drop_out=self.drop_out, max_range=self.max_range)


@dataclass(frozen=True, slots=True, eq=False)
class StreetDrive:
    """A drive: what the laser measured, where the robot was, and where it believes it was."""

    street: Street
    robot: StreetRobot
    scans: RangeScans
    truth: Trajectory
    believed: Trajectory


def drive_street(
    street: Street,
    seed: int,
    robot: StreetRobot = StreetRobot(),
    *,
    aside: float | None = None,
    start: float = 16.0,
    until: float = 1.0,
) -> StreetDrive:
    """Drive towards the target with the panning laser, or past it with the fixed one.

    Parameters
    ----------
    seed : int
        Of every error.
    aside : float, optional
        The laser does not pan but looks to the left, and the robot drives across the street at this distance before
        the target [m], its left towards it.
    start, until : float
        A drive towards the target begins, and ends, so far before it [m].

    Raises
    ------
    ConfigError
        A drive without a way.
    GraphSlamError
        Open3D is not there.
    """
    if not until + 0.5 < start or (aside is not None and not 0.5 < aside < 14.0):
        raise ConfigError(f"street: a drive from {start} m to {until} m before the target, or {aside} m aside of it")
    tree = SeedTree(int(seed)).child("street drive", "panning" if aside is None else "fixed")
    if aside is None:
        x = np.arange(max(street.target_at - start, 0.0), street.target_at - until, 0.02)
        y = np.zeros_like(x)
        yaw = 0.0
    else:
        y = np.arange(2.2, -2.2, -0.02)
        x = np.full_like(y, street.target_at - aside)
        yaw = -0.5 * np.pi
    z = street.base(x, y)
    rise = np.gradient(z, 0.02)
    route = SampledRoute(
        step=0.02,
        positions=np.column_stack([x, y, z]),
        yaw=np.full(len(x), yaw),
        pitch=-np.arctan(rise),
        roll=np.zeros(len(x)),
    )
    config = DriveConfig(rate=100.0, ramp=0.5, stand=robot.stand)
    motion = Balancing(route, robot.speed, config, math.radians(robot.lean), 1.0, tree.child("lean"))
    count = int((motion.duration - 1.0 / robot.line_rate) * robot.line_rate)
    scans = robot.scans(np.arange(count) / robot.line_rate, panning=aside is None)
    cast = cast_scans(scans, motion, RayCaster(*street.mesh()), robot.noise(), tree.child("beams"))
    truth = motion.trajectory()
    dt = float(np.median(np.diff(truth.times)))
    error = pose_errors(len(truth.times), dt, robot.pose_scale, tree.child("pose"))
    believed = Trajectory(truth.times, se3.se3_compose(truth.poses, se3.se3_exp(error)))
    return StreetDrive(street, robot, cast, truth, believed)


def pose_errors(n: int, dt: float, scale: float, tree: SeedTree) -> Array:
    """Errors ``(n, 6)`` that a pose from scans, IMU and wheels has, every ``dt`` [s]: rotation [rad] and place [m]
    in the frame of the body, times ``scale``; see `StreetRobot.pose_scale`."""
    rng = tree.generator()
    white = np.repeat(rng.standard_normal((n, 6)), 1, axis=0) * [*[math.radians(0.05)] * 3, *[0.002] * 3]
    slow = [
        ornstein_uhlenbeck(rng, (n, 1), sigma, time, dt)
        for sigma, time in (
            *((math.radians(s), 1.0) for s in (0.1, 0.2, 0.2)),
            *((s, 3.0) for s in (0.02, 0.02, 0.01)),
        )
    ]
    return scale * np.asarray(white + np.hstack(slow))


def simulate_street(target: str, seed: int, robot: StreetRobot = StreetRobot()) -> SensorLog:
    """A drive towards a target as a log.

    Parameters
    ----------
    target : str
        Of :data:`TARGETS`.

    Returns
    -------
    SensorLog
        Stream ``panning`` (RangeScans); truth and, in ``meta``, the street.
    """
    street = draw_street(target, seed)
    drive = drive_street(street, seed, robot)
    streams: dict[str, Stream] = {"panning": drive.scans}
    meta = {
        "source": "simulation",
        "robot": "street",
        "world": f"street-{target}",
        "seed": int(seed),
        "frame": "world, z up",
        "street": {**dataclasses.asdict(street), "figures": dict(street.figures)},
        "config": dataclasses.asdict(robot),
    }
    return SensorLog(name=f"street-{target}", streams=streams, truth=Truth(drive.truth), meta=meta)
