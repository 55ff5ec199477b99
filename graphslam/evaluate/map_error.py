"""Errors of landmarks against ground truth, with a given gauge."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.errors import DataError
from graphslam.core.geometry import Array, ArrayLike, align_se2
from graphslam.core.poses import SE2, SE3, group_of
from graphslam.evaluate.statistics import ErrorStatistics

Gauge = Literal["first-base", "rigid"]
Index = npt.NDArray[np.intp]


@dataclass(frozen=True, slots=True, kw_only=True)
class MapError:
    """Errors of landmarks.

    Parameters
    ----------
    gauge : {"first-base", "rigid"}
        ``first-base``: both are in the frame of the first base; nothing is fitted. ``rigid``: the estimate was moved
        onto the truth by least squares first, without scale.
    T_truth_estimate : (3,) or (7,)
        The transform that was applied; identity for ``first-base``.
    errors : (n,)
        Distances [m].
    unmatched : int
        Estimates without a true landmark.
    """

    quantity: str
    gauge: Gauge
    T_truth_estimate: Array
    errors: Array
    unmatched: int = 0

    @property
    def statistics(self) -> ErrorStatistics:
        """Statistics of the distances [m]."""
        return ErrorStatistics.of(self.errors)

    def as_row(self) -> dict[str, Any]:
        """One row of a table."""
        row = {"quantity": self.quantity, "gauge": self.gauge, "unmatched": self.unmatched}
        return {**row, **self.statistics.as_dict()}


def match_ids(ids: ArrayLike, truth_ids: ArrayLike) -> tuple[Index, Index]:
    """Indices ``(i, j)`` with ``ids[i] == truth_ids[j]``; negative ids match nothing.

    Estimates may repeat an id, the ground truth may not.
    """
    a, b = np.asarray(ids, dtype=np.int64), np.asarray(truth_ids, dtype=np.int64)
    order = np.argsort(b, kind="stable")
    s = b[order]
    if len(s) and np.any(np.diff(s) == 0):
        raise DataError("a true landmark is repeated", got=int(s[1:][np.diff(s) == 0][0]), wanted="unique ids")
    if not len(s):
        return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
    at = np.minimum(np.searchsorted(s, a), len(s) - 1)
    i = np.flatnonzero((s[at] == a) & (a >= 0))
    return i, order[at[i]]


def fit_gauge(points: Array, truth: Array, gauge: Gauge) -> Array:
    """``T_truth_estimate`` for points ``(n, 2)`` or ``(n, 3)``: identity, or the rigid least-squares fit."""
    dim = points.shape[1]
    if gauge == "first-base":
        return (SE2 if dim == 2 else SE3).identity.copy()
    if gauge != "rigid":
        raise DataError("unknown gauge", got=gauge, wanted="first-base or rigid")
    if len(points) < dim:
        raise DataError("too few points to align", got=len(points), wanted=f"at least {dim}")
    return align_se2(points, truth) if dim == 2 else se3.align_se3(points, truth)[0]


def landmark_error(
    ids: ArrayLike,
    positions: ArrayLike,
    truth_ids: ArrayLike,
    truth_positions: ArrayLike,
    *,
    gauge: Gauge = "first-base",
) -> MapError:
    """Distances of estimated landmarks ``(n, dim)`` to the true ones of the same id."""
    p, q = np.asarray(positions, dtype=np.float64), np.asarray(truth_positions, dtype=np.float64)
    i, j = match_ids(ids, truth_ids)
    if not len(i):
        raise DataError("no landmark has a truth of the same id", got=len(p), wanted="common ids")
    T = fit_gauge(p[i], q[j], gauge)
    return MapError(
        quantity="landmarks",
        gauge=gauge,
        T_truth_estimate=T,
        errors=np.linalg.norm(group_of(T).transform(T, p[i]) - q[j], axis=1),
        unmatched=len(p) - len(i),
    )
