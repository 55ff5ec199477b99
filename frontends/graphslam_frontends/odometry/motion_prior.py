"""Motion before scans are used: increments, covariances, and systematic errors.

Sensor errors are time-correlated: one gyro bias bends a whole path, and independent increments would be overconfident.
Systematic errors are therefore states (:class:`BiasStates`), and the covariance of a motion over an interval is the
covariance of these states propagated through it. There are two implementations: for odometry and controls
(:class:`OdometryBiases`), and for an IMU with wheels
(:class:`~graphslam_frontends.odometry.inertial_biases.InertialBiases`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of, remove_roll_pitch
from graphslam.core.records import Odometry
from graphslam.core.trajectory import Trajectory
from graphslam_frontends.odometry.gaps import Gaps


@dataclass(frozen=True, slots=True, kw_only=True)
class BiasSigmas:
    """Prior σ of the systematic errors."""

    yaw_bias: float
    """Of the yaw rate [rad/s]."""
    yaw_walk: float
    """Its random walk [rad/s/√s]."""
    scale: float
    """Of distances, relative."""
    direction: float
    """Angle between the motion directions of odometry and scanner [rad]."""
    clock: float
    """Offset between the clocks of motion and scans [s]."""
    tilt: float
    """Constant error of roll and pitch by gravity [rad]."""
    bend: float
    """Planar wheels: heading error per metre, by unequal wheel radii [rad/m]."""
    turn: float
    """Planar wheels: relative error of rotations, by an error of the wheel base."""

    @classmethod
    def of(cls, stated: Mapping[str, float]) -> BiasSigmas:
        """Those given with the motion, but not less than :data:`LEAST`."""
        found = {k: max(stated.get(k, 0.0), getattr(LEAST, k)) for k in cls.__dataclass_fields__}
        # a random walk larger than given is found and widened later
        return cls(**{**found, "yaw_walk": stated.get("yaw_walk") or LEAST.yaw_walk})


LEAST = BiasSigmas(
    yaw_bias=2e-3, yaw_walk=5e-6, scale=0.01, direction=0.01, clock=0.02, tilt=2e-3, bend=0.03, turn=0.03
)
"""Lower bounds of the σ before calibration: consumer gyros, wheels under load, brackets, clocks."""


class BiasStates(Protocol):
    """Errors of a motion, including systematic ones, as states of a linear system."""

    @property
    def floor(self) -> Array:
        """Least σ of every covariance ``(d,)``."""

    @property
    def sigmas(self) -> Mapping[str, float]:
        """Given σ by the names of :class:`BiasSigmas`."""

    def initial(self, start: int) -> Array:
        """Covariance ``(s, s)`` of the states when an interval begins at step ``start``."""

    def step(self, k: int) -> tuple[Array, Array]:
        """Transition and noise ``(s, s)`` from step k - 1 to step k."""

    def tangent(self, start: int, end: int, *, level_start: bool, level_end: bool) -> Array:
        """Jacobian ``(d, s)`` of the right tangent of the motion from ``start`` to ``end`` by the states at the end."""


def interval_covariance(
    states: BiasStates, start: int, end: int, *, level_start: bool = False, level_end: bool = False
) -> Array:
    """Covariance ``(d, d)``, right tangent, of the motion from step ``start`` to step ``end``."""
    G = states.tangent(start, end, level_start=level_start, level_end=level_end)
    P = states.initial(start)
    for k in range(start + 1, end + 1):
        F, Q = states.step(k)
        P = F @ P @ F.T + Q
    C = G @ P @ G.T + np.diag(states.floor**2)
    return np.asarray(0.5 * (C + C.T))


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionPrior:
    """Motion at given times, in two or three dimensions.

    Parameters
    ----------
    odometry : Odometry
        Increments ``(n, 7)`` or ``(n, 3)`` with the covariance of the white noise in each step, for filters that sample
        independent steps; systematic errors are not included.
    poses : (n, 7) or (n, 3)
        In the frame of the path: position and heading of its start, in 3-D levelled.
    path : Trajectory
        Poses at all records of the sensors, same frame.
    biases : BiasStates
    tilt : (n, 2) or None
        Roll and pitch by gravity [rad].
    tilt_sigma, tilt_time : float
        σ of its error [rad], and the correlation time of the error [s].
    gaps : Gaps
        Gaps in the records, where the motion is extrapolated.
    """

    odometry: Odometry
    poses: Array
    path: Trajectory
    biases: BiasStates
    tilt: Array | None = None
    tilt_sigma: float = 0.0
    tilt_time: float = 1.0
    gaps: Gaps = field(default_factory=Gaps)

    def between(
        self, start: int, end: int, *, level_start: bool = False, level_end: bool = False
    ) -> tuple[Array, Array]:
        """Motion from pose ``start`` to pose ``end`` and its covariance, including systematic errors.

        Parameters
        ----------
        start, end : int
            0 ≤ start ≤ end < n.
        level_start, level_end : bool
            True: the frame there has position and heading of the body but is levelled, as frames of submaps are. A
            levelled frame has no roll and pitch error, only errors of position and heading. No effect in 2-D; an error
            in 3-D if the motion has no gravity.

        Returns
        -------
        pose : (7,) or (3,)
        covariance : (6, 6) or (3, 3)
            Right tangent.
        """
        return motion_between(self.poses, self.biases, start, end, level_start=level_start, level_end=level_end)


def motion_between(
    poses: Array, biases: BiasStates, start: int, end: int, *, level_start: bool = False, level_end: bool = False
) -> tuple[Array, Array]:
    """See :meth:`MotionPrior.between`."""
    n = len(poses)
    if not 0 <= start <= end < n:
        raise DataError("no such interval of the path", got=(start, end), wanted=f"0 ≤ start ≤ end < {n}")
    C = interval_covariance(biases, start, end, level_start=level_start, level_end=level_end)
    a = remove_roll_pitch(poses[start]) if level_start else poses[start]
    b = remove_roll_pitch(poses[end]) if level_end else poses[end]
    return group_of(a).between(a, b), C


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryBiases:
    """Constant errors of yaw rate and scale; all other errors are white.

    Parameters
    ----------
    odometry : Odometry
        Its covariances are the white noise in each step.
    yaw_bias : float
        σ of a constant error of the yaw rate, about the z axis of the base [rad/s].
    scale : float
        σ of the relative error of all distances.
    """

    odometry: Odometry
    yaw_bias: float = 0.0
    scale: float = 0.0

    @property
    def floor(self) -> Array:
        """See :class:`BiasStates`; the floors are in the covariances of the increments."""
        return np.zeros(self.odometry.covariances.shape[1])

    @property
    def sigmas(self) -> Mapping[str, float]:
        """See :class:`BiasStates`."""
        return {"yaw_bias": self.yaw_bias, "scale": self.scale}

    def initial(self, start: int) -> Array:
        """See :class:`BiasStates`."""
        constant = np.diag([self.yaw_bias**2, self.scale**2])
        return _blocks(self.odometry.covariances[0], constant)

    def step(self, k: int) -> tuple[Array, Array]:
        """See :class:`BiasStates`."""
        o, u = self.odometry, self.odometry.increments[k]
        g = group_of(u)
        F = _blocks(g.adjoint(g.inverse(u)), np.eye(2))
        F[: g.dof, g.dof :] = bias_effect(u, float(o.times[k] - o.times[k - 1]))
        return F, _blocks(o.covariances[k], np.zeros((2, 2)))

    def tangent(self, start: int, end: int, *, level_start: bool, level_end: bool) -> Array:
        """See :class:`BiasStates`; 3-D odometry has no gravity."""
        g = group_of(self.odometry.increments)
        if g.dim == 3 and (level_start or level_end):
            raise DataError("recorded odometry does not say where level is", wanted="an IMU")
        return np.eye(g.dof, g.dof + 2)


def bias_effect(step: Array, seconds: float) -> Array:
    """Right-tangent error ``(d, 2)`` of a motion per unit of yaw rate [rad/s] and of scale, constant during it."""
    g = group_of(step)
    xi = g.log(step)
    change = np.zeros((g.dof, 2))
    change[g.heading, 0] = seconds
    change[g.position, 1] = xi[g.position]
    return np.asarray(g.right_jacobian(xi) @ change)


def _blocks(a: Array, b: Array) -> Array:
    """Block-diagonal matrix of two."""
    n = len(a)
    out = np.zeros((n + len(b), n + len(b)))
    out[:n, :n], out[n:, n:] = a, b
    return out
