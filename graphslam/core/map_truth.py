"""Ground truth of submap ends and landmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import GeometryError
from graphslam.core.geometry import Array
from graphslam.core.reading import finite_mask


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class MapTruth:
    """Ground truth of a chain of submaps, in the frame of the first base.

    Parameters
    ----------
    keys : (m,) int64
        Keys of the submaps whose end is known.
    exit_poses : (m, 3) or (m, 7)
        True base-to-exit poses, ``T_first-base_exit``.
    landmark_ids : (n,) int64
        Each once.
    landmarks : (n, dim)
    """

    keys: npt.NDArray[np.int64]
    exit_poses: Array
    landmark_ids: npt.NDArray[np.int64]
    landmarks: Array

    def __repr__(self) -> str:
        return f"MapTruth(ends of {len(self.keys)} submaps, {len(self.landmark_ids)} landmarks)"

    def __post_init__(self) -> None:
        keys = np.ascontiguousarray(self.keys, dtype=np.int64)
        poses = np.ascontiguousarray(self.exit_poses, dtype=np.float64)
        ids = np.ascontiguousarray(self.landmark_ids, dtype=np.int64)
        points = np.ascontiguousarray(self.landmarks, dtype=np.float64)
        if poses.ndim != 2 or poses.shape[1] not in (3, 7) or len(poses) != len(keys):
            raise GeometryError(
                "true exit poses have the wrong shape", got=poses.shape, wanted=f"({len(keys)}, 3 or 7)"
            )
        dim = 2 if poses.shape[1] == 3 else 3
        points = points.reshape(-1, dim) if points.size == 0 else points
        if points.shape != (len(ids), dim):
            raise GeometryError("true landmarks have the wrong shape", got=points.shape, wanted=(len(ids), dim))
        if not (np.all(finite_mask(poses)) and np.all(finite_mask(points))):
            raise GeometryError("truth is not finite", wanted="finite poses and landmarks")
        for name, values in (("keys", keys), ("landmark_ids", ids)):
            if len(np.unique(values)) != len(values):
                raise GeometryError(f"truth names one of its {name} twice", wanted="each once")
        for name, array in (("keys", keys), ("exit_poses", poses), ("landmark_ids", ids), ("landmarks", points)):
            object.__setattr__(self, name, array)
