"""Configuration of SegSLAM. The defaults were found on a simulated garage of two levels; the path lengths and times
assume a robot at some tenths to a few metres per second."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal

from graphslam.core.config import check_options
from graphslam.core.errors import ConfigError
from graphslam.registration.config import RegistrationConfig

MAX_YAW = 0.8
"""Greatest half width of a search in heading [rad]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmentationConfig:
    """Criteria for the end of a segment: A7 motion error, A8 predictive score, period; within size limits."""

    score: float = 0.45
    """A segment ends if the predictive score is below this (A8); 0 = off."""
    relative_score: float = 0.65
    """… or below this fraction of its running maximum in the segment; 0 = off."""
    window: float = 4.0
    """Look-ahead window W [s]; the filter lags behind the sensors by this."""
    tolerance: float = 0.6
    """A look-ahead beam is predicted if its ray-cast range is within this [m]."""
    excluded: float = 5.0
    """The score is not used in the first seconds of a segment, nor for its maximum [s]."""
    every: float = 2.0
    """Time between decisions [s]."""
    min_seconds: float = 12.0
    """Minimum size of a segment [s] …"""
    min_length: float = 9.0
    """… and [m]: both must be reached."""
    max_length: float = 60.0
    """A segment ends at this length of new ground at the latest [m] …"""
    max_seconds: float = math.inf
    """… or after this time [s], unless it is shorter than the minimum length."""
    period: float = 0.0
    """Segments of this duration, without the criteria of score and motion [s]; 0 = off."""
    motion_translation: float = 0.0
    """α1 of the motion error: error per metre driven [1/m] (A7). A segment ends if its error reaches 1."""
    motion_rotation: float = 0.0
    """α2: error per radian rotated [1/rad]; α1 = α2 = 0: criterion off."""
    decide: Literal["filter", "particle"] = "filter"
    """One decision for the filter, or one per particle; with the latter fewer segments fit together."""

    def __post_init__(self) -> None:
        ranges = {
            "> 0 or inf": "window tolerance every max_length max_seconds",
            "in [0, 1]": "score relative_score",
            "≥ 0 or inf": "*",
        }
        check_options(self, "segmentation.", ranges)
        if self.min_length > self.max_length or self.min_seconds > self.max_seconds:
            raise ConfigError(f"segmentation: the minimum size is above the maximum, got {self}")


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmentCandidateConfig:
    """Selection of earlier segments for matching (A10)."""

    gap: float = 40.0
    """Segments that ended more recently than this are no candidates [s]."""
    sigma: float = 0.5
    """σ of the path-length model: this [m] …"""
    sigma_per_metre: float = 0.04
    """… plus this per metre driven since."""
    sigmas: float = 2.5
    """A candidate is nearer than this many σ …"""
    height: float = 1.6
    """… and its path not higher or lower than this [m] …"""
    height_per_metre: float = 0.0
    """… plus this per metre driven since; search and choice add the same to their own heights. An accelerometer bias
    causes a slope: with 5 mrad, heights are off by 2 m after 400 m. Use only without overlapping floors of a building:
    they look alike and would be confused."""
    near: float = 2.0
    """Edge of the box around the robot for the count of known voxels [m]; widened by the uncertainty."""
    known: int = 50
    """Least number of known voxels of the candidate in the box."""
    keep: int = 4
    """Most candidates of one particle at one time, nearest (in σ) first."""

    def __post_init__(self) -> None:
        check_options(self, "winnowing.", {"> 0 or inf": "sigma sigmas keep", "≥ 0 or inf": "*"})

    def rise(self, length: Any) -> Any:
        """Height allowance after a path of a length [m]; arrays too."""
        return self.height_per_metre * length

    def drift(self, length: Any) -> Any:
        """σ after a path of a length [m]; arrays too."""
        return self.sigma + self.sigma_per_metre * length


YAW = (0.1, 2.5e-3)
"""Half width of a search in heading: this [rad], plus this per metre driven since, at most :data:`MAX_YAW`."""
STARTS = 6
"""Most distinct modes of a search that are registered."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CandidateSearch:
    """Correlative search for a candidate: drift at a loop closure exceeds the convergence range of registration."""

    grid: float = 0.8
    """Step of the search in position [m]; its modes are refined in quarters of it."""
    sigma: float = 0.3
    """σ of the distance to the map within which a point counts as explained [m]; doubled in the coarse search."""
    yaw_step: float = 0.1
    """Step in heading [rad]; refined in quarters of it."""
    max_radius: float = 30.0
    """Half width of the search: at most this [m], and at most 2.5 σ of the path-length model."""
    height: float = 0.8
    """Half width in z [m]."""
    source_radius: float = 15.0
    """Points of the look-ahead window farther than this are left out [m]."""
    source_points: int = 300
    """Most points of the look-ahead window."""
    most_searches: int = 12
    """Most searches at one time, of all particles together."""

    def __post_init__(self) -> None:
        positive = "grid yaw_step max_radius source_radius source_points most_searches"
        check_options(self, "search.", {"> 0 or inf": positive, "≥ 0 or inf": "*"})

    def yaw_width(self, length: float) -> float:
        """Half width in heading after a path of a length [m]."""
        return min(YAW[0] + YAW[1] * length, MAX_YAW)


@dataclass(frozen=True, slots=True, kw_only=True)
class ChoiceConfig:
    """Acceptance of matches, and time between attempts (A9)."""

    every: float = 4.0
    """Time between attempts [s]; each needs a complete look-ahead window."""
    fitness: float = 0.83
    """Least share of the points that a match explains, besides the gates of the registration. In simulated mines and
    garages correct matches had 0.78 to 0.98, most of them 0.92 and more; false ones up to 0.82."""
    fitness_upright: float = 0.8
    """The same for points on vertical surfaces, if known: false matches that passed all other gates had 0.75 to 0.79 in
    mines, correct ones rarely less than 0.81."""
    height: float = 1.6
    """Greatest height difference between match and prediction [m]."""
    shift: float = 2.5
    """Greatest distance between match and prediction, in σ of the path-length model."""
    margin: float = 0.1
    """A second mode must be worse by this share of the points. In simulated mines correct matches were better than any
    other mode by 0.10 and more, false ones by 0.03 to 0.09."""
    null_weight: float = 0.01
    """Weight of "no match", which is always an option."""
    position_sigma: float = 0.1
    """Standard deviations of an accepted match: position [m] …"""
    angle_sigma: float = 0.012
    """… and angles [rad], added to the registration's own covariance."""
    method: Literal["registration", "localisation", "both"] = "registration"
    """Score of a match: registration (eq. 18), localisation (eq. 19), or both."""

    def __post_init__(self) -> None:
        ranges = {
            "> 0 or inf": "every shift null_weight position_sigma angle_sigma",
            "in [0, 1]": "fitness fitness_upright margin",
            "≥ 0 or inf": "*",
        }
        check_options(self, "choice.", ranges)


@dataclass(frozen=True, slots=True, kw_only=True)
class HandoverConfig:
    """Output of finished segments."""

    drift_scale: float = 1.0
    """Factor on the drift model in the exit covariance."""
    matched_only: bool = False
    """Moment matching of the paper instead of particles plus drift: for comparison only."""

    def __post_init__(self) -> None:
        check_options(self, "handover.", {"> 0 or inf": "drift_scale", "≥ 0 or inf": "*"})


@dataclass(frozen=True, slots=True, kw_only=True)
class SegSlamConfig:
    """All options of SegSLAM except those of the particle filter within segments."""

    segmentation: SegmentationConfig = field(default_factory=SegmentationConfig)
    """End of segments."""
    winnowing: SegmentCandidateConfig = field(default_factory=SegmentCandidateConfig)
    """Selection of candidates."""
    search: CandidateSearch = field(default_factory=CandidateSearch)
    """Search for matches."""
    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    """Registration of matches, with gates of fitness, degeneracy and tilt."""
    choice: ChoiceConfig = field(default_factory=ChoiceConfig)
    """Acceptance of matches."""
    handover: HandoverConfig = field(default_factory=HandoverConfig)
    """Output of segments."""
    inside: Literal["filter", "scan-window"] = "filter"
    """Motion of the particles within a segment: dead reckoning with sampled noise, as in the paper; or scan-to-window
    odometry (``frontend.window``), the same for all particles, because its noise is too small to sample. Particles then
    differ only in the older maps they enter."""

    def __post_init__(self) -> None:
        check_options(self, "segslam.", {"≥ 0 or inf": "*"})
