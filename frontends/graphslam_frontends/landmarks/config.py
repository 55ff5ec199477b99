"""Configuration of the RBPF-EKF front end. Every default is for the simulated landmark field of Combined SLAM."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array
from graphslam_frontends.detectors.trees import TreeDetectorConfig
from graphslam_frontends.odometry.motion import MotionNoise


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeBearingNoise:
    """Errors of a range-bearing sensor: σ_r = range_sigma + range_slope · r, σ_β = bearing_sigma, and systematic ones.

    Without it the log's own sigmas are used, and its ranges as they are. Scale and offset are those of the filter's
    noise; a noise for the smoothing has no say in them.
    """

    range_sigma: float
    """Constant part of the range σ [m]."""
    range_slope: float = 0.0
    """Part of the range σ proportional to range [m/m]."""
    bearing_sigma: float
    """σ of the bearing [rad]; inf: bearings are not used."""
    range_scale: float = 1.0
    """A distance d is measured as range_scale · d + range_offset; both are taken out before anything else."""
    range_offset: float = 0.0
    """[m]."""

    def __post_init__(self) -> None:
        if not (self.range_sigma > 0 and self.range_slope >= 0 and self.bearing_sigma > 0):
            raise ConfigError(f"range-bearing noise must be positive, got {self}")
        if not (self.range_scale > 0 and np.isfinite(self.range_offset)):
            raise ConfigError(f"range_scale must be > 0 and range_offset finite, got {self}")

    def variances(self, ranges: Array) -> Array:
        """``(q, 2)`` variances of range and bearing."""
        s = self.range_sigma + self.range_slope * ranges
        return np.stack([s**2, np.full_like(s, self.bearing_sigma**2)], -1)

    def distances(self, ranges: Array) -> Array:
        """Distances ``(q,)`` [m] that measured ranges stand for."""
        return np.asarray((ranges - self.range_offset) / self.range_scale)


@dataclass(frozen=True, slots=True, kw_only=True)
class StoppingConfig:
    """When a submap ends (Combined SLAM B8). Each criterion names itself in the submap's report."""

    num_features: int = 30
    """(iii) the standard particle holds this many confirmed features."""
    time_max: float = 8.0
    """(i) TIME_max [s]: a submap without any feature for TIME_max · min(1, ε/σ) ends."""
    min_ancestors: int = 0
    """(ii) diversity: end when the particles descend from this many or fewer of the first ones; 0 = off."""
    max_resamplings: int = 0
    """(ii) diversity: end at this many resamplings; 0 = off."""
    max_distance: float = 40.0
    """End after this many metres driven: local accuracy, and the smoother's linear cost."""
    max_scans: int = 400
    """End after this many scans (a vehicle that stands still gathers no distance)."""
    min_scans: int = 20
    """No criterion counts before this many scans."""
    scans: int = 0
    """With a number: the submap ends after exactly this many scans and nothing else counts, so that every algorithm
    of a study cuts the log at the same places; 0 = off."""

    def __post_init__(self) -> None:
        if self.scans < 0:
            raise ConfigError(f"stopping.scans = {self.scans}; wanted ≥ 0")


@dataclass(frozen=True, slots=True, kw_only=True)
class DelayedInitialisation:
    """When the ranges to a beacon, kept until then, make a landmark. A single range says too little."""

    min_ranges: int = 5
    """At least this many ranges, outliers not counted."""
    spread: float = 0.1
    """The fit's largest σ is at most this part of the mean range: beyond it the circle is too curved for a Gaussian."""
    margin: float = 16.0
    """Every other minimum (the mirror image above all) fits worse by this much in χ²."""
    support: float = 0.9
    """Share of the particles' weight whose fits must satisfy both."""

    def __post_init__(self) -> None:
        if self.min_ranges < 3:
            raise ConfigError(f"delayed.min_ranges = {self.min_ranges}; wanted ≥ 3")
        if not (self.spread > 0 and self.margin > 0 and 0 < self.support <= 1):
            raise ConfigError(f"delayed start needs spread > 0, margin > 0 and 0 < support ≤ 1, got {self}")


DELAYED = DelayedInitialisation()
"""Of the particle filters."""

GATE_NEW = 30.0
"""An observation farther (χ², 2 dof) than this from every landmark founds a new one; between the gates it is unused."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SightingConfig:
    """What every filter over a map of landmarks needs."""

    gate: float = 11.8
    """χ² gate of an association (2 dof: 99.7 %; the same tail for an observation of one channel)."""
    outlier_gate: float = 0.0
    """With known association: an observation with d² above this (χ², 2 dof; the same tail where it has one channel) is
    an outlier (to that particle) and not used; 0 = use all."""
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
    """Landmarks handed over were seen at least this often (under the winning association)."""
    detector: TreeDetectorConfig = field(default_factory=TreeDetectorConfig)
    """Tree detector, used when the log holds raw scans instead of landmark observations."""

    def __post_init__(self) -> None:
        if not self.longest_gap >= 0:
            raise ConfigError(f"longest_gap = {self.longest_gap}; wanted ≥ 0 s")
        if not 0 < self.gate <= GATE_NEW:
            raise ConfigError(f"gate = {self.gate}; wanted 0 < gate ≤ {GATE_NEW}")
        if not self.outlier_gate >= 0:
            raise ConfigError(f"outlier_gate = {self.outlier_gate}; wanted ≥ 0")


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterConfig(SightingConfig):
    """What a particle filter over one map needs, whatever becomes of the map."""

    particles: int = 40
    """Number of particles N."""
    proposal: Literal["2.0", "1.0"] = "2.0"
    """FastSLAM 2.0 (EKF proposal, measurement in the proposal) or 1.0 (motion prior)."""
    association: Literal["likelihood", "known"] = "likelihood"
    """Per-particle maximum likelihood, or the identities in the log."""
    ess_fraction: float = 0.5
    """Systematic resampling when N_eff < ess_fraction · N. Never switch it off inside a submap."""

    def __post_init__(self) -> None:
        SightingConfig.__post_init__(self)
        if self.particles < 1:
            raise ConfigError(f"particles = {self.particles}; wanted ≥ 1")
        if self.proposal not in ("1.0", "2.0"):
            raise ConfigError(f"proposal = {self.proposal!r}; known: 1.0, 2.0")
        if self.association not in ("likelihood", "known"):
            raise ConfigError(f"association = {self.association!r}; known: likelihood, known")
        if not 0 < self.ess_fraction <= 1:
            raise ConfigError(f"ess_fraction = {self.ess_fraction}; wanted in (0, 1]")


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorBiasConfig:
    """Constant errors that a graph estimates with the map: σ of what is known of each beforehand; 0: it is none.

    The defaults are what a robot's data sheet and a tape measure leave open.
    """

    yaw_bias: float = float(np.deg2rad(1.0))
    """Of the yaw rate while the robot moves [rad/s]."""
    turn_per_metre: float = 0.0
    """Of the heading for every metre driven [rad/m], in the place of a bias of the yaw rate."""
    distance_scale: float = 0.05
    """Of the logarithm of the distances."""
    range_offset: float = 0.3
    """Of the zero of the ranges [m]."""
    sensor_yaw: float = float(np.deg2rad(5.0))
    """Of the direction of the sensor [rad]."""
    range_scale: float = 0.0
    """Of the logarithm of the ranges, in the place of a direction: for ranges without bearings."""
    mount: float = 0.05
    """Of where the sensor stands on the robot, ahead and to the left [m]."""

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) >= 0.0):
                raise ConfigError(f"lasting.{name} = {getattr(self, name)}; wanted a finite σ ≥ 0")
        for one, other in (("yaw_bias", "turn_per_metre"), ("sensor_yaw", "range_scale")):
            if getattr(self, one) and getattr(self, other):
                raise ConfigError(
                    f"lasting.{one} and lasting.{other} cannot be estimated together; wanted 0 for one of them"
                )

    def chosen(self) -> tuple[tuple[str, ...], Array]:
        """Name and σ of each of :data:`~graphslam.core.sensor_biases.CONSTANTS`; what is none has no name, and a σ of
        1."""
        pairs = (("yaw_bias", "turn_per_metre"), ("distance_scale",), ("range_offset",), ("sensor_yaw", "range_scale"))
        names = tuple(next((n for n in some if getattr(self, n) > 0.0), "") for some in pairs)
        sigmas = [getattr(self, n) if n else 1.0 for n in names]
        places = ("mount_x", "mount_y") if self.mount > 0.0 else ("", "")
        return (*names, *places), np.array([*sigmas, *2 * [self.mount or 1.0]])


@dataclass(frozen=True, slots=True, kw_only=True)
class RbpfEkfConfig(FilterConfig):
    """FastSLAM local maps, summarised as one Gaussian each."""

    smoothing_noise: RangeBearingNoise | None = None
    """Observation noise in the smoothing; None: as in the filter."""
    trim: float = 0.0
    """After a Huber pass, observations with d² above this (2 dof; the same tail where there is one channel) are dropped
    and counted; 0 = keep all."""
    handover: Literal["smoothed", "moments", "pooled"] = "smoothed"
    """``smoothed``: Gauss-Newton under the winning association, Laplace covariance; ``moments``: B3 (paper mode);
    ``pooled``: moments of ``pooled`` independent filters."""
    moment_inflation: bool = False
    """Paper mode only: multiply the between-particle part by 1 + 40/N."""
    pooled: int = 0
    """Number K of independent filters over the same scans, the first of them the one that decides; their pooled moments
    stand in the report as an alarm. Costs K times the filter's time; 0 = off."""
    stopping: StoppingConfig = field(default_factory=StoppingConfig)
    """When a submap ends."""
    lasting: SensorBiasConfig | None = None
    """Constant errors of wheels and sensor that the graph estimates with the map; None: there are none."""

    def __post_init__(self) -> None:
        FilterConfig.__post_init__(self)
        if self.handover not in ("smoothed", "moments", "pooled"):
            raise ConfigError(f"handover = {self.handover!r}; known: smoothed, moments, pooled")
        if self.pooled < 0 or self.pooled == 1:
            raise ConfigError(
                f"pooled = {self.pooled}; wanted 0 (off) or ≥ 2: one filter has no spread between filters"
            )
        if self.handover == "pooled" and not self.pooled:
            raise ConfigError('handover = "pooled" needs pooled ≥ 2 filters')
