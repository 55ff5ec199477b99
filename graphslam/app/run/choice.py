"""Choose the front end and the preset for a log from the types of its streams."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from graphslam.core.errors import MissingDataError
from graphslam.core.gnss import Pseudoranges
from graphslam.core.imu import Imu
from graphslam.core.log import SensorLog
from graphslam.core.point_clouds import PointClouds
from graphslam.core.range_scans import RangeScans
from graphslam.core.records import (
    Gps,
    LandmarkObservations,
    LaserScans,
    Odometry,
    PointObservations,
    SteeringControls,
    VelocityControls,
)

LEVEL = 1e-6
"""Largest change of height and tilt [m, quaternion] of wheel odometry that is stored as 3-D poses."""
NAMED = 0.9
"""If at least this share of the observations has an identity, the preset for known identities is used."""


@dataclass(frozen=True, slots=True)
class FrontEndChoice:
    """A front end with the reason for the choice.

    Parameters
    ----------
    why : str
        The streams that it is chosen for.
    """

    frontend: str
    why: str


def choose_front_end(log: SensorLog) -> FrontEndChoice:
    """The front end for the streams of a log."""

    def has(*kinds: type) -> bool:
        return any(isinstance(s, kinds) and len(s.times) for s in log.streams.values())

    moves = has(SteeringControls, VelocityControls, Odometry)
    if has(LandmarkObservations) and moves:
        return FrontEndChoice("rbpf-ekf", "landmark observations with odometry")
    if has(SteeringControls) and has(LaserScans):
        return FrontEndChoice("rbpf-ekf", "planar laser of a car-like robot; trunks are detected in the scans")
    if has(RangeScans) and (moves or has(Imu)):
        return FrontEndChoice("segslam", "spinning scanners with odometry")
    if has(PointClouds):
        if not any(isinstance(s, Odometry) and _in_space(s) for s in log.streams.values()):
            return FrontEndChoice("lidar-odometry", "point clouds of a 3-D LiDAR; the odometry is computed from them")
        if "clouds" in log.meta.get("unplaced", ()):
            return FrontEndChoice(
                "lidar-odometry", "point clouds of a 3-D LiDAR with unknown mounting, so without odometry"
            )
        return FrontEndChoice("segslam", "point clouds of a 3-D LiDAR with odometry")
    if has(LaserScans) and moves:
        return FrontEndChoice("segslam", "planar laser with odometry")
    held = ", ".join(f"{n} ({type(s).__name__}, {len(s.times)} records)" for n, s in log.streams.items()) or "nothing"
    raise MissingDataError("no front end can map this log", where=log.name, got=held, wanted=_wanted(log))


def _in_space(odometry: Odometry) -> bool:
    """Does the odometry measure height and tilt? Wheel odometry does not, even if it is stored as 3-D poses."""
    steps = odometry.increments
    return steps.shape[1] == 7 and len(steps) > 1 and float(np.abs(steps[1:, 2:5]).max()) > LEVEL


def _wanted(log: SensorLog) -> str:
    kinds = {type(s) for s in log.streams.values()}
    if LaserScans in kinds:
        return "odometry in addition to the laser scans (wheels, or poses of the robot)"
    if LandmarkObservations in kinds:
        return "odometry or velocities in addition to the landmark observations"
    if PointObservations in kinds:
        return 'local maps by graphslam.local_maps(log, "points"), joined by graphslam.join_submaps'
    if Pseudoranges in kinds:
        return "scans or landmark observations; pseudoranges alone are solved by `graphslam study smartloc`"
    if Gps in kinds and Imu in kinds:
        return (
            "scans, clouds or landmark observations; IMU and GPS alone are solved by `graphslam study withheld-fixes`"
        )
    return "laser scans with odometry, clouds, or landmark observations with odometry"


def kind_preset(log: SensorLog) -> str:
    """Name of the preset for a recorded log with these streams; empty if there is none, and for simulated logs."""
    if "reader" not in log.meta or log.meta.get("source") == "simulation":
        return ""
    kinds: set[object] = {type(s) for s in log.streams.values()}
    if PointClouds in kinds:
        return "clouds"
    seen = next((s for s in log.streams.values() if isinstance(s, LandmarkObservations)), None)
    if seen is not None and seen.ids is not None and np.mean(seen.ids >= 0) >= NAMED:
        return "named-landmarks" if np.any(seen.has_bearing) else "named-ranges"
    return "planar-laser" if LaserScans in kinds and (Odometry in kinds or VelocityControls in kinds) else ""


def reading_line(log: SensorLog) -> str:
    """One line: reader, streams and numbers of records; empty for a log that was not read by a reader."""
    read: Any = log.meta.get("reader")
    if not isinstance(read, dict):
        return ""
    streams = ", ".join(f"{n} {len(s.times)}" for n, s in log.streams.items())
    also = f"; could also be read as {', '.join(read['also'])} (--reader)" if read.get("also") else ""
    notes = "".join(f"; {n}" for n in log.meta.get("notes", []))
    return f"read: {read.get('found')} by reader {read.get('name')!r}: {streams}{notes}{also}"
