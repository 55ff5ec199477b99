"""Checks of odometry and wheels before a run: limits, jumps, and comparison with landmark observations."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import GraphSlamError
from graphslam.core.findings import Finding
from graphslam.core.geometry import Array, se2_between
from graphslam.core.log import SensorLog
from graphslam.core.poses import group_of
from graphslam.core.records import LandmarkObservations, Odometry, SteeringControls, VelocityControls
from graphslam_frontends.odometry.motion import MotionNoise, dead_reckoned_increments
from graphslam_frontends.odometry.recorded import chain_odometry

Ints = npt.NDArray[np.int64]

FASTEST, FASTEST_TURN = 70.0, 10.0
"""Speed limit [m/s] for the fastest quarter of the records, and yaw rate limit [rad/s] for the fastest hundredth."""
LEAP, LEAP_TIMES = 1.0, 30.0
"""A step longer than this [m] and this multiple of the usual speed is a jump of the odometry."""
SIDEWAYS = 0.6
"""Ratio of sideways to forward motion above which the heading is reported as wrong."""
APART = (0.5, 6.0)
"""Limits of the time between the two compared observations of a landmark [s]."""
MOST_PAIRS, LEAST_PAIRS = 4000, 30
BETTER = 0.5
"""A hypothesis is reported if the landmarks move less than this share of what they move without a change, …"""
FAR_OFF = 0.5
"""Shift of landmarks, as a share of their range, that is reported also if no hypothesis explains it."""
NOISY = 2.0
"""… and that is at least this multiple of the noise."""


def check_odometry(motion: Odometry | VelocityControls, name: str) -> list[Finding]:
    """Findings on one motion stream."""
    if len(motion.times) < 3:
        return []
    dt = np.diff(motion.times)
    if isinstance(motion, VelocityControls):
        return _too_fast(np.abs(motion.speed), np.abs(motion.yaw_rate), name)
    g = group_of(motion.increments)
    xi = np.asarray(g.log(motion.increments))[1:]
    d, turn = np.linalg.norm(xi[:, g.position], axis=1), np.abs(xi[:, g.heading])
    # bursts of delayed records have stamps without use for speeds
    usual_steps = (dt > 0.5 * np.median(dt)) & (dt <= 5.0 * np.median(dt))
    speed, rate = d / dt, turn / dt
    out = _too_fast(speed[usual_steps], rate[usual_steps], name)
    usual = float(np.percentile(speed, 90)) if len(speed) else 0.0
    k = np.flatnonzero((d > LEAP) & (speed > LEAP_TIMES * max(usual, 0.05)))
    if len(k):
        text = (
            f"jumps of {name}: {len(k)}, first {d[k[0]]:.1f} m in {dt[k[0]]:.2f} s at {motion.times[k[0] + 1]:.3f} s "
            f"(record {k[0] + 1}; usual speed up to {usual:.2g} m/s) — the odometry was reset, or corrected by another "
            "map. Give the raw odometry, or cut the log."
        )
        out.append(Finding("bad", "odometry-leaps", text))
    if g.dim == 2 and not out:
        ahead, side = np.abs(xi[:, g.position][:, 0]).sum(), np.abs(xi[:, g.position][:, 1]).sum()
        if ahead + side > 5.0 and side > SIDEWAYS * ahead:
            text = (
                f"motion of {name}: {side:.3g} m sideways and {ahead:.3g} m ahead — the heading does not follow the "
                "motion. Give headings in radians, counted from x to the left; check axes and quaternion order."
            )
            out.append(Finding("look", "heading-not-ahead", text))
    return out


def _too_fast(speed: Array, rate: Array, name: str) -> list[Finding]:
    out = []
    for values, limit, share, unit, code, why in (
        (speed, FASTEST, 25, "m/s", "speed-unit", "millimetres or centimetres"),
        (rate, FASTEST_TURN, 1, "rad/s", "turn-unit", "degrees instead of radians"),
    ):
        usual = float(np.percentile(values, 100 - share)) if len(values) else 0.0
        if usual > limit:
            what = "speed" if unit == "m/s" else "yaw rate"
            text = (
                f"{what} of {name}: above {usual:.3g} {unit} in {share} % of the records [≤ {limit:g}] — {why}, or "
                "wrong stamps. Check unit and stamps."
            )
            out.append(Finding("bad", code, text))
    if len(out) == 2:
        text = f"{out[0].text.partition(' — ')[0]} — yaw rates are as high: the stamps are too dense or wrong."
        return [Finding("look", "stamps-dense", text)]
    return out


@dataclass(frozen=True, slots=True)
class MotionFault:
    """One hypothesis on a wrong unit or sign: factors on the data, and the message.

    Parameters
    ----------
    yaw : float
        Added to bearings [rad].
    """

    text: str
    speed: float = 1.0
    turn: float = 1.0
    ranges: float = 1.0
    bearings: float = 1.0
    yaw: float = 0.0


_DEG = float(np.pi / 180.0)
HYPOTHESES = (
    MotionFault("speeds seem to be in km/h, wanted m/s: divide them by 3.6", speed=1 / 3.6),
    MotionFault("speeds seem to be 3.6 times too small (m/s read as km/h)", speed=3.6),
    MotionFault("speeds or distances of the motion seem to be in millimetres, wanted metres", speed=1e-3),
    MotionFault("speeds or distances of the motion seem to be in centimetres, wanted metres", speed=1e-2),
    MotionFault("the speed has the wrong sign: the robot drives forward where the log has backward", speed=-1.0),
    MotionFault("yaw rates or headings seem to be in degrees, wanted radians", turn=_DEG),
    MotionFault("yaw rates or headings seem to be divided by 57.3 once too often", turn=1 / _DEG),
    MotionFault("turns and bearings have opposite signs: both count to the left, seen from above", turn=-1.0),
    MotionFault("ranges seem to be in millimetres, wanted metres", ranges=1e-3),
    MotionFault("ranges seem to be in centimetres, wanted metres", ranges=1e-2),
    MotionFault("ranges seem to be in kilometres, wanted metres", ranges=1e3),
    MotionFault("ranges seem to be in feet, wanted metres", ranges=0.3048),
    MotionFault("bearings seem to be in degrees, wanted radians", bearings=_DEG),
    MotionFault("bearings seem to be divided by 57.3 once too often", bearings=1 / _DEG),
    MotionFault("bearings seem to count from the left side of the robot, wanted from ahead", yaw=0.5 * np.pi),
    MotionFault("bearings seem to count from the right side of the robot, wanted from ahead", yaw=-0.5 * np.pi),
    MotionFault("bearings seem to count from behind the robot, wanted from ahead", yaw=np.pi),
)


def check_sighted_motion(z: LandmarkObservations, name: str, log: SensorLog) -> list[Finding]:
    """Test whether landmarks stay in place under the motion in the log; if not, which unit or sign error explains it.

    Two observations of a landmark are transformed into one frame with the motion between them. The hypotheses are tried
    one by one; that with the smallest shift of the landmarks is reported.
    """
    pairs = _sighted_twice(z)
    if pairs is None:
        return []
    first, second = pairs
    scan = np.repeat(np.arange(len(z.times)), np.diff(z.offsets))
    paths = {}
    for h in (MotionFault(""), *HYPOTHESES):
        key = h.speed, h.turn
        if key not in paths:
            path = _path(log, z.times, *key)
            if path is None:
                return []
            paths[key] = se2_between(path[scan[first]], path[scan[second]])
    a, b = (np.column_stack([z.ranges[k], z.bearings[k]]) for k in (first, second))
    noise = float(np.median(np.hypot(z.sigmas[first, 0] / z.ranges[first], z.sigmas[first, 1])))
    as_is = _unrest(a, b, paths[1.0, 1.0], MotionFault(""))
    if as_is < NOISY * noise:
        return []
    tried = [(_unrest(a, b, paths[h.speed, h.turn], h), k) for k, h in enumerate(HYPOTHESES)]
    least, k = min(tried)
    if least > BETTER * as_is and as_is < FAR_OFF:
        return []
    text = (
        f"shift of landmarks of {name} between observations: {100 * as_is:.0f} % of their range (median of "
        f"{len(first)} pairs), "
    )
    if least > BETTER * as_is:
        text += (
            "and no change of one unit, sign or zero explains it — check ids, stamps, and that bearings are counted "
        )
        text += "from the heading of the robot."
    else:
        text += f"only {100 * least:.0f} % after one change — {HYPOTHESES[k].text}."
    return [Finding("bad", "observations-and-motion", text)]


def _sighted_twice(z: LandmarkObservations) -> tuple[Ints, Ints] | None:
    """Rows of pairs of observations of one landmark: each row with the last one inside :data:`APART`."""
    if z.ids is None or not len(z.ranges) or not np.all(z.has_bearing) or not np.all(z.ranges > 0):
        return None
    scan = np.repeat(np.arange(len(z.times)), np.diff(z.offsets))
    a, b = [], []
    for i in np.unique(z.ids[z.ids >= 0]):
        rows = np.flatnonzero(z.ids == i)
        t = z.times[scan[rows]]
        k = np.searchsorted(t, t + APART[1], side="right") - 1
        ok = t[k] >= t + APART[0]
        a.append(rows[ok])
        b.append(rows[k[ok]])
    if sum(map(len, a)) < LEAST_PAIRS:
        return None
    first, second = np.concatenate(a), np.concatenate(b)
    few = np.linspace(0, len(first) - 1, min(len(first), MOST_PAIRS)).round().astype(np.int64)
    return first[few], second[few]


def _path(log: SensorLog, times: Array, speed: float, turn: float) -> Array | None:
    """Poses ``(n, 3)`` from dead reckoning with scaled distances and turns; None if there is no planar motion."""
    streams = dict(log.streams)
    for name, s in log.streams.items():
        if isinstance(s, VelocityControls):
            streams[name] = replace(s, speed=speed * s.speed, yaw_rate=turn * s.yaw_rate)
        elif isinstance(s, Odometry) and s.increments.shape[1] == 3:
            xi = np.asarray(group_of(s.increments).log(s.increments))
            streams[name] = replace(s, increments=group_of(s.increments).exp(xi * [speed, speed, turn]))
        elif isinstance(s, SteeringControls):
            streams[name] = replace(s, speed=speed * s.speed, steering=turn * s.steering)
    try:
        odometry = dead_reckoned_increments(replace(log, streams=streams), times, MotionNoise(), hold=np.inf)[0]
    except GraphSlamError:
        return None
    return chain_odometry(odometry).poses if odometry.increments.shape[1] == 3 else None


def _unrest(first: Array, second: Array, steps: Array, h: MotionFault) -> float:
    """Median shift of the landmarks over their range."""
    ends = []
    for z in (first, second):
        angle = h.bearings * z[:, 1] + h.yaw
        ends.append(h.ranges * z[:, :1] * np.column_stack([np.cos(angle), np.sin(angle)]))
    c, s = np.cos(steps[:, 2]), np.sin(steps[:, 2])
    d = ends[0] - steps[:, :2]
    there = np.column_stack([c * d[:, 0] + s * d[:, 1], -s * d[:, 0] + c * d[:, 1]])
    return float(np.median(np.linalg.norm(there - ends[1], axis=1) / (h.ranges * first[:, 0])))
