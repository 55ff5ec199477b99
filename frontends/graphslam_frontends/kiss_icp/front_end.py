"""The front end ``kiss-icp``: odometry of the package ``kiss_icp``, with the submaps and covariances of this project.

KISS-ICP (Vizzo et al. 2023) registers each scan to its own point map and gives a pose, but no covariance. Submaps,
their clouds and evidence grids, reports and refinement are those of
:mod:`graphslam_frontends.lidar_odometry.front_end`. The covariance is that of a registration to Gaussian cells, at the
pose of KISS-ICP:

- information by window pose, and noise of the gradient, as in ``lidar-odometry``;
- the optimum of the cells, started at the pose of KISS-ICP, is a second estimate from the same scan. The difference of
  the two is propagated through the window as one error, and its outer product is added;
- along unobservable directions the motion may be anything from zero to the predicted one: the whole predicted motion is
  added as σ.

The map of the cells uses the poses of KISS-ICP. If both maps drift together (few points, mostly in rings on a level
floor), the covariance does not include it.

Scans are deskewed here at constant velocity, because the package aborts the process if all point stamps are equal.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from graphslam.core import se3
from graphslam.core.config import check_options
from graphslam.core.errors import ConfigError
from graphslam.core.extras import import_extra
from graphslam.core.geometry import Array
from graphslam.core.record_source import RecordSource
from graphslam_frontends.lidar_odometry.cells import NormalEquations
from graphslam_frontends.lidar_odometry.config import LidarOdometryConfig
from graphslam_frontends.lidar_odometry.front_end import LidarFrontEnd, LidarSubmapConfig, Unit
from graphslam_frontends.lidar_odometry.odometry import (
    FEW,
    FITS,
    LITTLE,
    MOST_STEPS,
    SCALE,
    STILL,
    SUSPICIOUS,
    LidarOdometry,
    RawScan,
    ScanResult,
    observable_projection,
    split_pose,
)

CELL = 0.5
"""Edge of the Gaussian cells for the covariance [m]."""
NO_STAMPS = np.zeros(0)
"""Without stamps the package does not deskew."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KissIcpConfig:
    """Parameters of the package, with its defaults."""

    max_range: float = 100.0
    """Points farther away are ignored [m]."""
    min_range: float = 0.0
    """Nearer points are ignored [m]."""
    voxel_size: float | None = None
    """Edge of the voxels of its map [m]; None: ``max_range`` / 100."""
    deskew: bool = True
    """Deskew points to the stamp of the scan, if they have times of their own."""

    def __post_init__(self) -> None:
        check_options(self, "kiss-icp: ", {"> 0": "voxel_size max_range", "≥ 0": "min_range"})
        if not self.min_range < self.max_range:
            raise ConfigError(f"kiss-icp: min_range = {self.min_range}; wanted 0 … max_range {self.max_range}")

    def registration(self) -> Any:
        """The odometry of the package in its initial state, with one thread, so that runs are reproducible."""
        package = import_extra("kiss_icp.kiss_icp", "front end 'kiss-icp'")
        config = import_extra("kiss_icp.config", "front end 'kiss-icp'").KISSConfig()
        config.data.max_range, config.data.min_range, config.data.deskew = self.max_range, self.min_range, False
        config.mapping.voxel_size = self.max_range / 100.0 if self.voxel_size is None else self.voxel_size
        config.registration.max_num_threads = 1
        return package.KissICP(config)


@dataclass(frozen=True, slots=True, kw_only=True)
class KissIcpFrontEndConfig:
    """The front end ``kiss-icp``."""

    stream: str | None = None
    """Stream of point clouds; None: the first of the log."""
    odometry: KissIcpConfig = field(default_factory=KissIcpConfig)
    """Registration of scans."""
    submap: LidarSubmapConfig = field(default_factory=LidarSubmapConfig)
    """Cutting of the path, and contents of the submaps."""
    imu: ClassVar[str] = "none"
    """KISS-ICP uses scans only."""


class KissIcpOdometry(LidarOdometry):
    """Poses by ``kiss_icp``, with covariance by Gaussian cells; see the module docstring.

    Parameters
    ----------
    config : KissIcpConfig
    """

    def __init__(self, config: KissIcpConfig) -> None:
        super().__init__(
            LidarOdometryConfig(
                max_range=config.max_range, min_range=config.min_range, levels=(CELL,), deskew=config.deskew
            )
        )
        self.package = config.registration()
        self._whole: tuple[Array, Array | None] = np.zeros((0, 3)), None

    def step(self, cloud: Array, time: float, ages: Array | None = None) -> ScanResult:
        """See :class:`~graphslam_frontends.lidar_odometry.odometry.LidarOdometry`."""
        self._whole = cloud, ages if self.config.deskew else None
        if self.scan + 1 == self.first and len(cloud):
            self._register(cloud)
        return super().step(cloud, time, ages)

    def _register(self, points: Array) -> Array:
        """Register a scan and add it to the map of the package; returns its pose ``(7,)``."""
        self.package.register_frame(np.ascontiguousarray(points, dtype=np.float64), NO_STAMPS)
        T = self.package.last_pose
        return np.concatenate([T[:3, 3], se3.matrix_to_quat(T[:3, :3])])

    def _match(
        self,
        raw: RawScan,
        predicted: Array,
        bridge: Array | None,
        spread: Array | None,
        time: float,
        by_imu: bool,
    ) -> tuple[Array, NormalEquations | None, ScanResult]:
        points, self.off = self._unbent(raw, predicted, time), np.zeros(6)
        if len(points) < FEW:
            return predicted, None, ScanResult(len(points), 0.0, 6, "empty", False)
        pose = self._register(self._unbent(RawScan(*self._whole), predicted, time))
        points = self._unbent(raw, pose, time)
        fit = self.levels[-1].fit(points, *split_pose(pose), SCALE)
        state = "matched"
        if len(self.overlaps) >= 3 and fit.overlap < SUSPICIOUS * np.median(self.overlaps):
            fits = not self.lost and fit.quality > FITS * np.median(self.qualities) and fit.known * len(points) > FEW
            state = "new space" if fits else "lost"
        if state == "lost" or fit.known < LITTLE:
            return pose, None, ScanResult(len(points), fit.overlap, 6, state, False)
        P = observable_projection(fit.H, fit.every)
        R, t = split_pose(pose.copy())
        self.levels[-1].descend(points, R, t, SCALE, 1e-6 * np.trace(fit.H) / 6.0 * np.eye(6), STILL, MOST_STEPS)
        best = np.concatenate([t, se3.matrix_to_quat(R)])
        self.off = P @ np.asarray(se3.se3_log(se3.se3_between(pose, best)))
        if state == "matched":
            self.overlaps.append(fit.overlap)
            self.qualities.append(fit.quality)
        return pose, fit, ScanResult(len(points), fit.overlap, 6 - round(float(np.trace(P))), state, False)

    def _instead(self, seen: ScanResult, motion: Array, Q: Array | None) -> Array | None:
        if not seen.unobservable or self.scan == 0:
            return None
        moved = np.asarray(se3.se3_log(motion))
        turn2, shift2 = np.maximum(np.mean(self.missed, axis=0) if self.missed else 0.0, [1e-6, 1e-4])
        return np.diag([turn2] * 3 + [shift2] * 3) + np.outer(moved, moved)


@dataclass(frozen=True, slots=True)
class KissIcpFrontEnd(LidarFrontEnd):
    """The front end ``kiss-icp``: point clouds only, without IMU and wheels."""

    config: KissIcpFrontEndConfig = field(default_factory=KissIcpFrontEndConfig)  # type: ignore[assignment]
    name: ClassVar[str] = "kiss-icp"

    def _odometry(self, unit: Unit) -> LidarOdometry:
        return KissIcpOdometry(self.config.odometry)

    def _imu(self, feed: RecordSource, clouds: str) -> str | None:
        return None

    def _wheels(self, feed: RecordSource, clouds: str) -> str | None:
        return None
