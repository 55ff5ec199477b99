"""Configuration of the RBPF-EKF front end. Every default is for the simulated landmark field of Combined SLAM."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from graphslam.core.config import check_options
from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array
from graphslam_frontends.detectors.trees import TreeDetectorConfig
from graphslam_frontends.odometry.motion import MotionNoise


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeBearingNoise:
    """Noise of a range-bearing sensor: σ_r = range_sigma + range_slope · r, σ_β = bearing_sigma, and systematic errors.

    Without it the sigmas of the log are used, and its ranges unchanged. Scale and offset are those of the filter's
    noise, not of the smoothing's.
    """

    range_sigma: float
    """Constant part of the range σ [m]."""
    range_slope: float = 0.0
    """Part of the range σ proportional to range [m/m]."""
    bearing_sigma: float
    """σ of the bearing [rad]; inf: bearings are not used."""
    range_scale: float = 1.0
    """A distance d is measured as range_scale · d + range_offset; both are corrected before anything else."""
    range_offset: float = 0.0
    """[m]."""

    def __post_init__(self) -> None:
        ranges = {
            "> 0 or inf": "range_sigma bearing_sigma range_scale",
            "≥ 0 or inf": "range_slope",
            "finite": "range_offset",
        }
        check_options(self, "range-bearing noise: ", ranges)

    def variances(self, ranges: Array) -> Array:
        """``(q, 2)`` variances of range and bearing."""
        s = self.range_sigma + self.range_slope * ranges
        return np.stack([s**2, np.full_like(s, self.bearing_sigma**2)], -1)

    def distances(self, ranges: Array) -> Array:
        """Distances ``(q,)`` [m] from measured ranges."""
        return np.asarray((ranges - self.range_offset) / self.range_scale)


@dataclass(frozen=True, slots=True, kw_only=True)
class StoppingConfig:
    """End of a submap (Combined SLAM B8). The report of the submap gives the criterion that applied."""

    num_features: int = 30
    """(iii) number of confirmed features of the standard particle."""
    time_max: float = 8.0
    """(i) TIME_max [s]: a submap without any feature for TIME_max · min(1, ε/σ) ends."""
    min_ancestors: int = 0
    """(ii) diversity: end if the particles descend from this many or fewer initial ones; 0 = off."""
    max_resamplings: int = 0
    """(ii) diversity: end at this many resamplings; 0 = off."""
    max_distance: float = 40.0
    """End after this many metres driven: limits the errors of the local map and the cost of the smoother."""
    max_scans: int = 400
    """End after this many scans, because a stationary vehicle reaches no distance."""
    min_scans: int = 20
    """No criterion applies before this many scans."""
    scans: int = 0
    """If positive: the submap ends after exactly this many scans, without other criteria, so that all algorithms of a
    study cut the log at the same places; 0 = off."""

    def __post_init__(self) -> None:
        check_options(self, "stopping.", {"≥ 0": "scans"})


@dataclass(frozen=True, slots=True, kw_only=True)
class DelayedInitialisation:
    """When stored ranges to a beacon initialise a landmark; a single range is not enough."""

    min_ranges: int = 5
    """Least number of ranges, without outliers."""
    spread: float = 0.1
    """Largest σ of the fit, relative to the mean range; above it the posterior is too curved for a Gaussian."""
    margin: float = 16.0
    """Least χ² difference to every other minimum, such as the mirror image."""
    support: float = 0.9
    """Least share of the particle weights with fits that meet both criteria."""

    def __post_init__(self) -> None:
        ranges = {"≥ 3": "min_ranges", "> 0 or inf": "spread margin", "in (0, 1]": "support"}
        check_options(self, "delayed.", ranges)


DELAYED = DelayedInitialisation()
"""Default of the particle filters."""

GATE_NEW = 30.0
"""An observation farther (χ², 2 dof) from all landmarks initialises a new one; between the gates it is unused."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ObservationConfig:
    """Common options of all filters with a map of landmarks."""

    gate: float = 11.8
    """χ² gate of an association (2 dof: 99.7 %; the same tail for an observation of one channel)."""
    outlier_gate: float = 0.0
    """With known association: an observation with larger d² (χ², 2 dof; same tail probability with one channel) is an
    outlier for that particle and is not used; 0 = use all."""
    confirm_hits: int = 3
    """A feature is provisional until it has been observed this often."""
    drop_misses: int = 5
    """A provisional feature is deleted after this many scans in which it was expected but not observed."""
    drop_scans: int = 10
    """A provisional feature is deleted if it is not confirmed this many scans after its first observation."""
    max_range: float = 45.0
    """Observations beyond this range are not used [m]."""
    longest_gap: float = 60.0
    """Longest gap in the records of the motion that is bridged [s] (:mod:`graphslam_frontends.odometry.motion_gaps`).
    Longer gaps are bridged if recorded odometry gives the motion over them."""
    motion: MotionNoise = field(default_factory=MotionNoise)
    """Noise of the dead-reckoning increments."""
    noise: RangeBearingNoise | None = None
    """Observation noise in the filter; None: the sigmas of the log."""
    min_hits: int = 1
    """Landmarks in the submap were observed at least this often (under the winning association)."""
    detector: TreeDetectorConfig = field(default_factory=TreeDetectorConfig)
    """Tree detector, used if the log has raw scans instead of landmark observations."""

    def __post_init__(self) -> None:
        check_options(self, "", {"≥ 0 or inf": "longest_gap outlier_gate", f"in (0, {GATE_NEW}]": "gate"})


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterConfig(ObservationConfig):
    """Options of a particle filter over one map."""

    particles: int = 40
    """Number of particles N."""
    proposal: Literal["2.0", "1.0"] = "2.0"
    """FastSLAM 2.0 (EKF proposal, measurement in the proposal) or 1.0 (motion prior)."""
    association: Literal["likelihood", "known"] = "likelihood"
    """Maximum likelihood per particle, or the identities in the log."""
    ess_fraction: float = 0.5
    """Systematic resampling if N_eff < ess_fraction · N. Do not switch it off."""

    def __post_init__(self) -> None:
        ObservationConfig.__post_init__(self)
        check_options(self, "", {"≥ 1": "particles", "in (0, 1]": "ess_fraction"})


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorBiasConfig:
    """Constant errors that a graph estimates with the map: prior σ of each; 0: not estimated.

    The defaults are typical uncertainties of a data sheet and a tape measure.
    """

    yaw_bias: float = float(np.deg2rad(1.0))
    """Of the yaw rate while the robot moves [rad/s]."""
    turn_per_metre: float = 0.0
    """Of the heading per metre driven [rad/m]; instead of a yaw-rate bias."""
    distance_scale: float = 0.05
    """Of the logarithm of the scale of distances."""
    range_offset: float = 0.3
    """Of the offset of the ranges [m]."""
    sensor_yaw: float = float(np.deg2rad(5.0))
    """Of the yaw of the sensor on the robot [rad]."""
    range_scale: float = 0.0
    """Of the logarithm of the scale of ranges, instead of ``sensor_yaw``; for ranges without bearings."""
    mount: float = 0.05
    """Of the position of the sensor on the robot, ahead and to the left [m]."""

    def __post_init__(self) -> None:
        check_options(self, "biases.", {"≥ 0": "*"})
        for one, other in (("yaw_bias", "turn_per_metre"), ("sensor_yaw", "range_scale")):
            if getattr(self, one) and getattr(self, other):
                raise ConfigError(
                    f"biases.{one} and biases.{other} cannot be estimated together; wanted 0 for one of them"
                )

    def chosen(self) -> tuple[tuple[str, ...], Array]:
        """Name and σ of each of :data:`~graphslam.core.sensor_biases.CONSTANTS`; those not estimated have no name and σ
        = 1."""
        pairs = (("yaw_bias", "turn_per_metre"), ("distance_scale",), ("range_offset",), ("sensor_yaw", "range_scale"))
        names = tuple(next((n for n in some if getattr(self, n) > 0.0), "") for some in pairs)
        sigmas = [getattr(self, n) if n else 1.0 for n in names]
        places = ("mount_x", "mount_y") if self.mount > 0.0 else ("", "")
        return (*names, *places), np.array([*sigmas, *2 * [self.mount or 1.0]])


@dataclass(frozen=True, slots=True, kw_only=True)
class RbpfEkfConfig(FilterConfig):
    """FastSLAM local maps, each summarised as one Gaussian."""

    smoothing_noise: RangeBearingNoise | None = None
    """Observation noise in the smoothing; None: as in the filter."""
    trim: float = 0.0
    """After a robust (Huber) iteration, observations with larger d² (2 dof; same tail probability with one channel) are
    dropped and counted; 0 = keep all."""
    handover: Literal["smoothed", "moments", "pooled"] = "smoothed"
    """``smoothed``: Gauss-Newton under the winning association, Laplace covariance; ``moments``: B3 (paper mode);
    ``pooled``: moments of ``pooled`` independent filters."""
    moment_inflation: bool = False
    """Paper mode only: multiply the between-particle part by 1 + 40/N."""
    pooled: int = 0
    """Number K of independent filters over the same scans; the first one determines the association. The discrepancy of
    their pooled moments is reported as a check. The filter takes K times as long; 0 = off."""
    stopping: StoppingConfig = field(default_factory=StoppingConfig)
    """Criteria for the end of a submap."""
    biases: SensorBiasConfig | None = None
    """Constant errors of wheels and sensor that the graph estimates with the map; None: none."""

    def __post_init__(self) -> None:
        FilterConfig.__post_init__(self)
        if self.pooled < 0 or self.pooled == 1:
            raise ConfigError(
                f"pooled = {self.pooled}; wanted 0 (off) or ≥ 2: one filter has no spread between filters"
            )
        if self.handover == "pooled" and not self.pooled:
            raise ConfigError('handover = "pooled" needs pooled ≥ 2 filters')
