"""Front ends by name (entry points ``graphslam.frontends``) and their configuration."""

from __future__ import annotations

import typing
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias, cast

from graphslam.app.run import config as cfg
from graphslam.app.run.choice import kind_preset
from graphslam.core.config import build_config, merge_options
from graphslam.core.errors import ConfigError, UnknownNameError
from graphslam.core.log import SensorLog
from graphslam.core.plugins import load_plugin, plugins, unknown
from graphslam.io.readers import list_readers
from graphslam_frontends.base import FrontEnd
from graphslam_frontends.mixed import MixedFrontEnd

GROUP = "graphslam.frontends"


def front_end_names() -> list[str]:
    """Names of the installed front ends."""
    return list(plugins(GROUP))


def check_name(name: str) -> None:
    """Raise an error if no front end of that name is installed."""
    known = front_end_names()
    if name not in known:
        raise unknown(GROUP, "front end", name, known)


FrontEndLike: TypeAlias = str | FrontEnd | type[FrontEnd]


def name_of(front: FrontEndLike | Sequence[FrontEndLike]) -> str | list[str]:
    """Name of a front end that is given as a name, class or object; a list of names for several ones."""
    if isinstance(front, MixedFrontEnd):
        return [p.name for p in front.parts]
    if isinstance(front, (list, tuple)):
        names = [_name(f) for f in front]
        if len(names) != len(set(names)):
            raise ConfigError(f"front ends of a run: got {', '.join(names)}; wanted each once")
        return names
    return _name(front)


def _name(front: Any) -> str:
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


def config_of(name: str) -> Any:
    """Configuration class of a front end, a dataclass."""
    return _kind(name)[1]


def make_front_end(
    front: FrontEndLike | Sequence[FrontEndLike], options: Mapping[str, Any], where: str = "frontend"
) -> FrontEnd:
    """Build a front end with ``options`` checked against its own configuration class.

    Parameters
    ----------
    front : str, class or object, or a sequence of these
        An object has its own configuration and is returned unchanged. Several front ends map one log together
        (:class:`~graphslam_frontends.mixed.MixedFrontEnd`); the options of each are under its name.
    where : str
        Table of the options, in errors.
    """
    name = name_of(front)
    if isinstance(front, (list, tuple)):
        for key in options:
            if key not in name:
                tables = " or ".join(f"{where}.{n}" for n in name)
                raise ConfigError(f"{where}.{key}: this run has several front ends; wanted options in {tables}")
        return MixedFrontEnd(tuple(make_front_end(f, options.get(_name(f), {}), f"{where}.{_name(f)}") for f in front))
    if not isinstance(front, (str, type)):
        if options:
            raise ConfigError(f"front end {name!r} is given as an object, which has its options; got also {options}")
        return cast(FrontEnd, front)
    kind, config_type = _kind(front)
    made = kind(config=build_config(config_type, options, where))
    if not isinstance(made, FrontEnd):
        raise ConfigError(
            f"front end {name!r} is none: {kind.__name__} does not inherit from graphslam_frontends.base.FrontEnd"
        )
    if not made.incremental() and type(made).submaps is FrontEnd.submaps:
        raise ConfigError(f"front end {name!r} is none: {kind.__name__} has neither submaps nor follow")
    return made


def options_of_scans(values: Mapping[str, Any]) -> Mapping[str, Any]:
    """Options of the front end that works on scans; of several front ends the one that has ``steps``."""
    own: Mapping[str, Any] = values.get("frontend", {})
    if isinstance(values.get("run", {}).get("frontend"), list):
        return next((v for v in own.values() if "steps" in v), {})
    return own


def recommended_options(log: SensorLog, frontend: str | Sequence[str], preset: str | None = None) -> dict[str, Any]:
    """Preset of a source for a front end: a shipped TOML file, and the noise that a simulated log states.

    Logs of one data set (``mrclam-dataset7/robot1``) share the preset of the set, layouts of a simulated world
    (``garage-A``) that of the world. A recorded log without one uses that of its reader, or of its kind.

    Parameters
    ----------
    frontend : str or sequence of str
        For several front ends, the options of each are under its name; the other options are merged.
    preset : str, optional
        Name of a preset to use instead; ``none``: defaults.
    """
    if not isinstance(frontend, str):
        out: dict[str, Any] = {}
        for name in frontend:
            known = preset in (None, "none") or preset in cfg.preset_names(name)
            values = recommended_options(log, name, preset if known else "none")
            own = {"frontend": {name: values["frontend"]}} if "frontend" in values else {}
            out = merge_options(out, {**values, **own})
        return out
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
    """Settings of a preset for a front end; empty for ``none`` and None."""
    if preset is None or preset == "none":
        return {}
    known = cfg.preset_names(frontend)
    if preset not in known:
        raise UnknownNameError(f"preset for front end {frontend!r}", preset, [*known, "none"])
    return cfg.preset(f"{preset}.{frontend}")


def preset_of(log: SensorLog, frontend: str | Sequence[str]) -> tuple[str, bool]:
    """Name of the preset used by :func:`recommended_options` (empty if there is none), and whether its noise applies.

    The preset of a reader or of a kind of log sets how the log is read; its noise is that of other robots.
    """
    if not isinstance(frontend, str):
        found = [preset_of(log, name) for name in frontend]
        return ", ".join(dict.fromkeys(n for n, _ in found if n)), all(own for _, own in found)
    name = log.name.partition("/")[0]
    read: Any = log.meta.get("reader")
    known = list_readers().get(read.get("name", "")) if isinstance(read, Mapping) else None
    there = cfg.preset_names(frontend)
    own = next((n for n in (name, name.rpartition("-")[0]) if n in there), "")
    kind = next((n for n in ("" if known is None else known.preset, kind_preset(log)) if n in there), "")
    return own or kind, bool(own) or not kind
