"""What steers the back end: association, merging, loops; GPS and IMU as far as the graph does not say it."""

from __future__ import annotations

import dataclasses
from typing import Literal

import numpy as np

from graphslam.core.config import flattened_field
from graphslam.core.errors import ConfigError
from graphslam.graph.factors.imu.config import ImuConfig
from graphslam.graph.noise import RobustKernel
from graphslam.graph.sensors.beacons import BeaconConfig
from graphslam.graph.sensors.compass import CompassConfig
from graphslam.graph.sensors.gps import GpsConfig


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class GpsOptions(GpsConfig):
    """Which GPS fixes enter the graph, and how; the others are kept back to score it."""

    use: Literal["none", "all", "every-second", "even-segments", "odd-segments"] = "none"
    """Fixes that become factors; the rest is withheld and scored. Segments are runs of fixes without a gap."""
    every: float = 0.0
    """Of these at most one in so many seconds becomes a factor; the rest is withheld, too [s]."""
    robust: RobustKernel = flattened_field(RobustKernel("cauchy", 2.385), robust="kind", robust_width="k")
    """Robust kernel on every GPS factor, and its width in standard deviations; less costs accuracy where fixes are good
    (docs/notes/segmap-graph.md)."""

    def __post_init__(self) -> None:
        GpsConfig.__post_init__(self)
        if not (np.isfinite(self.every) and self.every >= 0):
            raise ConfigError(f"gps.every must not be negative, got {self.every}")


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
    """``"none"``, or the name of a stream of sightings with known identities that the front end does not use."""


MATCH_KERNEL = RobustKernel("cauchy", 2.385)
"""Robust kernel on every match of a front end and on every loop: 95 % efficient where all are right."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class BackEndConfig:
    """From submaps to a solved graph."""

    covariance_scale: float = 1.0
    """Factor on every submap covariance in the join; 1 = trust the front end. Choose it so that join χ²/dof is 1."""
    associate: bool = True
    """Associate landmarks without identity to the graph's (joint compatibility); identities in the submaps win."""
    method: Literal["joint-compatibility", "nearest-neighbour"] = "joint-compatibility"
    """How landmarks are associated."""
    gate: float = 11.8
    """χ² gate of one pairing given the ones before (2 dof: 99.7 %)."""
    identity_gate: float = 0.0
    """At the end, a sighting that contradicts the map by this χ² (2 dof) becomes a landmark of its own; 0 = never."""
    merge_distance: float = 0.0
    """Landmarks nearer than this after the join are one [m]; 0 = never merge by distance."""
    merge_every: int = 20
    """Look for landmarks to merge after this many submaps, and at the end."""
    confirmed_hits: int = 1
    """Landmarks of the final map were sighted at least this often over all submaps."""
    node_spacing: float = 3.0
    """Dense submaps get an inner node about every so many metres of their path [m]; 0 = none."""
    level_sigma: float = 0.0
    """In space: bases are levelled, each by itself, with this σ of roll and pitch [rad]; 0 = exits say it."""
    match_support: float = 0.5
    """A front end's match becomes a factor if at least this share of the particles took it; above 1 = none does."""
    loops: Literal[True, False, "auto"] = "auto"
    """Look for loops between dense submaps; every decision is in ``events.jsonl`` (``graphslam loops``).
    The front end's matches are decided on with them; without, each that has the support is a factor. "auto": a run
    looks for them where passes of its fused map deny each other, and keeps the map in which fewer points are denied."""
    draws: int = 3
    """A run whose maps are still denied makes its submaps anew of other random numbers, so many draws in all, and keeps
    the map in which the fewest points are denied; 1 = never."""
    look_every: int = 5
    """While the run goes on, tie in IMUs and look for loops after every so many submaps, too; 0 = at the end only."""
    loop_ties: bool = True
    """With loops: also along submaps, where their bodies were in a map that held them."""
    loop_appearance: bool = False
    """Also try places that look alike, wherever they are."""

    @property
    def looks(self) -> bool:
        """Are loops looked for from the start?"""
        return self.loops is True

    def __post_init__(self) -> None:
        for name in ("node_spacing", "level_sigma", "match_support", "look_every"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"backend.{name} must not be negative, got {getattr(self, name)}")
