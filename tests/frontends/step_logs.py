"""Logs that steps are made of: a room in space, and one in the plane."""

from __future__ import annotations

import numpy as np

from graphslam.core import se3
from graphslam.core.geometry import se2_between, se2_transform
from graphslam.core.log import SensorLog, Truth
from graphslam.core.records import LaserScans, Odometry, VelocityControls
from graphslam.core.trajectory import Trajectory
from tests.reference.plain_steps import room_scans, winding_path

HALF = np.array([6.0, 5.0, 2.0])


def odometry_of(path: Trajectory, sigma: float = 1e-3) -> Odometry:
    steps = np.tile([0.0, 0, 0, 0, 0, 0, 1], (len(path), 1)) if path.dim == 3 else np.zeros((len(path), 3))
    between = se3.se3_between if path.dim == 3 else se2_between
    steps[1:] = between(path.poses[:-1], path.poses[1:])
    d = 6 if path.dim == 3 else 3
    return Odometry(times=path.times, increments=steps, covariances=np.tile(sigma**2 * np.eye(d), (len(path), 1, 1)))


def planar_log(**more: object) -> SensorLog:
    """A square room of 8 m, seen by a laser at 5 Hz from a base that turns and drives."""
    n = 41
    t = 0.2 * np.arange(n)
    wheels = VelocityControls(times=t, speed=np.full(n, 0.5), yaw_rate=np.full(n, 0.4))
    heading = 0.4 * t
    xy = 0.5 / 0.4 * np.column_stack([np.sin(heading), 1 - np.cos(heading)])
    truth = Trajectory(t, np.column_stack([xy, np.arctan2(np.sin(heading), np.cos(heading))]))
    bearings = np.linspace(-np.pi / 2, np.pi / 2, 91)
    laser = np.array([0.2, 0.0, 0.1])
    p = se2_transform(truth.poses, laser[:2])
    angle = heading[:, None] + laser[2] + bearings
    d = np.stack([np.cos(angle), np.sin(angle)], -1)
    ranges = np.min((np.copysign(4.0, d) - p[:, None]) / d, axis=2)
    scans = LaserScans(times=t, ranges=ranges, bearings=bearings, max_range=5.0, T_base_sensor=laser)
    streams = {"laser": scans, "wheels": wheels, **more}
    return SensorLog(name="square", streams=streams, truth=Truth(truth))


def room_log() -> SensorLog:
    """A body winds through a room of 12 by 10 by 4 m with a scanner, and perfect odometry."""
    path = winding_path()
    streams = {"scanner": room_scans(path, HALF), "odometry": odometry_of(path)}
    return SensorLog(name="room", streams=streams, truth=Truth(path))


def spoiled(log: SensorLog, **changes: object) -> SensorLog:
    """The log with other streams in the place of some of its own."""
    return SensorLog(name="spoiled", streams={**log.streams, **changes}, truth=log.truth)
