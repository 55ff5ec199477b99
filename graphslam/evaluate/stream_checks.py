"""Raw streams looked at before a run: what cannot be right in them whatever the map.

Every check rests on what a stream says of itself, on physics, or on two streams that must agree. What is found is a
line of the verdict; nothing is changed and nothing is dropped here.
"""

from __future__ import annotations

from dataclasses import dataclass

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


def check_speeds(wheels: VelocityControls, name: str) -> list[Finding]:
    """Wheels that never turn: a robot that is to map something moves."""
    if len(wheels.times) < 2 or wheels.speed.any():
        return []
    text = f"speed of {name}: 0 in all {len(wheels.times)} records — the robot never moves. Check that it is connected."
    return [Finding("bad", "wheels-still", text)]


def check_streams(log: SensorLog) -> list[StreamFinding]:
    """Look at every stream of a log.

    Returns
    -------
    list of StreamFinding
        In the order of the streams.
    """
    out: list[StreamFinding] = []
    wheels = next((s for s in log.streams.values() if isinstance(s, VelocityControls)), None)
    for name, stream in log.streams.items():
        found: list[Finding] = []
        if isinstance(stream, LaserScans | RangeScans | PointClouds):
            found = check_beams(stream, name)
        elif isinstance(stream, LandmarkObservations):
            found = check_sightings(stream, name, log)
        elif isinstance(stream, SteeringControls):
            found = check_steering(stream, name)
        elif isinstance(stream, Gps):
            found = check_gps(stream, name, log)
        elif isinstance(stream, Imu):
            found = check_imu(stream, name)
            if wheels is not None:
                found += check_turns(stream, wheels, name)
        elif isinstance(stream, VelocityControls):
            found = check_speeds(stream, name)
        out += [StreamFinding(name, f) for f in found]
    return out
