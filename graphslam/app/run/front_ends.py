"""Front ends by name (entry points ``graphslam.frontends``) and their configuration."""

from __future__ import annotations

import typing
from collections.abc import Mapping
from importlib.metadata import entry_points
from typing import Any

from graphslam.app.run import config as cfg
from graphslam.core.config import build, merge
from graphslam.core.errors import ConfigError, GraphSlamError, UnknownNameError
from graphslam.core.log import SensorLog
from graphslam.frontends.base import FrontEnd

GROUP = "graphslam.frontends"


def front_end_names() -> list[str]:
    """Names of the installed front ends."""
    return sorted({e.name for e in entry_points(group=GROUP)})


def _kind(name: str) -> tuple[Any, Any]:
    """Class of front end ``name`` and its configuration class."""
    found = [e for e in entry_points(group=GROUP) if e.name == name]
    if not found:
        raise UnknownNameError("front end", name, front_end_names())
    try:
        kind = found[0].load()
    except ImportError as error:
        raise GraphSlamError(f"front end {name!r} cannot be imported ({error})") from error
    return kind, typing.get_type_hints(kind)["config"]


def make_front_end(name: str, options: Mapping[str, Any]) -> FrontEnd:
    """Build front end ``name`` with ``options`` checked against its own configuration class.

    Raises
    ------
    UnknownNameError, ConfigError
    """
    kind, config_type = _kind(name)
    made = kind(config=build(config_type, options, "frontend"))
    if not isinstance(made, FrontEnd):
        raise ConfigError(
            f"front end {name!r} is none: {kind.__name__} does not inherit from graphslam.frontends.base.FrontEnd"
        )
    return made


def recommended(log: SensorLog, frontend: str) -> dict[str, Any]:
    """Preset of a source for a front end: a shipped TOML, and a simulated log's own stated noise.

    Logs of one data set (``mrclam-dataset7/robot1``) share the preset of the set, layouts of a simulated world
    (``garage-A``) that of the world.
    """
    name = log.name.partition("/")[0]
    values = cfg.preset(f"{name}.{frontend}") or cfg.preset(f"{name.rpartition('-')[0]}.{frontend}")
    noise = log.meta.get("noise", {})
    simulated = log.meta.get("source") == "simulation" and {"speed", "steering"} <= set(noise)
    if simulated and "motion" in typing.get_type_hints(_kind(frontend)[1]):
        scale = float(noise.get("scale", 1.0))
        motion = {"speed": noise["speed"] * scale, "steering": noise["steering"] * scale}
        values = merge({"frontend": {"motion": motion}}, values)
    return values
