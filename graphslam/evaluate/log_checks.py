"""Checks of a whole log before a run, for ``graphslam data check``.

:func:`~graphslam.evaluate.stream_checks.check_streams` is part of every run. The check of odometry by scan matching
takes some seconds.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from graphslam.core.errors import GraphSlamError
from graphslam.core.findings import Finding
from graphslam.core.log import SensorLog
from graphslam.core.point_clouds import PointClouds
from graphslam.core.range_scans import RangeScans
from graphslam.core.records import LaserScans, Odometry, VelocityControls
from graphslam.evaluate.stream_checks import CLOCK_CODES, StreamFinding, check_streams
from graphslam_frontends.odometry.make_steps import make_steps
from graphslam_frontends.odometry.motion_check import check_motion, motion_findings
from graphslam_frontends.odometry.step_config import StepConfig

MOST_SCANS = 1500
"""Scans of a planar laser, from the middle of a log, that are compared with the odometry; …"""
MOST_CLOUDS = 300
"""… and of a 3-D lidar."""
POINTS, REACH = 400, 30.0
"""Points per scan, and their maximum range [m]."""


def check_log(log: SensorLog) -> list[StreamFinding]:
    """Run all checks on a log.

    Returns
    -------
    list of StreamFinding
        Clock faults first, because they cause many others.
    """
    out = check_streams(log, refusals=False)
    if not any(n.finding.level == "bad" and n.finding.code in CLOCK_CODES for n in out):
        out += _scans_and_motion(log)  # with a clock fault this comparison is meaningless
    return _once(out)


def _once(found: list[StreamFinding]) -> list[StreamFinding]:
    seen, out = set(), []
    for n in found:
        if (n.stream, n.finding.code, n.finding.text) not in seen:
            seen.add((n.stream, n.finding.code, n.finding.text))
            out.append(n)
    return out


def _scans_and_motion(log: SensorLog) -> list[StreamFinding]:
    """Findings from the comparison of odometry with the motion between neighbouring scans."""
    scanner = next((n for n, s in log.streams.items() if isinstance(s, PointClouds | RangeScans)), None)
    scanner = scanner or log.of_type(LaserScans)
    moves = (Odometry, VelocityControls)  # not for steered cars: their scans, among trees, match badly
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
