"""LiDAR odometry at its start, to be stepped by hand."""

from __future__ import annotations

from graphslam.core.imu import Imu
from graphslam.core.log import SensorLog
from graphslam.core.point_clouds import PointClouds
from graphslam.core.record_source import RecordSource
from graphslam.core.records import Stream
from graphslam_frontends.lidar_odometry.config import LidarOdometryConfig
from graphslam_frontends.lidar_odometry.front_end import Unit
from graphslam_frontends.lidar_odometry.odometry import LidarOdometry


def start_odometry(clouds: PointClouds, config: LidarOdometryConfig, imu: Imu | None = None) -> LidarOdometry:
    """LiDAR odometry at its start.

    With an IMU, the first scans are followed to learn its bias, the velocity and gravity, and whether it is to be
    believed; then they are to be followed anew, so that not even the first of them is bent.
    """
    streams: dict[str, Stream] = {"clouds": clouds} if imu is None else {"clouds": clouds, "imu": imu}
    unit = Unit(RecordSource(SensorLog(name="clouds", streams=streams)), None if imu is None else "imu", config)
    for _ in unit.rehearse("clouds"):
        pass
    return unit.odometry()
