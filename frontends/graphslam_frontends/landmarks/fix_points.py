"""Antenna positions on the smoothed path of a submap at the times of fixes, jointly with exit pose and landmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graphslam.core.gaussian import Gaussian
from graphslam.core.geometry import (
    Array,
    rotation2,
    se2_compose,
    se2_exp,
    se2_inverse,
    se2_log,
    se2_transform,
    wrap_angle,
)
from graphslam.core.path_points import SAME_TIME, PathPoints
from graphslam.core.record_source import RecordSource
from graphslam.core.records import Gps
from graphslam_frontends.landmarks.smoothing_kernels import path_covariances
from graphslam_frontends.landmarks.summarise import SmoothingResult

STEP = 1e-5
"""Step of the central differences [m, rad]."""
FLOOR = 1e-4
"""Least σ of a point [m]."""


def expects_fixes(feed: RecordSource, until: float) -> bool:
    """May fixes older than ``until`` [s] still arrive in a growing log?

    The result of a front end must not depend on the portions in which a log arrives.
    """
    name = feed.of_type(Gps)
    return not feed.ended and name is not None and feed.until(name) < until


def measured_times(feed: RecordSource) -> tuple[Array, Array] | None:
    """Times of the fixes, and of control and check points with the same lever; and that lever ``(2,)``."""
    name = feed.of_type(Gps)
    if name is None:
        return feed.places
    gps: Gps = feed.part(name)  # type: ignore[assignment]
    lever = np.asarray(gps.lever[:2], dtype=np.float64)
    if feed.places is None or np.abs(feed.places[1] - lever).max() > SAME_TIME:
        return gps.times, lever
    return np.union1d(gps.times, feed.places[0]), lever


def has_fixes(feed: RecordSource, t_start: float, times: Array) -> bool:
    """Are there fixes between the ends of a submap?"""
    found = measured_times(feed)
    if found is None:
        return False
    return bool(np.any((found[0] > t_start + SAME_TIME) & (found[0] < times[-1] - SAME_TIME)))


def transfer_points(points: PathPoints | None, smoothed: Gaussian, mean: Array, joint: Array) -> PathPoints | None:
    """Points with another Gaussian over exit pose and landmarks than the smoothed one that they were made with.

    The conditional distribution of the points given exit pose and landmarks is unchanged; their marginal is replaced.
    """
    if points is None:
        return None
    gain, left = points.given(smoothed.covariance, np.arange(len(points)))
    off = mean - smoothed.mean
    off[2] = wrap_angle(off[2])
    cross = gain @ joint
    own = left + cross @ gain.T
    return PathPoints(
        times=points.times, lever=points.lever, positions=points.positions + (gain @ off).reshape(-1, 2),
        covariance=0.5 * (own + own.T), cross=cross,
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class FixPlacement:
    """Positions of fixes on a smoothed path: on the arc from pose ``at`` to the next (-1: from the base).

    Parameters
    ----------
    times : (q,)
    lever : (2,)
    at : (q,)
    share : (q,)
        Fraction of the arc.
    positions : (q, 2)
        Of the antenna.
    by_first, by_second : (q, 2, 3)
        Jacobians by the right tangents of both poses.
    """

    times: Array
    lever: Array
    at: npt.NDArray[np.int64]
    share: Array
    positions: Array
    by_first: Array
    by_second: Array


def place_fixes(feed: RecordSource, smoothed: SmoothingResult, t_start: float, times: Array) -> FixPlacement | None:
    """Positions of the fixes inside a submap; None if there are none.

    Parameters
    ----------
    t_start : float
        Of the submap [s].
    times : (T,)
        Of the smoothed poses [s].
    """
    found = measured_times(feed)
    if found is None or not has_fixes(feed, t_start, times):
        return None
    measured, lever = found
    inside = (measured > t_start + SAME_TIME) & (measured < times[-1] - SAME_TIME)
    at_fixes = np.unique(measured[inside])
    known = np.concatenate([[min(t_start, times[0])], times])
    poses = np.concatenate([np.zeros((1, 3)), smoothed.poses])
    k = np.clip(np.searchsorted(known, at_fixes, side="right") - 1, 0, len(known) - 2)
    span = known[k + 1] - known[k]
    share = np.where(span > 0, (at_fixes - known[k]) / np.where(span > 0, span, 1.0), 1.0)[:, None]

    def antenna(a: Array, b: Array) -> Array:
        between = share * se2_log(se2_compose(se2_inverse(a), b))
        return se2_transform(se2_compose(a, se2_exp(between)), np.broadcast_to(lever, (len(a), 2)))

    G = np.zeros((2, len(k), 2, 3))
    for c in range(3):
        step = np.zeros((1, 3))
        step[0, c] = STEP
        for end in range(2):
            moved = []
            for sign in (1.0, -1.0):
                ends = [poses[k], poses[k + 1]]
                ends[end] = se2_compose(ends[end], se2_exp(np.tile(sign * step, (len(k), 1))))
                moved.append(antenna(*ends))
            G[end, :, :, c] = (moved[0] - moved[1]) / (2.0 * STEP)
    G[0, k == 0] = 0.0  # the base is fixed
    at = (k - 1).astype(np.int64)
    return FixPlacement(at_fixes, lever, at, share[:, 0], antenna(poses[k], poses[k + 1]), G[0], G[1])


def fix_points(smoothed: SmoothingResult, placed: FixPlacement) -> PathPoints:
    """Points of a submap's path at the fixes inside it.

    Between two scans the path is the arc from one pose to the next; the deviation from it has the variance of a
    Brownian bridge, ``a (1 - a) Q`` at the fraction a of a step whose odometry has the covariance Q.
    """
    cross, own = path_covariances(
        smoothed.poses, smoothed.landmarks, smoothed.evidence, placed.at, placed.by_first, placed.by_second
    )
    exit_turn = rotation2(smoothed.poses[-1, 2])
    cross[:, :2] = cross[:, :2] @ exit_turn.T  # right tangent of the exit -> plain vector of eq. 15
    Q = np.linalg.inv(smoothed.evidence.W)[:, :2, :2]
    k, share = placed.at + 1, placed.share
    for i in range(len(k)):
        R = rotation2(smoothed.poses[k[i], 2])
        for j in range(i, len(k)):
            if k[j] != k[i]:
                break
            bridge = float(share[i] * (1.0 - share[j])) * (R @ Q[k[i]] @ R.T)
            own[2 * i : 2 * i + 2, 2 * j : 2 * j + 2] += bridge
            if j > i:
                own[2 * j : 2 * j + 2, 2 * i : 2 * i + 2] += bridge
    own[np.diag_indices(len(own))] += FLOOR**2
    return PathPoints(
        times=placed.times, lever=placed.lever, positions=placed.positions, covariance=0.5 * (own + own.T), cross=cross
    )
