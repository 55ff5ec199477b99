"""Configuration of the EKF front ends. Every default is for the simulated landmark field of Combined SLAM."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from graphslam.core.errors import ConfigError
from graphslam_frontends.detectors.trees import TreeDetectorConfig
from graphslam_frontends.landmarks.config import RangeBearingNoise, StoppingConfig
from graphslam_frontends.odometry.motion import MotionNoise


@dataclass(frozen=True, slots=True, kw_only=True)
class EkfFilterConfig:
    """What an EKF over one map needs, whatever becomes of the map."""

    association: Literal["known", "nearest", "jcbb"] = "nearest"
    """Identities in the log, gated nearest neighbour, or joint compatibility by branch and bound."""
    gate: float = 11.8
    """χ² gate of an association with 2 dof (99.7 %); other degrees of freedom use the same probability."""
    gate_new: float = 30.0
    """An observation farther than this from every landmark founds a new one; between the gates it is ignored."""
    outlier_gate: float = 0.0
    """With known association: an observation with d² above this (χ², 2 dof; the same tail where it has one channel) is
    an outlier and not used; 0 = use all."""
    max_nodes: int = 20_000
    """Joint compatibility: hypotheses tested per scan; the best one so far is taken then, and the scan counted."""
    confirm_hits: int = 3
    """A feature is provisional until it has been seen this often."""
    drop_misses: int = 5
    """A provisional feature goes after this many scans in which it should have been seen and was not."""
    drop_scans: int = 10
    """A provisional feature goes if it is not confirmed this many scans after its birth."""
    max_range: float = 45.0
    """Observations beyond are not used [m]."""
    longest_gap: float = 60.0
    """Longest time without a record of the motion that is bridged [s]
    (:mod:`graphslam_frontends.odometry.motion_gaps`)."""
    motion: MotionNoise = field(default_factory=MotionNoise)
    """Noise of the dead-reckoning increments."""
    noise: RangeBearingNoise | None = None
    """Observation noise in the filter; None: the log's sigmas."""
    min_hits: int = 1
    """Landmarks handed over were seen at least this often."""
    detector: TreeDetectorConfig = field(default_factory=TreeDetectorConfig)
    """Tree detector, used when the log holds raw scans instead of landmark observations."""

    def __post_init__(self) -> None:
        if self.association not in ("known", "nearest", "jcbb"):
            raise ConfigError(f"association = {self.association!r}; known: known, nearest, jcbb")
        if not self.longest_gap >= 0:
            raise ConfigError(f"longest_gap = {self.longest_gap}; wanted ≥ 0 s")
        if not 0 < self.gate <= self.gate_new:
            raise ConfigError(f"gates must satisfy 0 < gate ≤ gate_new, got {self.gate} and {self.gate_new}")
        if not self.outlier_gate >= 0:
            raise ConfigError(f"outlier_gate = {self.outlier_gate}; wanted ≥ 0")
        for name in ("max_nodes", "confirm_hits", "drop_misses", "drop_scans", "min_hits"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name} = {getattr(self, name)}; wanted ≥ 1")
        if not (np.isfinite(self.max_range) and self.max_range > 0):
            raise ConfigError(f"max_range = {self.max_range}; wanted a finite number > 0")


@dataclass(frozen=True, slots=True, kw_only=True)
class EkfConfig(EkfFilterConfig):
    """EKF local maps, one Gaussian each."""

    smoothing_noise: RangeBearingNoise | None = None
    """Observation noise in the smoothing; None: as in the filter."""
    trim: float = 0.0
    """Smoothed hand-over: after a Huber pass, observations with d² above this are dropped and counted; 0 = keep all."""
    handover: Literal["smoothed", "filter"] = "smoothed"
    """``smoothed``: Gauss-Newton under the filter's association, Laplace covariance; ``filter``: the EKF's own
    Gaussian, as the paper has it. Each sighting is linearised once there: where ranges are far surer than bearings
    (5 cm, 3°), its covariances are too small by a factor of up to ten."""
    stopping: StoppingConfig = field(default_factory=StoppingConfig)
    """When a submap ends."""

    def __post_init__(self) -> None:
        EkfFilterConfig.__post_init__(self)
        if self.handover not in ("filter", "smoothed"):
            raise ConfigError(f"handover = {self.handover!r}; known: filter, smoothed")
        if not self.trim >= 0:
            raise ConfigError(f"trim = {self.trim}; wanted ≥ 0")
