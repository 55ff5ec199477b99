"""A lasting error of planar odometry: how much it turns too far for each metre driven.

Wheels of unequal size bend every path by the same angle a metre. No white noise covers that, and a particle filter that
has to undo it at every step bends its maps; but a few hundred matches of scans show it, before any filter runs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.errors import ConfigError, DataError
from graphslam.core.geometry import se2_compose, se2_exp, se2_log, wrap_angle
from graphslam.core.records import Odometry
from graphslam.registration.config import RegistrationConfig
from graphslam.registration.register import register
from graphslam.registration.target import Target
from graphslam_frontends.odometry.steps import Steps

_MATCHING = RegistrationConfig(radii=(1.0, 0.3), near=0.15)
_APART = 0.5  # way between the scans of a pair [m]
_LEAST = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class YawCalibration:
    """What scans say of the odometry's heading.

    Parameters
    ----------
    per_metre, per_radian : float
        Odometry turns too much by so much for each metre driven [rad/m], and for each radian turned.
    per_metre_sigma, per_radian_sigma : float
        Their σ.
    rest : float
        σ of what is left of one pair (robust) [rad].
    pairs : int
        Pairs of scans that were matched.
    """

    per_metre: float
    per_radian: float
    per_metre_sigma: float
    per_radian_sigma: float
    rest: float
    pairs: int


def yaw_per_metre(steps: Steps) -> YawCalibration:
    """Fit the heading error of planar odometry to matches of pairs of scans, 0.5 m of the way apart.

    Parameters
    ----------
    steps : Steps
        In the plane.
    """
    if steps.dim != 2:
        raise ConfigError(f"{steps.name}: the yaw of odometry in space is not calibrated here")
    way = steps.path_length
    starts = np.unique(np.searchsorted(way, np.linspace(0.0, max(way[-1] - _APART, 0.0), 400)))
    rows, errors = [], []
    for a in starts.tolist():
        b = int(np.searchsorted(way, way[a] + _APART))
        if b >= len(steps) or b - a > 50:
            continue
        clouds = [_cloud(steps, k) for k in (a, b)]
        if min(map(len, clouds)) < _MATCHING.least_points:
            continue
        T = np.zeros(3)
        for u in steps.odometry.increments[a + 1 : b + 1]:
            T = se2_compose(T, u)
        found = register(clouds[1], Target(clouds[0]), T, _MATCHING)
        if found.converged and found.fitness > 0.6 and found.degeneracy > _MATCHING.gates.degeneracy_planar:
            rows.append([float(way[b] - way[a]), float(T[2])])
            errors.append(float(wrap_angle(T[2] - found.T_target_source[2])))
    if len(rows) < _LEAST:
        raise DataError("too few scans match to calibrate odometry", where=steps.name, got=len(rows), wanted=_LEAST)
    A, d = np.array(rows), np.array(errors)
    good = np.ones(len(d), np.bool_)
    for _ in range(10):  # least squares on what is within 2.5 σ of the last fit, σ from the median
        c = np.linalg.lstsq(A[good], d[good], rcond=None)[0]
        left = np.abs(d - A @ c)
        sigma = max(1.4826 * float(np.median(left)), 1e-6)
        good = left < 2.5 * sigma
    C = sigma**2 * np.linalg.inv(A[good].T @ A[good])
    return YawCalibration(
        per_metre=float(c[0]),
        per_radian=float(c[1]),
        per_metre_sigma=float(np.sqrt(C[0, 0])),
        per_radian_sigma=float(np.sqrt(C[1, 1])),
        rest=sigma,
        pairs=len(d),
    )


def without_yaw_per_metre(odometry: Odometry, rate: float, *, where: str = "odometry") -> Odometry:
    """The odometry without a turn of ``rate`` [rad/m] for each metre driven."""
    if odometry.increments.shape[1] != 3:
        raise ConfigError(f"{where}: yaw_per_metre is for odometry in the plane")
    xi = se2_log(odometry.increments)
    xi[:, 2] -= rate * np.hypot(xi[:, 0], xi[:, 1])
    return replace(odometry, increments=se2_exp(xi))


def _cloud(steps: Steps, k: int) -> np.ndarray:
    points, _, returns = steps.scan(k)
    return points[returns]
