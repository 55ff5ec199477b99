"""Configuration of a run: one frozen dataclass per part, defaults in code, a TOML file optional and partial.

Order of precedence: defaults, noise estimated from the log (:mod:`graphslam.calibrate`) if no preset was made for it,
preset of the source (``graphslam/app/presets``), the user's TOML file, ``--set a.b=c``.
Unknown keys are refused with their full name; the effective configuration is written into the run folder.
"""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Mapping
from importlib import resources
from importlib.resources.abc import Traversable
from typing import Any

from graphslam.backend.config import BackEndConfig, BeaconOptions, CompassOptions, GpsOptions, ImuOptions
from graphslam.calibrate.corrections import CalibrateConfig
from graphslam.core.plugins import plugins
from graphslam.maps.run_map import MapConfig
from graphslam.refine.config import RefineConfig


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class RunConfig:
    """All options of ``graphslam run`` except the source and the seed."""

    frontend: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Options of the front end; its own dataclass validates them."""
    backend: BackEndConfig = dataclasses.field(default_factory=BackEndConfig)
    """Association, scale, merging."""
    gps: GpsOptions = dataclasses.field(default_factory=GpsOptions)
    """GPS factors, and withheld fixes."""
    imu: ImuOptions = dataclasses.field(default_factory=ImuOptions)
    """IMU factors, and the axes of IMUs."""
    compass: CompassOptions = dataclasses.field(default_factory=CompassOptions)
    """Headings of compasses."""
    beacons: BeaconOptions = dataclasses.field(default_factory=BeaconOptions)
    """Distances to beacons."""
    refine: RefineConfig = dataclasses.field(default_factory=RefineConfig)
    """Path refinement with scans, for front ends that work on scans."""
    map: MapConfig = dataclasses.field(default_factory=MapConfig)
    """The fused map."""
    calibrate: CalibrateConfig = dataclasses.field(default_factory=CalibrateConfig)
    """Noise and systematic errors, estimated from the log before the run."""


def preset(name: str) -> dict[str, Any]:
    """Recommended settings of a source; empty if there are none."""
    files = (folder / f"{name}.toml" for folder in _preset_folders())
    file = next((f for f in files if f.is_file()), None)
    return {} if file is None else tomllib.loads(file.read_text())


def preset_names(frontend: str) -> list[str]:
    """Sources that have recommended settings for a front end."""
    end = f".{frontend}.toml"
    files = (f.name for folder in _preset_folders() for f in folder.iterdir())
    return sorted({name[: -len(end)] for name in files if name.endswith(end)})


def _preset_folders() -> list[Traversable]:
    """Folders of presets: our own, then those of plug-ins (entry points ``graphslam.presets``)."""
    packages = [entry.value for entry in plugins("graphslam.presets").values()]
    return [resources.files("graphslam.app") / "presets", *(resources.files(p) for p in packages)]
