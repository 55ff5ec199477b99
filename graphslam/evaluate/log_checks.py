"""A whole log looked at before hours of computing: everything that can be told to be wrong without a map.

:func:`~graphslam.evaluate.stream_checks.check_streams` is part of every run. What is here besides takes some
seconds, and is asked for by ``graphslam data check``: stamps and clocks, odometry by itself, and odometry against what
scanner, gyro and landmarks say of the same motion.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from graphslam.core.errors import GraphSlamError
from graphslam.core.findings import Finding
from graphslam.core.imu import Imu
from graphslam.core.log import SensorLog
from graphslam.core.point_clouds import PointClouds
from graphslam.core.poses import group_of
from graphslam.core.range_scans import RangeScans
from graphslam.core.records import LandmarkObservations, LaserScans, Odometry, VelocityControls
from graphslam.evaluate.stream_checks import StreamFinding, check_streams
from graphslam.evaluate.stream_checks_clock import check_clocks
from graphslam.evaluate.stream_checks_imu import compare_turns
from graphslam.evaluate.stream_checks_motion import check_odometry, check_sighted_motion
from graphslam_frontends.odometry.make_steps import make_steps
from graphslam_frontends.odometry.motion_check import check_motion, motion_findings
from graphslam_frontends.odometry.step_config import StepConfig

MOST_SCANS = 1500
"""Scans of a planar laser that are held against the motion, from the middle of a log; …"""
MOST_CLOUDS = 300
"""… and of a 3-D lidar."""
POINTS, REACH = 400, 30.0
"""Points of a scan, and how far they may be [m]."""
GYRO = 40.0
"""No IMU of a robot measures faster turns [rad/s]: 2000 °/s are 35 rad/s."""
BENT = 0.1
"""Motion within a scan that bends it visibly [m]."""


def check_log(log: SensorLog) -> list[StreamFinding]:
    """Everything that can be told of a log before a run.

    Returns
    -------
    list of StreamFinding
        Faults of the clocks first: they are the cause of many others.
    """
    out = [StreamFinding(name, f) for name, f in check_clocks(log)]
    clocks = any(n.finding.level == "bad" for n in out)
    try:
        out += check_streams(log)
    except GraphSlamError as error:
        out.append(StreamFinding("", Finding("bad", "refused", str(error))))
    for name, stream in log.streams.items():
        found: list[Finding] = []
        if isinstance(stream, Odometry | VelocityControls):
            found = check_odometry(stream, name)
        elif isinstance(stream, LandmarkObservations):
            found = check_sighted_motion(stream, name, log)
        elif isinstance(stream, Imu):
            found = _gyro(stream, name, log)
        elif isinstance(stream, PointClouds):
            found = _point_times(stream, name, log)
        out += [StreamFinding(name, f) for f in found]
    for name in log.meta.get("unplaced", ()):
        out.append(StreamFinding(name, Finding("look", "place-unknown", _UNPLACED.format(name))))
    if not clocks:  # scans and motion of different times differ for that reason
        out += _scans_and_motion(log)
    return _once(out)


_UNPLACED = (
    "mounting of {0}: unknown, the log has no transform to its frame — the base pose is assumed. Set it with "
    "--reader-option mount=[x, y, z, roll, pitch, yaw] (metres, radians), or record tf_static."
)


def _once(found: list[StreamFinding]) -> list[StreamFinding]:
    seen, out = set(), []
    for n in found:
        if (n.stream, n.finding.code, n.finding.text) not in seen:
            seen.add((n.stream, n.finding.code, n.finding.text))
            out.append(n)
    return out


def _gyro(imu: Imu, name: str, log: SensorLog) -> list[Finding]:
    if not len(imu.times):
        return []
    fastest = float(np.percentile(np.abs(imu.angular_rate), 99.9))
    if fastest > GYRO:
        text = (
            f"gyro of {name}: up to {fastest:.3g} rad/s [≤ {GYRO:g}] — probably in degrees per second. Convert it to "
            "rad/s."
        )
        return [Finding("bad", "gyro-unit", text)]
    if any(isinstance(s, VelocityControls) for s in log.streams.values()):
        return []  # compared with wheels by every run
    odometry = next((s for s in log.streams.values() if isinstance(s, Odometry) and len(s.times) > 2), None)
    if odometry is None:
        return []
    g = group_of(odometry.increments)
    dt = np.diff(odometry.times)
    turn = np.asarray(g.log(odometry.increments))[1:, g.heading] / dt
    middle = odometry.times[1:] - 0.5 * dt
    return compare_turns(imu, VelocityControls(times=middle, speed=np.zeros(len(turn)), yaw_rate=turn), name)


def _point_times(clouds: PointClouds, name: str, log: SensorLog) -> list[Finding]:
    """Points without times, or with one time for all, on a robot that moves while it scans."""
    k = next((k for k in range(len(clouds)) if len(clouds.cloud(k))), None)
    if k is None or clouds.ages(k) is not None:
        return []
    odometry = next((s for s in log.streams.values() if isinstance(s, Odometry) and len(s.times) > 2), None)
    moved = float("nan")
    if odometry is not None:
        way = np.linalg.norm(odometry.increments[1:, : group_of(odometry.increments).dim], axis=1)
        period = min(float(np.median(np.diff(clouds.times))), 0.1)
        moved = float(np.percentile(way / np.diff(odometry.times), 75)) * period
    stuck = log.meta.get("point_times") == "constant"
    if not stuck and not moved > BENT:
        return []
    said = "the same for all points of a scan" if stuck else "none"
    bent = f", which distorts a scan by {moved:.2f} m at the usual speed" if np.isfinite(moved) else ""
    text = (
        f"point times of {name}: {said}{bent} — scans cannot be deskewed. Switch on point times in the lidar driver, "
        "or deskew the scans before."
    )
    return [Finding("bad" if stuck and not moved <= BENT else "look", "points-without-times", text)]


def _scans_and_motion(log: SensorLog) -> list[StreamFinding]:
    """Lines on what neighbouring scans say of the motion."""
    scanner = next((n for n, s in log.streams.items() if isinstance(s, PointClouds | RangeScans)), None)
    scanner = scanner or log.of_type(LaserScans)
    moves = (Odometry, VelocityControls)  # a steered car drives among trees, where scans are hardly alike
    motion = [n for n, s in log.streams.items() if isinstance(s, moves) and len(s.times) > 1]
    if scanner is None or not motion:
        return []
    stream: Any = log[scanner]
    spinning = isinstance(stream, RangeScans)
    if isinstance(stream, PointClouds) and not any(
        isinstance(s, Odometry) and s.increments.shape[1] == 7 for s in log.streams.values()
    ):
        return []
    most = MOST_CLOUDS if isinstance(stream, PointClouds) else MOST_SCANS
    part = log
    if not spinning and len(stream.times) > most:
        middle = len(stream.times) // 2
        part = replace(
            log, streams={**log.streams, scanner: stream.take(slice(middle - most // 2, middle + most // 2))}
        )
    try:
        config = StepConfig(period=0.4 if spinning else None, most_points=POINTS, max_range=REACH, silent="unknown")
        steps = make_steps(part, config)
        return [StreamFinding(scanner, f) for f in motion_findings(check_motion(steps))]
    except GraphSlamError as error:
        text = f"{scanner} and {', '.join(motion)}: cannot be combined — {error}"
        return [StreamFinding(scanner, Finding("bad", "scans-and-motion", text))]
