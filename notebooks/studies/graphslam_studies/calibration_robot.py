"""Random robots of the calibration study, and simulated logs that state a quarter of their true σ."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphslam.core.geometry import Array, se2_between, se2_compose, se2_exp, se2_log, wrap_angle
from graphslam.core.log import SensorLog, Truth
from graphslam.core.random import SeedTree
from graphslam.core.records import LandmarkObservations, Odometry
from graphslam.core.trajectory import Trajectory

FINE = 0.02
"""Step of the true path [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawnRobot:
    """True parameters of a robot.

    Sigmas as in :class:`graphslam.calibrate.corrections.Corrections`; ``correlated_…``: σ of Gauss–Markov errors of yaw
    rate [rad/s] and speed [m/s] with time constant ``memory`` [s].
    """

    speed: float
    along_metre: float
    lateral_metre: float
    heading_metre: float
    heading_radian: float
    heading_second: float
    yaw_bias: float
    distance_scale: float
    range_sigma: float
    bearing_sigma: float
    range_offset: float
    sensor_yaw: float
    clock: float
    range_scale: float = 1.0
    correlated_rate: float = 0.0
    correlated_speed: float = 0.0
    memory: float = 5.0


def draw_robot(seed: int, *, correlated: bool = False) -> DrawnRobot:
    """A random robot: log-uniform sigmas; normally distributed constants, except for a uniform clock offset."""
    rng = SeedTree(seed).child("calibration", "robot").generator()

    def between(a: float, b: float) -> float:
        return float(np.exp(rng.uniform(np.log(a), np.log(b))))

    return DrawnRobot(
        speed=between(0.6, 3.0),
        along_metre=between(0.01, 0.12),
        lateral_metre=between(0.005, 0.05),
        heading_metre=between(0.002, 0.02),
        heading_radian=between(0.005, 0.08),
        heading_second=between(0.001, 0.02),
        yaw_bias=float(rng.normal(0.0, np.deg2rad(1.0))),
        distance_scale=float(1.0 + 0.04 * rng.standard_normal()),
        range_sigma=between(0.03, 0.3),
        bearing_sigma=float(np.deg2rad(between(0.3, 3.0))),
        range_offset=float(0.2 * rng.standard_normal()),
        sensor_yaw=float(np.deg2rad(2.0) * rng.standard_normal()),
        clock=float(rng.uniform(-0.25, 0.25)),
        correlated_rate=between(0.01, 0.06) if correlated else 0.0,
        correlated_speed=between(0.01, 0.1) if correlated else 0.0,
    )


def drive(robot: DrawnRobot, seed: int, seconds: float = 120.0, *, rate: float = 10.0, scans: float = 4.0) -> SensorLog:
    """A log of the robot on a random path, with ground truth; the stated σ are a quarter of the true ones.

    Parameters
    ----------
    rate : float
        Rate of odometry [1/s].
    scans : float
        Rate of landmark scans [1/s].
    """
    rng = SeedTree(seed).child("calibration", "drive").generator()
    t, poses = _path(robot, seconds, rng)
    truth = Trajectory(t, poses)
    size = 8.0 + 6.0 * robot.speed
    low, high = poses[:, :2].min(axis=0) - size, poses[:, :2].max(axis=0) + size
    marks = rng.uniform(low, high, (int(np.clip(np.prod(high - low) / size**2 * 5.0, 40, 4000)), 2))
    stamps = np.arange(0.0, seconds - 1e-9, 1.0 / rate)
    odometry = _odometry(robot, truth, stamps, rng)
    detections = _observations(robot, truth, marks, size, np.arange(0.5, seconds - 0.5, 1.0 / scans), rng)
    return SensorLog(
        name=f"drawn-robot-{seed}",
        streams={"odometry": odometry, "landmarks": detections},
        truth=Truth(trajectory=truth, landmark_ids=np.arange(len(marks), dtype=np.int64), landmarks=marks),
        meta={"source": "simulation", "world": "drawn-robot", "seed": int(seed)},
    )


def _path(robot: DrawnRobot, seconds: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Times and poses of a drive with random turns that returns towards the origin when it is far away."""
    n = int((seconds + 2.0) / FINE) + 1
    t: Array = np.arange(n, dtype=np.float64) * FINE - 1.0  # starts at -1 s, because of clock offsets
    poses: Array = np.zeros((n, 3))
    turn, speed, reach = 0.0, robot.speed, 12.0 * robot.speed + 10.0
    hold = np.exp(-FINE / 4.0)
    for k in range(1, n):
        x, y, th = poses[k - 1]
        home = float(wrap_angle(np.arctan2(-y, -x) - th)) if np.hypot(x, y) > reach else 0.0
        turn = hold * turn + 0.5 * np.sqrt(1 - hold**2) * rng.standard_normal() + 0.02 * home
        speed = (
            robot.speed
            + hold * (speed - robot.speed)
            + 0.25 * robot.speed * np.sqrt(1 - hold**2) * (rng.standard_normal())
        )
        poses[k] = se2_compose(poses[k - 1], se2_exp(np.array([max(speed, 0.0) * FINE, 0.0, turn * FINE])))
    return t, poses


def _odometry(robot: DrawnRobot, truth: Trajectory, stamps: Array, rng: np.random.Generator) -> Odometry:
    r = robot
    at = truth.interpolate(np.clip(stamps - r.clock, truth.times[0], truth.times[-1]))
    xi = np.zeros((len(stamps), 3))
    xi[1:] = se2_log(se2_between(at[:-1], at[1:]))
    dt = np.concatenate([[0.0], np.diff(stamps)])
    d, turned = np.hypot(xi[:, 0], xi[:, 1]), np.abs(xi[:, 2])
    sigma = np.column_stack(
        [
            r.along_metre * np.sqrt(d),
            r.lateral_metre * np.sqrt(d),
            np.sqrt(r.heading_metre**2 * d + r.heading_radian**2 * turned + r.heading_second**2 * dt),
        ]
    )
    noise = sigma * rng.standard_normal(sigma.shape)
    noise[:, 0] += _gauss_markov(r.correlated_speed, r.memory, dt, rng) * dt
    noise[:, 2] += _gauss_markov(r.correlated_rate, r.memory, dt, rng) * dt
    moved = xi + noise
    moved[:, :2] *= r.distance_scale
    moved[1:, 2] += r.yaw_bias * dt[1:]
    moved[0] = 0.0
    stated = (0.25 * np.maximum(sigma, 1e-5)) ** 2
    return Odometry(times=stamps, increments=se2_exp(moved), covariances=stated[:, :, None] * np.eye(3))


def _gauss_markov(sigma: float, memory: float, dt: Array, rng: np.random.Generator) -> Array:
    out, value = np.zeros(len(dt)), sigma * rng.standard_normal()
    for k, h in enumerate(dt):
        left = np.exp(-h / memory)
        value = left * value + sigma * np.sqrt(1 - left**2) * rng.standard_normal()
        out[k] = value
    return out


def _observations(
    robot: DrawnRobot, truth: Trajectory, marks: Array, reach: float, stamps: Array, rng: np.random.Generator
) -> LandmarkObservations:
    at = truth.interpolate(stamps)
    offsets, ranges, bearings, ids = [0], [], [], []
    for pose in at:
        d = marks - pose[:2]
        r = np.hypot(d[:, 0], d[:, 1])
        b = wrap_angle(np.arctan2(d[:, 1], d[:, 0]) - pose[2])
        seen = np.flatnonzero((r < reach) & (np.abs(b) < np.pi / 2))
        ranges.append(
            robot.range_scale * r[seen] + robot.range_offset + robot.range_sigma * rng.standard_normal(len(seen))
        )
        bearings.append(b[seen] - robot.sensor_yaw + robot.bearing_sigma * rng.standard_normal(len(seen)))
        ids.append(seen)
        offsets.append(offsets[-1] + len(seen))
    z = np.concatenate(ranges)
    sigmas = np.tile([0.25 * robot.range_sigma, 0.25 * robot.bearing_sigma], (len(z), 1))
    return LandmarkObservations(
        times=stamps,
        offsets=np.array(offsets, dtype=np.int64),
        ranges=np.maximum(z, 0.05),
        bearings=np.asarray(wrap_angle(np.concatenate(bearings))),
        sigmas=sigmas,
        ids=np.concatenate(ids).astype(np.int64),
        max_range=2.0 * reach,
    )
