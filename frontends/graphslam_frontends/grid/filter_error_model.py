"""Error model of a particle filter: covariance of its remaining error, depending on the shape of the path.

Particles share ancestors, and thus most of their errors; their spread is only a small part of the error. The remaining
error is mainly a random walk of the heading: it rotates everything after it, so the error of the end pose is mainly
across the path and grows with the distance from the heading error. A model by path length alone cannot describe that:
with a correct heading σ it is overconfident in position.

There are two sources. One is the filter itself (particle noise, voxels, wide likelihood), present even with perfect
odometry: `FilterDrift` was fitted to it. The other is motion errors that enter the map before they are observed:
`ErrorPassThrough`, a fraction of the dead-reckoning covariance. So worse odometry gives larger end-pose covariances.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.config import check_options
from graphslam.core.errors import ConfigError, DataError
from graphslam.core.geometry import Array, rotation2
from graphslam.core.poses import group_of, remove_roll_pitch

_NODES = 64
"""Number of points of a path for the integration of heading errors; more do not change the result."""
HEADING_START = 0.002
"""σ of the heading at the end of a path of zero length [rad]."""
POSITION_START = 0.01
"""σ along x and y there [m]."""
HEIGHT_START = 0.025
"""σ of the height there [m]."""
HEIGHT_SCALE = 0.002
"""Time-correlated error of roll and pitch: σ of the height after a path of one metre [m/m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorPassThrough:
    """Fraction of the dead-reckoning errors that a filter does not correct.

    Scans constrain a pose to the map of the last metres, and that map has the errors of the same path. The fractions
    were fitted to end poses of simulated random robots (noise of motion, laser and speed over a factor of 4 to 16, each
    robot in another garage); either half of the robots gives the same values within 0.02 and 0.06.
    """

    heading: float = 0.6
    """Of the heading error, and without gravity of roll and pitch."""
    position: float = 0.75
    """Along x and y, and without gravity along z."""
    height_tilt: float = 110.0
    """Height error per metre over the square of the σ of roll and pitch by gravity [1/rad²]. Tilted scans thicken the
    floor, which pulls the body along. Height errors of dead reckoning are small compared with that: with poor gravity a
    filter is worse than dead reckoning."""

    def __post_init__(self) -> None:
        check_options(self, "errors passed on: ", {"in [0, 1]": "heading position", "≥ 0": "*"})

    def covariance(self, reckoned: Array, length: float, particles: int, *, tilt: float | None = None) -> Array:
        """Covariance to add at the end of a path, right tangent, of the size of ``reckoned``.

        Parameters
        ----------
        reckoned : (6, 6) or (3, 3)
            Covariance of dead reckoning over the path, right tangent.
        length : float
            [m]
        particles : int
            A single one corrects nothing: the fraction is 1.
        tilt : float, optional
            σ of roll and pitch by gravity, if measured [rad].
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
"""Default, added to the error of the filter itself if the dead-reckoning covariance is known."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterDrift:
    """Covariance at the end of a path of a filter with N particles.

    Walks are variances per metre. The defaults were fitted to the end poses of 550 segments of 10 to 65 m in simulated
    garages, with 5, 20 and 40 particles and half the random walk (``walk_scale``); with the full walk, heading and
    position walks are nearly twice as large.
    """

    heading_walk: float = 0.0042
    """[rad/√m]"""
    position_walk: float = 0.0118
    """Along x and y [m/√m]."""
    position_scale: float = 0.0045
    """σ of a constant scale error of the wheels; it moves the end along the line from the start."""
    few: float = 3.0
    """The variances of these walks are increased by this over the number of particles."""
    alone_walk: float = 0.015
    """Heading walk of a single particle, which corrects nothing [rad/√m]."""
    height_walk: float = 0.021
    """[m/√m]"""
    tilt: float = 0.006
    """σ of roll and pitch, independent of the length [rad]."""

    def __post_init__(self) -> None:
        check_options(self, "filter drift: ", {"≥ 0": "*"})
        if self.tilt <= 0:
            raise ConfigError("filter drift: σ of roll and pitch must be > 0, or covariances are singular")

    def covariance(
        self,
        path: Array,
        particles: int,
        *,
        gravity: bool = True,
        reckoned: Array | None = None,
        tilt_sigma: float | None = None,
    ) -> Array:
        """Right-tangent covariance at the end of a path.

        Parameters
        ----------
        path : (n, 7) or (n, 3)
            Poses from the start to the end, in any frame whose z axis is up.
        gravity : bool
            The frame at the end is levelled, as that of a submap is.
        reckoned : (d, d), optional
            Covariance of dead reckoning over the path, a fraction of which is added; without it a single particle has
            the heading walk ``alone_walk``, and nothing is added to the error of the filter itself.
        tilt_sigma : float, optional
            σ of roll and pitch by gravity, if measured [rad].
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
        # positions in the end frame: a heading error there rotates the rest of the path about it
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
        return C if reckoned is None else C + PASSED.covariance(reckoned, length, particles, tilt=tilt_sigma)


def interpolate_covariances(knots: npt.NDArray[np.int64], covariances: Array, poses: Array, along: Array) -> Array:
    """Covariances ``(n, d, d)`` at all poses of a path from those at some, linear in path length, right tangents.

    Interpolated in the axes of the base frame, where neighbours do not differ by the rotation of the body.

    Parameters
    ----------
    knots : (k,) int
        Increasing, from 0 to n - 1.
    covariances : (k, d, d)
    poses : (n, 7) or (n, 3)
    along : (n,)
        Metres driven, not decreasing.
    """
    n = len(poses)
    R = _axes(poses)
    D = R[knots] @ covariances @ np.swapaxes(R[knots], 1, 2)
    length = along + 1e-9 * np.arange(n)  # stationary robot: by steps
    j = np.clip(np.searchsorted(knots, np.arange(n), side="right") - 1, 0, len(knots) - 2)
    a, b = length[knots[j]], length[knots[j + 1]]
    u = ((length - a) / (b - a))[:, None, None]
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
