"""Recorded odometry in two or three dimensions: cut at any stamps, bridged, degraded, and honest over intervals."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from frontends.motion import MotionNoise, recorded_odometry
from graphslam.core.errors import DataError
from graphslam.core.geometry import (
    Array,
    se2_adjoint,
    se2_between,
    se2_compose,
    se2_exp,
    se2_inverse,
    se2_log,
    se2_right_jacobian,
)
from graphslam.core.log import DropCounter
from graphslam.core.records import Odometry, check_times
from graphslam.core.se3 import (
    se3_adjoint,
    se3_between,
    se3_compose,
    se3_exp,
    se3_inverse,
    se3_log,
    se3_right_jacobian,
)
from graphslam.core.trajectory import Trajectory

BRIDGED = 0.2
"""σ of the pieces of a bridged record together, as a share of its motion."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedErrors:
    """Dead reckoning whose increments are independent but for a yaw rate and a scale that are off all along.

    Parameters
    ----------
    odometry : Odometry
        Its covariances hold what is new in each step.
    yaw_bias : float
        σ of a constant error of the yaw rate, about the z axis of the base [rad/s].
    scale : float
        σ of the scale of all distances.
    """

    odometry: Odometry
    yaw_bias: float = 0.0
    scale: float = 0.0

    def between(
        self, start: int, end: int, *, level_start: bool = False, level_end: bool = False
    ) -> tuple[Array, Array]:
        """Motion from record ``start`` to record ``end`` and its covariance, errors that last included.

        Parameters
        ----------
        start, end : int
            0 ≤ start ≤ end < n.
        level_start, level_end : bool
            Changes nothing in the plane. In three dimensions recorded odometry does not see gravity: refused.

        Returns
        -------
        pose : (7,) or (3,)
        covariance : (d, d)
            Right tangent.

        Raises
        ------
        DataError
        """
        o = self.odometry
        n, planar = len(o.times), o.increments.shape[1] == 3
        if not 0 <= start <= end < n:
            raise DataError("no such interval of the path", got=(start, end), wanted=f"0 ≤ start ≤ end < {n}")
        if not planar and (level_start or level_end):
            raise DataError("recorded odometry does not say where level is", wanted="an IMU")
        T = np.zeros(3) if planar else np.array([0.0, 0, 0, 0, 0, 0, 1])
        d = 3 if planar else 6
        P, J = o.covariances[0].copy(), np.zeros((d, 2))  # J: the error per unit of yaw rate and of scale
        for k in range(start + 1, end + 1):
            step = o.increments[k]
            back = se2_adjoint(se2_inverse(step)) if planar else se3_adjoint(se3_inverse(step))
            J = back @ J + lasting_effect(step, float(o.times[k] - o.times[k - 1]))
            P = back @ P @ back.T + o.covariances[k]
            T = se2_compose(T, step) if planar else se3_compose(T, step)
        P = P + J @ np.diag([self.yaw_bias**2, self.scale**2]) @ J.T
        return T, 0.5 * (P + P.T)


def lasting_effect(step: Array, seconds: float) -> Array:
    """Right-tangent error ``(d, 2)`` of a motion per unit of yaw rate [rad/s] and of scale, constant during it."""
    planar = len(step) == 3
    xi = se2_log(step) if planar else se3_log(step)
    change = np.zeros((len(xi), 2))
    change[2, 0] = seconds  # heading in the plane, rotation about z in space
    if planar:
        change[:2, 1] = xi[:2]
    else:
        change[3:, 1] = xi[3:]
    return (se2_right_jacobian(xi) if planar else se3_right_jacobian(xi)) @ change


def add_yaw_bias(odometry: Odometry, rate: float) -> Odometry:
    """The odometry of a robot whose gyro is off by ``rate`` about the z axis of the base [rad/s], all along."""
    planar = odometry.increments.shape[1] == 3
    seconds = np.concatenate([[0.0], np.diff(odometry.times)])[: len(odometry.times)]
    xi = se2_log(odometry.increments) if planar else se3_log(odometry.increments)
    xi[:, 2] += rate * seconds
    return replace(odometry, increments=se2_exp(xi) if planar else se3_exp(xi))


def chain(odometry: Odometry) -> Trajectory:
    """Poses ``(n, 3 | 7)`` of recorded increments in the frame of the first record's pose."""
    poses = odometry.increments.copy()
    compose = se2_compose if poses.shape[1] == 3 else se3_compose
    if len(poses):
        poses[0] = np.zeros(3) if poses.shape[1] == 3 else [0.0, 0, 0, 0, 0, 0, 1]
    for k in range(1, len(poses)):
        poses[k] = compose(poses[k - 1], odometry.increments[k])
    return Trajectory(odometry.times, poses)


def bridge(odometry: Odometry, limit: float, *, where: str, drops: DropCounter | None = None) -> Odometry:
    """Records of odometry that span a gap, made less certain.

    A record tells the whole motion over its time, however long, but not how it went meanwhile: cut into pieces its
    covariance must cover more than the record's own. Records that take longer than thrice the usual (and than 1 s) are
    counted, and those of which the motion is cut get σ = 20 % of their motion on every axis besides their own.

    Raises
    ------
    DataError
        A record longer than ``limit`` seconds: names it.
    """
    if len(odometry.times) < 2:
        return odometry
    spacing = np.diff(odometry.times)
    k = np.flatnonzero(spacing > max(3.0 * float(np.median(spacing)), 1.0))
    if len(k) and spacing[k].max() > limit:
        worst = int(k[np.argmax(spacing[k])])
        raise DataError(
            f"gap without records: {spacing[worst]:.3f} s after record {worst}",
            where=where,
            got=f"{odometry.times[worst]:.3f} to {odometry.times[worst + 1]:.3f} s",
            wanted=f"gaps of at most {limit:g} s",
        )
    if drops is not None:
        drops.drop(where, "gap bridged", len(k))
    planar = odometry.increments.shape[1] == 3
    covariances = odometry.covariances.copy()
    for record in k + 1:
        xi = (se2_log if planar else se3_log)(odometry.increments[record])
        turn, move = (xi[2:], xi[:2]) if planar else (xi[:3], xi[3:])
        metres, radians = BRIDGED * np.linalg.norm(move), BRIDGED * np.linalg.norm(turn)
        sigma = [metres, metres, radians] if planar else np.repeat([radians, metres], 3)
        covariances[record] += np.diag(np.square(sigma))
    return replace(odometry, covariances=covariances)


def cut_odometry(odometry: Odometry, times: Array, noise: MotionNoise) -> Odometry:
    """Increments between consecutive ``times``; a record that a stamp falls into is cut at constant velocity.

    In the plane this is :func:`frontends.motion.recorded_odometry`; here it goes on in space.

    Parameters
    ----------
    odometry : Odometry
    times : (n,)
        Inside the records.
    noise : MotionNoise
        Only its floors.

    Raises
    ------
    DataError
    """
    if odometry.increments.shape[1] == 3:
        return recorded_odometry(odometry, times, noise)
    t, stamps = check_times(times), odometry.times
    if len(stamps) < 2 or (len(t) and not (t[0] >= stamps[0] and t[-1] <= stamps[-1])):
        span = f"[{stamps[0]:.3f}, {stamps[-1]:.3f}] s" if len(stamps) > 1 else "two records at least"
        raise DataError("stamps outside the odometry", got=f"[{t[0]:.3f}, {t[-1]:.3f}] s", wanted=span)
    increments = np.tile([0.0, 0, 0, 0, 0, 0, 1], (len(t), 1))
    floor = np.diag(np.square(np.repeat([noise.floor_heading, noise.floor_position], 3)))
    covariances = np.tile(floor, (len(t), 1, 1))
    if len(t) < 2:
        return Odometry(times=t, increments=increments, covariances=covariances)
    knots = np.union1d(stamps[(stamps > t[0]) & (stamps < t[-1])], t)
    record = np.clip(np.searchsorted(stamps, 0.5 * (knots[:-1] + knots[1:]), side="right"), 1, len(stamps) - 1)
    share = np.diff(knots) / (stamps[record] - stamps[record - 1])
    whole = (knots[:-1] == stamps[record - 1]) & (knots[1:] == stamps[record])
    pieces = np.where(
        whole[:, None], odometry.increments[record], se3_exp(share[:, None] * se3_log(odometry.increments[record]))
    )
    added = share[:, None, None] * odometry.covariances[record]
    first = np.searchsorted(knots, t)
    counts = np.diff(first)
    P = np.zeros((len(t) - 1, 6, 6))
    for m in range(int(counts.max())):  # all increments grow together, one piece each at a time
        live = np.flatnonzero(counts > m)
        piece = pieces[first[live] + m]
        increments[live + 1] = se3_compose(increments[live + 1], piece)
        back = se3_adjoint(se3_inverse(piece))
        P[live] = back @ P[live] @ np.swapaxes(back, -1, -2) + added[first[live] + m]
    covariances[1:] += 0.5 * (P + np.swapaxes(P, -1, -2))
    return Odometry(times=t, increments=increments, covariances=covariances)


def between(T_wa: Array, T_wb: Array) -> Array:
    """``T_ab`` of poses ``(..., 3)`` or ``(..., 7)``."""
    return se2_between(T_wa, T_wb) if np.shape(T_wa)[-1] == 3 else se3_between(T_wa, T_wb)
