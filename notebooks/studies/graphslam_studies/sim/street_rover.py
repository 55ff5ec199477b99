"""A robot that drives through a street where it is told to, and measures on its way: for drives in closed loop."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from graphslam.core import se3
from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array, ArrayLike
from graphslam.core.random import SeedTree
from graphslam.core.range_scans import RangeScans
from graphslam.core.trajectory import Trajectory
from graphslam.sim.crawler_sensors import cast_scans
from graphslam.sim.raycast import RayCaster
from graphslam_studies.sim.movers import Mover, MovingObjects
from graphslam_studies.sim.street import Street, StreetRobot, pose_errors

_DT = 0.01
_AHEAD = 0.4
"""The robot looks towards where its way leads so far ahead [m]."""
_TURN = 1.5
"""How fast it turns [rad/s]."""
_AXLE = 0.25
"""The ground so far before and behind its middle tells its pitch [m]."""
_LEANS = 3


@dataclass(frozen=True, slots=True)
class Command:
    """A way ``(k, 2)`` that begins where the robot will be, in its own map [m], and the speed to come to [m/s]."""

    path: Array
    speed: float


@dataclass(slots=True)
class RoverState:
    """Where the robot believes it is: time [s], place [m], yaw [rad], speed [m/s], and metres along its way."""

    time: float = 0.0
    place: Array = field(default_factory=lambda: np.zeros(2))
    yaw: float = 0.0
    speed: float = 0.0
    along: float = 0.0


class StreetRover:
    """The robot of a street, driven step by step; it keeps to its way as well as it knows where it is.

    Parameters
    ----------
    seed : int
        Of every error.
    acceleration : float
        Of speeding up and of braking [m/s²].
    longest : float
        Time that it may drive [s].
    movers : sequence of Mover
        What moves in the street, seen by the laser.

    Raises
    ------
    GraphSlamError
        Open3D is not there.
    """

    def __init__(
        self,
        street: Street,
        seed: int,
        robot: StreetRobot | None = None,
        *,
        acceleration: float = 0.5,
        longest: float = 120.0,
        movers: Sequence[Mover] = (),
    ) -> None:
        if not (acceleration > 0 and longest > 1):
            raise ConfigError(f"rover: acceleration {acceleration}, longest {longest}; wanted > 0, > 1")
        self.street, self.acceleration, self.longest, self.movers = street, acceleration, longest, movers
        self.robot = robot = robot or StreetRobot()
        self._tree = SeedTree(int(seed)).child("street rover")
        self._errors = pose_errors(round(longest / _DT) + 200, _DT, robot.pose_scale, self._tree.child("pose"))
        rng = self._tree.child("lean").generator()
        self._lean = math.radians(robot.lean) * rng.dirichlet(np.ones(_LEANS))
        self._omega, self._phase = 2.0 * np.pi * rng.uniform(0.7, 1.3, _LEANS), rng.uniform(0.0, 2.0 * np.pi, _LEANS)
        self._caster = RayCaster(*street.mesh())

    def after(self, state: RoverState, command: Command, time: float) -> RoverState:
        """Where it will believe to be after some time [s] under a command."""
        return self._follow(state, command, round(time / _DT), beyond=1)[0]

    def drive(
        self, state: RoverState, command: Command, time: float
    ) -> tuple[RoverState, RangeScans, Trajectory, Array]:
        """Drive on for some time [s].

        Returns
        -------
        scans : RangeScans
            What it measured on the way.
        true_places : (n, 2)
            Where it was [m], every 0.01 s.
        """
        steps = round(time / _DT)
        new, planar = self._follow(state, command, steps, beyond=4)
        first = round(state.time / _DT)
        at = first + np.arange(len(planar))
        times = np.asarray(at * _DT, dtype=np.float64)
        error = self._errors[at]
        cos, sin = np.cos(planar[:, 2]), np.sin(planar[:, 2])
        x = planar[:, 0] - cos * error[:, 3] + sin * error[:, 4]
        y = planar[:, 1] - sin * error[:, 3] - cos * error[:, 4]
        poses = self._poses(x, y, planar[:, 2] - error[:, 2], times)
        believed = Trajectory(times, se3.se3_compose(poses, se3.se3_exp(error)))
        rate = self.robot.line_rate
        lines = np.arange(math.ceil(first * _DT * rate - 1e-9), math.ceil((first + steps) * _DT * rate - 1e-9))
        truth = _Path(Trajectory(times, poses))
        seeds = self._tree.child("beams", str(first))
        wanted = self.robot.scans(lines / rate)
        nearer = MovingObjects(self.movers, wanted.ranges.shape, self.robot.max_range) if self.movers else None
        scans = cast_scans(wanted, truth, self._caster, self.robot.noise(), seeds, nearer=nearer)
        return new, scans, believed, np.column_stack([x, y])[:steps]

    def _follow(self, state: RoverState, command: Command, steps: int, *, beyond: int) -> tuple[RoverState, Array]:
        """State after some steps, and planar poses of these and a few more ``(steps + beyond, 3)``."""
        path = command.path
        lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
        along, v, yaw = state.along, state.speed, state.yaw
        out, new = np.empty((steps + beyond, 3)), state
        for k in range(steps + beyond):
            x, y = np.interp(along, lengths, path[:, 0]), np.interp(along, lengths, path[:, 1])
            if k == steps:
                new = RoverState(state.time + steps * _DT, np.array([x, y]), yaw, v, along)
            out[k] = x, y, yaw
            ahead = min(along + _AHEAD, lengths[-1])
            to = np.interp(ahead, lengths, path[:, 0]) - x, np.interp(ahead, lengths, path[:, 1]) - y
            turn = 0.0
            if math.hypot(*to) > 1e-3:
                turn = (math.atan2(to[1], to[0]) - yaw + math.pi) % (2.0 * math.pi) - math.pi
            yaw += float(np.clip(turn, -_TURN * _DT, _TURN * _DT))
            wanted = command.speed if abs(turn) < 0.25 * math.pi else 0.0  # it turns where it stands
            v += float(np.clip(wanted - v, -self.acceleration * _DT, self.acceleration * _DT))
            along = min(along + v * _DT, lengths[-1])
        return new, out

    def _poses(self, x: Array, y: Array, yaw: Array, t: Array) -> Array:
        """Poses ``(n, 7)`` of the body on the ground, leaning."""
        dx, dy = _AXLE * np.cos(yaw), _AXLE * np.sin(yaw)
        front, rear = self.street.height(x + dx, y + dy), self.street.height(x - dx, y - dy)
        pitch = -np.arctan2(front - rear, 2.0 * _AXLE)
        pitch = pitch + np.sin(t[:, None] * self._omega + self._phase) @ self._lean
        zero = np.zeros(len(x))
        turn = se3.so3_exp(np.column_stack([zero, zero, yaw]))
        tilt = se3.so3_exp(np.column_stack([zero, pitch, zero]))
        return np.column_stack([x, y, 0.5 * (front + rear), se3.quat_multiply(turn, tilt)])


@dataclass(frozen=True, slots=True)
class _Path:
    """A trajectory as a motion."""

    trajectory: Trajectory

    def poses(self, t: ArrayLike) -> Array:
        return self.trajectory.interpolate(t)
