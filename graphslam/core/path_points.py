"""Points of a submap's path at the times of fixes, in the joint Gaussian of the submap.

The error of the path at a fix inside a submap is correlated with the exit, the landmarks, and all other fixes of the
submap. The front end computes these correlations when it smooths; with the points in the Gaussian they are preserved,
and no measurement is used twice.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import CovarianceError, GeometryError
from graphslam.core.geometry import Array
from graphslam.core.reading import finite_mask

SAME_TIME = 1e-6
"""Largest time difference between a fix and its point [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PathPoints:
    """Antennas on the path of a submap, jointly Gaussian with its exit and its landmarks.

    Parameters
    ----------
    times : (p,)
        Strictly increasing, inside the submap [s].
    lever : (dim,)
        Antenna in the body frame [m].
    positions : (p, dim)
        In the base frame [m].
    covariance : (dim p, dim p)
    cross : (dim p, d + dim n)
        Covariance with ``[exit pose, landmark_1, …]``, laid out as that of the landmark map.
    """

    times: Array
    lever: Array
    positions: Array
    covariance: Array
    cross: Array

    def __post_init__(self) -> None:
        p, dim = len(self.times), len(self.lever)
        shapes = (self.positions.shape, self.covariance.shape, self.cross.shape[:1])
        wanted = ((p, dim), (dim * p, dim * p), (dim * p,))
        if shapes != wanted or self.cross.ndim != 2:
            raise GeometryError("points of the path do not fit each other", got=shapes, wanted=wanted)
        for part in (self.times, self.lever, self.positions, self.covariance, self.cross):
            if not np.all(finite_mask(part)):
                raise GeometryError("points of the path are not finite", wanted="finite numbers")
        if np.any(np.diff(self.times) <= 0):
            raise GeometryError("points of the path are not in the order of time", wanted="increasing times")
        if np.abs(self.covariance - self.covariance.T).max(initial=0.0) > 1e-6 * np.abs(self.covariance).max(
            initial=1e-300
        ):
            raise CovarianceError("covariance of the points of the path is not symmetric")

    def __len__(self) -> int:
        return len(self.times)

    def at(self, time: float, lever: Array) -> int | None:
        """Index of the point of a fix at a time, with a given antenna in the body frame; None if there is none."""
        if not len(self.times) or np.shape(lever) != self.lever.shape or np.abs(lever - self.lever).max() > 1e-9:
            return None
        k = int(np.argmin(np.abs(self.times - time)))
        return k if abs(self.times[k] - time) <= SAME_TIME else None

    def scalars(self, points: npt.ArrayLike) -> npt.NDArray[np.intp]:
        """Rows of points ``(k,)`` in the matrices ``(k dim,)``."""
        d = len(self.lever)
        return (d * np.asarray(points, dtype=np.intp)[:, None] + np.arange(d)).ravel()

    def given(self, joint: Array, points: npt.ArrayLike) -> tuple[Array, Array]:
        """Points conditioned on exit and landmarks: gain ``(k dim, n)``, and conditional covariance.

        Parameters
        ----------
        joint : (n, n)
            Covariance of the landmark map.
        points : (k,) int
        """
        ix = self.scalars(points)
        gain = np.asarray(np.linalg.solve(joint, self.cross[ix].T).T)
        left = self.covariance[np.ix_(ix, ix)] - gain @ self.cross[ix].T
        return gain, np.asarray(0.5 * (left + left.T))

    def of_landmarks(self, keep: npt.NDArray[np.intp]) -> PathPoints:
        """The points for a subset of landmarks: ``keep`` are columns of the landmark map's vector."""
        return PathPoints(
            times=self.times, lever=self.lever, positions=self.positions, covariance=self.covariance,
            cross=self.cross[:, keep],
        )  # fmt: skip
