"""A 3-D lidar that is carried or driven through a world: scans with a stamp for every point, and truth.

Lidars differ in what they see at once: one that spins sees all around in lines, one with a narrow view sees ±35° in a
rosette that fills up. Carriers differ in how they move: a hand turns the lidar by ten degrees and more between scans.
Both are drawn from the seed, within what is written here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array
from graphslam.core.imu import GRAVITY, Imu, ImuNoise
from graphslam.core.log import SensorLog, Truth
from graphslam.core.point_clouds import PointClouds
from graphslam.core.random import SeedTree
from graphslam.core.trajectory import Trajectory
from graphslam.sim.drive import DriveConfig, drive_motion
from graphslam.sim.raycast import RayCaster

if TYPE_CHECKING:
    from graphslam.sim.world import World

_FINE = 200.0
"""Poses a second of the true path [Hz]; between them it is even."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LidarConfig:
    """A lidar and what carries it."""

    pattern: str = "spinning"
    """``spinning``: lines all around; ``rosette``: a cone ahead."""
    rate: float = 10.0
    """Scans recorded per second [Hz]; each lasts ``sweep``."""
    sweep: float = 0.1
    """Time of a scan [s]."""
    points: int = 6000
    """Beams of a scan."""
    lines: int = 32
    """Of a spinning lidar."""
    elevation: tuple[float, float] = (-25.0, 15.0)
    """Of its lowest and highest line [deg]."""
    half_angle: float = 35.0
    """Of the cone of a rosette [deg]."""
    range_sigma: float = 0.02
    """σ of a range [m]."""
    beam_sigma: float = 0.0
    """σ of an error that each line, or each twentieth of a rosette, keeps [m]."""
    max_range: float = 100.0
    """[m]"""
    height: float = 1.2
    """Of the lidar over the floor [m]."""
    sway: float = 0.0
    """σ of roll, pitch and yaw by which a hand moves the lidar beside the way [rad] …"""
    sway_time: float = 1.0
    """… and the time in which it does so [s]."""
    bob: float = 0.0
    """σ of its position [m], over the same time."""
    imu: ImuNoise | None = None
    """Of an IMU beside it; None: it has none."""
    imu_rate: float = 200.0
    """Readings per second [Hz]."""
    T_base_imu: tuple[float, ...] = (0.05, -0.03, -0.06, 0.0, 0.0, 1.0, 0.0)
    """Where it is: turned by half a turn about the vertical."""

    def __post_init__(self) -> None:
        if self.pattern not in ("spinning", "rosette"):
            raise ConfigError(f"lidar: pattern = {self.pattern!r}; known: spinning, rosette")
        for name in ("rate", "sweep", "points", "lines", "half_angle", "max_range", "height", "sway_time", "imu_rate"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ConfigError(f"lidar: {name} = {getattr(self, name)}; wanted > 0")
        for name in ("range_sigma", "beam_sigma", "sway", "bob"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise ConfigError(f"lidar: {name} = {getattr(self, name)}; wanted ≥ 0")
        if self.sweep > 1.0 / self.rate + 1e-9:
            raise ConfigError(f"lidar: a sweep of {self.sweep} s does not fit {self.rate} scans per second")


def drawn_lidar(seed: int) -> LidarConfig:
    """A lidar and its carrier as they may come: on wheels or in a hand, spinning or with a narrow view."""
    r = SeedTree(int(seed)).child("drawn-lidar").generator()
    hand = r.random() < 0.5
    spinning = r.random() < 0.6
    rate = float(r.choice([2.0, 2.5, 5.0] if hand else [5.0, 10.0]))
    return LidarConfig(
        pattern="spinning" if spinning else "rosette",
        rate=rate,
        sweep=0.1,
        points=int(r.integers(4000, 12000)),
        lines=int(r.choice([16, 32, 64])),
        half_angle=float(r.uniform(30.0, 45.0)),
        range_sigma=float(r.uniform(0.01, 0.04)),
        beam_sigma=float(r.uniform(0.0, 0.01)),
        height=float(r.uniform(0.5, 1.6)),
        sway=float(np.deg2rad(r.uniform(2.0, 5.0))) if hand else 0.0,
        sway_time=float(r.uniform(1.0, 2.0)),
        bob=float(r.uniform(0.02, 0.06)) if hand else 0.0,
    )


def drawn_imu(seed: int) -> ImuNoise:
    """An IMU as lidars carry them: densities of data sheets of small units, up to ten times as much where it shakes."""
    r = SeedTree(int(seed)).child("drawn-imu").generator()
    gyro, force = np.exp(r.uniform(np.log([1e-4, 1e-3]), np.log([1e-3, 1e-2])))
    return ImuNoise(
        gyro=float(gyro),
        gyro_bias=float(r.uniform(1e-3, 1e-2)),
        gyro_walk=1e-4,
        accelerometer=float(force),
        accelerometer_bias=float(r.uniform(0.01, 0.1)),
        accelerometer_walk=1e-3,
    )


def simulate_lidar(world: World, seed: int, config: LidarConfig = LidarConfig(), *, most: float = np.inf) -> SensorLog:
    """Carry a lidar through a world.

    Parameters
    ----------
    seed : int
        Of every error drawn.
    most : float
        Stop after so much time [s].

    Returns
    -------
    SensorLog
        Stream ``clouds`` (PointClouds with times of points), and ``imu`` (Imu) where there is one. Truth in the frame
        of the world.
    """
    caster = RayCaster.of(world)
    motion = drive_motion(world, DriveConfig(), caster)
    tree = SeedTree(int(seed)).child("lidar")
    end = min(motion.duration, most)
    fine = np.arange(int(end * _FINE) + 1) / _FINE
    base = motion.poses(fine)
    sway = tree.child("sway").generator()
    # smooth: a running mean of white noise over the sway's time, twice
    width = max(int(config.sway_time * _FINE / 2), 1)
    kernel = np.hanning(2 * width + 1)
    kernel /= np.sqrt(np.sum(kernel**2))
    raw = sway.standard_normal((len(fine) + 2 * width, 6))
    moved = np.stack([np.convolve(raw[:, k], kernel, mode="valid") for k in range(6)], axis=1)
    hand = se3.se3_exp(moved * ([config.sway] * 3 + [config.bob] * 3))
    up = np.array([0.0, 0, config.height, 0, 0, 0, 1])
    truth = Trajectory(fine, se3.se3_compose(se3.se3_compose(base, up), hand))

    n = int((end - config.sweep) * config.rate)
    times = config.sweep + np.arange(n) / config.rate
    bias = tree.child("beams").generator().normal(0.0, config.beam_sigma, 64) if config.beam_sigma else np.zeros(64)
    rows, ages, counts = [], [], []
    for k in range(n):
        r = tree.child("scan", k).generator()
        directions, before, line = _beams(config, r, k)
        poses = truth.interpolate(times[k] - before)
        rays = np.hstack([poses[:, :3], se3.quat_rotate(poses[:, 3:], directions)])
        ranges = caster.ranges(rays)
        met = np.isfinite(ranges) & (ranges < config.max_range) & (ranges > 0.3)
        read = ranges[met] + r.normal(0.0, config.range_sigma, int(met.sum())) + bias[line[met] % 64]
        rows.append(directions[met] * read[:, None])
        ages.append(before[met])
        counts.append(len(read))
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    points = np.concatenate(rows) if rows else np.zeros((0, 3))
    streams: dict[str, Any] = {
        "clouds": PointClouds.from_arrays(times, points, offsets, np.concatenate(ages) if ages else np.zeros(0))
    }
    if config.imu is not None:
        streams["imu"] = _imu(truth, config, config.imu, tree.child("imu").generator())
    meta = {"source": "simulation", "robot": "lidar", "world": world.name, "seed": int(seed)}
    return SensorLog(name=f"lidar-{world.name}", streams=streams, truth=Truth(trajectory=truth), meta=meta)


def _imu(truth: Trajectory, config: LidarConfig, noise: ImuNoise, r: np.random.Generator) -> Imu:
    """Readings of a unit that is carried along a path, by differences of its poses half a reading apart."""
    dt = 1.0 / config.imu_rate
    t = np.arange(1, int((truth.times[-1] - 2.0 * dt) * config.imu_rate)) * dt
    unit = np.asarray(config.T_base_imu, dtype=np.float64)
    before, now, after = (
        se3.se3_compose(truth.interpolate(t + k * dt), np.broadcast_to(unit, (len(t), 7))) for k in (-1, 0, 1)
    )
    rate = se3.so3_log(se3.se3_between(before, after)[:, 3:]) / (2.0 * dt)
    force = (after[:, :3] - 2.0 * now[:, :3] + before[:, :3]) / dt**2 + [0.0, 0.0, GRAVITY]
    force = se3.quat_rotate(now[:, 3:] * [-1.0, -1.0, -1.0, 1.0], force)

    def errors(density: float, bias: float, walk: float) -> Array:
        constant = bias * r.standard_normal(3)
        walked = np.cumsum(np.sqrt(dt) * walk * r.standard_normal((len(t), 3)), axis=0)
        return np.asarray(constant + walked + density / np.sqrt(dt) * r.standard_normal((len(t), 3)))

    return Imu(
        times=np.asarray(t),
        angular_rate=rate + errors(noise.gyro, noise.gyro_bias, noise.gyro_walk),
        specific_force=force + errors(noise.accelerometer, noise.accelerometer_bias, noise.accelerometer_walk),
        noise=noise,
        T_base_imu=unit,
    )


def _beams(config: LidarConfig, r: np.random.Generator, k: int) -> tuple[Array, Array, npt.NDArray[np.int64]]:
    """Directions ``(m, 3)``, ages ``(m,)`` and lines ``(m,)`` of the beams of scan ``k``."""
    if config.pattern == "spinning":
        columns = max(config.points // config.lines, 1)
        azimuth = np.repeat(2.0 * np.pi * (np.arange(columns) + r.random()) / columns, config.lines)
        line = np.tile(np.arange(config.lines), columns)
        low, high = np.deg2rad(config.elevation)
        elevation = low + (high - low) * line / max(config.lines - 1, 1)
    else:
        # two turns whose ratio is no simple fraction: a rosette, another one in every scan
        m = config.points
        phase = 2.0 * np.pi * (np.arange(m) / m * 23.17 + k * 0.618034)
        off = np.deg2rad(config.half_angle) * np.cos(phase)
        around = 2.0 * np.pi * (np.arange(m) / m * 3.57 + k * 0.381966)
        azimuth, elevation = off * np.cos(around), off * np.sin(around)
        line = np.arange(m) * 20 // m
    c = np.cos(elevation)
    directions = np.stack([c * np.cos(azimuth), c * np.sin(azimuth), np.sin(elevation)], axis=1)
    before = config.sweep * (1.0 - (np.arange(len(directions)) + 1) / len(directions))
    return directions, before, line.astype(np.int64)
