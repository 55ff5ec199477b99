"""Configuration as frozen dataclasses: built from nested mappings, merged, read from and written as TOML.

Defaults are in the code, a file is optional and partial, unknown keys are refused with their full name.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import tomllib
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import tomli_w

from graphslam.core.errors import ConfigError, DataError, MissingDataError
from graphslam.core.reading import LARGEST, read_text

KEYS = "keys"


def flattened_field(default: Any, **keys: str) -> Any:
    """A field with a small dataclass that is written as several keys, one per field.

    ``robust: Robust = flattened_field(NO_KERNEL, robust="kind", robust_width="k")`` is ``robust = "cauchy"`` and
    ``robust_width = 2.385`` in TOML; a missing key keeps the default.
    """
    return dataclasses.field(default=default, metadata={KEYS: keys})


def build_config(kind: Any, values: Mapping[str, Any], where: str = "") -> Any:
    """Build dataclass ``kind`` from nested mappings."""
    hints = typing.get_type_hints(kind)
    fields = {f.name: f for f in dataclasses.fields(kind)}
    parts = {key: (f, part) for f in fields.values() for key, part in f.metadata.get(KEYS, {}).items()}
    known = {n for n, f in fields.items() if KEYS not in f.metadata} | set(parts)
    out: dict[str, Any] = {}
    for key, value in values.items():
        name = f"{where}.{key}" if where else key
        if key not in known:
            raise ConfigError(f"unknown configuration key {name!r}; known: {', '.join(sorted(known))}")
        if key in parts:
            f, part = parts[key]
            converted = convert_option(typing.get_type_hints(hints[f.name])[part], value, name)
            out[f.name] = dataclasses.replace(out.get(f.name, f.default), **{part: converted})
        else:
            out[key] = convert_option(hints[key], value, name)
    try:
        return kind(**out)
    except TypeError as error:
        raise ConfigError(f"{where or kind.__name__}: {error}") from None


def convert_option(hint: Any, value: Any, name: str) -> Any:
    """Convert ``value`` to the type ``hint``; ``name`` is the option in messages."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None or (value == "none" and str not in args):
            return None
        return convert_option(next(a for a in args if a is not type(None)), value, name)
    if origin is Literal:
        value = str(value) if value not in args and str(value) in args else value  # 1.0 is a number in TOML
        if value not in args:
            raise ConfigError(f"{name} = {value!r}; known: {', '.join(map(str, args))}")
        return value
    if dataclasses.is_dataclass(hint):
        if not isinstance(value, Mapping):
            raise ConfigError(f"{name} = {value!r}; wanted a table of options")
        return build_config(hint, value, name)
    if origin is tuple:
        if not isinstance(value, (list, tuple)):
            raise ConfigError(f"{name} = {value!r}; wanted a list")
        if args[1:] == (...,):
            return tuple(convert_option(args[0], v, name) for v in value)
        if len(value) != len(args):
            raise ConfigError(f"{name} = {value!r}; wanted {len(args)} values")
        return tuple(convert_option(a, v, name) for a, v in zip(args, value, strict=True))
    if hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        if not (abs(value) <= LARGEST or abs(value) == math.inf):
            raise ConfigError(f"{name} = {value}; wanted a number, at most {LARGEST:g}")
        return float(value)
    if hint in (int, bool, str) and type(value) is hint:
        return value
    if origin is Mapping or hint is Mapping or hint is Any:
        return value
    if origin is not None and isinstance(origin, type) and issubclass(origin, Mapping):
        return dict(value)
    raise ConfigError(f"{name} = {value!r}; wanted {getattr(hint, '__name__', hint)}")


def check_options(config: Any, prefix: str, ranges: Mapping[str, str]) -> None:
    """Refuse numbers outside their range, and a value that is not among the choices of a ``Literal``.

    Parameters
    ----------
    config : dataclass
    prefix : str
        What is before the name of an option in a message, such as ``"gps."``.
    ranges : mapping of str to str
        Range → names of the options that must be in it. A range is ``"> 0"``, ``"≥ 1"``, ``"in (0, 1]"`` or
        ``"finite"``; infinity is only allowed by ``"> 0 or inf"``. The name ``*`` means all numbers that are not
        named. An optional option may be None.
    """
    kind: Any = type(config)
    hints, named = _type_hints(kind), " ".join(ranges.values()).split()
    for wanted, names in ranges.items():
        for name in hints if names == "*" else names.split():
            value = getattr(config, name)
            if names == "*" and (name in named or isinstance(value, bool) or not isinstance(value, int | float)):
                continue
            if value is None and type(None) in typing.get_args(hints[name]):
                continue
            if not _in_range(value, wanted):
                raise ConfigError(f"{prefix}{name} = {value}; wanted {wanted}")
    for name, hint in hints.items():
        value, choices = getattr(config, name), typing.get_args(hint)
        if typing.get_origin(hint) is Literal and value not in choices:
            raise ConfigError(f"{prefix}{name} = {value!r}; known: {', '.join(map(str, choices))}")


@functools.cache
def _type_hints(kind: Any) -> dict[str, Any]:
    return typing.get_type_hints(kind)


def _in_range(value: float, wanted: str) -> bool:
    bound = wanted.removesuffix(" or inf")
    if bound == wanted and not math.isfinite(value):
        return False
    if wanted == "finite":
        return True
    if bound.startswith("in "):
        low, high = map(float, bound[4:-1].split(","))
        above = value >= low if bound[3] == "[" else value > low
        return above and (value <= high if bound[-1] == "]" else value < high)
    return value >= float(bound[2:]) if bound[0] == "≥" else value > float(bound[2:])


def merge_options(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Deep merge of nested mappings, ``over`` has priority."""
    out = dict(base)
    for key, value in over.items():
        old = out.get(key)
        out[key] = merge_options(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
    return out


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file."""
    try:
        return tomllib.loads(read_text(path))
    except MissingDataError as error:
        raise ConfigError(f"{path}: cannot be read ({error.what})") from None
    except DataError as error:
        raise ConfigError(f"{path}: not a TOML file ({error.what})") from None
    except (ValueError, RecursionError) as error:  # tomllib's own errors are ValueErrors
        raise ConfigError(f"{path}: not a TOML file ({error})") from None


def parse_setting(text: str) -> dict[str, Any]:
    """``a.b=c`` → ``{"a": {"b": c}}``; c is read as a TOML value, or as a bare word."""
    key, eq, raw = text.partition("=")
    parts = key.strip().split(".")
    if not eq or not all(parts):
        raise ConfigError(f"--set {text!r}; wanted a.b=value")
    try:
        value = tomllib.loads(f"v = {raw.strip()}")["v"]
    except tomllib.TOMLDecodeError:
        value = raw.strip()
    for part in reversed(parts):
        value = {part: value}
    return dict(value)


def options_dict(config: Any) -> dict[str, Any]:
    """Nested plain dict of a configuration; None becomes absent (TOML has no null)."""
    if dataclasses.is_dataclass(config) and not isinstance(config, type):
        items: dict[str, Any] = {}
        for f in dataclasses.fields(config):
            value = getattr(config, f.name)
            keys = f.metadata.get(KEYS)
            items |= {f.name: value} if keys is None else {key: getattr(value, part) for key, part in keys.items()}
    else:
        items = dict(config)
    out: dict[str, Any] = {}
    for key, value in items.items():
        if value is None:
            continue
        if dataclasses.is_dataclass(value) or isinstance(value, Mapping):
            out[key] = options_dict(value)
        else:
            out[key] = list(value) if isinstance(value, tuple) else value
    return out


def dump_toml(values: Mapping[str, Any]) -> str:
    """TOML text of nested mappings."""
    return tomli_w.dumps(values)
