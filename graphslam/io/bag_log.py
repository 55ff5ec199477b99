"""A log of a planar robot as messages of ROS 2: laser, wheels, IMU, GPS, and the transforms of the sensors."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, cast

import numpy as np

from graphslam.core.geodesy import enu_to_geodetic
from graphslam.core.geometry import Array, se2_compose
from graphslam.core.imu import Imu
from graphslam.core.log import SensorLog
from graphslam.core.records import Gps, LaserScans, Odometry
from graphslam.io.bag_writer import BagRecord, MessageFactory
from graphslam.io.tum import embed_plane

BASE = "base_link"


def log_records(
    log: SensorLog, factory: MessageFactory, *, start: float, origin: tuple[float, float]
) -> Iterator[BagRecord]:
    """Messages of a simulated log: ``/scan``, ``/odom``, ``/imu``, ``/fix`` and ``/tf_static``.

    Parameters
    ----------
    log : SensorLog
        With the streams ``laser``, ``wheels``, ``imu`` and ``gps``.
    start : float
        Time of the first record [s since 1970].
    origin : (float, float)
        Latitude and longitude of the origin of the fixes [degrees].
    """
    m = factory
    laser, wheels = cast(LaserScans, log["laser"]), cast(Odometry, log["wheels"])
    imu, gps = cast(Imu, log["imu"]), cast(Gps, log["gps"])

    def stamps(times: Array) -> list[int]:
        return [round((start + t) * 1e9) for t in times.tolist()]

    first, lever = stamps(np.zeros(1))[0], np.zeros(3)
    lever[: len(gps.lever)] = gps.lever
    mounts = {"laser": embed_plane(laser.T_base_sensor[None])[0], "imu": imu.T_base_imu}
    mounts["gps"] = np.array([*lever, 0.0, 0.0, 0.0, 1.0])
    fixed = [m.transforms(first, BASE, child, T).transforms[0] for child, T in mounts.items()]
    yield BagRecord("/tf_static", m.make("tf2_msgs/TFMessage", transforms=fixed), first, latched=True)
    for time, ranges in zip(stamps(laser.times), laser.ranges):
        yield BagRecord("/scan", _scan(m, time, laser, ranges), time)
    pose = np.zeros(3)
    for time, step in zip(stamps(wheels.times), wheels.increments):
        pose = se2_compose(pose, step)
        yield BagRecord("/odom", _odometry(m, time, pose), time)
    for time, rate, force in zip(stamps(imu.times), imu.angular_rate, imu.specific_force):
        yield BagRecord("/imu", _inertia(m, time, rate, force, imu), time)
    flat = np.column_stack([gps.positions[:, :2], np.zeros(len(gps.times))])
    places = enu_to_geodetic(flat, *origin)
    for time, place, sigma in zip(stamps(gps.times), places, gps.sigma):
        yield BagRecord("/fix", _fix(m, time, place, float(sigma)), time)


def _scan(m: MessageFactory, time: int, laser: LaserScans, ranges: Array) -> Any:
    seen = np.where(ranges >= laser.max_range, np.inf, ranges).astype(np.float32)
    return m.make(
        "sensor_msgs/LaserScan", header=m.header(time, "laser"), angle_min=float(laser.bearings[0]),
        angle_max=float(laser.bearings[-1]), angle_increment=float(np.mean(np.diff(laser.bearings))),
        time_increment=0.0, scan_time=0.0, range_min=0.05, range_max=float(laser.max_range), ranges=seen,
        intensities=np.zeros(0, np.float32),
    )  # fmt: skip


def _odometry(m: MessageFactory, time: int, pose: Array) -> Any:
    none, still = np.zeros(36), np.zeros(3)
    twist = m.make("geometry_msgs/Twist", linear=m.vector(still), angular=m.vector(still))
    return m.make(
        "nav_msgs/Odometry", header=m.header(time, "odom"), child_frame_id=BASE,
        pose=m.make("geometry_msgs/PoseWithCovariance", pose=m.pose(embed_plane(pose[None])[0]), covariance=none),
        twist=m.make("geometry_msgs/TwistWithCovariance", twist=twist, covariance=none),
    )  # fmt: skip


def _inertia(m: MessageFactory, time: int, rate: Array, force: Array, imu: Imu) -> Any:
    unknown = np.zeros(9)
    unknown[0] = -1.0  # no orientation
    return m.make(
        "sensor_msgs/Imu", header=m.header(time, "imu"), orientation=m.quaternion(np.array([0.0, 0, 0, 1])),
        orientation_covariance=unknown, angular_velocity=m.vector(rate), angular_velocity_covariance=np.zeros(9),
        linear_acceleration=m.vector(force), linear_acceleration_covariance=np.zeros(9),
    )  # fmt: skip


def _fix(m: MessageFactory, time: int, place: Array, sigma: float) -> Any:
    latitude, longitude, altitude = (float(v) for v in place)
    return m.make(
        "sensor_msgs/NavSatFix", header=m.header(time, "gps"), status=m.make("sensor_msgs/NavSatStatus", status=0,
        service=1), latitude=latitude, longitude=longitude, altitude=altitude,
        position_covariance=np.diag([sigma**2, sigma**2, 4.0 * sigma**2]).reshape(-1), position_covariance_type=2,
    )  # fmt: skip
