"""What is known of the motion before any scan is looked at: increments, covariances, and errors that outlive a step.

Errors of sensors last: one bias of a gyro bends a whole path, and increments that pretend to be independent promise a
path many times better than it is. What lasts is therefore carried in states (:class:`BiasStates`), and the covariance
of a motion over any interval is had by running these states through the interval. There are two kinds of states: of
odometry and controls (:class:`OdometryBiases`), and of an IMU with wheels
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
    """Prior σ of the errors that outlive a step."""

    yaw_bias: float
    """Of the yaw rate [rad/s]."""
    yaw_walk: float
    """Its walk [rad/s/√s]."""
    scale: float
    """Share of the distance."""
    direction: float
    """Between the way in which the odometry says the body moves, and that in which the scanner sees it move [rad]."""
    clock: float
    """Between the clocks of motion and scans [s]."""
    tilt: float
    """Constant part of gravity's roll and pitch [rad]."""
    bend: float
    """Of wheels in the plane: what they turn too much for each metre driven, one being larger [rad/m]."""
    turn: float
    """Of wheels in the plane: share of the turns, the distance between them being known no better."""

    @classmethod
    def of(cls, stated: Mapping[str, float]) -> BiasSigmas:
        """Those that the motion states, never less than :data:`LEAST`."""
        found = {k: max(stated.get(k, 0.0), getattr(LEAST, k)) for k in cls.__dataclass_fields__}
        # a walk that is greater than stated is found and widened
        return cls(**{**found, "yaw_walk": stated.get("yaw_walk") or LEAST.yaw_walk})


LEAST = BiasSigmas(
    yaw_bias=2e-3, yaw_walk=5e-6, scale=0.01, direction=0.01, clock=0.02, tilt=2e-3, bend=0.03, turn=0.03
)
"""What no robot is known better to than from its own scans: consumer gyros, wheels under load, brackets, clocks."""


class BiasStates(Protocol):
    """Errors of a motion, those that outlive a step among them, as states of a linear system."""

    @property
    def floor(self) -> Array:
        """σ that every covariance has at least ``(d,)``."""

    @property
    def sigmas(self) -> Mapping[str, float]:
        """σ by the names of :class:`BiasSigmas`, of those that are stated."""

    def initial(self, start: int) -> Array:
        """Covariance ``(s, s)`` of the states when an interval begins at step ``start``."""

    def step(self, k: int) -> tuple[Array, Array]:
        """Transition and noise ``(s, s)`` from step k - 1 to step k."""

    def tangent(self, start: int, end: int, *, level_start: bool, level_end: bool) -> Array:
        """Right tangent of the motion from step ``start`` to step ``end`` by the states at the end ``(d, s)``."""


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
        Increments ``(n, 7)`` or ``(n, 3)`` with the covariance of what is new in each step: for filters that sample
        steps as independent. Errors that last are not in it.
    poses : (n, 7) or (n, 3)
        Frame of the path: position and heading of its start, in space level.
    path : Trajectory
        Poses at every record of the sensors, same frame.
    biases : BiasStates
    tilt : (n, 2) or None
        Roll and pitch seen by gravity [rad].
    tilt_sigma, tilt_time : float
        σ of its error [rad], and the time over which errors stay alike [s].
    gaps : Gaps
        In the records: the motion there is a guess.
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
        """Motion from pose ``start`` to pose ``end`` and its covariance, errors that last included.

        Parameters
        ----------
        start, end : int
            0 ≤ start ≤ end < n.
        level_start, level_end : bool
            True: the frame there has position and heading of the body, but stands level, as frames of submaps do. Such
            a frame is level by definition; what the sensors get wrong about it is only where it is and heads. Changes
            nothing in the plane; refused in space where the motion does not see gravity.

        Returns
        -------
        pose : (7,) or (3,)
        covariance : (6, 6) or (3, 3)
            Right tangent.
        """
        n = len(self.poses)
        if not 0 <= start <= end < n:
            raise DataError("no such interval of the path", got=(start, end), wanted=f"0 ≤ start ≤ end < {n}")
        C = interval_covariance(self.biases, start, end, level_start=level_start, level_end=level_end)
        a = remove_roll_pitch(self.poses[start]) if level_start else self.poses[start]
        b = remove_roll_pitch(self.poses[end]) if level_end else self.poses[end]
        return group_of(a).between(a, b), C


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryBiases:
    """A yaw rate and a scale that are off all along; what else is wrong is new in each step.

    States: error of the motion since the start of the interval (right tangent), yaw rate [rad/s], scale.

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

    @property
    def floor(self) -> Array:
        """See :class:`BiasStates`; that of the increments is in their covariances."""
        return np.zeros(self.odometry.covariances.shape[1])

    @property
    def sigmas(self) -> Mapping[str, float]:
        """See :class:`BiasStates`."""
        return {"yaw_bias": self.yaw_bias, "scale": self.scale}

    def initial(self, start: int) -> Array:
        """See :class:`BiasStates`."""
        lasting = np.diag([self.yaw_bias**2, self.scale**2])
        return _blocks(self.odometry.covariances[0], lasting)

    def step(self, k: int) -> tuple[Array, Array]:
        """See :class:`BiasStates`."""
        o, u = self.odometry, self.odometry.increments[k]
        g = group_of(u)
        F = _blocks(g.adjoint(g.inverse(u)), np.eye(2))
        F[: g.dof, g.dof :] = bias_effect(u, float(o.times[k] - o.times[k - 1]))
        return F, _blocks(o.covariances[k], np.zeros((2, 2)))

    def tangent(self, start: int, end: int, *, level_start: bool, level_end: bool) -> Array:
        """See :class:`BiasStates`; odometry in space has not seen gravity."""
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
