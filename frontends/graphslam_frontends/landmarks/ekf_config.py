"""Configuration of the EKF front ends. Every default is for the simulated landmark field of Combined SLAM."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from graphslam.core.config import check_options
from graphslam_frontends.landmarks.config import ObservationConfig, RangeBearingNoise, StoppingConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class EkfFilterConfig(ObservationConfig):
    """Options of an EKF over one map."""

    association: Literal["known", "nearest", "jcbb"] = "nearest"
    """Identities in the log, gated nearest neighbour, or joint compatibility by branch and bound."""
    max_nodes: int = 20_000
    """Joint compatibility: most hypotheses tested per scan; then the best one so far is used, and counted."""

    def __post_init__(self) -> None:
        ObservationConfig.__post_init__(self)
        check_options(self, "", {"≥ 1": "max_nodes confirm_hits drop_misses drop_scans min_hits", "> 0": "max_range"})


@dataclass(frozen=True, slots=True, kw_only=True)
class EkfConfig(EkfFilterConfig):
    """EKF local maps, one Gaussian each."""

    smoothing_noise: RangeBearingNoise | None = None
    """Observation noise in the smoothing; None: as in the filter."""
    trim: float = 0.0
    """Smoothed output: after robust (Huber) iterations, observations with larger d² are dropped, counted; 0: off."""
    handover: Literal["smoothed", "filter"] = "smoothed"
    """``smoothed``: Gauss-Newton under the filter's association, Laplace covariance; ``filter``: the Gaussian of the
    EKF, as in the paper. That linearises each observation once: if ranges are far more precise than bearings (5 cm,
    3°), its covariances are too small by a factor of up to 10."""
    stopping: StoppingConfig = field(default_factory=StoppingConfig)
    """Criteria for the end of a submap."""

    def __post_init__(self) -> None:
        EkfFilterConfig.__post_init__(self)
        check_options(self, "", {"≥ 0 or inf": "trim"})
