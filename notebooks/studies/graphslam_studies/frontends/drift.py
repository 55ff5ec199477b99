"""Covariance of dead reckoning as a function of path length only.

Segments of a particle filter need it: particles with a common ancestor share its errors, so their spread
underestimates the error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import ConfigError, DataError
from graphslam.core.geometry import Array


@dataclass(frozen=True, slots=True, kw_only=True)
class DriftModel:
    """Covariance at the end of a path of length L: each variance is ``start² + walk² L + (scale L)²``.

    The defaults are for the paths of a particle filter, i.e. dead reckoning corrected by scans: sections of 5 to 80 m
    of the paths of 20 particles in simulated garages.
    """

    dim: int = 3
    position_start: float = 0.028
    """σ along x and y at length 0 [m]."""
    position_walk: float = 0.0
    """[m/√m]"""
    position_scale: float = 0.0093
    """[m/m]"""
    z_start: float = 0.026
    """[m]"""
    z_walk: float = 0.0
    """[m/√m]"""
    z_scale: float = 0.0024
    """[m/m]"""
    heading_start: float = 0.0095
    """[rad]"""
    heading_walk: float = 0.005
    """[rad/√m]"""
    heading_scale: float = 0.0
    """[rad/m]"""
    tilt: float = 0.006
    """σ of roll and pitch at any length [rad]."""
    bend: float = 0.22
    """Share of the heading error that moves the end point sideways: 1 on a straight path without correction, 0 if scans
    fix the position. If it is > 0, heading error and lateral error are correlated."""

    def __post_init__(self) -> None:
        if self.dim not in (2, 3):
            raise ConfigError(f"drift model: dim = {self.dim}; wanted 2 or 3")
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ConfigError(f"drift model: {name} = {value}; wanted ≥ 0")
        starts = (self.position_start, self.z_start, self.heading_start, self.tilt)
        if min(starts if self.dim == 3 else (self.position_start, self.heading_start)) <= 0:
            raise ConfigError("drift model: σ at no length must be > 0, or covariances are singular")

    def covariance(self, length: float) -> Array:
        """Right-tangent covariance at the end of a path ``(6, 6)`` or ``(3, 3)``.

        Parameters
        ----------
        length : float
            [m], ≥ 0.
        """
        L = float(length)
        if not (np.isfinite(L) and L >= 0):
            raise DataError("length of a path is impossible", got=length, wanted="≥ 0 m")
        xy = float(_variance(L, self.position_start, self.position_walk, self.position_scale))
        side, cross = _sideways(L, self.heading_walk**2, self.heading_scale**2)
        heading = float(_variance(L, self.heading_start, self.heading_walk, self.heading_scale))
        if self.dim == 2:
            C, y, yaw = np.diag([xy, xy, heading]), 1, 2
        else:
            z = float(_variance(L, self.z_start, self.z_walk, self.z_scale))
            C, y, yaw = np.diag([self.tilt**2, self.tilt**2, heading, xy, xy, z]), 4, 2
        C[y, y] += self.bend**2 * side
        C[y, yaw] += self.bend * cross
        C[yaw, y] = C[y, yaw]
        return C

    def __call__(self, length: float) -> Array:
        """:meth:`covariance`."""
        return self.covariance(length)


def _variance(L: npt.ArrayLike, start: float, walk: float, scale: float) -> Array:
    """``start² + walk² L + (scale L)²``."""
    l = np.asarray(L, dtype=np.float64)
    return np.asarray(start**2 + walk**2 * l + (scale * l) ** 2)


def _sideways(L: npt.ArrayLike, walk: npt.ArrayLike, scale: npt.ArrayLike) -> tuple[Array, Array]:
    """Lateral variance, and covariance with the heading, at the end of a straight path with heading errors.

    A random walk of the heading with variance w L gives the lateral variance ∫∫ w min(a, b) = w L³/3 and the covariance
    w L²/2; a heading error proportional to length, with variance s L², gives s L⁴/4 and s L³/2.
    """
    l, w, s = (np.asarray(a, dtype=np.float64) for a in (L, walk, scale))
    return w * l**3 / 3.0 + s * l**4 / 4.0, w * l**2 / 2.0 + s * l**3 / 2.0
