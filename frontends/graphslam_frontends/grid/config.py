"""Configuration of the particle filter on evidence grids. The defaults are for a robot at walking pace with steps of
0.4 s; what they rest on stands beside them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from graphslam.core.errors import ConfigError
from graphslam.evidence.beams import BeamModel
from graphslam.evidence.likelihood import CastLikelihood, EndpointLikelihood

CAST_EFFECTIVE_BEAMS = 4.0
"""Independent beams that a step counts as, weighed by casting, which is far sharper than end points: a few."""
GREATEST_EXPONENT = 1.0
"""A beam counts as no more than this many, however few there are."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GridFilterConfig:
    """What a particle filter needs whose particles each carry a pose and an evidence grid."""

    particles: int = 40
    """Number of particles N. A single one moves without noise: there is nobody to choose from, so that noise would only
    take it off the dead reckoning."""
    ess_fraction: float = 0.5
    """Systematic resampling when N_eff < ess_fraction · N (SegSLAM eq. 7)."""

    voxel_size: float = 0.2
    """Edge of a voxel [m]: smaller ones cost time with the cube, larger ones blur what end points are weighed by."""
    lift: float = 0.25
    """Height of the body over the lattice of a new map, in voxels, where gravity is measured. A floor between two
    layers of voxels sinks into the lower one, and the body with it: half a voxel in every new map. In simulated garages
    heights drifted half as much with 0.25 (and with 0.5) as with 0."""
    hit: float = 0.7
    """Probability that a voxel is occupied, given that a beam ended in it (OctoMap's). With a larger one floors outlast
    the beams that graze them, so that heights drift less; walls get thicker, and the way across them is told less
    well."""
    map_beams: int = 0
    """Beams of a step that go into the maps, spread over it; 0 = all there are."""

    likelihood: Literal["endpoint", "cast", "upright"] = "endpoint"
    """How beams are weighed. End points are flat, so that of particles all a little off the nearest still wins. Casting
    is sharp, and asks for more particles or less motion noise. ``upright``: end points of upright surfaces alone, which
    say where the body is in the plan, and some casts, which say how high it is; end points of floors pull the
    body down. Where no gravity is measured that is ``endpoint``."""
    weight_beams: int = 180
    """Beams of a step that are weighed, spread over it. Neighbours repeat each other, so fewer than go into the map."""
    endpoint_effective_beams: float = 60.0
    """Independent beams that a step counts as, weighed by end points: the exponent of its likelihood is this over the
    number weighed. Some tens leave about half of the particles effective; fewer teach the filter little, and many more
    have it resample at nearly every step."""
    floor: float = 0.05
    """End points: probability that a beam has nothing to do with the map."""
    unknown: float = 0.3
    """End points: probability of occupancy where the map knows nothing. Below one half, so that a particle which finds
    the surfaces it knows again beats one that puts them where nothing was seen; far above, new ground is a reward."""
    young: int = 12
    """A map of fewer scans than this says little yet, and what it says is not to be held against maps that know more:
    its particle takes the mean evidence of the older ones. 12 are 5 s, after which a spun scanner has seen all round
    once and a walking robot's scans overlap."""

    walk_scale: float = 1.0
    """Factor on the walks below. A filter over a whole way needs them whole, to undo what the gyro's bias has done;
    inside the segments of SegSLAM about half is better: most of what is left at the end of one is this noise."""
    motion_scale: float = 1.0
    """Factor on the σ of the odometry."""
    position_walk: float = 0.025
    """σ along and across, added after one metre, growing with the root of the path [m/√m]."""
    height_walk: float = 0.01
    """σ of the height, likewise [m/√m]."""
    heading_walk: float = 0.013
    """σ of the heading, likewise [rad/√m]: 7 mrad per 0.3 m. Noise is white and a gyro's bias is not, so it must be ten
    to twenty times what a bias turns in a step: else no particle is ever where the bias has to be undone."""
    heading_turn: float = 0.05
    """σ of the heading, added after a turn of one radian, growing with the root of the angle [rad/√rad]: turning on the
    spot."""
    tilt_walk: float = 0.003
    """σ of roll and pitch, growing with the root of the path, where no gravity tells them [rad/√m]."""

    threads: int = 1
    """Threads that weigh and update maps; the result is the same for any number."""

    def __post_init__(self) -> None:
        for name, least in (
            ("particles", 1),
            ("weight_beams", 1),
            ("threads", 1),
            ("map_beams", 0),
            ("young", 0),
        ):
            if getattr(self, name) < least:
                raise ConfigError(f"{name} = {getattr(self, name)}; wanted ≥ {least}")
        if not (math.isfinite(self.lift) and 0.0 <= self.lift <= 1.0):
            raise ConfigError(f"lift = {self.lift}; wanted 0 … 1 voxels")
        if not 0.0 < self.ess_fraction <= 1.0:
            raise ConfigError(f"ess_fraction = {self.ess_fraction}; wanted in (0, 1]")
        for name in ("voxel_size", "endpoint_effective_beams"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0.0):
                raise ConfigError(f"{name} = {getattr(self, name)}; wanted a finite number above 0")
        walks = ("walk_scale", "position_walk", "height_walk", "heading_walk", "heading_turn", "tilt_walk")
        for name in ("motion_scale", *walks):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0.0):
                raise ConfigError(f"{name} = {getattr(self, name)}; wanted a finite number ≥ 0")
        if self.likelihood not in ("endpoint", "cast", "upright"):
            raise ConfigError(f"likelihood = {self.likelihood!r}; known: endpoint, cast, upright")
        self.beam_model()
        self.by_end_points(self.weight_beams)
        self.by_casting(self.weight_beams)

    def beam_model(self) -> BeamModel:
        """What a beam says of a voxel."""
        return BeamModel(hit=self.hit)

    def by_end_points(self, beams: int) -> EndpointLikelihood:
        """The likelihood of a step of which the end points of so many beams are weighed."""
        return EndpointLikelihood(
            exponent=self._exponent(self.endpoint_effective_beams, beams),
            floor=self.floor,
            unknown=self.unknown,
        )

    def by_casting(self, beams: int) -> CastLikelihood:
        """The likelihood of a step of which so many beams are cast."""
        exponent = self._exponent(CAST_EFFECTIVE_BEAMS, beams)
        return CastLikelihood(exponent=exponent)

    def _exponent(self, effective: float, beams: int) -> float:
        return min(effective / max(beams, 1), GREATEST_EXPONENT)
