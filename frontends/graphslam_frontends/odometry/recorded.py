"""Recorded odometry in two or three dimensions: cut at any stamps, bridged, degraded, and honest over intervals."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.errors import ConfigError, DataError
from graphslam.core.geometry import Array, se2_exp, se2_log
from graphslam.core.log import DropCounter
from graphslam.core.poses import group_of
from graphslam.core.records import Odometry, check_times
from graphslam.core.se3 import se3_adjoint, se3_compose, se3_exp, se3_inverse, se3_log
from graphslam.core.trajectory import Trajectory
from graphslam_frontends.odometry.gaps import Gaps, refuse_long_gaps
from graphslam_frontends.odometry.motion import MotionNoise, recorded_odometry

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
        """
        o = self.odometry
        n, g = len(o.times), group_of(o.increments)
        if not 0 <= start <= end < n:
            raise DataError("no such interval of the path", got=(start, end), wanted=f"0 ≤ start ≤ end < {n}")
        if g.dim == 3 and (level_start or level_end):
            raise DataError("recorded odometry does not say where level is", wanted="an IMU")
        T = g.identity
        P, J = o.covariances[0].copy(), np.zeros((g.dof, 2))  # J: the error per unit of yaw rate and of scale
        for k in range(start + 1, end + 1):
            step = o.increments[k]
            back = g.adjoint(g.inverse(step))
            J = back @ J + bias_effect(step, float(o.times[k] - o.times[k - 1]))
            P = back @ P @ back.T + o.covariances[k]
            T = g.compose(T, step)
        P = P + J @ np.diag([self.yaw_bias**2, self.scale**2]) @ J.T
        return T, 0.5 * (P + P.T)


def bias_effect(step: Array, seconds: float) -> Array:
    """Right-tangent error ``(d, 2)`` of a motion per unit of yaw rate [rad/s] and of scale, constant during it."""
    g = group_of(step)
    xi = g.log(step)
    change = np.zeros((g.dof, 2))
    change[g.heading, 0] = seconds
    change[g.position, 1] = xi[g.position]
    return np.asarray(g.right_jacobian(xi) @ change)


def add_yaw_bias(odometry: Odometry, rate: float) -> Odometry:
    """The odometry of a robot whose gyro is off by ``rate`` about the z axis of the base [rad/s], all along."""
    g = group_of(odometry.increments)
    seconds = np.concatenate([[0.0], np.diff(odometry.times)])[: len(odometry.times)]
    xi = g.log(odometry.increments)
    xi[:, g.heading] += rate * seconds
    return replace(odometry, increments=g.exp(xi))


def chain_odometry(odometry: Odometry) -> Trajectory:
    """Poses ``(n, 3 | 7)`` of recorded increments in the frame of the first record's pose."""
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
    """Records of odometry that span a gap, made less certain; and the gaps.

    A record tells the whole motion over its time, however long, but not how it went meanwhile: cut into pieces its
    covariance must cover more than the record's own. Records that take longer than thrice the usual (and than 1 s) are
    counted, and those of which the motion is cut get σ = 20 % of their motion on every axis besides their own. Where
    the body moved before and after, and the record tells less than half of that speed, records may have been lost, and
    with them motion: σ is then what the body drives (and, root of the mean square, turns) in that time.
    """
    if len(odometry.times) < 2:
        return odometry, Gaps()
    spacing = np.diff(odometry.times)
    k = np.flatnonzero(spacing > max(3.0 * float(np.median(spacing)), 1.0))
    refuse_long_gaps(odometry.times, k, limit, where)
    if drops is not None:
        drops.drop(where, "gap bridged", len(k))
    g = group_of(odometry.increments)
    xi = g.log(odometry.increments[1:])
    metres = np.linalg.norm(xi[:, g.position], axis=1)
    radians = np.linalg.norm(np.delete(xi, np.r_[g.position], axis=1), axis=1)
    sound = np.setdiff1d(np.arange(len(spacing)), k)
    turns = float(np.sqrt(np.mean((radians[sound] / spacing[sound]) ** 2))) if len(sound) else 0.0
    covariances = odometry.covariances.copy()
    for i in k:
        near = [j for j in (i - 1, i + 1) if 0 <= j < len(spacing) and j not in k]
        # beside the first and the last record there is one neighbour only: a body that stands before it sets off
        speed = min(float(metres[j] / spacing[j]) for j in near) if len(near) == 2 else 0.0
        sigma = np.full(g.dof, BRIDGED * radians[i])
        sigma[g.position] = BRIDGED * metres[i]
        if metres[i] < 0.5 * speed * spacing[i]:
            sigma[g.heading] = max(sigma[g.heading], turns * spacing[i])
            sigma[g.position] = speed * spacing[i]
        covariances[i + 1] += np.diag(np.square(sigma))
    return replace(odometry, covariances=covariances), Gaps(odometry.times[k], odometry.times[k + 1])


def cut_odometry(odometry: Odometry, times: Array, noise: MotionNoise) -> Odometry:
    """Increments between consecutive ``times``; a record that a stamp falls into is cut at constant velocity.

    In the plane this is :func:`graphslam_frontends.odometry.motion.recorded_odometry`; here it goes on in space.

    Parameters
    ----------
    times : (n,)
        Inside the records.
    noise : MotionNoise
        Only its floors.
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


def without_yaw_per_metre(odometry: Odometry, rate: float, *, where: str = "odometry") -> Odometry:
    """The odometry without a turn of ``rate`` [rad/m] for each metre driven."""
    if odometry.increments.shape[1] != 3:
        raise ConfigError(f"{where}: yaw_per_metre is for odometry in the plane")
    xi = se2_log(odometry.increments)
    xi[:, 2] -= rate * np.hypot(xi[:, 0], xi[:, 1])
    return replace(odometry, increments=se2_exp(xi))
