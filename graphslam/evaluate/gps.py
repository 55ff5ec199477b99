"""Residuals of a trajectory against GPS, for logs without ground truth.

The map frame is aligned with the GPS frame by one rigid 2-D transform, without scale and clock offset. The compared
body point is the antenna; its lever arm (metres on a car) is given, not fitted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import special

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array, ArrayLike, align_se2, se2_compose, se2_transform
from graphslam.core.plan_view import plan_path
from graphslam.core.records import Gps
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.statistics import ErrorStatistics

Mask = npt.NDArray[np.bool_]
FEWEST = 8
"""Fewer fixes do not test a path: the alignment alone has three parameters."""
ROUNDS = 30
"""Iterations of reweighting (IRLS) for the least sum of distances."""
NEAR = 1e-4
"""Lower limit of the squared normalised distance in the IRLS weights."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GpsResiduals:
    """Residuals ``fix - T_gps_map · point`` in the GPS frame.

    Parameters
    ----------
    times : (n,)
        Stamps of the fixes that were scored.
    residuals : (n, 2)
        [m].
    points : (n, 2)
        Antenna on the trajectory at the stamps, in the GPS frame [m].
    T_gps_map : (3,)
    lever : (2,)
        Antenna in the base frame [m].
    fitted : int
        Fixes that determined the alignment; 0 if it was given.
    outside : int
        Fixes before the start or after the end of the trajectory: not scored.
    in_gap : int
        Fixes in a gap of the trajectory longer than ``max_gap``: not scored.
    """

    times: Array
    residuals: Array
    points: Array
    T_gps_map: Array
    lever: Array
    fitted: int
    outside: int
    in_gap: int

    @property
    def errors(self) -> Array:
        """Lengths of the residuals ``(n,)`` [m]."""
        return np.linalg.norm(self.residuals, axis=1)

    @property
    def statistics(self) -> ErrorStatistics:
        """RMSE, median, p95, maximum and number used, of the lengths [m]."""
        return ErrorStatistics.of(self.errors)

    def as_row(self) -> dict[str, Any]:
        """One row of a table."""
        counts = {"fitted": self.fitted, "outside": self.outside, "in_gap": self.in_gap}
        return {"gauge": "rigid 2-D, no scale", **self.statistics.as_dict(), **counts}


def gps_residuals(
    trajectory: Trajectory,
    gps: Gps,
    *,
    lever: ArrayLike | None = None,
    T_gps_map: ArrayLike | None = None,
    fit: Mask | None = None,
    score: Mask | None = None,
    max_gap: float | None = None,
) -> GpsResiduals:
    """Score a 2-D trajectory against GPS fixes.

    Parameters
    ----------
    trajectory : Trajectory
        Base poses in any frame.
    gps : Gps
        Only x and y are used.
    lever : (2,), optional
        Antenna in the base frame [m]; default is the lever of the stream.
    T_gps_map : (3,), optional
        Known alignment; default is the rigid least-squares fit, unweighted, without scale.
    fit, score : (n,) bool, optional
        Fixes that determine the alignment and fixes that are scored; default all. Withheld fixes: disjoint masks.
    max_gap : float, optional
        Fixes between two poses farther apart than this are counted in ``in_gap``, not scored [s].
    """
    if trajectory.dim != 2:
        raise DataError("GPS residuals need a 2-D trajectory", got=f"{trajectory.dim}-D")
    n = len(gps.times)
    fit = np.ones(n, dtype=bool) if fit is None else np.asarray(fit, dtype=bool)
    score = np.ones(n, dtype=bool) if score is None else np.asarray(score, dtype=bool)
    if fit.shape != (n,) or score.shape != (n,):
        raise DataError("masks do not fit the fixes", got=(fit.shape, score.shape), wanted=(n,))
    inside = np.zeros(n, dtype=bool)
    if len(trajectory):
        inside = (gps.times >= trajectory.times[0]) & (gps.times <= trajectory.times[-1])
    gap = inside & _in_gap(trajectory.times, gps.times, max_gap)
    usable = inside & ~gap
    arm = gps.lever[:2] if lever is None else np.asarray(lever, dtype=np.float64)
    points = np.full((n, 2), np.nan)
    if np.any(usable):
        poses = trajectory.interpolate(gps.times[usable])
        points[usable] = se2_transform(poses, np.broadcast_to(arm, (len(poses), 2)))
    fixes = gps.positions[:, :2]
    if T_gps_map is None:
        chosen = usable & fit
        if np.sum(chosen) < 2:
            raise DataError("too few fixes on the trajectory to align", got=int(np.sum(chosen)), wanted="at least 2")
        T = align_se2(points[chosen], fixes[chosen])
        fitted = int(np.sum(chosen))
    else:
        T, fitted = np.asarray(T_gps_map, dtype=np.float64), 0
    scored = usable & score
    aligned = se2_transform(T, points[scored])
    return GpsResiduals(
        times=gps.times[scored],
        residuals=fixes[scored] - aligned,
        points=aligned,
        T_gps_map=T,
        lever=arm,
        fitted=fitted,
        outside=int(np.sum(score & ~inside)),
        in_gap=int(np.sum(score & gap)),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class FixDistances:
    """Distances of unused fixes from a path, with the distances expected from the covariances of path and fixes.

    Parameters
    ----------
    median : float
        Median distance in the plane [m].
    expected : float
        Square root of the median variance of such a distance, of path and fix [m].
    ratio : float
        Median of the squared distances over their variances.
    """

    median: float
    expected: float
    ratio: float
    fixes: int

    @property
    def chance(self) -> float:
        """Upper bound of the probability of at least this ratio if the covariances are right, for any correlation.

        The worst case is that all errors are equal along one axis; the median is then one sample of χ² with one degree
        of freedom.
        """
        return float(special.chdtrc(1, self.ratio))


def fix_distances(trajectory: Trajectory, gps: Gps, *, sigma: float | None = None) -> FixDistances | None:
    """Compare a path with fixes that were not used for it.

    The path is first aligned with the fixes by the least sum of normalised distances, which is robust against outliers.
    The alignment only reduces distances, so unknown correlations between poses cannot make them larger than the
    variances predict: the test is one-sided.

    Parameters
    ----------
    trajectory : Trajectory
        With covariances; a 3-D path is projected to the horizontal plane.
    sigma : float, optional
        σ of each coordinate [m] in place of the noise of the stream.

    Returns
    -------
    FixDistances or None
        None if fewer than :data:`FEWEST` fixes lie on the path, or it has no covariances.
    """
    path = plan_path(trajectory) if trajectory.dim == 3 else trajectory
    if path.covariances is None or not len(path):
        return None
    on = (gps.times >= path.times[0]) & (gps.times <= path.times[-1])
    if np.sum(on) < FEWEST:
        return None
    t, z, arm = gps.times[on], gps.positions[on, :2], gps.lever[:2]
    points = se2_transform(path.interpolate(t), np.broadcast_to(arm, (len(t), 2)))
    C = path.interpolate_covariance(t)
    R = np.trace(gps.noise[on][:, :2, :2], axis1=1, axis2=2) if sigma is None else np.full(len(t), 2 * sigma**2)
    variances = C[:, 0, 0] + C[:, 1, 1] + (arm @ arm) * C[:, 2, 2] + R
    w = 1.0 / variances
    for _ in range(ROUNDS):
        d2 = np.sum((z - se2_transform(align_se2(points, z, w), points)) ** 2, axis=1)
        w = 1.0 / (variances * np.sqrt(np.maximum(d2 / variances, NEAR)))
    return FixDistances(
        median=float(np.sqrt(np.median(d2))),
        expected=float(np.sqrt(np.median(variances))),
        ratio=float(np.median(d2 / variances)),
        fixes=len(t),
    )


def move_to_gps_frame(trajectory: Trajectory, residuals: GpsResiduals) -> Trajectory:
    """The trajectory moved into the GPS frame by the alignment of ``residuals``."""
    poses = se2_compose(np.broadcast_to(residuals.T_gps_map, trajectory.poses.shape), trajectory.poses)
    return Trajectory(trajectory.times, poses, trajectory.covariances)


def _in_gap(times: Array, query: Array, max_gap: float | None) -> Mask:
    if max_gap is None or len(times) < 2:
        return np.zeros(len(query), dtype=bool)
    j = np.clip(np.searchsorted(times, query), 1, len(times) - 1)
    between = (query > times[j - 1]) & (query < times[j])
    return np.asarray(between & (times[j] - times[j - 1] > max_gap))
