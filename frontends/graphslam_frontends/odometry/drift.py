"""How far off dead reckoning is after a path of some length: a small model that only knows the length.

Segments of a particle filter need it: particles that descend from a common ancestor share its errors, so their spread
says little about how far off they all are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
from scipy.optimize import nnls

from graphslam.core.errors import ConfigError, DataError
from graphslam.core.geometry import Array


class IntervalCovariance(Protocol):
    """Knows how far off dead reckoning may be over an interval of steps, errors that last included."""

    def between(
        self, start: int, end: int, *, level_start: bool = False, level_end: bool = False
    ) -> tuple[Array, Array]:
        """Motion from step ``start`` to step ``end``, and its covariance in the right tangent."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class DriftModel:
    """Covariance at the end of a path of length L: each variance is ``start² + walk² L + (scale L)²``.

    The defaults are those of what a particle filter leaves of dead reckoning: pieces of 5 to 80 m of the paths of 20
    particles in simulated garages. :func:`calibrate_drift` makes a model for one's own sensors.
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


def fit_drift(lengths: npt.ArrayLike, moments: npt.ArrayLike) -> DriftModel:
    """The drift model nearest to covariances, or to outer products of errors, of paths of known length.

    Variances are fitted by non-negative least squares, each weighted by what the model itself expects (the likelihood
    of a variance), so that a few long paths do not decide alone.

    Parameters
    ----------
    lengths : (m,)
        [m], of three different lengths at least.
    moments : (m, 6, 6) or (m, 3, 3)
        Right tangent at the end of each path.
    """
    L, M = np.asarray(lengths, dtype=np.float64), np.asarray(moments, dtype=np.float64)
    if L.ndim != 1 or M.shape not in ((len(L), 3, 3), (len(L), 6, 6)) or not np.all(np.isfinite(M)):
        raise DataError("moments and lengths do not match", got=(L.shape, M.shape), wanted="(m,) and (m, d, d), finite")
    if len(np.unique(L)) < 3 or L.min() < 0:
        raise DataError("too few lengths to fit a drift model", got=len(np.unique(L)), wanted="3 different, ≥ 0 m")
    dim = 2 if M.shape[1] == 3 else 3
    x, y, yaw = (0, 1, 2) if dim == 2 else (3, 4, 2)
    heading = _fit_variance(L, M[:, yaw, yaw], 1e-5)
    side, cross = _sideways(L, heading[1] ** 2, heading[2] ** 2)
    # the product of two errors varies as the product of their variances: short paths hardly tell how they bend
    weight = 1.0 / (_variance(L, *heading) * _variance(L, *_fit_variance(L, M[:, y, y], 1e-4)))
    told = float(np.sum(weight * cross**2))
    bend = float(np.clip(np.sum(weight * cross * M[:, y, yaw]) / told, 0.0, 1.5)) if told > 0.0 else 0.0
    sideways = np.concatenate([0.0 * side, bend**2 * side])
    position = _fit_variance(np.concatenate([L, L]), np.concatenate([M[:, x, x], M[:, y, y]]), 1e-4, known=sideways)
    z, tilt = (0.01, 0.0, 0.0), 0.006
    if dim == 3:
        z = _fit_variance(L, M[:, 5, 5], 1e-4)
        tilt = float(max(np.sqrt(0.5 * np.mean(M[:, 0, 0] + M[:, 1, 1])), 1e-5))
    names = [f"{what}_{how}" for what in ("position", "z", "heading") for how in ("start", "walk", "scale")]
    return DriftModel(dim=dim, bend=bend, tilt=tilt, **dict(zip(names, (*position, *z, *heading))))


def _fit_variance(L: Array, variance: Array, floor: float, known: Array | float = 0.0) -> tuple[float, float, float]:
    """start, walk, scale of ``start² + walk² L + scale² L²``, besides a ``known`` part; start at least ``floor``."""
    design = np.column_stack([np.ones_like(L), L, L**2])
    unit = np.maximum(design.max(axis=0), 1e-12)  # columns of one size: metres to the fourth would drown the rest
    expected = np.full(len(L), max(float(np.mean(variance)), floor**2))
    found = np.zeros(3)
    for _ in range(8):
        found = nnls(design / unit / expected[:, None], (variance - known) / expected)[0] / unit
        expected = np.maximum(design @ found + known, max(floor**2, 1e-3 * float(np.mean(variance))))
    start, walk, scale = np.sqrt(found)
    return max(float(start), floor), float(walk), float(scale)


def calibrate_drift(
    errors: IntervalCovariance,
    path_length: Array,
    *,
    lengths: Sequence[float] = (5.0, 10.0, 20.0, 40.0, 60.0),
    intervals: int = 20,
    level: bool = False,
) -> DriftModel:
    """A drift model of a robot from the noise of its motion, along a path that it drove.

    Parameters
    ----------
    errors : IntervalCovariance
        Covariance of dead reckoning between any two steps, as of :class:`~graphslam_frontends.odometry.steps.Steps`.
    path_length : (n,)
        Metres driven until each step, not falling.
    lengths : sequence of float
        Of the intervals looked at [m]; those longer than the path are left out.
    intervals : int
        Intervals of each length, spread evenly over the path.
    level : bool
        Frames at both ends stand level, as those of submaps do where gravity is seen.
    """
    s = np.asarray(path_length, dtype=np.float64)
    if intervals < 1:
        raise ConfigError(f"drift model: intervals = {intervals}; wanted ≥ 1")
    driven, moments = [], []
    for wanted in lengths:
        last = int(np.searchsorted(s, s[-1] - wanted, side="right")) - 1
        if wanted <= 0 or last < 0:
            continue
        for start in np.unique(np.linspace(0, last, intervals).astype(int)):
            end = min(int(np.searchsorted(s, s[start] + wanted)), len(s) - 1)
            driven.append(float(s[end] - s[start]))
            moments.append(errors.between(int(start), end, level_start=level, level_end=level)[1])
    if len(np.unique(np.round(driven, 3))) < 3:
        raise DataError("path is too short to calibrate a drift model", got=f"{s[-1]:.1f} m", wanted=f"> {lengths} m")
    return fit_drift(driven, np.array(moments))
