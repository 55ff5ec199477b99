"""Checks of the raw streams before a run: errors that can be found without a map.

A check uses one stream, physical limits, or two streams that must agree. Its findings are lines of the verdict, or end
the run (:data:`STOPPING`); no record is changed or dropped.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphslam.core.errors import DataError, GraphSlamError
from graphslam.core.findings import Finding
from graphslam.core.imu import Imu
from graphslam.core.log import FAR_FIX, SensorLog
from graphslam.core.point_clouds import PointClouds
from graphslam.core.poses import group_of
from graphslam.core.range_scans import RangeScans
from graphslam.core.records import (
    Gps,
    LandmarkObservations,
    LaserScans,
    Odometry,
    SteeringControls,
    VelocityControls,
)
from graphslam.evaluate.stream_checks_beams import check_beams
from graphslam.evaluate.stream_checks_clock import ORDER, check_clocks
from graphslam.evaluate.stream_checks_gps import check_gps
from graphslam.evaluate.stream_checks_imu import check_imu, check_turns, compare_turns
from graphslam.evaluate.stream_checks_motion import check_odometry, check_sighted_motion
from graphslam.evaluate.stream_checks_observations import check_observations, check_steering
from graphslam.io.clock import CLOCK_SET_BACK

GYRO = 40.0
"""Highest plausible yaw rate of a robot's IMU [rad/s]: 2000 °/s are 35 rad/s."""
BENT = 0.1
"""Motion during a scan above which its distortion is reported [m]."""


@dataclass(frozen=True, slots=True)
class StreamFinding:
    """A finding about one stream.

    Parameters
    ----------
    stream : str
        Name of the stream: errors of unused streams do not affect the map.
    """

    stream: str
    finding: Finding


def check_speeds(wheels: VelocityControls | Odometry, name: str, log: SensorLog) -> list[Finding]:
    """Wheels that never turn, and odometry that never moves."""
    moves = group_of(wheels.increments).log(wheels.increments[1:]) if isinstance(wheels, Odometry) else wheels.speed
    if len(wheels.times) < 2 or np.any(moves):
        return []
    what = "motion" if isinstance(wheels, Odometry) else "speed"
    text = (
        f"{what} of {name}: 0 in all {len(wheels.times)} records — the robot never moves. Check that it is connected."
    )
    return [Finding("bad", "wheels-still", text)]


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
        return []  # check_turns compares it with the wheels
    odometry = next((s for s in log.streams.values() if isinstance(s, Odometry) and len(s.times) > 2), None)
    if odometry is None:
        return []
    g = group_of(odometry.increments)
    dt = np.diff(odometry.times)
    turn = np.asarray(g.log(odometry.increments))[1:, g.heading] / dt
    middle = odometry.times[1:] - 0.5 * dt
    return compare_turns(imu, VelocityControls(times=middle, speed=np.zeros(len(turn)), yaw_rate=turn), name)


def _point_times(clouds: PointClouds, name: str, log: SensorLog) -> list[Finding]:
    """Points without times, or with equal times, on a robot that moves during a scan."""
    state = log.meta.get("point_times")
    k = next((k for k in range(len(clouds)) if len(clouds.cloud(k))), None)
    if k is None or state in ("used", "unclear") or clouds.ages(k) is not None:
        return []  # "unclear" is reported as an assumption of the reader
    odometry = next((s for s in log.streams.values() if isinstance(s, Odometry) and len(s.times) > 2), None)
    moved = float("nan")
    if odometry is not None:
        lengths = np.linalg.norm(odometry.increments[1:, : group_of(odometry.increments).dim], axis=1)
        period = min(float(np.median(np.diff(clouds.times))), 0.1)
        moved = float(np.percentile(lengths / np.diff(odometry.times), 75)) * period
    stuck = state == "constant"
    if not stuck and not moved > BENT:
        return []
    kind = "the same for all points of a scan" if stuck else "none"
    bent = f", which distorts a scan by {moved:.2f} m at the usual speed" if np.isfinite(moved) else ""
    text = (
        f"point times of {name}: {kind}{bent} — scans cannot be deskewed. Switch on point times in the lidar driver, "
        "or deskew the scans before."
    )
    return [Finding("bad" if stuck and not moved <= BENT else "look", "points-without-times", text)]


_UNPLACED = (
    "mounting of {0}: unknown, the log has no transform to its frame — the base pose is assumed. Set it with "
    "--reader-option mount=[x, y, z, roll, pitch, yaw] (metres, radians), or record tf_static."
)


STREAM_CHECKS: tuple[tuple[tuple[type, ...], Callable[[Any, str, SensorLog], list[Finding]]], ...] = (
    ((LaserScans, RangeScans, PointClouds), check_beams),
    ((LandmarkObservations,), check_observations),
    ((SteeringControls,), check_steering),
    ((Gps,), check_gps),
    ((Imu,), check_imu),
    ((Imu,), check_turns),
    ((VelocityControls, Odometry), check_speeds),
    ((Odometry, VelocityControls), lambda stream, name, log: check_odometry(stream, name)),
    ((LandmarkObservations,), check_sighted_motion),
    ((Imu,), _gyro),
    ((PointClouds,), _point_times),
)
"""Stream types, and their check: ``check(stream, name, log)``."""


def check_streams(log: SensorLog, *, refusals: bool = True) -> list[StreamFinding]:
    """Check every stream of a log, its clocks, and the records that the reader dropped.

    Parameters
    ----------
    refusals : bool
        Raise for an unusable stream; otherwise it is a finding.

    Returns
    -------
    list of StreamFinding
        Clock faults first, because they cause many others; then in the order of the streams.
    """
    out = [StreamFinding(name, f) for name, f in check_clocks(log)]
    for name, stream in log.streams.items():
        for check in (check for kinds, check in STREAM_CHECKS if isinstance(stream, kinds)):
            try:
                out += [StreamFinding(name, finding) for finding in check(stream, name, log)]
            except GraphSlamError as error:
                if refusals:
                    raise
                out.append(StreamFinding("", Finding("bad", "refused", str(error))))
    for name in log.meta.get("unplaced", ()):
        out.append(StreamFinding(name, Finding("look", "mounting-unknown", _UNPLACED.format(name))))
    out += [StreamFinding("", Finding(level, "assumed", text)) for level, text in log.meta.get("assumed", ())]
    return [*out, *_losses(log)]


STOPPING = ("stamps-unit",)
"""Codes of errors that make a map impossible: the run ends with their text."""
CLOCK_CODES = ("stamps-unit", "clock-jump", "clock-set-back", "no-common-time", "stamps-order")


def refuse_faulty(found: list[StreamFinding], log: SensorLog) -> None:
    """Raise :class:`~graphslam.core.errors.DataError` for the first error that makes a map impossible."""
    for f in found:
        if f.finding.code in STOPPING:
            raise DataError(f.finding.text, where=f"{log.name}, {f.stream}")


LOST = 0.05
"""Share of dropped records of a stream above which they are reported."""
EXPECTED_LOSSES = ("no fix (status)", "observations of other robots", CLOCK_SET_BACK, *ORDER)
"""Reasons that are no error of the log, or that :func:`check_clocks` reports."""


def _losses(log: SensorLog) -> list[StreamFinding]:
    """Records that the reader dropped: any outlying fix, and more than :data:`LOST` of a stream."""
    lost: dict[str, dict[str, int]] = {}
    for key, n in log.dropped.items():
        name, _, reason = key.partition(": ")
        if name in log.read and not reason.startswith(("point ", *EXPECTED_LOSSES)) and not reason.endswith("(kept)"):
            lost.setdefault(name, {})[reason] = n
    out = []
    for name, reasons in lost.items():
        total, read = sum(reasons.values()), max(log.read[name], 1)
        far = FAR_FIX in reasons
        if total <= LOST * read and not far:
            continue
        why = "; ".join(f"{n} {r}" for r, n in reasons.items())
        share = 100 * total / read
        text = f"records of {name} left out: {total} of {read} ({share:.1f} %): {why}. Check the recording."
        if far:
            text += " A receiver reports such fixes before it has a solution: they are outliers."
        out.append(StreamFinding(name, Finding("look", "records-left-out", text)))
    return out
