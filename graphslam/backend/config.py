"""Options of the back end: association, merging, loops; use of GPS, IMU, compasses and beacons."""

from __future__ import annotations

import dataclasses
from typing import Literal

from graphslam.core.config import check_options, flattened_field
from graphslam.graph.factors.imu.config import ImuConfig
from graphslam.graph.noise import RobustKernel
from graphslam.graph.sensors.beacons import BeaconConfig
from graphslam.graph.sensors.compass import CompassConfig
from graphslam.graph.sensors.gps import GpsConfig


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class GpsOptions(GpsConfig):
    """Which GPS fixes enter the graph, and how; the others are withheld to test it."""

    use: Literal["none", "all", "every-second", "even-segments", "odd-segments"] = "none"
    """Fixes that become factors; the others are withheld as a test. Segments are sequences of fixes without a gap."""
    every: float = 0.0
    """Minimum time between two fixes that become factors [s]; the others are withheld, too."""
    robust: RobustKernel = flattened_field(RobustKernel("cauchy", 2.385), robust="kind", robust_width="k")
    """Robust kernel on every GPS factor, and its width in standard deviations; a smaller width costs accuracy if the
    fixes are good (docs/notes/segmap-graph.md)."""

    def __post_init__(self) -> None:
        GpsConfig.__post_init__(self)
        check_options(self, "gps.", {"≥ 0": "every"})


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ImuOptions(ImuConfig):
    """Which IMUs that the front end did not use enter the graph, and how; and the axes of every IMU."""

    use: str = "none"
    """``"none"``, ``"auto"`` (every IMU of the log that no submap used), or the name of a stream."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class CompassOptions(CompassConfig):
    """Which compasses enter the graph, and how."""

    use: str = "none"
    """``"none"``, ``"auto"`` (every compass of the log), or the name of a stream."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class BeaconOptions(BeaconConfig):
    """Which distances to beacons enter the graph, and how."""

    use: str = "none"
    """``"none"``, or the name of a stream of observations with known identities that the front end does not use."""


MATCH_KERNEL = RobustKernel("cauchy", 2.385)
"""Robust kernel on every front-end match and every loop: 95 % efficiency if all are inliers."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class BackEndConfig:
    """Options from submaps to a solved graph."""

    covariance_scale: float = 1.0
    """Factor on every submap covariance in the join; 1: as given by the front end. Choose it so that χ²/dof is 1."""
    associate: bool = True
    """Associate landmarks without identity with those in the graph; identities in the submaps have priority."""
    method: Literal["joint-compatibility", "nearest-neighbour"] = "joint-compatibility"
    """Method of landmark association."""
    gate: float = 11.8
    """χ² gate of one pairing given the previous ones (2 dof: 99.7 %)."""
    identity_gate: float = 0.0
    """At the end, an observation that contradicts the map by this χ² (2 dof) becomes a separate landmark; 0 = never."""
    merge_distance: float = 0.0
    """Landmarks closer than this after the join are merged [m]; 0 = never merge by distance."""
    merge_every: int = 20
    """Search for landmarks to merge after this number of submaps, and at the end."""
    confirmed_hits: int = 1
    """Minimum number of observations, over all submaps, of a landmark in the final map."""
    node_spacing: float = 3.0
    """Approximate distance between inner nodes along the path of a dense submap [m]; 0 = no inner nodes."""
    level_sigma: float = 0.0
    """3-D: σ of roll and pitch of an attitude factor on each base [rad]; 0 = roll and pitch are in the end poses."""
    match_support: float = 0.5
    """Minimum share of the particles that a front-end match needs to become a factor; above 1 = none does."""
    loops: Literal[True, False, "auto"] = "auto"
    """Search for loops between dense submaps; every decision is in ``events.jsonl`` (``graphslam loops``).
    Front-end matches are then decided on as well; without the search, each match with enough support is a factor.
    "auto": search if traversals of the fused map contradict each other, and keep the map with fewer contradictions."""
    draws: int = 3
    """If the maps still contradict themselves, submaps are made again with other random numbers. Largest number of
    draws; the map with the fewest contradictory points is kept; 1 = never."""
    look_every: int = 5
    """During the run, add IMU factors and search for loops after this number of submaps; 0 = only at the end."""

    @property
    def looks(self) -> bool:
        """Are loops searched from the start?"""
        return self.loops is True

    def __post_init__(self) -> None:
        check_options(self, "backend.", {"≥ 0 or inf": "node_spacing level_sigma match_support look_every"})
