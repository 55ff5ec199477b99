"""Checks of landmark observations and steering before a run, by physical limits.

No map is needed: angles are limited, repeated scans are exact copies, and between two observations of a landmark its
range changes by at most the path length, but not by much less over a whole drive.
"""

from __future__ import annotations

import numpy as np

from graphslam.core.errors import DataError, MissingDataError
from graphslam.core.findings import Finding
from graphslam.core.geometry import Array
from graphslam.core.log import SensorLog
from graphslam.core.records import LandmarkObservations, SteeringControls
from graphslam_frontends.odometry.motion import MotionNoise, dead_reckoned_increments

APART = 1.0
"""Least time between two compared observations of a landmark [s]."""
LEAST_PAIRS = 20
LEAST_PATH = 10.0
"""Path length over all pairs below which the ranges are not tested [m]."""
HARDLY = 0.01
"""Ranges that change by less than this share of the path length are in a wrong unit. When a robot passes a landmark,
the range changes by half of the path on average."""
COPIES = 0.5
"""Share of exact copies of the previous scan above which they are reported."""
FEW = 0.25
"""Share of implausible pairs that wrong identities or wheel slip may explain."""


def check_observations(z: LandmarkObservations, name: str, log: SensorLog) -> list[Finding]:
    """Findings on a stream of landmark observations.

    Parameters
    ----------
    name : str
        Name of the stream.
    log : SensorLog
        Its motion gives the path length between observations.
    """
    if len(z.ranges) == 0:
        return []
    out = []
    if len(z.ranges) >= LEAST_PAIRS and np.ptp(z.ranges) == 0.0:
        text = (
            f"ranges of {name}: all {len(z.ranges)} are {z.ranges[0]:g} m — the sensor is stuck, or ranges were not "
            "read."
        )
        out.append(Finding("bad", "ranges-constant", text))
    beyond = int(np.sum(np.abs(z.bearings) > 2.0 * np.pi))
    if beyond:
        text = f"bearings of {name}: {beyond} of {len(z.bearings)} beyond a full turn — probably in degrees."
        out.append(Finding("bad", "bearings-degrees", text))
    copies = sum(_same(z, k) for k in range(1, len(z.times)))
    if copies > COPIES * len(z.times):
        text = (
            f"scans of {name} equal to the one before: {copies} of {len(z.times)} — the driver repeats its last scan, "
            "and each copy counts as a measurement. Keep the first of each."
        )
        out.append(Finding("bad", "scans-repeated", text))
    return out + _ranges_and_path(z, name, log)


def check_steering(controls: SteeringControls, name: str, log: SensorLog) -> list[Finding]:
    """Findings on steering angles."""
    beyond = int(np.sum(np.abs(controls.steering) > 0.5 * np.pi))
    if not beyond:
        return []
    text = f"steering angles of {name}: {beyond} of {len(controls.steering)} beyond 90° — probably in degrees."
    return [Finding("bad", "steering-degrees", text)]


def _same(z: LandmarkObservations, k: int) -> bool:
    a, b = z.scan(k - 1), z.scan(k)
    if a.stop - a.start != b.stop - b.start or a.stop == a.start:
        return False
    return bool(np.array_equal(z.ranges[a], z.ranges[b]) and np.array_equal(z.bearings[a], z.bearings[b]))


def _ranges_and_path(z: LandmarkObservations, name: str, log: SensorLog) -> list[Finding]:
    pairs = _pairs(z)
    if pairs is None:
        return []
    first, second = pairs
    lengths = _path_length(log, z.times)
    if lengths is None:
        return []
    scan = np.repeat(np.arange(len(z.times)), np.diff(z.offsets))
    moved = np.abs(lengths[scan[second]] - lengths[scan[first]])
    change = np.abs(z.ranges[second] - z.ranges[first])
    noise = 4.0 * np.sqrt(z.sigmas[first, 0] ** 2 + z.sigmas[second, 0] ** 2)
    if moved.sum() < LEAST_PATH:
        return []
    if change.sum() < HARDLY * moved.sum() and np.ptp(z.ranges) > 0.0:
        raise DataError(
            "ranges hardly change while the robot drives: are they in kilometres?",
            where=f"{log.name}/{name}",
            got=f"ranges to the same landmarks change by {change.sum():.3g} m over {moved.sum():.3g} m of path",
            wanted="ranges in metres",
        )
    too_much = change > moved + noise
    if np.mean(too_much) <= FEW:
        return []
    times = float(np.median(change[too_much] / np.maximum(moved[too_much], 1e-3)))
    text = (
        f"range changes of {name}: larger than the motion of the robot in {int(too_much.sum())} of {len(moved)} pairs "
        f"of observations (median factor {times:.3g}) — ranges are too long or in another unit, wheel distances too "
        "short, or ids wrong."
    )
    return [Finding("bad", "ranges-and-path", text)]


def _pairs(z: LandmarkObservations) -> tuple[Array, Array] | None:
    """Rows of pairs of observations of the same landmark, :data:`APART` to twice :data:`APART` apart in time."""
    if z.ids is None:
        return None
    scan = np.repeat(np.arange(len(z.times)), np.diff(z.offsets))
    t = z.times[scan]
    first, second = [], []
    for i in np.unique(z.ids[z.ids >= 0]):
        rows = np.flatnonzero(z.ids == i)
        k = np.searchsorted(t[rows], t[rows] + APART - 1e-9)
        ok = k < len(rows)
        ok[ok] &= t[rows[k[ok]]] < t[rows[ok]] + 2.0 * APART
        first.append(rows[ok])
        second.append(rows[k[ok]])
    if not first or sum(map(len, first)) < LEAST_PAIRS:
        return None
    return np.concatenate(first), np.concatenate(second)


def _path_length(log: SensorLog, times: Array) -> Array | None:
    """Path length [m] up to each of ``times``, from wheel odometry."""
    try:
        steps = dead_reckoned_increments(log, times, MotionNoise(), hold=np.inf)[0].increments
    except (DataError, MissingDataError):
        return None
    return np.cumsum(np.hypot(steps[:, 0], steps[:, 1])) if steps.shape[1] == 3 else None
