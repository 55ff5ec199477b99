"""Options of matching submaps in pairs."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields

from graphslam.core.errors import ConfigError
from graphslam.registration.config import RegistrationConfig, RegistrationGates
from graphslam.registration.gates import MatchGates

# Maps of submaps are bent by what drifts inside them, and their surroundings reach out of each other's.
_RULES = RegistrationConfig(
    floor_sigma=0.05,
    floor_turn=0.01,
    gates=RegistrationGates(fitness_known=0.78, known_share=0.4, fitness_upright=0.78),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class PairConfig:
    """How two submaps are matched."""

    radius: float = 15.0
    """The source are occupied voxels so near to its place, horizontally [m]."""
    height: float = 6.0
    """… and vertically [m]."""
    source_points: int = 1500
    """At most so many of them are registered; a search takes fewer."""
    cloud_level: int = 1
    """Cells of 2**level voxels, in which a map's occupied voxels are gathered."""
    grid: float = 0.8
    """Steps of the search in position [m]; its modes are then looked at in quarters of them."""
    field_sigma: float = 0.3
    """σ of the distance to the map within which a point counts as explained [m]; twice that in the first look."""
    yaw_step: float = 0.1
    """Steps in heading [rad], and quarters of them."""
    sigmas: float = 3.0
    """Half widths of the search in σ of the prediction …"""
    least: tuple[float, float, float] = (1.5, 0.8, 0.1)
    """… no less than this: position, height [m], heading [rad] …"""
    most: tuple[float, float, float] = (30.0, 3.0, math.pi)
    """… and no more."""
    starts: int = 8
    """Distinct places handed to the registration, at most."""
    least_score: float = 0.5
    """Places that explain less of the points in the search are not registered."""
    score_margin: float = 0.2
    """… nor those that score so much less than the best."""
    registration: RegistrationConfig = _RULES
    """Its gates and the floor of its covariance."""
    gates: MatchGates = field(default_factory=lambda: MatchGates(fitness=0.78, shift=math.inf))
    """Beside those of the registration."""
    contradiction: float = 0.05
    """Greatest share of what one map has occupied and the other knows that the other has free."""
    chi2_level: float = 0.999
    """A match is refused that the prediction contradicts with this confidence."""
    inflation: float = 1.0
    """Factor on the covariance of a match, floor included."""
    loose: bool = True
    """Keep matches that one direction does not hold (a corridor), with the prediction's own σ along it; else refuse
    them."""

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if isinstance(value, (int, float)) and not isinstance(value, bool):
                zero = f.name in ("cloud_level", "least_score", "score_margin", "contradiction")
                if math.isnan(value) or value < 0 or (value == 0 and not zero):
                    raise ConfigError(f"pairs of submaps: {f.name} = {value}; wanted {'≥' if zero else '>'} 0")
        if not 0 < self.chi2_level < 1 or min(*self.least, *self.most) <= 0:
            raise ConfigError(
                f"pairs of submaps: chi2_level = {self.chi2_level}, least = {self.least}, most = {self.most}; wanted "
                "a level in (0, 1) and positive half widths"
            )
