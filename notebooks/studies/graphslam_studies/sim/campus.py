"""A self-balancing robot drives over a campus, outside and through buildings, with two lasers, an IMU, wheels and GPS.

After Montemerlo and Thrun's Segway (2005): it pitches all the time to keep its balance, one laser
scans a vertical plane to its left, another pans from side to side in front of it, and GPS is there outside only.
"""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from typing import Any

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.log import BeamLabels, SensorLog, Truth
from graphslam.core.random import SeedTree
from graphslam.core.range_scans import RangeScans
from graphslam.core.records import Gps, Stream, VelocityControls
from graphslam.core.se3 import se3_inverse
from graphslam.sim.crawler import start_frame
from graphslam.sim.crawler_config import CrawlerConfig
from graphslam.sim.crawler_sensors import cast_scans, measure_imu, measure_wheels, ornstein_uhlenbeck
from graphslam.sim.drive import DriveConfig, RouteMotion, SampledRoute, sample_route, smooth_route
from graphslam.sim.mixed import true_intervals
from graphslam.sim.raycast import RayCaster
from graphslam.sim.world import World
from graphslam_studies.sim.campus_config import CampusConfig
from graphslam_studies.sim.campus_plan import plan_campus
from graphslam_studies.sim.campus_world import campus
from graphslam_studies.sim.gps_shadowing import measure_gps
from graphslam_studies.sim.movers import Mover, MovingObjects, draw_movers

_LEANS = 4  # waves that the pitch is made of
PANNING_MOUNT = (0.25, 0.0, 0.9, -0.5, -0.5, -0.5, 0.5)
"""T_base_mount of the panning laser: its axis (x of the mount) is upright, and y of the mount looks ahead."""
VERTICAL_MOUNT = (0.0, 0.15, 0.9, 0.0, 0.0, 0.0, 1.0)
"""T_base_mount of the vertical laser, which does not turn: its beams are in the y-z plane of the base."""
VERTICAL_MIDDLE = np.deg2rad(20.0)
"""Elevation of the middle beam of the vertical laser, to the left [rad]: so it sees kerbs, façades and ceilings."""


class Balancing(RouteMotion):
    """A drive whose base pitches to keep its balance: the sum of some waves, never more than the greatest lean.

    Parameters
    ----------
    way : SampledRoute
        Of the base: the middle of the axle.
    lean : float
        Greatest pitch [rad].
    rate : float
        Frequency, about [Hz].
    tree : SeedTree
        Draws the waves.
    """

    def __init__(
        self, route: SampledRoute, speed: float, config: DriveConfig, lean: float, rate: float, tree: SeedTree
    ) -> None:
        super().__init__(route, speed, config)
        rng = tree.generator()
        share = rng.dirichlet(np.ones(_LEANS))
        self._amplitude = lean * share
        self._omega = 2.0 * np.pi * rate * rng.uniform(0.7, 1.3, _LEANS)
        self._phase = rng.uniform(0.0, 2.0 * np.pi, _LEANS)

    def lean(self, t: Array) -> tuple[Array, Array, Array]:
        """Pitch that the balance takes ``(n,)`` [rad], and its first two derivatives."""
        x = np.asarray(t)[..., None] * self._omega + self._phase
        a, w = self._amplitude, self._omega
        return np.sin(x) @ a, np.cos(x) @ (a * w), -np.sin(x) @ (a * w**2)

    def _angles(self, t: Array) -> tuple[Array, Array, Array]:
        out = []
        for angles, lean in zip(super()._angles(t), self.lean(t)):
            angles = np.array(angles)
            angles[..., 1] += lean
            out.append(angles)
        return out[0], out[1], out[2]


def campus_motion(world: World, config: CampusConfig, tree: SeedTree) -> Balancing:
    """The true motion of the robot's base, the middle of its axle, in the frame of the world."""
    drive = DriveConfig(rate=config.imu_rate, wheelbase=0.6)
    route = smooth_route(sample_route(world.route()), drive.wheelbase)
    route = replace(route, positions=route.positions + [0.0, 0.0, config.axle])
    return Balancing(route, world.speed, drive, config.lean, config.lean_rate, tree.child("balance"))


def sensors_of(config: CampusConfig, drawn: dict[str, float]) -> CrawlerConfig:
    """The figures of a session's lasers, IMU and wheels, in the words of the crawler, whose models they share."""
    return CrawlerConfig(
        beams=config.beams,
        fan=config.fan,
        scan_rate=config.line_rate / config.every,
        sweep_time=config.line_time,
        max_range=config.max_range,
        range_sigma=drawn["range_sigma"],
        drop_out=config.drop_out,
        imu_rate=config.imu_rate,
        imu_mount=(0.0, 0.0, 0.4, 0.0, 0.0, 0.0, 1.0),
        gyro=drawn["gyro"],
        gyro_bias_across=drawn["gyro_bias"],
        gyro_walk=drawn["gyro_walk"],
        attitude_sigma=drawn["attitude_sigma"],
        wheel_rate=config.wheel_rate,
        wheel_scale=drawn["wheel_scale"],
        wheel_sigma=drawn["wheel_sigma"],
        noise_scale=config.noise_scale,
    )


def pan_angle(config: CampusConfig, t: Array) -> Array:
    """Angle ``(n,)`` [rad] of the panning laser at times ``(n,)``: from side to side at a constant rate."""
    phase = np.mod(np.asarray(t) / config.sweep, 2.0)
    return config.pan * (1.0 - 2.0 * np.abs(phase - 1.0))


def empty_scans(config: CampusConfig, duration: float, sigma: float) -> dict[str, RangeScans]:
    """Stamps, directions and true angles of both lasers; ranges are 0."""
    c = config
    kept = np.arange(0, c.beams, c.every_beam)
    elevation = np.linspace(-0.5 * c.fan, 0.5 * c.fan, c.beams)[kept]
    step = c.every / c.line_rate
    count = int(np.floor((duration - c.line_time) / step + 1e-9)) + 1
    times = step * np.arange(count, dtype=np.float64)
    zeros = np.zeros(len(kept))
    # mounts: x up for the panning head; the vertical laser is the base's own y-z plane
    ahead = np.column_stack([np.sin(elevation), np.cos(elevation), zeros])
    tilted = elevation + VERTICAL_MIDDLE
    aside = np.column_stack([zeros, np.cos(tilted), np.sin(tilted)])
    begin = pan_angle(c, times)
    rate = (pan_angle(c, times + max(c.line_time, 1e-6)) - begin) / max(c.line_time, 1e-6)
    out = {}
    for name, mount, directions, spin, spin_rate in (
        ("panning", PANNING_MOUNT, ahead, begin, rate),
        ("vertical", VERTICAL_MOUNT, aside, np.zeros(len(times)), np.zeros(len(times))),
    ):
        out[name] = RangeScans(
            times=times,
            ranges=np.zeros((len(times), len(kept)), np.float32),
            directions=directions,
            beam_times=np.linspace(0.0, c.line_time, c.beams)[kept],
            max_range=c.max_range,
            sigma=sigma,
            T_base_mount=np.array(mount),
            spin=spin,
            spin_rate=spin_rate,
        )
    return out


def movers_of(world: World, config: CampusConfig, motion: RouteMotion, seed: int, tree: SeedTree) -> list[Mover]:
    """Cars on the streets, people beside them and in the corridors that the robot drives."""
    plan = plan_campus(config, seed)
    lines: list[tuple[str, Array, Array, float]] = []
    for a, b in plan.streets():
        u = (b - a) / np.linalg.norm(b - a)
        left = np.array([-u[1], u[0]])
        for side in (-1.0, 1.0):
            lines.append(("car", a + side * 2.3 * left, b + side * 2.3 * left, 0.0))
            lines.append(("person", a + side * 1.6 * left, b + side * 1.6 * left, 0.0))
    for corridor in world.meta["corridors"]:
        corner = np.array(corridor["corner"])
        for end in np.array(corridor["ends"]):
            u = (end - corner) / np.linalg.norm(end - corner)
            left = np.array([-u[1], u[0]])
            lines += [
                ("person", corner + u + side * left, end - 2.0 * u + side * left, corridor["floor"])
                for side in (-1.0, 1.0)
            ]
    times = np.arange(0.0, motion.duration, 0.25)
    return draw_movers(lines, config.movers, times, motion.poses(times)[:, :3], tree.generator())


def slip_wheels(wheels: VelocityControls, sigma: float, time: float, scale: float, tree: SeedTree) -> VelocityControls:
    """Wheels that slip: the speed has a relative error that comes and goes."""
    step = float(np.median(np.diff(wheels.times)))
    slip = ornstein_uhlenbeck(tree.generator(), (len(wheels.times), 1), sigma, time, step)[:, 0]
    return replace(wheels, speed=wheels.speed * (1.0 + scale * slip))


def simulate_campus(
    config: CampusConfig, seed: int, *, world_seed: int | None = None, progress: bool = False
) -> SensorLog:
    """Drive a session over a campus and record it.

    Parameters
    ----------
    seed : int
        Of every error, and of what moves.
    world_seed : int, optional
        Of the campus, where it shall not be ``seed``: sessions of one place have different seeds and one of these.
    progress : bool
        Show a progress bar on stderr.

    Returns
    -------
    SensorLog
        Streams ``panning`` and ``vertical`` (RangeScans), ``imu`` (Imu), ``wheels`` (VelocityControls) and ``gps``
        (Gps; east, north, up of the campus). Truth: the path at the rate of the IMU in the frame of the first base made
        level, and ``moving``, which beams met cars and people. ``meta``: every figure, what was drawn,
        ``T_world_frame`` (7,), ``indoor`` (times ``[from, to]`` under a roof), ``corridors`` (angle between the two
        legs of each [rad], and the times in each leg), ``movers``.
    """
    c, place = config, seed if world_seed is None else world_seed
    world = campus(c, seed=place)
    caster = RayCaster.of(world)
    seeds = SeedTree(int(seed)).child("campus", "robot", c.session)
    drawn = c.draw(seeds.child("figures"))
    motion = campus_motion(world, c, seeds)
    sensors = sensors_of(c, drawn)

    movers = movers_of(world, c, motion, place, seeds.child("movers"))
    streams: dict[str, Stream] = {}
    moving = {}
    for name, scans in empty_scans(c, motion.duration, drawn["range_sigma"]).items():
        passers = MovingObjects(movers, scans.ranges.shape, c.max_range)
        cast = cast_scans(scans, motion, caster, sensors, seeds.child(name), nearer=passers, progress=progress)
        assert cast.spin is not None
        spin = cast.spin + c.encoder_offset if name == "panning" else cast.spin
        streams[name] = replace(cast, times=cast.times + c.clock_offset, spin=spin)
        returned = np.isfinite(cast.ranges) & (cast.ranges < c.max_range)
        moving[name] = BeamLabels(cast.times + c.clock_offset, np.where(returned, passers.labels, -1))
    bias = drawn["gyro_bias"] * float(seeds.child("yaw bias").generator().standard_normal())
    streams["imu"], constants = measure_imu(motion, sensors, bias, drawn["gyro_bias"], seeds.child("imu"))
    wheels, scales = measure_wheels(motion, sensors, seeds.child("wheels"))
    streams["wheels"] = slip_wheels(wheels, drawn["slip"], c.slip_time, c.noise_scale, seeds.child("slip"))
    fixes = measure_gps(motion, caster, c, drawn, seeds.child("gps"))
    streams["gps"] = Gps(
        times=fixes.times,
        positions=fixes.positions,
        sigma=np.sqrt(0.5 * (fixes.covariances[:, 0, 0] + fixes.covariances[:, 1, 1])),
        lever=np.array(c.lever),
        covariances=fixes.covariances,
    )

    frame = start_frame(motion)
    truth = motion.trajectory()
    meta: dict[str, Any] = {
        "source": "simulation",
        "robot": "campus",
        "world": world.name,
        "seed": int(seed),
        "frame": "first base, z up",
        "T_world_frame": frame.tolist(),
        "length": motion.length,
        "duration": motion.duration,
        "world_meta": dict(world.meta),
        "mesh": {"vertices": len(world.vertices), "triangles": len(world.triangles)},
        "config": {k: list(v) if isinstance(v, tuple) else v for k, v in dataclasses.asdict(c).items()},
        "noise": drawn,
        "drawn": {**constants, "wheel_scale": scales.speed, "turn_scale": scales.turn},
        "movers": [{"kind": m.kind, "speed": m.speed} for m in movers],
        "indoor": true_intervals(truth.times, plan_campus(c, place).inside(truth.poses)),
        "corridors": [
            {**corridor, "legs": legs_of(corridor, truth.times, truth.poses)} for corridor in world.meta["corridors"]
        ],
        "gps_hidden": int(fixes.hidden.sum()),
    }
    read = {name: len(s.times) for name, s in streams.items()}
    path = truth.transformed(se3_inverse(frame))
    return SensorLog(name=world.name, streams=streams, truth=Truth(path, moving=moving), read=read, meta=meta)


def legs_of(corridor: dict[str, Any], times: Array, poses: Array) -> list[list[list[float]]]:
    """Times ``[from, to]`` of every drive along either leg of a corridor, 2 m from the corner and the doors."""
    corner = np.array(corridor["corner"])
    out = []
    for end in np.array(corridor["ends"]):
        length = float(np.linalg.norm(end - corner))
        u = (end - corner) / length
        d = poses[:, :2] - corner
        along, across = d @ u, d @ np.array([-u[1], u[0]])
        out.append(true_intervals(times, (along > 2.0) & (along < length - 2.0) & (np.abs(across) < 1.0)))
    return out
