"""Input of a skeleton network: landmark measurements, odometry, tilt, GPS and a prior, as arrays."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import CovarianceError, DataError
from graphslam.core.geometry import Array
from graphslam.skeleton.chain_kernels import ChainArrays, compose_odometry
from graphslam.skeleton.landmark_kernels import Detections, Poses
from graphslam.skeleton.tile_store import Tiles


@dataclass(frozen=True, eq=False)
class SkeletonProblem:
    """Measurements sorted by pose, with priors and odometry factors.

    World frame: z up. Poses are ``T_world_body``. A covariance is given once for all, or one each.

    Parameters
    ----------
    points : (M, 3) float32
        Measured points in the body frame [m].
    landmark : (M,) int32
        Landmark of each measurement, numbered by first observation (:class:`~graphslam.skeleton.collapse.Collapse`).
    first : (N + 1,)
        First measurement of each pose; the last entry is M.
    odometry_rotation, odometry_translation : (N - 1, 3, 3), (N - 1, 3)
        From each pose to the next, in the body frame.
    odometry_covariance : (6, 6) or (N - 1, 6, 6)
        Rotation vector [rad], then translation [m].
    range_sigma, bearing_sigma : float
        Noise of the points along [m] and across [rad] the ray. With ``normals``: along the normal, and the extent of a
        landmark on its surface [m].
    start_rotation, start_position, start_covariance : (3, 3), (3,), (6, 6)
        Prior on the first pose: rotation in the world frame, then position.
    up : (N, 3), optional
        Upward unit vector in the body frame, from an accelerometer.
    up_sigma : float or (N,)
        Its noise [rad]; infinite if not measured.
    gps_pose, gps_position : (G,), (G, 3)
        Poses with a fix, and fixes of the body origin [m].
    gps_covariance : (3, 3) or (G, 3, 3)
    tiles : Tiles, optional
        Measurements on disk; ``points`` and ``landmark`` are empty then
        (:func:`~graphslam.skeleton.tiles.write_tiled_problem`).
    normals : (M, 3) float32, optional
        Unit normals of the surfaces at the points, body frame. A point then measures the distance along its normal.

    Raises
    ------
    DataError
        Shapes do not fit, numbers are not finite, a point is at the sensor origin, landmarks are not numbered by first
        observation.
    CovarianceError
        A covariance is not positive definite.

    Examples
    --------
    >>> from graphslam_studies.sim.laps import LapsConfig, draw_laps
    >>> problem = draw_laps(LapsConfig(poses=1200)).problem()
    >>> problem.poses, problem.measurements
    (1200, 119550)
    """

    points: npt.NDArray[np.float32]
    landmark: npt.NDArray[np.int32]
    first: npt.NDArray[np.int64]
    odometry_rotation: Array
    odometry_translation: Array
    odometry_covariance: Array
    range_sigma: float
    bearing_sigma: float
    start_rotation: Array
    start_position: Array
    start_covariance: Array
    up: Array | None = None
    up_sigma: float | Array = np.inf
    gps_pose: npt.NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    gps_position: Array = field(default_factory=lambda: np.empty((0, 3)))
    gps_covariance: Array = field(default_factory=lambda: np.eye(3))
    tiles: Tiles | None = None
    normals: npt.NDArray[np.float32] = field(default_factory=lambda: np.empty((0, 3), np.float32))

    def __post_init__(self) -> None:
        put = object.__setattr__
        kinds = (("points", np.float32), ("normals", np.float32), ("landmark", np.int32), ("first", np.int64))
        for name, kind in kinds:
            put(self, name, np.ascontiguousarray(getattr(self, name), dtype=kind))
        N = len(self.first) - 1
        if N < 2:
            raise DataError("a skeleton network of fewer than two poses", got=N)
        gps = np.asarray(self.gps_pose, dtype=np.int64)
        put(self, "gps_pose", gps)
        shapes = {
            "points": (len(self.landmark), 3),
            "odometry_rotation": (N - 1, 3, 3),
            "odometry_translation": (N - 1, 3),
            "start_rotation": (3, 3),
            "start_position": (3,),
            "start_covariance": (6, 6),
            "gps_position": (len(gps), 3),
            "normals": self.points.shape if len(self.normals) else (0, 3),
        }
        if self.up is not None:
            shapes["up"] = (N, 3)
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is None or np.shape(value) != shape:
                raise DataError(f"{name} of a skeleton network", got=np.shape(value), wanted=shape)
            if name not in ("points", "normals"):
                put(self, name, np.ascontiguousarray(value, dtype=np.float64))
            if not np.isfinite(getattr(self, name)).all():
                raise DataError(f"{name} of a skeleton network is not finite")
        self._check_numbers(N, gps)
        put(self, "odometry_covariance", np.asarray(self.odometry_covariance, dtype=np.float64).reshape(-1, 6, 6))
        if len(self.odometry_covariance) not in (1, N - 1):
            raise DataError("odometry_covariance", got=len(self.odometry_covariance), wanted=f"1 or {N - 1}")
        cov = np.asarray(self.gps_covariance, dtype=np.float64).reshape(-1, 3, 3)
        if len(cov) not in (1, len(gps)):
            raise DataError("gps_covariance", got=len(cov), wanted=f"1 or {len(gps)}")
        put(self, "gps_covariance", cov)
        _ = self.odometry_information, self.gps_information, self.start_information

    def _check_numbers(self, N: int, gps: npt.NDArray[np.int64]) -> None:
        if self.first[0] != 0 or self.first[-1] != self.measurements or (np.diff(self.first) < 0).any():
            raise DataError("first of a skeleton network", wanted=f"rising from 0 to {self.measurements}")
        if not (self.range_sigma > 0 and self.bearing_sigma > 0 and (np.asarray(self.up_sigma) > 0).all()):
            raise DataError("noise of a skeleton network", wanted="positive")
        if np.ndim(self.up_sigma) and np.shape(self.up_sigma) != (N,):
            raise DataError("up_sigma", got=np.shape(self.up_sigma), wanted=(N,))
        if len(gps) and (gps.min() < 0 or gps.max() >= N):
            raise DataError("gps_pose of a pose that is not there", got=int(gps.max()), wanted=f"0 … {N - 1}")
        if len(self.normals) and np.abs(np.linalg.norm(self.normals, axis=1) - 1.0).max() > 1e-3:
            raise DataError("normals of a skeleton network", wanted="unit vectors")
        if self.tiles is not None:
            object.__setattr__(self, "_landmarks", self.tiles.landmarks)
            return
        block = 1 << 22
        high = -1
        for k in range(0, len(self.points), block):
            near = np.abs(self.points[k : k + block]).max(axis=1) < 1e-6
            if near.any():
                raise DataError("a measured point lies in the sensor", where=f"measurement {k + int(near.argmax())}")
            label = self.landmark[k : k + block]
            peak = np.maximum.accumulate(np.concatenate([[high], label]))
            if label.min() < 0 or (label > peak[:-1] + 1).any():
                raise DataError("landmarks are not numbered by first observation", wanted="number_by_first_observation")
            high = int(peak[-1])
        object.__setattr__(self, "_landmarks", high + 1)

    @property
    def poses(self) -> int:
        """Number of poses N."""
        return len(self.first) - 1

    @property
    def measurements(self) -> int:
        """Number of measurements M."""
        return len(self.points) if self.tiles is None else self.tiles.measurements

    @property
    def landmarks(self) -> int:
        """Number of landmarks L."""
        return int(self.__dict__["_landmarks"])

    @property
    def fixes(self) -> int:
        """Number of GPS fixes G."""
        return len(self.gps_pose)

    @cached_property
    def odometry_information(self) -> Array:
        """(1 or N - 1, 6, 6)"""
        return inverse_covariance(self.odometry_covariance, "odometry_covariance")

    @cached_property
    def gps_information(self) -> Array:
        """(1 or G, 3, 3)"""
        return inverse_covariance(self.gps_covariance, "gps_covariance")

    @cached_property
    def start_information(self) -> Array:
        """(6, 6)"""
        return inverse_covariance(self.start_covariance, "start_covariance")

    @property
    def detections(self) -> Detections:
        """The measurements as input of the kernels."""
        return self.observations_of(0, self.poses)

    def observations_of(self, begin: int, end: int) -> Detections:
        """At least the measurements of the poses ``begin … end - 1``, as input of the kernels."""
        along, across = self.range_sigma**-2, self.bearing_sigma**-2
        if self.tiles is None:
            return Detections(self.points, self.landmark, self.first, along, across, 0, self.normals)
        points, landmark = self.tiles.read(begin, end)
        return Detections(points, landmark, self.first, along, across, int(self.first[begin]), self.normals)

    def chunks(self, begin: int, end: int) -> Iterator[tuple[int, int]]:
        """Ranges of poses to process at once: all if in memory, tile by tile if on disk."""
        if self.tiles is None:
            yield begin, end
        else:
            yield from self.tiles.ranges(begin, end)

    def room(self, shape: tuple[int, ...]) -> Array:
        """A large zero array: in memory, or on disk if the measurements are there."""
        return np.zeros(shape) if self.tiles is None else self.tiles.room(shape)

    def pieces(self, count: int, least: int = 1 << 20) -> Iterator[tuple[int, int]]:
        """Ranges of ``count`` rows of large arrays to process at once; a quarter if in memory, fewer if on disk."""
        step = max(1, -(-count // 4)) if self.tiles is None else least
        for a in range(0, count, step):
            if self.tiles is not None:
                self.tiles.release()
            yield a, min(a + step, count)

    @cached_property
    def chain(self) -> ChainArrays:
        """Odometry and tilt as input of the kernels."""
        if self.up is None:
            up, weight = np.zeros((self.poses, 3)), np.zeros(1)
        else:
            up, weight = self.up, np.atleast_1d(np.asarray(self.up_sigma, dtype=np.float64)) ** -2.0
        return ChainArrays(self.odometry_rotation, self.odometry_translation, self.odometry_information, up, weight)

    @property
    def freedom(self) -> int:
        """Degrees of freedom of the objective: measured minus estimated scalars."""
        tilts = 0
        if self.up is not None:
            tilts = int(np.isfinite(np.broadcast_to(np.asarray(self.up_sigma, np.float64), self.poses)).sum())
        each = 1 if len(self.normals) else 3
        return each * (self.measurements - self.landmarks) + 2 * tilts + 3 * self.fixes

    def dead_reckoning(self) -> Poses:
        """Poses from the prior of the first one and odometry only."""
        R, p = np.empty((self.poses, 3, 3)), np.empty((self.poses, 3))
        R[0], p[0] = self.start_rotation, self.start_position
        compose_odometry(self.odometry_rotation, self.odometry_translation, R, p)
        return Poses(R, p)

    def relabelled(self, landmark: npt.NDArray[np.int32]) -> SkeletonProblem:
        """The same measurements with other landmarks ``(M,)``, numbered by first observation."""
        return replace(self, landmark=landmark)


def inverse_covariance(covariance: Array, name: str) -> Array:
    """Information matrices of covariances ``(n, d, d)``, or a CovarianceError with ``name``."""
    try:
        np.linalg.cholesky(covariance)
        inverse = np.linalg.inv(covariance)
    except np.linalg.LinAlgError:
        raise CovarianceError(f"{name} of a skeleton network is not positive definite") from None
    if not np.isfinite(inverse).all():
        raise CovarianceError(f"{name} of a skeleton network is not finite")
    return np.ascontiguousarray(0.5 * (inverse + inverse.swapaxes(-1, -2)))
