"""What steers SegSLAM. Defaults are those that segmented and closed a simulated garage of two levels sanely; the path
lengths and times in them assume a robot of some tenths to a few metres a second."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any, Literal

from graphslam.core.errors import ConfigError
from graphslam.registration.config import RegistrationConfig

MAX_YAW = 0.8
"""Greatest half width of a search in heading [rad], however long the way was."""


def _check(config: Any, part: str, *, positive: tuple[str, ...] = (), unit: tuple[str, ...] = ()) -> None:
    """Refuse numbers that are NaN or negative, ``positive`` ones that are 0, and ``unit`` ones above 1."""
    for f in fields(config):
        value = getattr(config, f.name)
        if not isinstance(value, (int, float)) or isinstance(value, bool):
            continue
        if math.isnan(value) or value < 0 or (f.name in positive and value == 0) or (f.name in unit and value > 1):
            wanted = "0 … 1" if f.name in unit else "> 0" if f.name in positive else "≥ 0"
            raise ConfigError(f"{part}.{f.name} = {value}; wanted {wanted}")


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmentationConfig:
    """When a segment ends: A7 motion error, A8 predictive score, period; between a minimum and a maximum size."""

    score: float = 0.45
    """The predictive score below which a segment ends (A8); 0 = off."""
    relative_score: float = 0.65
    """… or below this share of its running maximum since the segment began; 0 = off."""
    window: float = 4.0
    """Look-ahead window W [s]; the filter runs this far behind."""
    tolerance: float = 0.6
    """A look-ahead beam is predicted if its cast range is within this [m]."""
    excluded: float = 5.0
    """The score says nothing in the first seconds of a segment, and does not count for its maximum [s]."""
    every: float = 2.0
    """Time between decisions [s]."""
    min_seconds: float = 12.0
    """Minimum size of a segment [s] …"""
    min_length: float = 9.0
    """… and [m]: both must be reached."""
    max_length: float = 60.0
    """A segment ends after this length of new ground at the latest [m]."""
    max_seconds: float = math.inf
    """… or after this time [s], except where less than the minimum length was driven."""
    period: float = 0.0
    """With a number: segments of this many seconds, whatever score and motion say [s]; 0 = off."""
    motion_translation: float = 0.0
    """α1 of the motion error: error a metre driven [1/m] (A7). A segment ends where its error reaches 1."""
    motion_rotation: float = 0.0
    """α2: error a radian turned [1/rad]; α1 = α2 = 0: the motion ends no segment."""
    decide: Literal["filter", "particle"] = "filter"
    """One decision for the filter, or one for each particle, which leaves fewer segments that fit together."""

    def __post_init__(self) -> None:
        _check(
            self,
            "segmentation",
            positive=(
                "window",
                "tolerance",
                "every",
                "max_length",
                "max_seconds",
            ),
            unit=("score", "relative_score"),
        )
        if self.min_length > self.max_length or self.min_seconds > self.max_seconds:
            raise ConfigError(f"segmentation: the minimum size is above the maximum, got {self}")
        if self.decide not in ("filter", "particle"):
            raise ConfigError(f"segmentation.decide = {self.decide!r}; known: filter, particle")


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmentCandidateConfig:
    """Which earlier segments are worth matching (A10)."""

    gap: float = 40.0
    """Segments that ended less than this ago are not candidates [s]."""
    sigma: float = 0.5
    """σ of the path-length model: this [m] …"""
    sigma_per_metre: float = 0.04
    """… plus this for each metre driven since."""
    sigmas: float = 2.5
    """A candidate is nearer than this many σ."""
    height: float = 1.6
    """… and its path not farther above or below: this [m] …"""
    height_per_metre: float = 0.0
    """… plus this for each metre driven since; search and choice allow the same on top of their own heights. Gravity
    tells the slope of the way only as well as the accelerometer lies true: at 5 mrad heights are off by 2 m after
    400 m. Allow for it only where no storeys lie above each other: they look alike, and are then taken for one."""
    near: float = 2.0
    """Edge of the box around the robot in which voxels must be known [m], widened by the uncertainty."""
    known: int = 50
    """Voxels in it that the candidate must know."""
    keep: int = 4
    """Candidates of one particle at one time, nearest (in σ) first."""

    def __post_init__(self) -> None:
        _check(self, "winnowing", positive=("sigma", "sigmas", "keep"))

    def rise(self, length: Any) -> Any:
        """What heights may have drifted by after a path of a length [m]; arrays too."""
        return self.height_per_metre * length

    def drift(self, length: Any) -> Any:
        """σ after a path of a length [m]; arrays too."""
        return self.sigma + self.sigma_per_metre * length


YAW = (0.1, 2.5e-3)
"""Half width of a search in heading: this [rad], and this for each metre driven since, no more than :data:`MAX_YAW`."""
STARTS = 6
"""Distinct modes of a search that are handed to the registration."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CandidateSearch:
    """Where a candidate is searched, and with what: drift at a closure exceeds what registration can capture."""

    grid: float = 0.8
    """Steps of the search in position [m]; its modes are then looked at in quarters of them."""
    sigma: float = 0.3
    """σ of the distance to the map within which a point counts as explained [m]; twice that in the first look."""
    yaw_step: float = 0.1
    """Steps in heading [rad], and quarters of them."""
    max_radius: float = 30.0
    """Half width of the search: this [m], or 2.5 σ of the path-length model if that is less."""
    height: float = 0.8
    """Half width in z [m]."""
    source_radius: float = 15.0
    """Points of the look-ahead window beyond this are left out [m]."""
    source_points: int = 300
    """Points of the look-ahead window, at most."""
    most_searches: int = 12
    """Searches at one time, of all particles together, at most."""

    def __post_init__(self) -> None:
        _check(
            self,
            "search",
            positive=(
                "grid",
                "yaw_step",
                "max_radius",
                "source_radius",
                "source_points",
                "most_searches",
            ),
        )

    def yaw_width(self, length: float) -> float:
        """Half width in heading after a path of a length [m]."""
        return min(YAW[0] + YAW[1] * length, MAX_YAW)


@dataclass(frozen=True, slots=True, kw_only=True)
class ChoiceConfig:
    """Which matches are believed, and how often (A9)."""

    every: float = 4.0
    """Time between attempts [s]; each needs a full look-ahead window."""
    fitness: float = 0.83
    """Least share of the points that the match explains, besides the gates of the registration: in simulated mines and
    garages right ones had 0.78 to 0.98, and most 0.92 and more; wrong ones up to 0.82."""
    fitness_upright: float = 0.8
    """The same of the points on upright surfaces, where known: wrong matches that passed all else had 0.75 to 0.79
    in mines, right ones seldom less than 0.81."""
    height: float = 1.6
    """The match is no farther above or below the prediction [m]."""
    shift: float = 2.5
    """… and no farther from it than this many σ of the path-length model."""
    margin: float = 0.1
    """A second mode must be worse by this share of the points: in simulated mines right matches were better than any
    other by 0.10 and more, wrong ones by 0.03 to 0.09 …"""
    null_weight: float = 0.01
    """Weight of no match at all, which is always in the draw."""
    position_sigma: float = 0.1
    """Standard deviations of an accepted match: position [m] …"""
    angle_sigma: float = 0.012
    """… and angles [rad], added to the registration's own covariance."""
    method: Literal["registration", "localisation", "both"] = "registration"
    """What judges a match (eq. 18, eq. 19)."""

    def __post_init__(self) -> None:
        _check(
            self,
            "choice",
            positive=("every", "shift", "null_weight", "position_sigma", "angle_sigma"),
            unit=("fitness", "fitness_upright", "margin"),
        )
        if self.method not in ("registration", "localisation", "both"):
            raise ConfigError(f"choice.method = {self.method!r}; known: registration, localisation, both")


@dataclass(frozen=True, slots=True, kw_only=True)
class HandoverConfig:
    """What a settled segment hands over."""

    drift_scale: float = 1.0
    """Factor on the drift model in the exit covariance."""
    matched_only: bool = False
    """The paper's moment matching instead of particles plus drift: to be measured, not to be used."""

    def __post_init__(self) -> None:
        _check(self, "handover", positive=("drift_scale",))


@dataclass(frozen=True, slots=True, kw_only=True)
class SegSlamConfig:
    """Everything of SegSLAM but the particle filter inside its segments."""

    segmentation: SegmentationConfig = field(default_factory=SegmentationConfig)
    """When a segment ends."""
    winnowing: SegmentCandidateConfig = field(default_factory=SegmentCandidateConfig)
    """Which segments are tried."""
    search: CandidateSearch = field(default_factory=CandidateSearch)
    """How a match is searched."""
    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    """How it is registered, with the gates of fitness, degeneracy and tilt."""
    choice: ChoiceConfig = field(default_factory=ChoiceConfig)
    """Which matches are believed."""
    handover: HandoverConfig = field(default_factory=HandoverConfig)
    """What is handed over."""
    inside: Literal["filter", "scan-window"] = "filter"
    """What carries the particles through a segment: the motion with its noise, which the filter samples, as in the
    paper; or scan-to-window odometry (``frontend.window``), which is the same for all and leaves nothing to sample that
    a map could tell apart. Particles then differ where it pays: in which older map they enter."""

    def __post_init__(self) -> None:
        _check(self, "segslam")
        if self.inside not in ("filter", "scan-window"):
            raise ConfigError(f"segslam.inside = {self.inside!r}; known: filter, scan-window")
