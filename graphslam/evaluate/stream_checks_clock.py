"""Checks of stamps before a run: unit, jumps, order, and overlap in time of the streams."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

import numpy as np

from graphslam.core.findings import Finding
from graphslam.core.imu import Imu
from graphslam.core.log import SensorLog
from graphslam.core.point_clouds import PointClouds
from graphslam.core.range_scans import RangeScans
from graphslam.core.records import Gps, LandmarkObservations, LaserScans, Odometry, SteeringControls, VelocityControls
from graphslam.core.trajectory import Trajectory
from graphslam.io.clock import CLOCK_SET_BACK, MAX_DROPPED
from graphslam_frontends.odometry.recorded import motion_is_given

STEADY = (Imu, LaserScans, Odometry, PointClouds, RangeScans, SteeringControls, VelocityControls)
"""Streams with regular records; landmarks and fixes can pause."""
SLOWEST, FASTEST = 30.0, 2e-5
"""Plausible limits of the usual interval between records [s]."""
JUMP, JUMP_TIMES = 20.0, 50.0
"""A pause is reported if it is longer than this [s], and than this multiple of the usual interval."""
TOGETHER = 0.5
"""Least share of the shorter of two streams that the other must cover."""
ORDER = ("stamp out of order", "repeated stamp", "stamp is not finite")
REORDERED = 0.001
"""Share of stamps out of order or repeated above which they are reported."""


def check_clocks(log: SensorLog) -> list[tuple[str, Finding]]:
    """Findings on the stamps of a log, each with the name of its stream."""
    out: list[tuple[str, Finding]] = []
    for name, stream in log.streams.items():
        if isinstance(stream, STEADY) and len(stream.times) > 2:
            found = (*_unit(name, stream.times), *_jumps(name, stream.times, log))
            codes = {f.code for _, f in out} & {"pause-bridged"}  # all streams pause together
            out += [(name, f) for f in found if f.code not in codes]
    return [*out, *_overlap(log), *_order(log.read, log.dropped)]


def _unit(name: str, t: np.ndarray) -> list[Finding]:
    usual = float(np.median(np.diff(t)))
    if FASTEST <= usual <= SLOWEST:
        return []
    seems = "milliseconds" if usual < 3e4 else "microseconds" if usual < 3e7 else "nanoseconds"
    if usual < FASTEST:
        seems = "a unit much longer than a second"
    text = f"stamp interval of {name}: {usual:.3g} s — the stamps seem to be in {seems}, wanted seconds."
    return [Finding("bad", "stamps-unit", text)]


def _jumps(name: str, t: np.ndarray, log: SensorLog) -> list[Finding]:
    dt = np.diff(t)
    k = np.flatnonzero(dt > max(JUMP, JUMP_TIMES * float(np.median(dt))))
    if not len(k):
        return []
    worst = int(k[np.argmax(dt[k])])
    odometry = next((s for s in log.streams.values() if isinstance(s, Odometry) and len(s.times) > 2), None)
    if odometry is not None and all(motion_is_given(odometry, float(t[j]), float(t[j + 1])) for j in k):
        text = (
            f"records of {name}: pause of {dt[worst]:.1f} s after record {worst} (at {t[worst]:.3f} s); pauses of "
            f"{JUMP:g} s or more: {len(k)} — the odometry gives the motion over them. Check the map after the pause."
        )
        return [Finding("look", "pause-bridged", text)]
    more = f", and {len(k) - 1} more jumps of {JUMP:g} s or more" if len(k) > 1 else ""
    text = (
        f"stamps of {name}: jump of {dt[worst]:.1f} s after record {worst} (at {t[worst]:.3f} s){more} — a clock was "
        "set, or the recording paused. Cut the log there, or subtract the jump from the later stamps."
    )
    return [Finding("bad", "clock-jump", text)]


def _overlap(log: SensorLog) -> list[tuple[str, Finding]]:
    out = []
    kinds = (*STEADY, LandmarkObservations, Gps, Trajectory)
    there = [(n, s) for n, s in log.streams.items() if isinstance(s, kinds) and len(s.times) > 1]
    for (a, x), (b, y) in combinations(there, 2):
        if "reference" in (a, b):
            continue
        common = min(x.times[-1], y.times[-1]) - max(x.times[0], y.times[0])
        shorter = min(np.ptp(x.times), np.ptp(y.times))
        if common >= TOGETHER * shorter:
            continue
        spans = [f"{n} from {s.times[0]:.3f} to {s.times[-1]:.3f} s" for n, s in ((a, x), (b, y))]
        extent = "no time in common" if common <= 0 else f"only {common:.1f} s in common"
        text = (
            f"{a} and {b}: {extent} ({spans[0]}, {spans[1]}) — their clocks have different zeros or units, or they are "
            "of two drives. Convert them to one clock."
        )
        out.append((b, Finding("bad", "no-common-time", text)))
    return out


def _order(read: Mapping[str, int], dropped: Mapping[str, int]) -> list[tuple[str, Finding]]:
    out = []
    for key, n in dropped.items():
        name, _, reason = key.partition(": ")
        if reason not in (*ORDER, CLOCK_SET_BACK):
            continue
        share = n / max(read.get(name, n), 1)
        text = f"records of {name} left out: {n} ({100 * share:.1f} %), {reason}"
        if reason == CLOCK_SET_BACK:
            text += ", or of a second drive in the same recording. Cut the log where the stamps go back; map the parts."
            out.append((name, Finding("bad", "clock-set-back", text)))
        elif share > REORDERED:
            text += " — recorded twice or late, or from two drivers, or arrival times: use stamps of measurements."
            out.append((name, Finding("bad" if share > MAX_DROPPED else "look", "stamps-order", text)))
    return out
