"""Configuration of a run: one frozen dataclass per part, defaults in code, a TOML file optional and partial.

Order of precedence: defaults, preset of the source (``graphslam/app/presets``), the user's TOML file, ``--set a.b=c``.
Unknown keys are refused with their full name; the effective configuration is written into the run folder.
"""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Mapping
from importlib import resources
from typing import Any

from graphslam.backend.config import BackEndConfig, GpsOptions, ImuOptions
from graphslam.core.errors import ConfigError


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class MapConfig:
    """The fused map at the end of a run whose submaps have evidence grids."""

    fuse: bool = True
    """Make it."""
    low: float = 0.3
    """Floor plans begin this far above the path [m] …"""
    high: float = 1.8
    """… and end this far above it."""
    threads: int = 1
    """That put pieces where they are; the map is the same with any number."""

    def __post_init__(self) -> None:
        if not self.high > self.low:
            raise ConfigError(f"map: floor plans from {self.low} to {self.high} m; wanted low < high")
        if self.threads < 1:
            raise ConfigError(f"map.threads = {self.threads}; wanted ≥ 1")


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class RunConfig:
    """Everything that steers ``graphslam run`` beside the source and the seed."""

    frontend: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Options of the front end; its own dataclass validates them."""
    backend: BackEndConfig = dataclasses.field(default_factory=BackEndConfig)
    """Association, scale, merging."""
    gps: GpsOptions = dataclasses.field(default_factory=GpsOptions)
    """GPS factors and what is withheld."""
    imu: ImuOptions = dataclasses.field(default_factory=ImuOptions)
    """IMU factors, and the axes of IMUs."""
    map: MapConfig = dataclasses.field(default_factory=MapConfig)
    """The fused map."""


def preset(name: str) -> dict[str, Any]:
    """Recommended settings of a source, or nothing where there are none."""
    file = resources.files("graphslam.app") / "presets" / f"{name}.toml"
    return tomllib.loads(file.read_text()) if file.is_file() else {}
