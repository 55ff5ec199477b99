"""Options of matching submaps in pairs."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from graphslam.core.config import check_options
from graphslam.core.errors import ConfigError
from graphslam.registration.config import RegistrationConfig, RegistrationGates
from graphslam.registration.gates import MatchGates

# Maps of submaps are distorted by drift inside them, and their surroundings extend beyond each other's.
_RULES = RegistrationConfig(
    floor_sigma=0.05,
    floor_turn=0.01,
    gates=RegistrationGates(fitness_known=0.78, known_share=0.4, fitness_upright=0.78),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class PairConfig:
    """Configuration of matching two submaps."""

    radius: float = 15.0
    """Source: occupied voxels within this horizontal distance of the place [m] …"""
    height: float = 6.0
    """… and within this vertical distance [m]."""
    source_points: int = 1500
    """Most source points of a registration; a search uses fewer."""
    cloud_level: int = 1
    """Occupied voxels are averaged in cells of 2**level voxels."""
    grid: float = 0.8
    """Position step of the search [m]; its modes are refined with a quarter of it."""
    field_sigma: float = 0.3
    """σ of the distance to the map for an explained point [m]; twice that in the coarse search."""
    yaw_step: float = 0.1
    """Heading step [rad]; refined with a quarter of it."""
    sigmas: float = 3.0
    """Half widths of the search in σ of the prediction …"""
    least: tuple[float, float, float] = (1.5, 0.8, 0.1)
    """… with a lower limit: position, height [m], heading [rad] …"""
    most: tuple[float, float, float] = (30.0, 3.0, math.pi)
    """… and an upper limit."""
    starts: int = 8
    """Most places that are passed to the registration."""
    least_score: float = 0.5
    """Least share of explained points in the search for a registration …"""
    score_margin: float = 0.2
    """… and largest difference of the score to the best."""
    registration: RegistrationConfig = _RULES
    """Gates and covariance floor of the registration."""
    gates: MatchGates = field(default_factory=lambda: MatchGates(fitness=0.78, shift=math.inf))
    """Additional gates."""
    contradiction: float = 0.05
    """Largest share of contradicting voxels: occupied in one map and free in the other."""
    chi2_level: float = 0.999
    """A match outside this confidence region of the prediction is rejected."""
    inflation: float = 1.0
    """Factor on the covariance of a match, floor included."""
    loose: bool = True
    """Keep matches with one undetermined direction (a corridor), with the prediction's σ along it; otherwise reject
    them."""

    def __post_init__(self) -> None:
        ranges = {
            "≥ 0 or inf": "cloud_level least_score score_margin contradiction",
            "in (0, 1)": "chi2_level",
            "> 0 or inf": "*",
        }
        check_options(self, "pairs of submaps: ", ranges)
        if min(*self.least, *self.most) <= 0:
            raise ConfigError(
                f"pairs of submaps: least = {self.least}, most = {self.most}; wanted positive half widths"
            )
