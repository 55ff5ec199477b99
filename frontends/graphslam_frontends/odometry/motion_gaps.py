"""Gaps in planar motion: bridged with the usual motion of the robot, reported, and counted.

The motion in a gap is unknown. The model: speed and yaw rate are the mean of those just before and just after the gap,
plus an error that is constant over the gap, with the spread of all speeds and yaw rates until then about that mean. So
after a gap of T seconds σ of the distance is T · spread, and of the heading likewise, up to that of an unknown heading.
Increments in a gap share its variance in proportion to time: their sum is right, each of them is conservative.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array, se2_exp, se2_log
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.records import Odometry, SteeringControls, VelocityControls
from graphslam_frontends.odometry.gaps import refuse_long_gaps
from graphslam_frontends.odometry.motion import (
    HEADING_UNKNOWN,
    Motion,
    MotionNoise,
    dead_reckoned_increments,
    motion_stream,
)
from graphslam_frontends.odometry.recorded import BRIDGED, gives_motion, refuse_unbridged, usual_variances

SHORTEST = 1.0
"""An interval longer than this, and than 3 times the median, is a gap [s]: a robot can stop within a second."""
AROUND = 2.0
"""Time before and after a gap for the mean motion in it [s]."""
OPTION = "frontend.longest_gap"
"""Full name of the option that limits gaps."""
LOST = 0.5
"""A record of odometry over a gap with less than this share of the speed around it has lost motion."""


@dataclass(frozen=True, slots=True)
class MotionGap:
    """A gap in the motion.

    Parameters
    ----------
    begin, end : float
        Stamps of the records around it [s].
    speed, yaw_rate : float
        Assumed for it [m/s, rad/s].
    speed_sigma, yaw_rate_sigma : float
        Of the error that is constant over it.
    usual : float
        Median time between records [s].
    """

    begin: float
    end: float
    speed: float
    yaw_rate: float
    speed_sigma: float
    yaw_rate_sigma: float
    usual: float = SHORTEST

    def as_row(self) -> dict[str, float]:
        """JSON object for a report."""
        return {k: float(getattr(self, k)) for k in self.__dataclass_fields__ if k != "usual"}


def dead_reckon_over_gaps(
    log: SensorLog, times: Array, noise: MotionNoise, *, hold: float, limit: float, drops: DropCounter
) -> tuple[Odometry, str, list[MotionGap]]:
    """Dead reckoning (:mod:`graphslam_frontends.odometry.motion`), with the gaps of the motion bridged by this model.

    Parameters
    ----------
    log, times, noise, hold
        As there.
    limit : float
        Longest gap that is bridged [s].
    drops : DropCounter
        Counts the gaps.

    Returns
    -------
    odometry : Odometry
        At ``times``.
    name : str
        Of the motion stream.
    """
    name, motion = motion_stream(log)
    gaps = find_motion_gaps(motion, float(times[0]), float(times[-1]), limit, where=f"{log.name}/{name}")
    drops.drop(name, "gaps bridged", len(gaps))
    for gap in gaps:
        motion = _filled(motion, gap)
    if gaps:
        log = replace(log, streams={**log.streams, name: motion})
    odometry, name = dead_reckoned_increments(log, times, noise, hold=hold)
    return replace(odometry, covariances=_widened(odometry, gaps)) if gaps else odometry, name, gaps


def find_motion_gaps(motion: Motion, begin: float, end: float, limit: float, *, where: str) -> list[MotionGap]:
    """Gaps of the motion between two times.

    The result for a gap depends on the records up to :data:`AROUND` after its end, not on later ones.
    """
    stamps = motion.times
    if len(stamps) < 2:
        if len(stamps) and end - begin > SHORTEST:
            raise DataError(
                "the motion stream holds a single record, so there is no motion",
                where=where,
                got=f"one record for {end - begin:.1f} s",
                wanted=f"records at least every {limit:g} s ({OPTION})",
            )
        return []
    if not isinstance(motion, Odometry) and end > stamps[-1]:
        stamps = np.append(stamps, end)  # the last control is held to the end
    spacing = np.diff(stamps)
    out, gaps = [], []
    for i in np.flatnonzero((spacing > SHORTEST) & (stamps[1:] > begin) & (stamps[:-1] < end)):
        known = int(np.searchsorted(motion.times, stamps[i + 1] + AROUND, side="right"))
        usual = float(np.median(np.diff(motion.times[:known])))
        if spacing[i] > 3.0 * usual:
            gaps.append(i)
            part, long = motion.take(slice(0, known)), np.array([k for k in gaps if spacing[k] > limit], dtype=np.int64)
            if isinstance(part, Odometry):
                refuse_unbridged(part, long, limit, where, option=OPTION)
            else:
                refuse_long_gaps(stamps, long, limit, where, option=OPTION)
            out.append(_gap(part, float(stamps[i]), float(stamps[i + 1]), usual))
    return out


def final_until(motion: Motion) -> float:
    """Time until which future records cannot change the result of :func:`find_motion_gaps` [s]."""
    stamps = motion.times
    if len(stamps) < 2:
        return -np.inf
    open_gaps = np.flatnonzero((np.diff(stamps) > SHORTEST) & (stamps[1:] + AROUND >= stamps[-1]))
    return float(stamps[open_gaps[0]] if len(open_gaps) else stamps[-1])


def motion_rates(motion: Motion) -> tuple[Array, Array, Array]:
    """Speed along x ``(n,)`` [m/s] and yaw rate ``(n,)`` [rad/s] of all records, and the time from which they are valid
    [s]."""
    if isinstance(motion, VelocityControls):
        return motion.speed, motion.yaw_rate, motion.times
    if isinstance(motion, SteeringControls):
        g, a = motion.geometry, motion.steering
        if g.model == "front-steer":
            return motion.speed * np.cos(a), motion.speed * np.sin(a) / g.wheelbase, motion.times
        v = motion.speed / (1.0 - np.tan(a) * g.encoder_offset / g.wheelbase)
        return v, v * np.tan(a) / g.wheelbase, motion.times
    dt = np.diff(motion.times)
    xi = se2_log(motion.increments[1:])
    return xi[:, 0] / dt, xi[:, 2] / dt, motion.times[:-1]


def _gap(motion: Motion, begin: float, end: float, usual: float) -> MotionGap:
    speed, rate, since = motion_rates(motion)
    known = np.ones(len(since), dtype=np.bool_)
    over = -1
    if isinstance(motion, Odometry):  # the record that ends the gap
        over = int(np.searchsorted(since, begin))
        known[over] = len(since) == 1
    before = known & (since <= begin) & (since >= begin - AROUND)
    after = known & (since >= end) & (since <= end + AROUND)
    sides = [m for m in (before, after) if m.any()] or [known]
    v = float(np.mean([np.mean(speed[m]) for m in sides]))
    w = float(np.mean([np.mean(rate[m]) for m in sides]))
    if over >= 0 and abs(speed[over]) >= LOST * abs(v):  # it has the whole motion, not the velocity within
        v, w = float(speed[over]), float(rate[over])
        return MotionGap(begin, end, v, w, BRIDGED * abs(v), BRIDGED * abs(w), usual)
    if isinstance(motion, Odometry) and gives_motion(motion, np.array([over]))[0]:  # perhaps it stopped meanwhile
        return MotionGap(begin, end, float(speed[over]), float(rate[over]), abs(v), abs(w), usual)
    spread_v = float(np.sqrt(np.mean((speed[known] - v) ** 2)))
    spread_w = float(np.sqrt(np.mean((rate[known] - w) ** 2)))
    return MotionGap(begin, end, v, w, spread_v, spread_w, usual)


def _filled(motion: Motion, gap: MotionGap) -> Motion:
    """The motion with the speed and yaw rate of the gap inserted."""
    v, w = gap.speed, gap.yaw_rate
    if isinstance(motion, Odometry):
        increments = motion.increments.copy()
        k = int(np.searchsorted(motion.times, gap.end))
        T, covariances = gap.end - gap.begin, motion.covariances.copy()
        increments[k] = se2_exp(T * np.array([v, 0.0, w]))
        known = int(np.searchsorted(motion.times, gap.end + AROUND, side="right"))  # see find_motion_gaps
        covariances[k] += T * np.diag(usual_variances(motion.take(slice(0, known)), np.array([k - 1])))
        return replace(motion, increments=increments, covariances=covariances)
    k = int(np.searchsorted(motion.times, gap.begin)) + 1
    times = np.insert(motion.times, k, gap.begin + min(gap.usual, SHORTEST))
    if isinstance(motion, VelocityControls):
        return replace(
            motion, times=times, speed=np.insert(motion.speed, k, v), yaw_rate=np.insert(motion.yaw_rate, k, w)
        )
    g = motion.geometry
    angle = float(np.arctan(w * g.wheelbase / v)) if v else 0.0
    wheel = (
        v / np.cos(angle) if g.model == "front-steer" else v * (1.0 - np.tan(angle) * g.encoder_offset / g.wheelbase)
    )
    return replace(
        motion, times=times, speed=np.insert(motion.speed, k, wheel), steering=np.insert(motion.steering, k, angle)
    )


def _widened(odometry: Odometry, gaps: list[MotionGap]) -> Array:
    """Covariances ``(n, 3, 3)`` with the uncertainty of the motion in the gaps."""
    t, covariances = odometry.times, odometry.covariances.copy()
    for gap in gaps:
        T = gap.end - gap.begin
        inside = np.zeros(len(t))
        inside[1:] = np.maximum(np.minimum(t[1:], gap.end) - np.maximum(t[:-1], gap.begin), 0.0)
        heading = min(gap.yaw_rate_sigma * T, HEADING_UNKNOWN) / T
        for k in np.flatnonzero(inside > 0.0):
            h = inside[k]
            turn, length = heading * np.sqrt(T * h), abs(gap.speed) * h
            # along: the distance, and its loss by a bend; across: displacement of the end of an arc by a rotation
            along = np.hypot(gap.speed_sigma * np.sqrt(T * h), length * min(turn**2, 1.0) / 4.0)
            across = length * turn / np.sqrt(3.0) + 0.1 * along
            covariances[k] += np.diag(np.square([along, across, turn]))
    return covariances
