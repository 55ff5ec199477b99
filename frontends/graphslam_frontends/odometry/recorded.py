"""Recorded odometry in 2-D or 3-D: integration, bridging of gaps, corrections."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array, se2_exp, se2_log
from graphslam.core.log import DropCounter
from graphslam.core.poses import group_of
from graphslam.core.records import Odometry
from graphslam.core.trajectory import Trajectory
from graphslam_frontends.odometry.gaps import OPTION, Gaps, refuse_long_gaps

Ints = npt.NDArray[np.int64]
BRIDGED = 0.2
"""σ of the division of a bridged record, relative to its motion."""
PLAUSIBLE = 2.0
"""A record gives the motion over a gap if it is at most this multiple of the fastest motion elsewhere, …"""
CLOCK_SET = 2.0
"""… and, on a moving body, more than this multiple of the records beside it: if it is not, a clock was set."""
MOVING = 0.05, 0.05
"""Slower bodies are at rest [m/s, rad/s]."""


def record_rates(odometry: Odometry) -> tuple[Array, Array, Array]:
    """Distance ``(n - 1,)`` [m] and angle ``(n - 1,)`` [rad] of the records after the first, and their durations
    [s]."""
    g = group_of(odometry.increments)
    xi = g.log(odometry.increments[1:])
    metres = np.linalg.norm(xi[:, g.position], axis=1)
    radians = np.linalg.norm(np.delete(xi, np.r_[g.position], axis=1), axis=1)
    return metres, radians, np.diff(odometry.times)


def gives_motion(odometry: Odometry, records: Ints) -> npt.NDArray[np.bool_]:
    """Which of the long ``records`` (indices of intervals) give the motion of the body over their interval.

    Not one that is faster than the body ever was (the odometry was reset), nor one between moving records with a motion
    no longer than theirs (a clock was set, or the records in between are lost).

    Returns
    -------
    (k,) bool
    """
    metres, radians, seconds = record_rates(odometry)
    others = np.setdiff1d(np.arange(len(seconds)), records)
    out = np.ones(len(records), dtype=np.bool_)
    if not len(others):
        return out
    for moved, slow in zip((metres, radians), MOVING):
        fastest = max(float(np.percentile(moved[others] / seconds[others], 99)), slow)
        out &= moved[records] <= PLAUSIBLE * fastest * seconds[records]
    for n, i in enumerate(records):
        near = [j for j in (i - 1, i + 1) if 0 <= j < len(seconds) and j not in records]
        if len(near) == 2 and min(metres[j] / seconds[j] for j in near) > MOVING[0]:
            out[n] &= metres[i] > CLOCK_SET * max(metres[j] for j in near)
    return out


def motion_is_given(odometry: Odometry, begin: float, end: float) -> bool:
    """Whether all long records between two times [s] give the motion of the body (:func:`gives_motion`)."""
    t = odometry.times
    if not t[0] <= begin < end <= t[-1]:
        return False
    spacing = np.diff(t)
    k = np.flatnonzero(spacing > max(3.0 * float(np.median(spacing)), 1.0))
    return bool(np.all(gives_motion(odometry, k)[(t[k] < end) & (t[k + 1] > begin)]))


def usual_variances(odometry: Odometry, records: Ints) -> Array:
    """Median variance per second ``(d,)`` of the other records: covariances over gaps grow by at least this."""
    seconds = np.diff(odometry.times)
    others = np.setdiff1d(np.arange(len(seconds)), records)
    rates = np.diagonal(odometry.covariances[1:][others], axis1=1, axis2=2) / seconds[others][:, None]
    return np.asarray(np.median(rates, axis=0)) if len(others) else np.zeros(odometry.covariances.shape[1])


def add_yaw_bias(odometry: Odometry, rate: float) -> Odometry:
    """Add a constant gyro error ``rate`` about the z axis of the base [rad/s] to the odometry."""
    g = group_of(odometry.increments)
    seconds = np.concatenate([[0.0], np.diff(odometry.times)])[: len(odometry.times)]
    xi = g.log(odometry.increments)
    xi[:, g.heading] += rate * seconds
    return replace(odometry, increments=g.exp(xi))


def chain_odometry(odometry: Odometry) -> Trajectory:
    """Poses ``(n, 3 | 7)`` of recorded increments in the frame of the first pose."""
    poses = odometry.increments.copy()
    g = group_of(poses)
    if len(poses):
        poses[0] = g.identity
    for k in range(1, len(poses)):
        poses[k] = g.compose(poses[k - 1], odometry.increments[k])
    return Trajectory(odometry.times, poses)


def bridge_gap(
    odometry: Odometry, limit: float, *, where: str, drops: DropCounter | None = None
) -> tuple[Odometry, Gaps]:
    """Odometry with larger covariances of records that span a gap; and the gaps.

    A record gives the motion over its interval, but not the velocity within it, so pieces of it are less certain.
    Records longer than 3 times the median (and than 1 s) are counted and get an additional σ of 20 % of their motion on
    every axis. If the body moved before and after (:data:`MOVING`), and the record has less than half of that speed,
    records may be missing: σ is then that speed (and the RMS yaw rate) times the interval.

    Records longer than ``limit`` [s] must give the motion over their interval (:func:`gives_motion`); others are
    refused. Their covariance also grows by the usual variance per second.
    """
    if len(odometry.times) < 2:
        return odometry, Gaps()
    spacing = np.diff(odometry.times)
    k = np.flatnonzero(spacing > max(3.0 * float(np.median(spacing)), 1.0))
    long = k[spacing[k] > limit]
    refuse_unbridged(odometry, long, limit, where)
    if drops is not None:
        drops.drop(where, "gap bridged", len(k))
    g = group_of(odometry.increments)
    metres, radians, _ = record_rates(odometry)
    sound = np.setdiff1d(np.arange(len(spacing)), k)
    # weighted by the squared intervals: corrected stamps are 1 ms apart, and their rates mean nothing
    turns = float(np.sqrt(np.sum(radians[sound] ** 2) / np.sum(spacing[sound] ** 2))) if len(sound) else 0.0
    covariances = odometry.covariances.copy()
    for i in k:
        near = [j for j in (i - 1, i + 1) if 0 <= j < len(spacing) and j not in k]
        # the first and the last record have one neighbour only: a stationary body starts or stops there
        speed = min(float(metres[j] / spacing[j]) for j in near) if len(near) == 2 else 0.0
        sigma = np.full(g.dof, BRIDGED * radians[i])
        sigma[g.position] = BRIDGED * metres[i]
        if speed > MOVING[0] and metres[i] < 0.5 * speed * spacing[i]:
            sigma[g.heading] = max(sigma[g.heading], turns * spacing[i])
            sigma[g.position] = speed * spacing[i]
        covariances[i + 1] += np.diag(np.square(sigma))
    covariances[long + 1] += np.diag(usual_variances(odometry, k)) * spacing[long][:, None, None]
    return replace(odometry, covariances=covariances), Gaps(odometry.times[k], odometry.times[k + 1])


def refuse_unbridged(odometry: Odometry, long: Ints, limit: float, where: str, option: str = OPTION) -> None:
    """Raise for a record longer than ``limit`` seconds that does not give the motion over its interval."""
    odd = long[~gives_motion(odometry, long)]
    metres, _, _ = record_rates(odometry)
    moved = "" if not len(odd) else f"; the odometry moves {metres[odd].max():.2f} m over it: reset, or a clock was set"
    refuse_long_gaps(odometry.times, odd, limit, where, option, got=moved)


def without_yaw_per_metre(odometry: Odometry, rate: float, *, where: str = "odometry") -> Odometry:
    """The odometry minus a rotation of ``rate`` [rad/m] per metre driven."""
    if odometry.increments.shape[1] != 3:
        raise ConfigError(f"{where}: yaw_per_metre is for odometry in the plane")
    xi = se2_log(odometry.increments)
    xi[:, 2] -= rate * np.hypot(xi[:, 0], xi[:, 1])
    return replace(odometry, increments=se2_exp(xi))
