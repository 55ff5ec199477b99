"""Constant sensor errors (biases): dependence of a submap on constant errors of wheels and sensor.

A submap is smoothed as if wheels and sensor had no constant errors. With errors ``g``, its exit and landmarks are the
smoothed ones plus ``S g``, and its measurements give a likelihood of ``g`` by a score and an information matrix. These
are stored with the submap's Gaussian: a graph has g as variables shared by all submaps of a robot, so that errors that
are not observable in one submap are estimated jointly, and their uncertainty is included in the covariances of the
whole map.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import CovarianceError, GeometryError
from graphslam.core.geometry import Array
from graphslam.core.reading import finite_mask

CONSTANTS = ("turn", "distance", "range", "bearing", "ahead", "left")
"""Two of the wheels: yaw (per second or per metre), and the logarithm of the distance scale; two of the sensor: range
offset, and bearing offset (for ranges without bearings the logarithm of their scale); and the mounting position, ahead
and to the left."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorBiases:
    """Dependence of a submap on constant errors, and its information on them.

    Parameters
    ----------
    names : (6,) str
        Names of the constants, in the order of :data:`CONSTANTS`; empty if not estimated.
    sigmas : (6,)
        Prior σ, about zero.
    response : (3 + 2n, 6)
        Derivative of exit and landmarks, in the plain vector of the landmark map.
    score, information : (6,), (6, 6)
        ``score = Λ ĝ`` and ``Λ`` from the submap's motion and observations, with exit and landmarks marginalised out.
    path : (T, 3, 6)
        Derivative of the poses of the submap's trajectory, right tangents.
    points : (2p, 6)
        Derivative of the points of the path (:mod:`graphslam.core.path_points`) in the base frame.
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
        """The biases for a subset of landmarks: ``keep`` are rows of the landmark map's vector."""
        return replace(self, response=self.response[keep])

    def likelihood(self) -> tuple[Array, Array]:
        """The submap's likelihood of g as rows ``R g - d`` of unit variance: ``(r, 6)``, ``(r,)``.

        Directions with less than a millionth of the prior information have no row.
        """
        s = self.sigmas
        w, V = np.linalg.eigh(s[:, None] * self.information * s)
        informed = w > 1e-6
        R = np.sqrt(w[informed])[:, None] * V[:, informed].T / s
        d = (V[:, informed].T @ (s * self.score)) / np.sqrt(w[informed])
        return R, d
