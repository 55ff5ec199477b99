"""The landmark field of Combined SLAM (2012), section 5: a car drives a closed loop through point features.

Controls arrive at 40 Hz with white noise on speed and steering; a forward range-bearing sensor looks 180° and 30 m
at 5 Hz. Truth is exact: the vehicle moves with the true controls, only what it *measures* is noisy, independently
per record. Everything is in the frame of the first base pose, so no result needs an alignment.

The paper's figures (554 features, 126 submaps of about 15 features, 2 km × 2 km, one loop) do not fit into one
world. Worlds ``A`` (two laps, enough features per submap) and ``B`` (one lap as large as the paper's field) take
one half of them each; ``C`` is ``A`` with the sensor of the classic simulator.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from graphslam.core.errors import ConfigError, UnknownNameError
from graphslam.core.geometry import Array, rotation2, se2_transform, wrap_angle
from graphslam.core.log import DropCounter, SensorLog, Truth
from graphslam.core.random import SeedTree
from graphslam.core.records import AckermannGeometry, Gps, LandmarkObservations, SteeringControls, Stream
from graphslam.core.trajectory import Trajectory
from graphslam.sim.vehicle import follow_route, offset_from_route, wavy_loop

_POSITIVE = (
    *("lap_length", "laps", "wheelbase", "speed", "control_rate", "max_steering", "steering_rate", "look_ahead"),
    *("max_range", "scan_rate", "sigma_speed", "sigma_steering", "sigma_range", "sigma_bearing", "gps_sigma"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class LandmarkFieldConfig:
    """World, vehicle, sensors and noise of the landmark field; the defaults are world ``A``."""

    lap_length: float = 2230.0
    """Length of one lap of the route [m]."""
    laps: float = 2.0
    """Distance driven / lap_length; more than 1 closes the loop."""
    route_waves: int = 9
    """Waves per lap: r(θ) = R (1 + route_amplitude · sin(route_waves · θ))."""
    route_amplitude: float = 0.05
    """Wave height relative to the mean radius R."""

    landmarks: int = 554
    """Number of features, uniform along the route, on either side with equal probability."""
    lateral_min: float = 3.0
    """Least lateral distance of a feature from the route [m]."""
    lateral_max: float = 20.0
    """Greatest lateral distance of a feature from the route [m]; uniform between the two."""
    layout_seed: int | None = None
    """Seed of the feature layout. None: the run's own seed. A number holds the layout over Monte-Carlo runs."""

    wheelbase: float = 4.0
    """L of φ' = φ + V dt sin(G)/L [m]."""
    speed: float = 3.0
    """True speed V, constant [m/s]."""
    control_rate: float = 40.0
    """Controls per second [Hz]; dt = 1/control_rate."""
    max_steering: float = math.radians(30.0)
    """Limit of the true steering angle: |G| ≤ max_steering [rad]."""
    steering_rate: float = math.radians(20.0)
    """Limit of its rate: |ΔG| ≤ steering_rate · dt [rad/s]."""
    look_ahead: float = 6.0
    """Distance to the point of the route that the vehicle steers at [m]."""

    max_range: float = 30.0
    """Features farther than this are not seen [m]."""
    min_range: float = 1.0
    """Features nearer than this are not seen [m]."""
    field_of_view: float = math.pi
    """Full opening angle, centred on the heading: |bearing| ≤ field_of_view/2 [rad]."""
    scan_rate: float = 5.0
    """Scans per second [Hz]; divides control_rate. The first scan comes one period after the start."""
    detection_probability: float = 1.0
    """Probability that a visible feature is reported, independent per scan and feature."""
    clutter_rate: float = 0.0
    """Mean number of false observations per scan (Poisson), uniform over the area of the sensor's sector; id -1."""

    sigma_speed: float = 0.3
    """σ of the measured speed, independent per control record [m/s]."""
    sigma_steering: float = math.radians(3.0)
    """σ of the measured steering angle, independent per control record [rad]."""
    sigma_range: float = 0.5
    """σ of a measured range, independent per observation [m]."""
    sigma_bearing: float = math.radians(5.0)
    """σ of a measured bearing, independent per observation [rad]."""
    noise_scale: float = 1.0
    """Every drawn error is multiplied by it, the stated σ are not: 1 is honest, 0 gives exact data to check models
    with, 2 a vehicle whose data sheet lies by a factor of 2."""

    gps_rate: float = 0.0
    """GPS fixes per second [Hz]; 0 is no GPS. Divides control_rate."""
    gps_sigma: float = 1.0
    """σ of each coordinate of a fix, independent per fix [m]."""
    gps_lever: tuple[float, float] = (0.0, 0.0)
    """Antenna in the base frame [m]."""
    gps_frame: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """T_gps_base0: pose of the first base in the frame of the fixes [m, m, rad]."""

    def __post_init__(self) -> None:
        for name, n in (("gps_lever", 2), ("gps_frame", 3)):  # a configuration file gives lists
            value = tuple(float(v) for v in getattr(self, name))
            self._require(name, len(value) == n and all(map(math.isfinite, value)), f"{n} finite numbers")
            object.__setattr__(self, name, value)
        for name in _POSITIVE:
            self._require(name, getattr(self, name) > 0, "> 0")
        for name in ("route_waves", "landmarks", "min_range", "clutter_rate", "noise_scale", "gps_rate"):
            self._require(name, getattr(self, name) >= 0, "≥ 0")
        for name in [*_POSITIVE, "clutter_rate", "noise_scale", "gps_rate", "lateral_max"]:
            self._require(name, math.isfinite(getattr(self, name)), "a finite number")
        self._require("route_amplitude", 0 <= self.route_amplitude < 1, "in [0, 1)")
        self._require("lateral_min", 0 <= self.lateral_min <= self.lateral_max, "in [0, lateral_max]")
        self._require("min_range", self.min_range < self.max_range, "< max_range")
        self._require("field_of_view", 0 < self.field_of_view <= 2 * math.pi, "in (0, 2π]")
        self._require("detection_probability", 0 <= self.detection_probability <= 1, "in [0, 1]")
        self._require("look_ahead", self.look_ahead < self.lap_length / 4, "< lap_length / 4")
        self._require("scan_rate", _divides(self.scan_rate, self.control_rate), "a divisor of control_rate")
        if self.gps_rate:
            self._require("gps_rate", _divides(self.gps_rate, self.control_rate), "0 or a divisor of control_rate")
        self._require("laps", self.steps >= self.scan_stride, "long enough for one scan")

    def _require(self, name: str, ok: bool, wanted: str) -> None:
        if not ok:
            raise ConfigError(f"landmark field: {name} = {getattr(self, name)}; wanted {wanted}")

    @property
    def distance(self) -> float:
        """Distance driven [m]."""
        return self.laps * self.lap_length

    @property
    def steps(self) -> int:
        """Number of control steps."""
        return round(self.distance / self.speed * self.control_rate)

    @property
    def scan_stride(self) -> int:
        """Control steps per scan."""
        return round(self.control_rate / self.scan_rate)


def _divides(rate: float, base: float) -> bool:
    ratio = base / rate
    return ratio >= 1 - 1e-9 and abs(ratio - round(ratio)) < 1e-9 * ratio


_A = LandmarkFieldConfig()
PRESETS: Mapping[str, LandmarkFieldConfig] = {
    # two laps of 2.23 km, 0.5 m / 5° (the stated noise), about 15 features per 35 m of way
    "A": _A,
    # one lap of 5.3 km (1.65 km across, as the paper's field) and 5.5 % overlap, about 7 features per 44 m
    "B": dataclasses.replace(_A, lap_length=5300.0, laps=1.055),
    # A with the sensor of the classic simulator
    "C": dataclasses.replace(_A, sigma_range=0.1, sigma_bearing=math.radians(1.0)),
    # 480 m and a fifth of it again: closes a loop, the whole pipeline takes seconds
    "demo": dataclasses.replace(
        _A,
        lap_length=480.0,
        laps=1.2,
        route_waves=5,
        route_amplitude=0.08,
        landmarks=120,
        sigma_range=0.3,
        sigma_bearing=math.radians(3.0),
    ),
    # smaller still, for tests and notebooks in quick mode
    "quick": dataclasses.replace(
        _A,
        lap_length=120.0,
        laps=1.3,
        route_waves=3,
        route_amplitude=0.08,
        landmarks=40,
        lateral_max=12.0,
        max_range=20.0,
        sigma_range=0.2,
        sigma_bearing=math.radians(2.0),
    ),
}


def landmark_field_preset(name: str, **changes: Any) -> LandmarkFieldConfig:
    """The preset of that name with some fields changed.

    Raises
    ------
    UnknownNameError
        Unknown preset.
    ConfigError
        Unknown field or impossible value.
    """
    if name not in PRESETS:
        raise UnknownNameError("landmark-field preset", name, PRESETS)
    known = {f.name for f in dataclasses.fields(LandmarkFieldConfig)}
    for key in changes:
        if key not in known:
            raise ConfigError(f"landmark field has no field {key!r}; known: {', '.join(sorted(known))}")
    return dataclasses.replace(PRESETS[name], **changes)


@dataclass(slots=True)
class _World:
    """What is true, and the stamps at which it is looked at."""

    config: LandmarkFieldConfig
    seeds: SeedTree
    poses: Array
    steering: Array
    landmarks: Array
    drops: DropCounter = field(default_factory=DropCounter)

    def stamps(self, step: np.ndarray) -> Array:
        """Time of control step numbers; one formula for all streams, so equal instants have equal stamps."""
        return np.asarray(step / self.config.control_rate, dtype=np.float64)

    def noise(self, stream: str) -> np.random.Generator:
        return self.seeds.child("noise", stream).generator()


def landmark_layout(config: LandmarkFieldConfig, seed: int) -> tuple[Array, Array]:
    """Route ``(m, 2)`` and features ``(n, 2)`` in the first base's frame, from the layout's own branch of the seed."""
    route = wavy_loop(config.lap_length, config.route_waves, config.route_amplitude)
    layout_seed = seed if config.layout_seed is None else config.layout_seed
    rng = SeedTree(layout_seed).child("landmark-field", "layout").generator()
    s = rng.uniform(0.0, config.lap_length, config.landmarks)
    side = rng.choice([-1.0, 1.0], config.landmarks)
    lateral = rng.uniform(config.lateral_min, config.lateral_max, config.landmarks)
    return route, offset_from_route(route, s, side * lateral)


def _measure_controls(world: _World) -> SteeringControls:
    c, rng = world.config, world.noise("controls")
    n = len(world.steering)
    return SteeringControls(
        times=world.stamps(np.arange(n)),
        speed=c.speed + c.noise_scale * c.sigma_speed * rng.standard_normal(n),
        steering=world.steering + c.noise_scale * c.sigma_steering * rng.standard_normal(n),
        geometry=AckermannGeometry(wheelbase=c.wheelbase, model="front-steer"),
    )


def _visible(c: LandmarkFieldConfig, poses: Array, landmarks: Array) -> tuple[np.ndarray, np.ndarray, Array, Array]:
    """(scan, landmark, range, bearing) of every feature inside the sensor's sector."""
    if not len(landmarks):
        none = np.zeros(0)
        return none.astype(np.intp), none.astype(np.intp), none, none
    near = cKDTree(poses[:, :2]).sparse_distance_matrix(cKDTree(landmarks), c.max_range, output_type="ndarray")
    i, j = near["i"], near["j"]
    d = np.einsum("ij,ijk->ik", landmarks[j] - poses[i, :2], rotation2(poses[i, 2]))  # Rᵀ (l - p)
    rng_m, bearing = np.hypot(d[:, 0], d[:, 1]), np.arctan2(d[:, 1], d[:, 0])
    # the tree finds what lies within max_range up to rounding; the limits are the configuration's
    seen = (rng_m <= c.max_range) & (rng_m >= c.min_range) & (np.abs(bearing) <= c.field_of_view / 2)
    return i[seen], j[seen], rng_m[seen], bearing[seen]


def _measure_landmarks(world: _World) -> LandmarkObservations:
    c, rng = world.config, world.noise("landmarks")
    steps = np.arange(c.scan_stride, c.steps + 1, c.scan_stride)
    scan, ids, ranges, bearings = _visible(c, world.poses[steps], world.landmarks)
    # the tree's order is its own affair: sort, so that the draws below belong to the same features everywhere
    order = np.lexsort((ids, scan))
    scan, ids, ranges, bearings = scan[order], ids[order], ranges[order], bearings[order]

    detected = rng.random(len(scan)) < c.detection_probability
    ranges = ranges + c.noise_scale * c.sigma_range * rng.standard_normal(len(scan))
    bearings = bearings + c.noise_scale * c.sigma_bearing * rng.standard_normal(len(scan))
    world.drops.drop("landmarks", "visible but not detected", int(np.sum(~detected)))
    world.drops.drop("landmarks", "measured range not positive", int(np.sum(detected & (ranges <= 0))))
    keep = detected & (ranges > 0)

    clutter = world.noise("clutter")
    counts = clutter.poisson(c.clutter_rate, len(steps))
    q = int(counts.sum())
    # uniform over the area of the sector: r² is uniform
    clutter_ranges = np.sqrt(clutter.uniform(c.min_range**2, c.max_range**2, q))
    clutter_bearings = clutter.uniform(-c.field_of_view / 2, c.field_of_view / 2, q)

    scan = np.concatenate([scan[keep], np.repeat(np.arange(len(steps)), counts)])
    ids = np.concatenate([ids[keep], np.full(q, -1)])
    ranges = np.concatenate([ranges[keep], clutter_ranges])
    bearings = wrap_angle(np.concatenate([bearings[keep], clutter_bearings]))
    order = np.lexsort((bearings, scan))  # right to left, as a sensor sweeps: the order tells nothing of identity
    sigmas = np.tile([c.sigma_range, c.sigma_bearing], (len(scan), 1))
    return LandmarkObservations(
        times=world.stamps(steps),
        offsets=np.searchsorted(scan[order], np.arange(len(steps) + 1)),
        ranges=ranges[order],
        bearings=bearings[order],
        sigmas=sigmas,
        ids=ids[order].astype(np.int64),
        max_range=c.max_range,
        field_of_view=(-c.field_of_view / 2, c.field_of_view / 2),
    )


def _measure_gps(world: _World) -> Gps:
    c, rng = world.config, world.noise("gps")
    stride = round(c.control_rate / c.gps_rate)
    steps = np.arange(0, c.steps + 1, stride)
    antenna = se2_transform(world.poses[steps], np.broadcast_to(c.gps_lever, (len(steps), 2)))
    fixes = se2_transform(np.asarray(c.gps_frame), antenna)
    return Gps(
        times=world.stamps(steps),
        positions=fixes + c.noise_scale * c.gps_sigma * rng.standard_normal(fixes.shape),
        sigma=np.full(len(steps), c.gps_sigma),
        lever=np.asarray(c.gps_lever),
    )


def simulate_landmark_field(config: LandmarkFieldConfig, seed: int) -> SensorLog:
    """Simulate one run.

    Parameters
    ----------
    config : LandmarkFieldConfig
    seed : int
        Same seed, same bytes. Layout and each stream's noise hang from branches of their own, so switching GPS or
        clutter on does not change the rest, and ``config.layout_seed`` holds the features over runs.

    Returns
    -------
    SensorLog
        Streams ``controls`` (measured, zero-order hold), ``landmarks`` (true ids, -1 for clutter) and, if asked
        for, ``gps``; truth at the control rate, one pose more than controls. ``meta`` states every figure.
    """
    route, landmarks = landmark_layout(config, seed)
    poses, steering = follow_route(
        route,
        config.steps,
        speed=config.speed,
        dt=1.0 / config.control_rate,
        wheelbase=config.wheelbase,
        max_steering=config.max_steering,
        steering_rate=config.steering_rate,
        look_ahead=config.look_ahead,
    )
    world = _World(config, SeedTree(seed).child("landmark-field"), poses, steering, landmarks)
    streams: dict[str, Stream] = {"controls": _measure_controls(world), "landmarks": _measure_landmarks(world)}
    if config.gps_rate:
        streams["gps"] = _measure_gps(world)
    truth = Truth(
        trajectory=Trajectory(world.stamps(np.arange(len(poses))), poses),
        landmark_ids=np.arange(len(landmarks), dtype=np.int64),
        landmarks=landmarks,
    )
    return SensorLog(
        name="landmark-field",
        streams=streams,
        truth=truth,
        read={name: len(s.times) for name, s in streams.items()},
        dropped=dict(world.drops.counts),
        meta=_meta(config, seed),
    )


def _meta(config: LandmarkFieldConfig, seed: int) -> dict[str, Any]:
    """Figures of the world as JSON can hold them."""
    plain = {k: list(v) if isinstance(v, tuple) else v for k, v in dataclasses.asdict(config).items()}
    return {
        "source": "simulation",
        "world": "landmark-field",
        "seed": int(seed),
        "layout_seed": int(seed if config.layout_seed is None else config.layout_seed),
        "frame": "first base",
        "geometry": {"model": "front-steer", "wheelbase": config.wheelbase},
        "noise": {
            "speed": config.sigma_speed,
            "steering": config.sigma_steering,
            "range": config.sigma_range,
            "bearing": config.sigma_bearing,
            "gps": config.gps_sigma if config.gps_rate else None,
            "scale": config.noise_scale,
            "units": "m/s, rad, m, rad, m; standard deviations, independent per record",
        },
        "config": plain,
    }
