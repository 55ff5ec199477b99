"""Configuration of the particle filter on evidence grids. The defaults are for a robot at walking pace with steps of
0.4 s; the reasons are in the docstrings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from graphslam.core.config import check_options
from graphslam.evidence.beams import BeamModel
from graphslam.evidence.likelihood import CastLikelihood, EndpointLikelihood

CAST_EFFECTIVE_BEAMS = 4.0
"""Effective number of independent beams per step with ray casting, which is far more peaked than end points."""
GREATEST_EXPONENT = 1.0
"""Upper bound of the exponent: a beam never counts more than once."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GridFilterConfig:
    """Configuration of a particle filter with a pose and an evidence grid per particle."""

    particles: int = 40
    """Number of particles N. A single one moves without noise, because without a choice noise would only add errors."""
    ess_fraction: float = 0.5
    """Systematic resampling when N_eff < ess_fraction · N (SegSLAM eq. 7)."""

    voxel_size: float = 0.2
    """Edge of a voxel [m]: computing time grows with the inverse cube; larger ones blur the end-point likelihood."""
    lift: float = 0.25
    """Height of the body above the voxel boundary of a new map, in voxels, if gravity is measured. A floor at the
    boundary of two voxel layers falls into the lower one, which lowers the body by half a voxel in every new map. In
    simulated garages the height drift with 0.25 (and with 0.5) was half of that with 0."""
    hit: float = 0.7
    """Probability that a voxel is occupied, given that a beam ended in it (OctoMap's). With a larger one floors are not
    erased by grazing beams, so heights drift less; but walls get thicker, and positions across them less precise."""
    map_beams: int = 0
    """Most beams of a step inserted into the maps, evenly spaced; 0 = all."""

    likelihood: Literal["endpoint", "cast", "upright"] = "endpoint"
    """Likelihood of beams. End points are a wide likelihood: the nearest of several slightly wrong particles wins. Ray
    casting is peaked and needs more particles or less motion noise. ``upright``: end points on vertical surfaces only,
    for the horizontal position, and some ray casts, for the height; end points on floors pull the body down. Without
    gravity it is ``endpoint``."""
    weight_beams: int = 180
    """Most beams of a step used for the weights, evenly spaced; fewer than for the map, because neighbours are
    redundant."""
    endpoint_effective_beams: float = 60.0
    """Effective number of independent beams per step for end points: the exponent of the likelihood is this over the
    number used. With some tens about half of the particles stay effective; with fewer the filter learns little, with
    many more it resamples at nearly every step."""
    floor: float = 0.05
    """End points: probability that a beam is an outlier."""
    unknown: float = 0.3
    """End points: probability of occupancy in unknown space. Below 0.5, so that a particle that re-observes known
    surfaces is better than one that puts them into unknown space; larger values reward new ground."""
    young: int = 12
    """A map with fewer scans is not used for weights: its particle gets the mean evidence of the particles with older
    maps. 12 scans take 5 s, after which a spinning scanner has seen all directions and the scans of a walking robot
    overlap."""

    walk_scale: float = 1.0
    """Factor on the random walks below. A filter over a whole path needs them fully, to compensate the gyro bias;
    within the segments of SegSLAM about half is better: most of the end-pose error is this noise."""
    motion_scale: float = 1.0
    """Factor on the σ of the odometry."""
    position_walk: float = 0.025
    """σ along and across after one metre, growing with the root of the path [m/√m]."""
    height_walk: float = 0.01
    """σ of the height, likewise [m/√m]."""
    heading_walk: float = 0.013
    """σ of the heading, likewise [rad/√m]: 7 mrad per 0.3 m. This noise is white and a gyro bias is not, so it must be
    10 to 20 times the rotation by a bias in a step; otherwise no particle compensates the bias."""
    heading_turn: float = 0.05
    """σ of the heading after a rotation of one radian, growing with the root of the angle [rad/√rad]; for turning on
    the spot."""
    tilt_walk: float = 0.003
    """σ of roll and pitch, growing with the root of the path, without gravity [rad/√m]."""

    threads: int = 1
    """Number of threads for weights and map updates; results do not depend on it."""

    def __post_init__(self) -> None:
        walks = "walk_scale position_walk height_walk heading_walk heading_turn tilt_walk"
        ranges = {
            "> 0": "voxel_size endpoint_effective_beams",
            "≥ 1": "particles weight_beams threads",
            "≥ 0": f"map_beams young motion_scale {walks}",
            "in [0, 1]": "lift",
            "in (0, 1]": "ess_fraction",
        }
        check_options(self, "", ranges)
        self.beam_model()
        self.by_end_points(self.weight_beams)
        self.by_casting(self.weight_beams)

    def beam_model(self) -> BeamModel:
        """Sensor model of a beam for the evidence grid."""
        return BeamModel(hit=self.hit)

    def by_end_points(self, beams: int) -> EndpointLikelihood:
        """The likelihood of a step with this many end points."""
        return EndpointLikelihood(
            exponent=self._exponent(self.endpoint_effective_beams, beams),
            floor=self.floor,
            unknown=self.unknown,
        )

    def by_casting(self, beams: int) -> CastLikelihood:
        """The likelihood of a step with this many ray casts."""
        exponent = self._exponent(CAST_EFFECTIVE_BEAMS, beams)
        return CastLikelihood(exponent=exponent)

    def _exponent(self, effective: float, beams: int) -> float:
        return min(effective / max(beams, 1), GREATEST_EXPONENT)
