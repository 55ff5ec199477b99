"""Front ends by name (entry points ``graphslam.frontends``) and their configuration."""

from __future__ import annotations

import typing
from collections.abc import Mapping
from typing import Any

from graphslam.app.run import config as cfg
from graphslam.app.run.choice import kind_preset
from graphslam.core.config import build_config, merge_options, without_removed
from graphslam.core.errors import ConfigError, UnknownNameError
from graphslam.core.log import SensorLog
from graphslam.core.plugins import load_plugin, plugins, unknown
from graphslam.io.readers import list_readers
from graphslam_frontends.base import FrontEnd

GROUP = "graphslam.frontends"
RENAMED = {"kiss-icp": "lidar-odometry"}
"""Front ends by their name in older run folders."""


def front_end_names() -> list[str]:
    """Names of the installed front ends."""
    return list(plugins(GROUP))


def check_name(name: str) -> None:
    """See that a front end of that name is installed."""
    known = front_end_names()
    if name in known:
        return
    if name in RENAMED:
        raise ConfigError(f"front end {name!r} is now called {RENAMED[name]!r}; use that name")
    raise unknown(GROUP, "front end", name, known)


def name_of(front: str | FrontEnd | type[FrontEnd]) -> str:
    """Name of a front end that is given by its name, as a class or as an object."""
    if isinstance(front, str):
        return front
    kind = front if isinstance(front, type) else type(front)
    if FrontEnd not in kind.__mro__:
        raise ConfigError(
            f"front end {kind.__name__} is none; wanted a name, a class that inherits from "
            "graphslam_frontends.base.FrontEnd, or an object of one"
        )
    return str(getattr(kind, "name", kind.__name__))


def _kind(name: str | type[FrontEnd]) -> tuple[Any, Any]:
    """Class of a front end and its configuration class."""
    if isinstance(name, type):
        return name, typing.get_type_hints(name)["config"]
    check_name(name)
    kind = load_plugin(GROUP, "front end", name)
    return kind, typing.get_type_hints(kind)["config"]


def make_front_end(front: str | FrontEnd | type[FrontEnd], options: Mapping[str, Any]) -> FrontEnd:
    """Build a front end with ``options`` checked against its own configuration class.

    Parameters
    ----------
    front : str, class or object
        An object has its configuration and is taken as it is.
    """
    name = name_of(front)
    if not isinstance(front, (str, type)):
        if options:
            raise ConfigError(f"front end {name!r} is given as an object, which has its options; got also {options}")
        return front
    kind, config_type = _kind(front)
    made = kind(config=build_config(config_type, options, "frontend"))
    if not isinstance(made, FrontEnd):
        raise ConfigError(
            f"front end {name!r} is none: {kind.__name__} does not inherit from graphslam_frontends.base.FrontEnd"
        )
    if not made.incremental() and type(made).submaps is FrontEnd.submaps:
        raise ConfigError(f"front end {name!r} is none: {kind.__name__} has neither submaps nor follow")
    return made


def current_options(stored: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration of a run folder in the names of today, without options that were removed since."""
    out = without_removed(cfg.RunConfig, stored)
    run = out.get("run")
    if isinstance(run, Mapping) and isinstance(name := run.get("frontend"), str):
        name = RENAMED.get(name, name)
        out["run"] = {**run, "frontend": name}
        if isinstance(out.get("frontend"), Mapping) and name in front_end_names():
            out["frontend"] = without_removed(_kind(name)[1], out["frontend"], "frontend")
    return out


def recommended_options(log: SensorLog, frontend: str, preset: str | None = None) -> dict[str, Any]:
    """Preset of a source for a front end: a shipped TOML, and a simulated log's own stated noise.

    Logs of one data set (``mrclam-dataset7/robot1``) share the preset of the set, layouts of a simulated world
    (``garage-A``) that of the world. A recorded log without one has that of its reader, or else of its kind.

    Parameters
    ----------
    preset : str, optional
        Name of a preset instead; ``none``: defaults.
    """
    if preset is not None:
        return named_preset(frontend, preset)
    values = cfg.preset(f"{preset_of(log, frontend)[0]}.{frontend}")
    noise = log.meta.get("noise", {})
    simulated = log.meta.get("source") == "simulation" and {"speed", "steering"} <= set(noise)
    registered = frontend in front_end_names()
    if simulated and registered and "motion" in typing.get_type_hints(_kind(frontend)[1]):
        scale = float(noise.get("scale", 1.0))
        motion = {"speed": noise["speed"] * scale, "steering": noise["steering"] * scale}
        values = merge_options({"frontend": {"motion": motion}}, values)
    return values


def named_preset(frontend: str, preset: str | None) -> dict[str, Any]:
    """Settings of a preset for a front end; of ``none``, and of None, nothing."""
    if preset is None or preset == "none":
        return {}
    known = cfg.preset_names(frontend)
    if preset not in known:
        raise UnknownNameError(f"preset for front end {frontend!r}", preset, [*known, "none"])
    return cfg.preset(f"{preset}.{frontend}")


def preset_of(log: SensorLog, frontend: str) -> tuple[str, bool]:
    """Name of the preset that :func:`recommended_options` takes, empty where there is none; and is it made for this
    very set?

    That of a reader or of a kind of log says how it is read; its noise is that of other robots.
    """
    name = log.name.partition("/")[0]
    read: Any = log.meta.get("reader")
    known = list_readers().get(read.get("name", "")) if isinstance(read, Mapping) else None
    there = cfg.preset_names(frontend)
    own = next((n for n in (name, name.rpartition("-")[0]) if n in there), "")
    kind = next((n for n in ("" if known is None else known.preset, kind_preset(log)) if n in there), "")
    return own or kind, bool(own) or not kind
