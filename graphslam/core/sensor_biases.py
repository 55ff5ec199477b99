"""Errors of a robot's sensors that last: what a submap would be if wheels and sensor erred by constants.

A submap is smoothed as if wheels and sensor had no constant errors. If they err by ``g``, its exit and its landmarks
are those that were smoothed plus ``S g``, and its own measurements say how likely each ``g`` is, by a score and an
information matrix. Kept beside the submap's Gaussian, nothing is lost: a graph has g as variables that all submaps of a
robot share, so that errors which no single submap shows are estimated together, and what is not told of them widens the
covariances of the whole map.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import CovarianceError, GeometryError
from graphslam.core.geometry import Array
from graphslam.core.reading import finite_mask

CONSTANTS = ("turn", "distance", "range", "bearing", "ahead", "left")
"""Two of the wheels: their turns (by the second or by the metre), and the logarithm of their distances; and two of the
sensor: the zero of its ranges, and its direction (of ranges without bearings the logarithm of their scale); and where
it stands on the robot, ahead and to the left."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorBiases:
    """How a submap depends on constant errors, and what it says of them.

    Parameters
    ----------
    names : (6,) str
        What the constants are, in the order of :data:`CONSTANTS`; empty where one is not looked for.
    sigmas : (6,)
        What is known of them beforehand, about zero.
    response : (3 + 2n, 6)
        Change of exit and landmarks with each, in the plain vector of the landmark map.
    score, information : (6,), (6, 6)
        ``score = Λ ĝ`` and ``Λ`` of what the submap's own motion and sightings say, exit and landmarks left free.
    path : (T, 3, 6)
        Change of the poses of the submap's trajectory, right tangents.
    points : (2p, 6)
        Change of the points of the path (:mod:`graphslam.core.path_points`) in the base frame.
    """

    names: tuple[str, ...]
    sigmas: Array
    response: Array
    score: Array
    information: Array
    path: Array
    points: Array

    def __post_init__(self) -> None:
        c = len(CONSTANTS)
        shapes = (self.sigmas.shape, self.score.shape, self.information.shape)
        if len(self.names) != c or shapes != ((c,), (c,), (c, c)) or self.response.shape[1:] != (c,):
            raise GeometryError("systematic errors do not fit each other", got=shapes, wanted=((c,), (c,), (c, c)))
        if self.path.shape[1:] != (3, c) or self.points.shape[1:] != (c,):
            raise GeometryError("systematic errors do not fit the path", got=self.path.shape, wanted=f"(T, 3, {c})")
        for part in (self.sigmas, self.response, self.score, self.information, self.path, self.points):
            if not np.all(finite_mask(part)):
                raise GeometryError("systematic errors are not finite", wanted="finite numbers")
        if not np.all(self.sigmas > 0):
            raise CovarianceError("systematic errors need a positive prior σ", got=self.sigmas)
        L = self.information
        if np.abs(L - L.T).max() > 1e-6 * np.abs(L).max(initial=1e-300):
            raise CovarianceError("information of systematic errors is not symmetric")

    def of_landmarks(self, keep: npt.NDArray[np.intp]) -> SensorBiases:
        """The same beside fewer landmarks: ``keep`` are rows of the landmark map's vector."""
        return replace(self, response=self.response[keep])

    def likelihood(self) -> tuple[Array, Array]:
        """The submap's own word as rows ``R g - d`` of unit variance: ``(r, 6)``, ``(r,)``.

        Directions of which it says less than a millionth of what is known beforehand have no row.
        """
        s = self.sigmas
        w, V = np.linalg.eigh(s[:, None] * self.information * s)
        told = w > 1e-6
        R = np.sqrt(w[told])[:, None] * V[:, told].T / s
        d = (V[:, told].T @ (s * self.score)) / np.sqrt(w[told])
        return R, d
