"""Raw streams looked at before a run: what cannot be right in them whatever the map.

Every check rests on what a stream says of itself, on physics, or on two streams that must agree. What is found is a
line of the verdict; nothing is changed and nothing is dropped here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from graphslam.core.findings import Finding
from graphslam.core.imu import Imu
from graphslam.core.log import SensorLog
from graphslam.core.point_clouds import PointClouds
from graphslam.core.range_scans import RangeScans
from graphslam.core.records import Gps, LandmarkObservations, LaserScans, SteeringControls, VelocityControls
from graphslam.evaluate.stream_checks_beams import check_beams
from graphslam.evaluate.stream_checks_gps import check_gps
from graphslam.evaluate.stream_checks_imu import check_imu, check_turns
from graphslam.evaluate.stream_checks_sightings import check_sightings, check_steering


@dataclass(frozen=True, slots=True)
class StreamFinding:
    """A finding about one stream.

    Parameters
    ----------
    stream : str
        Its name: what is wrong with a stream that a run does not use does not spoil its map.
    """

    stream: str
    finding: Finding


def check_speeds(wheels: VelocityControls, name: str, log: SensorLog) -> list[Finding]:
    """Wheels that never turn: a robot that is to map something moves."""
    if len(wheels.times) < 2 or wheels.speed.any():
        return []
    text = f"speed of {name}: 0 in all {len(wheels.times)} records — the robot never moves. Check that it is connected."
    return [Finding("bad", "wheels-still", text)]


STREAM_CHECKS: tuple[tuple[tuple[type, ...], Callable[[Any, str, SensorLog], list[Finding]]], ...] = (
    ((LaserScans, RangeScans, PointClouds), check_beams),
    ((LandmarkObservations,), check_sightings),
    ((SteeringControls,), check_steering),
    ((Gps,), check_gps),
    ((Imu,), check_imu),
    ((Imu,), check_turns),
    ((VelocityControls,), check_speeds),
)
"""Kinds of streams, and what is checked in each of them: ``check(stream, name, log)``."""


def check_streams(log: SensorLog) -> list[StreamFinding]:
    """Look at every stream of a log.

    Returns
    -------
    list of StreamFinding
        In the order of the streams.
    """
    return [
        StreamFinding(name, finding)
        for name, stream in log.streams.items()
        for kinds, check in STREAM_CHECKS
        if isinstance(stream, kinds)
        for finding in check(stream, name, log)
    ]
