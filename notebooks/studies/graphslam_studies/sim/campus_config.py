"""A campus, the robot that maps it and its sensors: every figure, with its limits checked."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from graphslam.core.errors import ConfigError, UnknownNameError
from graphslam.core.random import SeedTree
from graphslam.sim.mixed import Range, draw_log_uniform


@dataclass(frozen=True, slots=True, kw_only=True)
class CampusConfig:
    """Streets with buildings, a self-balancing robot with two lasers, an IMU, wheels and GPS.

    A pair of numbers is a range that the seed draws from: logarithms of noise are uniform in it.
    """

    # the place
    size: Range = (600.0, 800.0)
    """East and north [m]."""
    block: float = 80.0
    """Distance of one street to the next, on average [m]."""
    street: float = 11.0
    """Width of a street [m]."""
    open_share: float = 0.5
    """Share of the blocks whose building has an interior."""
    clutter: float = 1.0
    """Trees, poles and parked cars by the streets, as a share of the usual."""

    # the session
    session: int = 0
    """Sessions of one world differ in start, way and noise."""
    visits: int = 4
    """Buildings that the robot goes round and through."""
    round: bool = True
    """It goes round the block before it goes in."""
    far: bool = False
    """Drive in the part of the campus that no other session sees."""
    speed: float = 1.0
    """Along the way [m/s]."""
    movers: int = 20
    """Cars and people that move."""

    # balance
    lean: float = math.radians(5.0)
    """Greatest pitch that keeping its balance takes [rad]."""
    lean_rate: float = 1.0
    """Its frequency, about [Hz]."""
    axle: float = 0.24
    """Height of the base, between the wheels, above the ground [m]."""

    # lasers
    beams: int = 181
    """Beams of a scan line, both lasers."""
    fan: float = math.pi / 2
    """Opening of the fan: 180 steps of half a degree [rad]."""
    line_rate: float = 75.0
    """Scan lines per second [Hz]."""
    every: int = 2
    """Only every so many lines are kept …"""
    every_beam: int = 2
    """… and of a line only every so many beams: less to store, and planes can still be seen."""
    line_time: float = 1.0 / 300.0
    """From the first beam of a line to its last: a quarter of a turn of the mirror [s]."""
    sweep: float = 2.0
    """Time in which the panning laser goes from one side to the other [s]."""
    pan: float = math.radians(60.0)
    """How far it pans to either side [rad]."""
    max_range: float = 50.0
    """Beams that meet nothing nearer are reported with this range [m]."""
    range_sigma: Range = (0.01, 0.03)
    """σ of a range, independent per beam [m]."""
    drop_out: float = 0.005
    """Probability of a beams without a reading."""
    encoder_offset: float = 0.0
    """What the pan encoder reads too much [rad]."""
    clock_offset: float = 0.0
    """What the stamps of both lasers are late [s]."""

    # motion
    imu_rate: float = 100.0
    """[Hz]"""
    wheel_rate: float = 25.0
    """[Hz]"""
    gyro: Range = (1e-4, 5e-4)
    """White noise of the angular rates [rad/s/√Hz]."""
    gyro_bias: Range = (2e-4, 2e-3)
    """σ of the constant biases of the rates [rad/s]."""
    gyro_walk: Range = (5e-6, 3e-5)
    """Random walk of these biases [rad/s/√s]."""
    attitude_sigma: Range = (math.radians(0.15), math.radians(0.4))
    """σ of the slowly varying error of the unit's roll and pitch [rad]."""
    wheel_scale: Range = (0.003, 0.015)
    """σ of the relative error of all speeds of a session."""
    wheel_sigma: Range = (0.01, 0.04)
    """σ of a speed, independent per record [m/s]."""
    slip: Range = (0.005, 0.03)
    """σ of a relative error of the speed that comes and goes."""
    slip_time: float = 3.0
    """Its correlation time [s]."""

    # GPS
    gps_rate: float = 1.0
    """Fixes per second where there are any [Hz]."""
    lever: tuple[float, float, float] = (-0.1, 0.0, 1.6)
    """Antenna in the base [m]."""
    satellites: int = 12
    """Satellites above the horizon."""
    mask: float = math.radians(10.0)
    """Lowest elevation that is used [rad]."""
    code_sigma: Range = (0.2, 0.5)
    """White noise of a distance to a satellite [m]."""
    orbit_sigma: Range = (0.3, 1.0)
    """σ of an error of that distance that lasts for minutes [m]."""
    orbit_time: float = 300.0
    """Correlation time of that error [s]."""
    reflect_sigma: Range = (0.5, 3.0)
    """σ of what a wall next to the antenna does to the distance of a satellite in view [m]."""
    reflect_reach: float = 8.0
    """That error falls with the distance from the wall by 1/e over this [m]."""
    reflect_time: float = 10.0
    """Its correlation time [s]."""
    hidden_share: Range = (0.1, 0.5)
    """Share of the satellites behind a wall that are taken all the same, by a reflection."""
    hidden_path: Range = (5.0, 20.0)
    """Mean of the longer way of such a signal [m]."""
    least_satellites: int = 5
    """No fix with fewer."""
    least_in_view: int = 2
    """No fix with fewer in direct view: inside there is none."""
    most_pdop: float = 6.0
    """No fix where the satellites stand worse than this."""

    noise_scale: float = 1.0
    """Every drawn error is multiplied by it, the stated figures are not; 0 gives exact data."""

    def __post_init__(self) -> None:
        for f in dataclasses.fields(self):
            value = getattr(self, f.name)
            if isinstance(f.default, bool):
                self._require(f.name, isinstance(value, bool), "true or false")
            elif isinstance(f.default, int):
                whole = isinstance(value, int) and not isinstance(value, bool)
                self._require(f.name, whole and value >= (0 if f.name in _MAY_BE_NONE else 1), "a whole number")
            elif isinstance(f.default, tuple):
                good = isinstance(value, list | tuple) and len(value) == len(f.default) and all(map(_number, value))
                self._require(f.name, good, f"{len(f.default)} numbers")
                object.__setattr__(self, f.name, tuple(float(v) for v in value))
                if f.name not in ("size", "lever"):
                    self._require(f.name, 0 < value[0] <= value[1], "a range above 0")
            else:
                low = f.name in _MAY_BE_NONE or f.name in _SIGNED
                self._require(f.name, _number(value) and (value > 0 or low), "a number above 0")
                self._require(f.name, value >= 0 or f.name in _SIGNED, "not below 0")
        self._require("open_share", self.open_share <= 1.0, "≤ 1")
        self._require("drop_out", self.drop_out < 1.0, "< 1")
        self._require("block", self.block >= 44.0 + self.street, "≥ 44 m and the street")
        self._require("street", 9.0 <= self.street <= 20.0, "9 … 20 m")
        self._require("size", min(self.size) >= self.block + self.street, "room for one block and its streets")
        self._require("line_time", self.line_time * self.line_rate <= 1.0, "≤ 1 / line_rate")
        self._require("beams", self.beams >= 2, "≥ 2")
        self._require("fan", self.fan <= math.pi, "≤ π")
        self._require("lean", self.lean < 0.5, "< 0.5 rad")
        self._require("least_satellites", self.least_satellites >= 4, "≥ 4")
        self._require("far", not self.far or self.size[1] >= 3 * self.block + self.street, "three blocks to the north")

    def _require(self, name: str, ok: bool, wanted: str) -> None:
        if not ok:
            raise ConfigError(f"campus: {name} = {getattr(self, name)}; wanted {wanted}")

    def draw(self, tree: SeedTree) -> dict[str, float]:
        """A figure out of every range: logarithms uniform."""
        ranges = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if isinstance(f.default, tuple)}
        return draw_log_uniform({k: v for k, v in ranges.items() if k not in ("size", "lever")}, tree)


_MAY_BE_NONE = (
    *("session", "movers", "visits", "clutter", "open_share", "lean", "drop_out", "line_time", "mask", "noise_scale"),
    *("least_in_view",),
)
_SIGNED = ("encoder_offset", "clock_offset")


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


PRESETS: dict[str, Mapping[str, Any]] = {
    "full": {},
    "three-blocks": {"size": (110.0, 310.0), "block": 90.0, "visits": 1, "open_share": 1.0, "movers": 8},
    "block": {"size": (110.0, 110.0), "block": 90.0, "visits": 1, "open_share": 1.0, "movers": 8},
    "quick": {
        **{"size": (72.0, 72.0), "block": 60.0, "visits": 1, "open_share": 1.0, "movers": 4, "round": False},
        **{"every": 3, "every_beam": 3},
    },
}
"""Sizes by name: ``full`` is the default; ``three-blocks`` has room for a far session, ``quick`` is for tests."""


def campus_preset(name: str = "full", **changes: Any) -> CampusConfig:
    """A preset with figures changed."""
    if name not in PRESETS:
        raise UnknownNameError("preset of the campus", name, PRESETS)
    known = {f.name for f in dataclasses.fields(CampusConfig)}
    for key in changes:
        if key not in known:
            raise ConfigError(f"campus: unknown parameter {key!r}; known: {', '.join(sorted(known))}")
    return CampusConfig(**{**PRESETS[name], **changes})
