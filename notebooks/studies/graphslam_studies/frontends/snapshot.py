"""Estimate of a single-map filter at one moment, for studies of whole runs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import CovarianceError, GeometryError
from graphslam.core.gaussian import Gaussian, check_covariance
from graphslam.core.geometry import Array


@dataclass(frozen=True, slots=True)
class Snapshot:
    """State of a single-map filter at one moment, in the frame of the first base.

    Parameters
    ----------
    scan : int
        Number of scans processed.
    time : float
        Time stamp of the last of them [s].
    pose : (3,)
        x, y, θ [m, m, rad].
    pose_covariance : (3, 3)
        Of the vector x, y, θ (as in :attr:`graphslam.core.submap.LandmarkMap.mean`), not of the tangent.
    landmark_ids : (L,) int64
        Identity of each landmark; -1 if it is unknown.
    landmarks : (L, 2)
        Positions [m].
    landmark_covariances : (L, 2, 2)
        Marginal of each landmark [m²].
    gaussian : Gaussian or None
        Joint Gaussian of ``[pose, landmark_1, …]`` in the order above, if requested.
    """

    scan: int
    time: float
    pose: Array
    pose_covariance: Array
    landmark_ids: npt.NDArray[np.int64]
    landmarks: Array
    landmark_covariances: Array
    gaussian: Gaussian | None = None

    def __post_init__(self) -> None:
        ids = np.ascontiguousarray(self.landmark_ids, dtype=np.int64)
        n = len(ids)
        for name, shape in (("pose", (3,)), ("landmarks", (n, 2)), ("landmark_covariances", (n, 2, 2))):
            a = np.ascontiguousarray(getattr(self, name), dtype=np.float64)
            if a.shape != shape:
                raise GeometryError(f"{name} of a snapshot has the wrong shape", got=a.shape, wanted=shape)
            if not np.all(np.isfinite(a)):
                raise GeometryError(f"{name} of the snapshot after scan {self.scan} is not finite")
            object.__setattr__(self, name, a)
        object.__setattr__(self, "landmark_ids", ids)
        what = f"pose covariance after scan {self.scan}"
        object.__setattr__(self, "pose_covariance", check_covariance(self.pose_covariance, what=what, dim=3))
        C = self.landmark_covariances
        bad = ~((C[:, 0, 0] > 0) & (C[:, 0, 0] * C[:, 1, 1] > C[:, 0, 1] * C[:, 1, 0]))
        if np.any(bad):
            k = int(np.flatnonzero(bad)[0])
            raise CovarianceError(f"covariance of landmark {k} after scan {self.scan} is not positive definite")
        if self.gaussian is not None and len(self.gaussian.mean) != 3 + 2 * n:
            raise GeometryError("joint of a snapshot has the wrong size", got=len(self.gaussian.mean), wanted=3 + 2 * n)

    def __len__(self) -> int:
        return len(self.landmark_ids)
