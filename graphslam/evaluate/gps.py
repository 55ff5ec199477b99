"""Residuals of a trajectory against GPS: the only judge where no truth exists.

A map's frame and the GPS frame have nothing in common until they are fitted: one rigid 2-D transform, no scale, no
clock offset. The body point matters (metres on a car): it is the antenna's lever, stated, never fitted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array, ArrayLike, align_se2, se2_compose, se2_transform
from graphslam.core.records import Gps
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.statistics import ErrorStatistics

Mask = npt.NDArray[np.bool_]


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
        The trajectory's body point at the stamps, in the GPS frame [m].
    T_gps_map : (3,)
    lever : (2,)
        The body point that was compared [m].
    fitted : int
        Fixes that determined the alignment; 0 if it was given.
    outside : int
        Fixes before the start or after the end of the trajectory: not scored.
    in_gap : int
        Fixes inside a gap of the trajectory longer than ``max_gap``: not scored.
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
        Body point to compare [m]; default is the stream's own lever.
    T_gps_map : (3,), optional
        Known alignment; default is the rigid least-squares fit, unweighted, without scale.
    fit, score : (n,) bool, optional
        Fixes that determine the alignment and fixes that are scored; default all. Withheld fixes: disjoint masks.
    max_gap : float, optional
        A fix between two poses farther apart than this is counted, not scored [s].

    Raises
    ------
    DataError
        Trajectory not 2-D, or fewer than two usable fixes.
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


def in_gps_frame(trajectory: Trajectory, residuals: GpsResiduals) -> Trajectory:
    """The trajectory moved into the GPS frame by the alignment of ``residuals``."""
    poses = se2_compose(np.broadcast_to(residuals.T_gps_map, trajectory.poses.shape), trajectory.poses)
    return Trajectory(trajectory.times, poses, trajectory.covariances)


def _in_gap(times: Array, query: Array, max_gap: float | None) -> Mask:
    if max_gap is None or len(times) < 2:
        return np.zeros(len(query), dtype=bool)
    j = np.clip(np.searchsorted(times, query), 1, len(times) - 1)
    between = (query > times[j - 1]) & (query < times[j])
    return np.asarray(between & (times[j] - times[j - 1] > max_gap))
