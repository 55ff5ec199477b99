"""Named landmark fields: the paper's parameters, small worlds for tests, and worlds with difficult association."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

from graphslam.core.errors import ConfigError, UnknownNameError
from graphslam.sim.landmark_config import LandmarkFieldConfig

_A = LandmarkFieldConfig()
_LOOP = dataclasses.replace(_A, lap_length=600.0, laps=1.3, route_waves=5, route_amplitude=0.08, landmarks=150)
_LOOP_OF_CLUTTER = dataclasses.replace(_LOOP, clutter_rate=2.0, detection_probability=0.8)
_AVENUE = dataclasses.replace(
    _LOOP,
    landmarks=30,
    row_spacing=4.0,
    control_rate=2.0,
    sigma_speed=1.4,
    sigma_steering=math.radians(1.0),
    sigma_range=0.1,
    sigma_bearing=math.radians(1.0),
    scan_rate=1.0,
)
PRESETS: Mapping[str, LandmarkFieldConfig] = {
    # two laps of 2.23 km, 0.5 m / 5° (the nominal noise), about 15 features per 35 m of path
    "A": _A,
    # one lap of 5.3 km (1.65 km across, as the paper's field) and 5.5 % overlap, about 7 features per 44 m
    "B": dataclasses.replace(_A, lap_length=5300.0, laps=1.055),
    # A with the sensor of the classic simulator
    "C": dataclasses.replace(_A, sigma_range=0.1, sigma_bearing=math.radians(1.0)),
    # 480 m and a fifth of it again: closes a loop, the whole pipeline runs in seconds
    "demo": dataclasses.replace(
        _A,
        lap_length=480.0,
        laps=1.2,
        route_waves=5,
        route_amplitude=0.08,
        landmarks=120,
        sigma_range=0.3,
        sigma_bearing=math.radians(3.0),
    ),
    # smaller still, for tests and notebooks in quick mode
    "quick": dataclasses.replace(
        _A,
        lap_length=120.0,
        laps=1.3,
        route_waves=3,
        route_amplitude=0.08,
        landmarks=40,
        lateral_max=12.0,
        max_range=20.0,
        sigma_range=0.2,
        sigma_bearing=math.radians(2.0),
    ),
    # one lap of 600 m and 30 % of it again, 0.25 features a metre as A; a third of what the sensor reports is false
    "clutter": _LOOP_OF_CLUTTER,
    # the same lap, every feature has a twin 1.5 m away: not distinguishable by a bearing of 5° beyond 17 m
    "pairs": dataclasses.replace(_LOOP, pair_fraction=1.0, pair_distance=1.5),
    # an avenue with few other features and a good sensor at 1 Hz, but a slipping wheel: σ of 1 m along the path between
    # two scans, a quarter of the distance between trees, so that now and then the next tree is the nearer one
    "rows": _AVENUE,
    # the avenue with everything at once: pairs, clutter, missed detections
    "hard": dataclasses.replace(
        _AVENUE, landmarks=60, pair_fraction=0.5, pair_distance=1.5, clutter_rate=1.0, detection_probability=0.8
    ),
}


def landmark_field_preset(name: str, **changes: Any) -> LandmarkFieldConfig:
    """The preset of that name with some fields changed."""
    if name not in PRESETS:
        raise UnknownNameError("landmark-field preset", name, PRESETS)
    known = {f.name for f in dataclasses.fields(LandmarkFieldConfig)}
    for key in changes:
        if key not in known:
            raise ConfigError(f"landmark field has no field {key!r}; known: {', '.join(sorted(known))}")
    return dataclasses.replace(PRESETS[name], **changes)
