"""A planar world of a building in a park: walls inside, trees outside, and a robot with every kind of sensor.

The route goes through the building and round through the park, at least twice each. Layout, route and noise levels are
random: another seed is another world.

- ``wheels``: :class:`~graphslam.core.records.Odometry`, noise independent per increment, growing with the distance;
- ``imu``: :class:`~graphslam.core.imu.Imu`, level, z up: yaw rate and two accelerations, with biases that drift slowly;
- ``gps``: :class:`~graphslam.core.records.Gps` in the plane; no fix under the roof and near the walls;
- ``laser``: :class:`~graphslam.core.records.LaserScans`, which measures walls and trunks;
- ``landmarks``: :class:`~graphslam.core.records.LandmarkObservations` of the trees. Their ``ids`` are ground truth for
  an evaluation; association ``likelihood`` does not use them.

Laser and landmark sensor are two instruments, for example a range finder and a camera with its own tree detector: the
observation of a tree is not computed from the scan that shows its trunk. Their noise is independent, so that a graph
may use both.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from graphslam.core.errors import ConfigError, UnknownNameError
from graphslam.core.geometry import Array, se2_between, se2_compose, se2_exp, se2_inverse, se2_transform
from graphslam.core.imu import Imu
from graphslam.core.log import DropCounter, SensorLog, Truth
from graphslam.core.random import SeedTree
from graphslam.core.range_scans import RangeScans
from graphslam.core.records import Gps, LaserScans, Odometry, Stream
from graphslam.core.trajectory import Trajectory
from graphslam.sim.clutter import KeepClear, scatter_obstacles
from graphslam.sim.crawler_config import CrawlerConfig
from graphslam.sim.crawler_sensors import cast_scans, measure_imu
from graphslam.sim.drive import DriveConfig, RouteMotion, sample_route, smooth_route
from graphslam.sim.landmark_config import LandmarkFieldConfig
from graphslam.sim.landmark_field import observe_landmarks
from graphslam.sim.mesh import MeshBuilder, Rectangle
from graphslam.sim.raycast import RayCaster
from graphslam.sim.route import Route, plan_route

Range = tuple[float, float]

_HALF = 1.5  # m, half the width of a corridor
_DOOR = 0.9  # m, half the width of a door
_RADIUS = 1.2  # m, of the corners of the route
_HEIGHT = 2.5
_EYE = 0.5  # m, height of the laser and of the landmark sensor
_SHADOW = 4.0  # m: no fix nearer to the building
_LEVER = (0.2, 0.0)  # antenna in the base [m]
_FLOOR = (1e-3, 1e-3, 2e-4)  # σ of an increment of the wheels at rest [m, m, rad]
_WHEEL_RATE, _IMU_RATE = 10.0, 50.0

NOISE: Mapping[str, Range] = {
    "wheel": (0.01, 0.03),  # along the path after one metre, growing with the root of the distance [m/√m]
    "lateral": (0.003, 0.01),  # across it [m/√m]
    "turn": (0.003, 0.01),  # of the heading [rad/√m]
    "laser": (0.01, 0.03),  # of a range [m]
    "range": (0.05, 0.15),  # of an observation of a tree [m]
    "bearing": (math.radians(0.5), math.radians(1.5)),  # [rad]
    "gps": (0.5, 1.5),  # of each coordinate [m]
    "gyro": (2e-4, 1e-3),  # [rad/s/√Hz]
    "gyro_bias": (1e-3, 5e-3),  # [rad/s]
    "gyro_walk": (5e-6, 3e-5),  # [rad/s/√s]
    "accelerometer": (2e-3, 1e-2),  # [m/s²/√Hz]
    "accelerometer_bias": (0.02, 0.1),  # [m/s²]
    "accelerometer_walk": (5e-5, 3e-4),  # [m/s²/√s]
}
"""Range of the σ of every sensor; a value is sampled log-uniformly with the seed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MixedConfig:
    """Size of the place, length of the route and rates of the sensors."""

    length: Range = (26.0, 34.0)
    """Of the building [m]."""
    width: Range = (19.0, 23.0)
    """Of the building [m]."""
    park: Range = (16.0, 26.0)
    """Distance from the building of the route through the park [m]."""
    trees: int = 60
    """Number of trees in the park; fewer if there is no room for them 3 m apart."""
    laps: int = 2
    """Number of passes through the building and the park, at least 2."""
    speed: float = 1.25
    """[m/s]"""
    layout_seed: int | None = None
    """Seed of building, trees and route. None: the run's own."""
    beams: int = 181
    """Of a laser scan, over 240°."""
    laser_rate: float = 5.0
    """Scans per second [Hz]; divides 10."""
    laser_range: float = 20.0
    """[m]"""
    landmark_rate: float = 2.5
    """Observations of the trees per second [Hz]; divides 10."""
    landmark_range: float = 14.0
    """[m]"""
    gps_rate: float = 1.0
    """Fixes per second in the open [Hz]; divides 10."""
    noise_scale: float = 1.0
    """Factor on every random error, but not on the nominal σ; 0 gives exact data."""

    def __post_init__(self) -> None:
        for name, least in (("length", 18.0), ("width", 15.0), ("park", 8.0)):
            low, high = (float(v) for v in getattr(self, name))
            self._require(name, least <= low <= high <= 200.0, f"a range from {least:g} m on")
            object.__setattr__(self, name, (low, high))
        for name in ("trees", "laps", "beams"):
            value = getattr(self, name)
            self._require(name, isinstance(value, int) and value >= (0 if name == "trees" else 2), "a whole number ≥ 2")
        for name in ("laser_rate", "landmark_rate", "gps_rate"):
            value = getattr(self, name)
            stride = _WHEEL_RATE / value if value > 0 else 0.5
            self._require(name, abs(stride - round(stride)) < 1e-9 and stride >= 1, "a divisor of 10 Hz")
        for name in ("speed", "laser_range", "landmark_range"):
            self._require(name, 0 < getattr(self, name) < math.inf, "> 0")
        self._require("noise_scale", 0 <= self.noise_scale < math.inf, "≥ 0")

    def _require(self, name: str, ok: bool, wanted: str) -> None:
        if not ok:
            raise ConfigError(f"mixed world: {name} = {getattr(self, name)}; wanted {wanted}")


PRESETS: Mapping[str, Mapping[str, Any]] = {
    "full": {},
    "quick": {
        **{"length": (18.0, 20.0), "width": (15.0, 16.0), "park": (8.0, 11.0), "trees": 30},
        **{"laser_rate": 2.5, "beams": 121},
    },
}
"""Sizes by name: ``full`` is the default, ``quick`` is for tests."""


def draw_log_uniform(ranges: Mapping[str, Range], tree: SeedTree) -> dict[str, float]:
    """A log-uniform random value from every range, each from the branch of its name."""
    return {
        name: float(np.exp(tree.child(name).generator().uniform(*np.log(limits)))) for name, limits in ranges.items()
    }


def true_intervals(times: Array, inside: Array) -> list[list[float]]:
    """Stretches of time ``[from, to]`` in which a condition holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], inside.astype(int), [0]])))
    return [[float(times[a]), float(times[b - 1])] for a, b in zip(edges[::2], edges[1::2])]


def mixed_preset(name: str = "full", **changes: Any) -> MixedConfig:
    """A preset with some parameters changed."""
    if name not in PRESETS:
        raise UnknownNameError("preset of the mixed world", name, PRESETS)
    known = {f.name for f in dataclasses.fields(MixedConfig)}
    for key in changes:
        if key not in known:
            raise ConfigError(f"mixed world: unknown parameter {key!r}; known: {', '.join(sorted(known))}")
    return MixedConfig(**{**PRESETS[name], **changes})


@dataclass(frozen=True, slots=True, kw_only=True)
class MixedPlace:
    """The building, the trees and the route; x along the building from its western wall, metres.

    Parameters
    ----------
    caster : RayCaster
        Walls, obstacles in the corridors and trunks.
    trees : (n, 3)
        Plan position of each trunk and its radius [m].
    building : (x0, y0, x1, y1)
    """

    caster: RayCaster
    trees: Array
    building: Rectangle
    route: Route

    def outside_by(self, points: Array) -> Array:
        """Distance of points ``(n, 2)`` from the building ``(n,)`` [m]; 0 under its roof."""
        x0, y0, x1, y1 = self.building
        out = np.maximum(np.maximum([x0, y0] - points, points - [x1, y1]), 0.0)
        return np.asarray(np.hypot(out[:, 0], out[:, 1]))

    def hidden(self, eyes: Array, rows: npt.NDArray[np.intp]) -> npt.NDArray[np.bool_]:
        """Which of the trees ``rows`` (q,) are occluded as seen from ``eyes`` (q, 2)."""
        if not len(rows):
            return np.zeros(0, dtype=bool)
        step = self.trees[rows, :2] - eyes
        away = np.hypot(step[:, 0], step[:, 1])
        up = np.zeros((len(rows), 1))
        found = self.caster.ranges(np.hstack([eyes, up + _EYE, step / away[:, None], up]))
        return np.asarray(found < away - self.trees[rows, 2] - 0.05)


def mixed_place(config: MixedConfig, seed: int) -> MixedPlace:
    """Generate building, route and trees."""
    tree = SeedTree(seed).child("mixed", "layout")
    rng = tree.child("plan").generator()
    w, h = (float(rng.uniform(*r)) for r in (config.length, config.width))
    rooms = rng.uniform(3.0, 4.5, 4)  # depth of the rooms to the south, east, north and west
    x1, x2, y1, y2 = rooms[3] + _HALF, w - rooms[1] - _HALF, rooms[0] + _HALF, h - rooms[2] - _HALF
    flip = -1.0 if rng.random() < 0.5 else 1.0  # mirrored: left turns become right turns

    # a closed route: from the park in by the western door, along the ring of corridors, out by the eastern one
    away = rng.uniform(*config.park, 3)
    park = [(w + 7.0, y2), (w + 7.0 + 4.0 * rng.random(), h + away[0]), (w * rng.uniform(0.35, 0.65), h + away[1])]
    park += [(-7.0 - 4.0 * rng.random(), h + away[2]), (-7.0, y1)]
    ring = [(x1, y1), (x2, y1), (x2, y2), (x1, y2)]
    points = [park[2]]
    for lap in range(config.laps):
        points += park[3:]
        # the whole ring once, then the half of it that leads to the other door, by the south or by the north
        points += ring if lap == 0 else []
        points += ring[:3] if lap == 0 or rng.random() < 0.5 else [ring[0], ring[3], ring[2]]
        points += park[:3]
    points += [(0.3 * a + 0.7 * b for a, b in zip(*park[2:4]))]  # type: ignore[list-item]
    waypoints = np.array([(*p, 0.0) for p in points])
    route = plan_route(waypoints, _RADIUS, where="mixed world")

    mesh = MeshBuilder()
    _walls(mesh, (w, h), (x1, y1, x2, y2), tree.child("walls").generator())
    clear = KeepClear(route, margin=0.75)
    things = tree.child("things").generator()
    c = _HALF
    for strip in (
        (x1, y1 - c, x2, y1 + c),
        (x1, y2 - c, x2, y2 + c),
        (x1 - c, y1, x1 + c, y2),
        (x2 - c, y1, x2 + c, y2),
    ):
        scatter_obstacles(mesh, strip, 0.0, 6, clear, things)
    trees = _trees(route, (w, h), max(away), config.trees, tree.child("trees").generator())
    for x, y, radius in trees:
        mesh.prism((x, y), radius, 0.0, _HEIGHT)
    mirror = np.array([1.0, flip, 1.0])
    vertices, triangles = mesh.build()
    return MixedPlace(
        caster=RayCaster(vertices * mirror, triangles),
        trees=trees * mirror,
        building=(0.0, min(0.0, flip * h), w, max(0.0, flip * h)),
        route=plan_route(waypoints * mirror, _RADIUS, where="mixed world"),
    )


def _walls(mesh: MeshBuilder, size: tuple[float, float], ring: Rectangle, rng: np.random.Generator) -> None:
    """Outer walls with two doors, a ring of corridors round a core, and rooms beside it with open doors."""
    (w, h), (x1, y1, x2, y2), c = size, ring, _HALF
    wall = partial(mesh.wall, low=0.0, high=_HEIGHT)

    def gaps(length: float) -> list[Rectangle]:
        at = np.arange(1.0 + rng.uniform(0.0, 2.0), length - 1.0 - 1.2, rng.uniform(4.0, 6.0))
        return [(float(a), float(a) + 1.1, 0.0, _HEIGHT) for a in at]

    def door(at: float) -> list[Rectangle]:
        return [(at - _DOOR, at + _DOOR, 0.0, _HEIGHT)]

    wall((0.0, 0.0), (w, 0.0))
    wall((0.0, h), (w, h))
    wall((0.0, 0.0), (0.0, h), openings=door(y1))
    wall((w, 0.0), (w, h), openings=door(y2))
    mesh.box((x1 + c, y1 + c, 0.0), (x2 - c, y2 - c, _HEIGHT))
    for a, b in (
        ((0.0, y1 - c), (x2 + c, y1 - c)),
        ((x2 + c, y1 - c), (x2 + c, y2 - c)),
        ((x1 - c, y2 + c), (w, y2 + c)),
        ((x1 - c, y1 + c), (x1 - c, y2 + c)),
    ):
        wall(a, b, openings=gaps(math.dist(a, b)))
    wall((0.0, y1 + c), (x1 - c, y1 + c))
    wall((x2 + c, y2 - c), (w, y2 - c))
    for x in np.arange(rng.uniform(3.0, 6.0), w - 2.0, rng.uniform(4.0, 7.0)):  # between the rooms
        wall((x, 0.0), (x, y1 - c))
    for x in np.arange(rng.uniform(3.0, 6.0), w - 2.0, rng.uniform(4.0, 7.0)):
        wall((x, y2 + c), (x, h))


def _trees(route: Route, size: tuple[float, float], away: float, count: int, rng: np.random.Generator) -> Array:
    """Trunks ``(n, 3)`` beside the route, off the building: plan position and radius [m]."""
    w, h = size
    tried = rng.uniform((-16.0, -4.0, 0.08), (w + 16.0, h + away + 6.0, 0.25), (20 * count, 3))
    off = np.maximum(np.maximum(-tried[:, :2], tried[:, :2] - [w, h]), 0.0)
    to_route = cKDTree(route.positions(route.every(0.25))[:, :2]).query(tried[:, :2])[0]
    out = np.zeros((0, 3))
    for trunk in tried[(np.hypot(off[:, 0], off[:, 1]) > 3.0) & (to_route > 1.5) & (to_route < 9.0)]:
        if len(out) < count and np.all(np.hypot(*(out - trunk)[:, :2].T) > 3.0):
            out = np.vstack([out, trunk])
    return out


def _planar(motion: RouteMotion, times: Array) -> Array:
    """Poses ``(n, 3)`` in the frame of the building [m, m, rad]."""
    p = motion.poses(times)
    return np.column_stack([p[:, :2], 2.0 * np.arctan2(p[:, 5], p[:, 6])])


def _wheels(times: Array, poses: Array, noise: Mapping[str, float], scale: float, seeds: SeedTree) -> Odometry:
    """Increments with noise that is independent from record to record."""
    exact = se2_between(poses[:-1], poses[1:])
    length = np.hypot(exact[:, 0], exact[:, 1])
    sigmas = np.hypot(np.sqrt(length)[:, None] * [noise["wheel"], noise["lateral"], noise["turn"]], _FLOOR)
    errors = scale * sigmas * seeds.generator().standard_normal(sigmas.shape)
    increments = np.vstack([np.zeros(3), se2_compose(exact, se2_exp(errors))])
    covariances = np.vstack([np.zeros((1, 3, 3)), sigmas[:, :, None] ** 2 * np.eye(3)])
    return Odometry(times=times, increments=increments, covariances=covariances)


def _imu(
    motion: RouteMotion, noise: Mapping[str, float], scale: float, seeds: SeedTree
) -> tuple[Imu, dict[str, list[float]]]:
    """A level unit above the base, and its initial biases."""
    config = CrawlerConfig(
        imu_rate=_IMU_RATE,
        gyro_bias_across=noise["gyro_bias"],
        gyro=noise["gyro"],
        gyro_walk=noise["gyro_walk"],
        accelerometer=noise["accelerometer"],
        accelerometer_bias=noise["accelerometer_bias"],
        accelerometer_walk=noise["accelerometer_walk"],
        noise_scale=scale,
    )
    yaw_bias = noise["gyro_bias"] * float(seeds.child("yaw bias").generator().standard_normal())
    imu, drawn = measure_imu(motion, config, yaw_bias, noise["gyro_bias"], seeds)
    level = replace(imu.noise, attitude=0.0, attitude_time=1.0)
    return replace(imu, attitude=None, noise=level), {k: drawn[k] for k in ("gyro_bias", "accelerometer_bias")}


def _laser(
    motion: RouteMotion, place: MixedPlace, c: MixedConfig, noise: Mapping[str, float], seeds: SeedTree
) -> LaserScans:
    """Scans of a planar laser whose beams are simultaneous."""
    bearings = np.linspace(-2.0 * math.pi / 3.0, 2.0 * math.pi / 3.0, c.beams)
    times = np.arange(int(motion.duration * c.laser_rate + 1e-9) + 1) / c.laser_rate
    empty = RangeScans(
        times=times,
        ranges=np.zeros((len(times), c.beams), np.float32),
        directions=np.column_stack([np.cos(bearings), np.sin(bearings), np.zeros(c.beams)]),
        beam_times=np.zeros(c.beams),
        max_range=c.laser_range,
        sigma=noise["laser"],
        T_base_mount=np.array([0.0, 0.0, _EYE, 0.0, 0.0, 0.0, 1.0]),
    )
    config = CrawlerConfig(max_range=c.laser_range, range_sigma=noise["laser"], noise_scale=c.noise_scale)
    scans = cast_scans(empty, motion, place.caster, config, seeds)
    return LaserScans(times=times, ranges=scans.ranges, bearings=bearings, max_range=c.laser_range)


def simulate_mixed(config: MixedConfig, seed: int) -> SensorLog:
    """Simulate the drive through the building and the park and record the sensors.

    Parameters
    ----------
    seed : int
        Same seed, same bytes. Of everything but the layout, if ``config.layout_seed`` gives that.

    Returns
    -------
    SensorLog
        Streams as in the module docstring. Planar ground truth in the frame of the first base: path at the rate of the
        IMU, trees as landmarks. ``meta``: ``datum``, pose of that frame in the frame of the fixes (E, N, heading) [m,
        rad]; ``noise``, every σ; ``drawn``, the biases of the IMU at the start; ``indoor``, times ``[from, to]`` under
        the roof; ``radii``, of the trunks [m].
    """
    c = config
    layout_seed = int(seed) if c.layout_seed is None else int(c.layout_seed)
    place, seeds = mixed_place(c, layout_seed), SeedTree(int(seed)).child("mixed", "robot")
    noise = draw_log_uniform(NOISE, seeds.child("figures"))
    drive = DriveConfig(rate=_IMU_RATE, stand=2.0, most_turn_rate=0.8)
    motion = RouteMotion(smooth_route(sample_route(place.route), drive.wheelbase), c.speed, drive)
    drops = DropCounter()

    steps = np.arange(int(motion.duration * _WHEEL_RATE + 1e-9) + 1)
    poses = _planar(motion, steps / _WHEEL_RATE)

    def every(rate: float) -> npt.NDArray[np.intp]:
        return steps[:: round(_WHEEL_RATE / rate)]

    imu, biases = _imu(motion, noise, c.noise_scale, seeds.child("imu"))
    streams: dict[str, Stream] = {
        "wheels": _wheels(steps / _WHEEL_RATE, poses, noise, c.noise_scale, seeds.child("wheels")),
        "imu": imu,
        "laser": _laser(motion, place, c, noise, seeds.child("laser")),
    }
    at = every(c.landmark_rate)
    camera = LandmarkFieldConfig(
        max_range=c.landmark_range,
        field_of_view=1.5 * math.pi,
        sigma_range=noise["range"],
        sigma_bearing=noise["bearing"],
        detection_probability=0.95,
        noise_scale=c.noise_scale,
    )
    streams["landmarks"] = observe_landmarks(
        camera, at / _WHEEL_RATE, poses[at], place.trees[:, :2], seeds, drops=drops, hidden=place.hidden
    )

    first = poses[0]
    draw = seeds.child("gps").generator()
    datum = np.array([*draw.uniform(-100.0, 100.0, 2), draw.uniform(-math.pi, math.pi)])
    at = every(c.gps_rate)
    antenna = se2_transform(poses[at], np.broadcast_to(_LEVER, (len(at), 2)))
    seen = place.outside_by(antenna) >= _SHADOW
    fixes = se2_transform(datum, se2_transform(se2_inverse(first), antenna))
    fixes += c.noise_scale * noise["gps"] * draw.standard_normal(fixes.shape)
    sigma = np.full(int(seen.sum()), noise["gps"])
    streams["gps"] = Gps(times=at[seen] / _WHEEL_RATE, positions=fixes[seen], sigma=sigma, lever=np.array(_LEVER))
    drops.drop("gps", "no fix under the roof or near the walls", int(np.sum(~seen)))

    times = np.arange(int(motion.duration * _IMU_RATE + 1e-9) + 1) / _IMU_RATE
    path = _planar(motion, times)
    truth = Truth(
        trajectory=Trajectory(times, se2_between(first, path)),
        landmark_ids=np.arange(len(place.trees), dtype=np.int64),
        landmarks=se2_transform(se2_inverse(first), place.trees[:, :2]),
    )
    meta: dict[str, Any] = {
        "source": "simulation",
        "world": "mixed",
        "seed": int(seed),
        "layout_seed": layout_seed,
        "frame": "first base",
        "length": motion.length,
        "duration": motion.duration,
        "datum": datum.tolist(),
        "noise": {**noise, "scale": c.noise_scale},
        "drawn": biases,
        "indoor": true_intervals(times, place.outside_by(path[:, :2]) == 0.0),
        "radii": place.trees[:, 2].tolist(),
        "config": {k: list(v) if isinstance(v, tuple) else v for k, v in dataclasses.asdict(c).items()},
    }
    read = {name: len(s.times) for name, s in streams.items()}
    return SensorLog(name="mixed", streams=streams, truth=truth, read=read, dropped=dict(drops.counts), meta=meta)
