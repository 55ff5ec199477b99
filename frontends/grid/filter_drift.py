"""What a particle filter leaves of the errors of dead reckoning: a covariance that knows the shape of the path.

Particles share their ancestors, and with them most of what is wrong with all of them; their spread is a small part of
how far off they are. What is left is, above all, a heading that walks: its errors turn everything that comes after, so
the end of a segment is off across its path, the more the longer the way from where the heading erred. A model that only
knows the length cannot say so, and is over-confident in position where it is right in heading.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphslam.core.errors import ConfigError, DataError
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of, level

_NODES = 64
"""Places along a path at which the heading may err; more change nothing that a Monte Carlo could see."""


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
    heading_start: float = 0.002
    """σ at no length [rad]."""
    position_start: float = 0.01
    """[m]"""
    height_start: float = 0.025
    """[m]"""
    height_walk: float = 0.021
    """[m/√m]"""
    height_scale: float = 0.002
    """Gravity is told with an error that lasts: σ of the height after a way of one metre [m/m]."""
    tilt: float = 0.006
    """σ of roll and pitch, whatever the length [rad]."""

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ConfigError(f"filter drift: {name} = {value}; wanted ≥ 0")
        if min(self.heading_start, self.position_start, self.height_start, self.tilt) <= 0:
            raise ConfigError("filter drift: σ at no length must be > 0, or covariances are singular")

    def covariance(self, path: Array, particles: int, *, gravity: bool = True) -> Array:
        """Right-tangent covariance at the end of a path.

        Parameters
        ----------
        path : (n, 7) or (n, 3)
            Poses from the start to the end, in any frame whose z axis is up.
        particles : int
        gravity : bool
            The frame at the end stands level, as that of a submap does.

        Raises
        ------
        DataError
            No pose, or no particle.
        """
        poses = np.asarray(path, dtype=np.float64)
        if poses.ndim != 2 or len(poses) == 0 or particles < 1:
            raise DataError("no path or no particle to say the drift of", got=(poses.shape, particles))
        group = group_of(poses)
        end = level(poses[-1]) if gravity and group.dim == 3 else poses[-1]
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
        heading = self.alone_walk**2 if particles == 1 else more * self.heading_walk**2
        C = heading * (effect * share[:, None]).T @ effect
        C[group.heading, group.heading] += self.heading_start**2
        C[[x, y], [x, y]] += self.position_start**2 + more * self.position_walk**2 * length
        away = np.zeros(group.dof)
        away[[x, y]] = -there[0, :2]
        C += self.position_scale**2 * np.outer(away, away)
        if group.dim == 3:
            C[5, 5] += self.height_start**2 + self.height_walk**2 * length + (self.height_scale * length) ** 2
            C[[0, 1], [0, 1]] += self.tilt**2
        return C
