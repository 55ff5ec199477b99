"""How far off dead reckoning is after a path of some length: a small model that only knows the length.

Segments of a particle filter need it: particles that descend from a common ancestor share its errors, so their spread
says little about how far off they all are.
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

    The defaults are those of what a particle filter leaves of dead reckoning: pieces of 5 to 80 m of the paths of 20
    particles in simulated garages.
    """

    dim: int = 3
    position_start: float = 0.028
    """σ along x and y at no length [m]."""
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
    """σ of roll and pitch, whatever the length [rad]."""
    bend: float = 0.22
    """How much of the error of the heading moves the end sideways: 1 on a straight path without any correction, 0 where
    scans hold the position. With it the error of the heading and that to the side are correlated."""

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
    """Variance to the side, and covariance with the heading, of a straight path whose heading walks and bends.

    A walk of variance w L of the heading gives ∫∫ w min(a, b) = w L³/3 to the side and w L²/2 with the heading; a
    heading that is off by s l at l gives s² L⁴/4 and s² L³/2.
    """
    l, w, s = (np.asarray(a, dtype=np.float64) for a in (L, walk, scale))
    return w * l**3 / 3.0 + s * l**4 / 4.0, w * l**2 / 2.0 + s * l**3 / 2.0
