"""Checks of GPS fixes before a run, against wheel odometry over short distances.

Dead reckoning is accurate over about ten metres. The chords between fixes must have the same lengths and turns; no map
and no alignment is needed. A chord is at least ten times σ of a fix long, so noise turns it by less than 10°.
"""

from __future__ import annotations

import numpy as np

from graphslam.core.errors import DataError, MissingDataError
from graphslam.core.findings import Finding
from graphslam.core.geometry import Array, se2_compose, se2_transform, wrap_angle
from graphslam.core.log import SensorLog
from graphslam.core.records import Gps, Odometry
from graphslam_frontends.odometry.motion import MotionNoise, dead_reckoned_increments, motion_stream

CHORD = 10.0
"""Least length of the compared chords, in σ of a fix, …"""
SHORTEST_CHORD = 5.0
"""… and in metres."""
LEAST_CHORDS = 3
MOVED = 20.0
"""Wheel path length above which equal fixes are reported as a stuck receiver [m]."""
TWICE = 2.0
"""A ratio of chord lengths above this factor, or below its inverse, is a wrong unit, not a wheel error."""
TURNED = np.deg2rad(60.0)
"""Sum of absolute turns of the wheels above which their sign is compared with that of the fixes."""


def check_gps(gps: Gps, name: str, log: SensorLog) -> list[Finding]:
    """Findings on the fixes of a log.

    Parameters
    ----------
    name : str
        Name of the stream.
    log : SensorLog
        The fixes are compared with its motion stream if that is planar.
    """
    if len(gps.times) == 0:
        return [Finding("look", "gps-empty", f"{name}: no fixes.")]
    try:
        stream, motion = motion_stream(log)
    except MissingDataError:
        return []
    if len(motion.times) < 2 or (isinstance(motion, Odometry) and motion.increments.shape[1] != 3):
        return []
    inside = (gps.times >= motion.times[0]) & (gps.times <= motion.times[-1])
    if not inside.any():
        text = (
            f"{name} and {stream}: no time in common (fixes from {gps.times[0]:.1f} to {gps.times[-1]:.1f} s, motion "
            f"from {motion.times[0]:.1f} to {motion.times[-1]:.1f} s) — their clocks have different zeros. Convert "
            "them to one clock."
        )
        return [Finding("bad", "gps-clock", text)]
    fixes, t = gps.positions[inside, :2], gps.times[inside]
    path = _reckoned(log, t, gps.lever[:2])
    if path is None:
        return []
    length = float(np.sum(np.linalg.norm(np.diff(path, axis=0), axis=1)))
    if length > MOVED and len(fixes) > 2 and bool(np.all(fixes == fixes[0])):
        text = f"{name}: all {len(fixes)} fixes equal while the wheels drive {length:.0f} m — the receiver is stuck."
        return [Finding("bad", "gps-stuck", text)]
    return _chords(fixes, path, float(np.median(gps.sigma)), name, stream)


def _reckoned(log: SensorLog, t: Array, lever: Array) -> Array | None:
    """Antenna positions ``(n, 2)`` at the fixes from dead reckoning."""
    try:
        steps = dead_reckoned_increments(log, t, MotionNoise(), hold=1.0)[0].increments
    except DataError:
        return None
    poses = np.zeros((len(steps), 3))
    for k in range(1, len(steps)):
        poses[k] = se2_compose(poses[k - 1], steps[k])
    return np.asarray(se2_transform(poses, np.broadcast_to(lever, (len(poses), 2))))


def _chords(fixes: Array, path: Array, sigma: float, name: str, stream: str) -> list[Finding]:
    ends = [0]
    for k in range(1, len(path)):
        if np.linalg.norm(path[k] - path[ends[-1]]) >= max(CHORD * sigma, SHORTEST_CHORD):
            ends.append(k)
    if len(ends) <= LEAST_CHORDS:
        return []
    a, b = np.diff(fixes[ends], axis=0), np.diff(path[ends], axis=0)
    ratio = float(np.median(np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)))
    if not 1.0 / TWICE < ratio < TWICE:
        degrees = bool(np.all(np.abs(fixes[:, 0]) <= 360.0) and np.all(np.abs(fixes[:, 1]) <= 360.0))
        probably = (
            "they are probably degrees of longitude and latitude" if degrees and ratio < 0.01 else "check the unit"
        )
        text = (
            f"distances of {name}: {ratio:.3g} times those of {stream} (median of {len(a)} stretches) — {probably}. "
            "Give positions in metres in a local frame, x east and y north."
        )
        return [Finding("bad", "gps-scale", text)]
    turn = [np.unwrap(np.arctan2(d[:, 1], d[:, 0])) for d in (a, b)]
    ta, tb = (wrap_angle(np.diff(x)) for x in turn)
    if np.sum(np.abs(tb)) > TURNED:
        slope = float(np.sum(ta * tb) / np.sum(tb**2))
        if slope < 0.0:
            text = (
                f"turns of {name}: {slope:.2f} times those of {stream} — its axes are probably swapped or one is "
                "reversed, or the steering has the wrong sign. Give x east, y north."
            )
            return [Finding("bad", "gps-mirrored", text)]
    return []
