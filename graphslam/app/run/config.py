"""Configuration of a run: one frozen dataclass per part, defaults in code, a TOML file optional and partial.

Order of precedence: defaults, preset of the source (``graphslam/app/presets``), the user's TOML file, ``--set a.b=c``.
Unknown keys are refused with their full name; the effective configuration is written into the run folder.
"""

from __future__ import annotations

import dataclasses
import math
import tomllib
import types
import typing
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import tomli_w

from graphslam.core.errors import ConfigError, DataError, MissingDataError
from graphslam.core.reading import LARGEST, read_text


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class GpsConfig:
    """How GPS enters the graph, and which fixes are kept back to score it."""

    use: Literal["none", "all", "every-second", "even-segments", "odd-segments"] = "none"
    """Fixes that become factors; the rest is withheld and scored. Segments are runs of fixes without a gap."""
    sigma: float | None = None
    """σ of each coordinate of a fix [m] in place of the stream's own."""
    robust: Literal["none", "huber", "cauchy"] = "cauchy"
    """Robust kernel on every GPS factor."""
    robust_width: float = 2.385
    """Width of the kernel in standard deviations; less costs accuracy where fixes are good (docs/segmap-graph.md)."""
    bias_sigma: float | None = None
    """With a number [m]: one bias per segment of fixes with that prior."""
    segment_gap: float = 2.0
    """A gap longer than this starts a new segment [s]."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ImuConfig:
    """How an IMU that the front end did not use enters the graph; and the axes of every IMU."""

    use: str = "none"
    """``"none"``, ``"auto"`` (every IMU of the log that no submap used), or the name of a stream."""
    longest: float = 10.0
    """Nodes that follow each other within so many seconds are tied; farther ones see gravity [s]."""
    accelerometer: bool = True
    """False: the gyro alone."""
    gravity: bool = True
    """Nodes far from all others see gravity."""
    acceleration: float = 0.3
    """σ of the mean acceleration about such a node where the body is not still [m/s²]."""
    robust: Literal["none", "huber", "cauchy"] = "none"
    """Robust kernel on every way between two nodes."""
    robust_width: float = 2.385
    """Width of that kernel in standard deviations."""
    axes: Literal["refuse", "warn", "ignore"] = "refuse"
    """What to do if readings contradict the mounting; in space, and of every IMU, the front end's as well."""

    def __post_init__(self) -> None:
        for name in ("longest", "acceleration", "robust_width"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"imu.{name} must be positive, got {getattr(self, name)}")


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
    merge_reach: float = 5.0
    """Landmarks farther apart than this are not tested for merging by covariance [m]."""
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
    match_robust: Literal["none", "huber", "cauchy"] = "cauchy"
    """Robust kernel on every match."""
    match_width: float = 2.385
    """Width of that kernel in standard deviations."""
    loops: bool = False
    """At the end, look for loops between dense submaps; every decision is in ``events.jsonl`` (``graphslam loops``).
    The front end's matches are decided on with them; without, each that has the support is a factor."""
    loop_overlap: float = 8.0
    """Maps of two places are matched if the places may be nearer than this [m] …"""
    loop_height: float = 1.0
    """… and not farther above each other than this [m]."""
    loop_ties: bool = True
    """With loops: also along submaps, where their bodies were in a map that held them."""
    loop_appearance: bool = False
    """Also try places that look alike, wherever they are."""

    def __post_init__(self) -> None:
        for name in ("node_spacing", "level_sigma", "match_support", "loop_overlap", "loop_height"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"backend.{name} must not be negative, got {getattr(self, name)}")


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
    gps: GpsConfig = dataclasses.field(default_factory=GpsConfig)
    """GPS factors and what is withheld."""
    imu: ImuConfig = dataclasses.field(default_factory=ImuConfig)
    """IMU factors, and the axes of IMUs."""
    map: MapConfig = dataclasses.field(default_factory=MapConfig)
    """The fused map."""


def build(kind: Any, values: Mapping[str, Any], where: str = "") -> Any:
    """Build dataclass ``kind`` from nested mappings.

    Raises
    ------
    ConfigError
        Unknown key or a value of the wrong type; names the full key.
    """
    hints = typing.get_type_hints(kind)
    known = {f.name for f in dataclasses.fields(kind)}
    out = {}
    for key, value in values.items():
        name = f"{where}.{key}" if where else key
        if key not in known:
            raise ConfigError(f"unknown configuration key {name!r}; known: {', '.join(sorted(known))}")
        out[key] = _convert(hints[key], value, name)
    try:
        return kind(**out)
    except TypeError as error:
        raise ConfigError(f"{where or kind.__name__}: {error}") from None


def _convert(hint: Any, value: Any, name: str) -> Any:
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None or (value == "none" and str not in args):
            return None
        return _convert(next(a for a in args if a is not type(None)), value, name)
    if origin is Literal:
        if value not in args:
            raise ConfigError(f"{name} = {value!r}; known: {', '.join(map(str, args))}")
        return value
    if dataclasses.is_dataclass(hint):
        if not isinstance(value, Mapping):
            raise ConfigError(f"{name} = {value!r}; wanted a table of options")
        return build(hint, value, name)
    if origin is tuple:
        if not isinstance(value, (list, tuple)):
            raise ConfigError(f"{name} = {value!r}; wanted a list")
        if args[1:] == (...,):
            return tuple(_convert(args[0], v, name) for v in value)
        if len(value) != len(args):
            raise ConfigError(f"{name} = {value!r}; wanted {len(args)} values")
        return tuple(_convert(a, v, name) for a, v in zip(args, value, strict=True))
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


def merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Deep merge of nested mappings, ``over`` wins."""
    out = dict(base)
    for key, value in over.items():
        old = out.get(key)
        out[key] = merge(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
    return out


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file.

    Raises
    ------
    ConfigError
        Missing or malformed.
    """
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


def preset(name: str) -> dict[str, Any]:
    """Recommended settings of a source, or nothing where there are none."""
    file = resources.files("graphslam.app") / "presets" / f"{name}.toml"
    return tomllib.loads(file.read_text()) if file.is_file() else {}


def as_dict(config: Any) -> dict[str, Any]:
    """Nested plain dict of a configuration; None becomes absent (TOML has no null)."""
    if dataclasses.is_dataclass(config) and not isinstance(config, type):
        items = {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}
    else:
        items = dict(config)
    out: dict[str, Any] = {}
    for key, value in items.items():
        if value is None:
            continue
        if dataclasses.is_dataclass(value) or isinstance(value, Mapping):
            out[key] = as_dict(value)
        else:
            out[key] = list(value) if isinstance(value, tuple) else value
    return out


def dump_toml(values: Mapping[str, Any]) -> str:
    """TOML text of nested mappings."""
    return tomli_w.dumps(values)
