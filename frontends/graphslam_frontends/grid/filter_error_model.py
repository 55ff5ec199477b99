"""What a particle filter leaves of the errors of dead reckoning: a covariance that knows the shape of the path.

Particles share their ancestors, and with them most of what is wrong with all of them; their spread is a small part of
how far off they are. What is left is, above all, a heading that walks: its errors turn everything that comes after, so
the end of a segment is off across its path, the more the longer the way from where the heading erred. A model that only
knows the length cannot say so, and is overconfident in position where it is right in heading.

What a filter leaves has two sources. One is its own (noise of its particles, voxels, a flat likelihood): it is there
with the best of odometry, and is what `FilterDrift` was fitted to. The other are errors of the motion that reach the
map before they are seen: `Passed`, a share of what dead reckoning states of itself. A robot whose odometry is worse
has exits that say so.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.errors import ConfigError, DataError
from graphslam.core.geometry import Array, rotation2
from graphslam.core.poses import group_of, remove_roll_pitch

_NODES = 64
"""Places along a path at which the heading may err; more change nothing that a Monte Carlo could see."""
HEADING_START = 0.002
"""σ of the heading at the end of a path of no length [rad]."""
POSITION_START = 0.01
"""σ along x and y there [m]."""
HEIGHT_START = 0.025
"""σ of the height there [m]."""
HEIGHT_SCALE = 0.002
"""Time-correlated error of roll and pitch: σ of the height after a path of one metre [m/m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorPassThrough:
    """How much of the errors of dead reckoning a filter passes on.

    A scan holds a pose to the map of the last metres, and that map was drawn along the same path: errors leak into it.
    The shares were fitted to exits of drawn robots (motion, laser and speed over a factor of 4 to 16, each robot in
    another garage), and are the same, within 0.02 and 0.06, in either half of these robots.
    """

    heading: float = 0.6
    """Of the error of the heading, and without gravity of roll and pitch."""
    position: float = 0.75
    """Along x and y, and without gravity along z."""
    height_tilt: float = 110.0
    """Slope of the height by the square of the σ of roll and pitch that gravity tells [1/rad²]. Scans that are tilted
    by it thicken the floor, and the floor pulls the body along. Errors of the heights of dead reckoning are beside that
    small: a filter is worse than these where gravity is told poorly."""

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ConfigError(f"errors passed on: {name} = {value}; wanted ≥ 0")
        if max(self.heading, self.position) > 1:
            raise ConfigError("errors passed on: wanted shares ≤ 1 of heading and position")

    def covariance(self, reckoned: Array, length: float, particles: int, *, tilt: float | None = None) -> Array:
        """What is added at the end of a path, right tangent, of the size of ``reckoned``.

        Parameters
        ----------
        reckoned : (6, 6) or (3, 3)
            Covariance of dead reckoning over the path, right tangent.
        length : float
            [m]
        particles : int
            One corrects nothing, and passes everything on.
        tilt : float, optional
            σ of roll and pitch where gravity tells them [rad].
        """
        C = np.asarray(reckoned, dtype=np.float64)
        if particles == 1:
            return C
        if len(C) == 3:
            share = np.array([self.position, self.position, self.heading])
        else:
            share = np.repeat([self.heading, self.position], 3)
            if tilt is not None:
                share[[0, 1, 5]] = 0.0
        out = share[:, None] * C * share
        if len(C) == 6 and tilt is not None:
            out[5, 5] += (self.height_tilt * tilt**2 * length) ** 2
        return np.asarray(out)


PASSED = ErrorPassThrough()
"""Comes on top of what a filter leaves, where it is known how far off dead reckoning is."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterDrift:
    """Covariance at the end of a path that a filter of N particles drove.

    Walks are variances per metre. The defaults were fitted to the exits of 550 segments of 10 to 65 m in simulated
    garages, with 5, 20 and 40 particles that walk half (``walk_scale``); with the whole noise heading and position walk
    nearly twice as much.
    """

    heading_walk: float = 0.0042
    """[rad/√m]"""
    position_walk: float = 0.0118
    """Along x and y [m/√m]."""
    position_scale: float = 0.0045
    """Wheels are off by a factor that lasts: σ of it. It moves the end along the line from the start."""
    few: float = 3.0
    """The variances of these walks are larger by this over the number of particles."""
    alone_walk: float = 0.015
    """Walk of the heading of a single particle, which corrects nothing [rad/√m]."""
    height_walk: float = 0.021
    """[m/√m]"""
    tilt: float = 0.006
    """σ of roll and pitch, whatever the length [rad]."""

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ConfigError(f"filter drift: {name} = {value}; wanted ≥ 0")
        if self.tilt <= 0:
            raise ConfigError("filter drift: σ of roll and pitch must be > 0, or covariances are singular")

    def covariance(
        self,
        path: Array,
        particles: int,
        *,
        gravity: bool = True,
        reckoned: Array | None = None,
        told_tilt: float | None = None,
    ) -> Array:
        """Right-tangent covariance at the end of a path.

        Parameters
        ----------
        path : (n, 7) or (n, 3)
            Poses from the start to the end, in any frame whose z axis is up.
        gravity : bool
            The frame at the end stands level, as that of a submap does.
        reckoned : (d, d), optional
            Covariance of dead reckoning over the path, of which a share is passed on; without it a single particle's
            heading walks by ``alone_walk``, and nothing comes on top of what the filter itself leaves.
        told_tilt : float, optional
            σ of roll and pitch where gravity tells them [rad].
        """
        poses = np.asarray(path, dtype=np.float64)
        if poses.ndim != 2 or len(poses) == 0 or particles < 1:
            raise DataError("no path or no particle to say the drift of", got=(poses.shape, particles))
        group = group_of(poses)
        end = remove_roll_pitch(poses[-1]) if gravity and group.dim == 3 else poses[-1]
        steps = np.concatenate([[0.0], np.linalg.norm(np.diff(poses[:, : group.dim], axis=0), axis=1)])
        s = np.cumsum(steps)
        k = np.unique(np.linspace(0, len(s) - 1, min(_NODES, len(s))).round().astype(np.int64))
        length = float(s[-1])
        # where the body was, as seen from the end: an error of the heading there turns all that comes after about it
        there = group.between(np.broadcast_to(end, poses[k].shape), poses[k])[:, : group.dim]
        effect = np.zeros((len(k), group.dof))
        effect[:, group.heading] = 1.0
        x, y = (0, 1) if group.dim == 2 else (3, 4)
        effect[:, x], effect[:, y] = there[:, 1], -there[:, 0]
        share = np.zeros(len(k))
        share[:-1] += 0.5 * np.diff(s[k])
        share[1:] += 0.5 * np.diff(s[k])
        more = 1.0 + self.few / particles
        alone = particles == 1 and reckoned is None
        heading = self.alone_walk**2 if alone else more * self.heading_walk**2
        C = heading * (effect * share[:, None]).T @ effect
        C[group.heading, group.heading] += HEADING_START**2
        C[[x, y], [x, y]] += POSITION_START**2 + more * self.position_walk**2 * length
        away = np.zeros(group.dof)
        away[[x, y]] = -there[0, :2]
        C += self.position_scale**2 * np.outer(away, away)
        if group.dim == 3:
            C[5, 5] += HEIGHT_START**2 + self.height_walk**2 * length + (HEIGHT_SCALE * length) ** 2
            C[[0, 1], [0, 1]] += self.tilt**2
        return C if reckoned is None else C + PASSED.covariance(reckoned, length, particles, tilt=told_tilt)


def interpolate_covariances(knots: npt.NDArray[np.int64], covariances: Array, poses: Array, along: Array) -> Array:
    """Covariances ``(n, d, d)`` at all poses of a path from those at some, linear in the way, right tangents.

    In the axes of the base, where neighbours differ by drift alone and not by the turn of the body.

    Parameters
    ----------
    knots : (k,) int
        Rising, from 0 to n - 1.
    covariances : (k, d, d)
    poses : (n, 7) or (n, 3)
    along : (n,)
        Metres driven, not falling.
    """
    n = len(poses)
    R = _axes(poses)
    D = R[knots] @ covariances @ np.swapaxes(R[knots], 1, 2)
    way = along + 1e-9 * np.arange(n)  # a robot that stands still: by steps
    j = np.clip(np.searchsorted(knots, np.arange(n), side="right") - 1, 0, len(knots) - 2)
    a, b = way[knots[j]], way[knots[j + 1]]
    u = ((way - a) / (b - a))[:, None, None]
    return np.asarray(np.swapaxes(R, 1, 2) @ ((1.0 - u) * D[j] + u * D[j + 1]) @ R)


def _axes(poses: Array) -> Array:
    """Rotation of tangents from the axes of the body to those of the frame ``(n, d, d)``."""
    n = len(poses)
    if poses.shape[1] == 3:
        out = np.zeros((n, 3, 3))
        out[:, :2, :2], out[:, 2, 2] = rotation2(poses[:, 2]), 1.0
        return out
    out = np.zeros((n, 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = se3.quat_to_matrix(poses[:, 3:])
    return out
