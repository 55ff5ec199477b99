"""Configuration of the crawler's sensors and their noise, with range checks."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

from graphslam.core.errors import ConfigError, UnknownNameError

Pose = tuple[float, float, float, float, float, float, float]

_POSITIVE = (
    *("fan", "scan_rate", "max_range", "imu_rate", "wheel_rate", "attitude_time", "most_turned"),
    *("wheelbase", "track", "ramp", "most_turn_rate"),
)
_NOT_NEGATIVE = (
    *("sweep_time", "spin_rate", "range_sigma", "min_range", "drift", "gyro", "gyro_bias_across", "gyro_walk"),
    *("accelerometer", "accelerometer_bias", "accelerometer_walk", "attitude_sigma", "attitude_bias"),
    *("wheel_scale", "wheel_sigma", "turn_scale", "turn_sigma", "stand", "noise_scale", "drift_spread"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class CrawlerConfig:
    """A robot like Cave Crawler: a planar scanner whose head spins while it drives, an IMU, and wheels.

    The defaults give the drift of SegSLAM's experiments: the dominant error of dead reckoning is a bias of the gyro's
    yaw rate; all others are small in comparison.
    """

    # scanner
    scanners: int = 1
    """1: facing forward; 2: an additional one facing backwards."""
    beams: int = 61
    """Beams of a scan, evenly over the fan."""
    fan: float = math.pi
    """Opening of the fan, in the x-y plane of the head [rad]."""
    scan_rate: float = 12.5
    """Scans per second [Hz]."""
    sweep_time: float = 1.0 / 75.0
    """Time from the first beam of a scan to its last [s]."""
    spin_rate: float = 0.25
    """Turns of the head about its x axis per second [Hz]."""
    max_range: float = 30.0
    """Range reported for beams without a hit within it [m]."""
    min_range: float = 0.1
    """Nearer surfaces give no reading [m]."""
    range_sigma: float = 0.025
    """σ of a range, independent per beam [m]."""
    drop_out: float = 0.005
    """Probability of a missing reading, independent per beam."""
    mount: Pose = (0.3, 0.0, 0.7, 0.0, 0.0, 0.0, 1.0)
    """T_base_mount of the forward scanner: x y z qx qy qz qw."""
    rear_mount: Pose = (-0.3, 0.0, 0.7, 0.0, 0.0, 1.0, 0.0)
    """T_base_mount of the scanner facing backwards."""

    # inertial measurement unit
    imu_rate: float = 100.0
    """Records per second, and poses of the ground truth [Hz]."""
    imu_mount: Pose = (0.0, 0.0, 0.4, 0.0, 0.0, 0.0, 1.0)
    """T_base_imu."""
    drift: float = 0.03
    """Position error at the end due to the yaw bias alone, relative to the route's length; the bias is computed from
    it, with a random sign. A constant bias b over T seconds gives an end error of b · T · |end - mean position|, so the
    effect of a fixed bias would depend strongly on the route."""
    drift_spread: float = 0.1
    """Relative σ of that error from seed to seed, cut at 2 σ."""
    most_turned: float = 1.0
    """Limit of the yaw bias, as the heading error at the end [rad]; reached for a route that ends near its mean
    position, where a bias has little effect. It varies with the seed as the drift does."""
    gyro: float = 1e-4
    """White noise of the angular rates [rad/s/√Hz]."""
    gyro_bias_across: float = 2e-4
    """σ of the constant bias of the roll and pitch rates [rad/s]."""
    gyro_walk: float = 2e-6
    """Random walk of the three biases [rad/s/√s]."""
    accelerometer: float = 2e-3
    """White noise of the specific force [m/s²/√Hz]."""
    accelerometer_bias: float = 0.02
    """σ of its constant bias [m/s²]."""
    accelerometer_walk: float = 1e-4
    """Random walk of that bias [m/s²/√s]."""
    attitude_sigma: float = math.radians(0.25)
    """σ of the slowly varying (Ornstein-Uhlenbeck) error of the unit's roll and pitch [rad]."""
    attitude_time: float = 5.0
    """Correlation time of that error [s]."""
    attitude_bias: float = math.radians(0.1)
    """σ of their constant error [rad]."""

    # wheels
    wheel_rate: float = 25.0
    """Records per second [Hz]."""
    wheel_scale: float = 0.005
    """σ of the relative error of all speeds of a log."""
    wheel_sigma: float = 0.02
    """σ of a measured speed, independent per record [m/s]."""
    turn_scale: float = 0.05
    """σ of the relative error of all yaw rates of the wheels."""
    turn_sigma: float = 0.02
    """σ of a yaw rate of the wheels, independent per record [rad/s]."""

    # drive
    wheelbase: float = 0.6
    """Changes of slope and curvature are smoothed over it [m]."""
    track: float = 0.5
    """Distance of the wheels to the left and right: the roll follows from the floor under them [m]."""
    ramp: float = 2.0
    """Time from rest to cruise [s]."""
    most_turn_rate: float = 0.6
    """Fastest yaw rate [rad/s]."""
    stand: float = 0.0
    """Time at rest before the start [s]."""

    noise_scale: float = 1.0
    """Factor on every random error, but not on the nominal σ; 0 gives exact data."""

    def __post_init__(self) -> None:
        for name in ("mount", "rear_mount", "imu_mount"):  # a configuration file gives lists
            given = getattr(self, name)
            numbers = isinstance(given, list | tuple) and all(isinstance(v, int | float) for v in given)
            value = tuple(float(v) for v in given) if numbers else ()
            unit = len(value) == 7 and all(map(math.isfinite, value)) and abs(math.hypot(*value[3:]) - 1.0) < 1e-6
            self._require(name, unit, "x y z qx qy qz qw with a unit quaternion")
            object.__setattr__(self, name, value)
        for name in (*_POSITIVE, *_NOT_NEGATIVE):
            value = getattr(self, name)
            self._require(name, isinstance(value, int | float) and not isinstance(value, bool), "a number")
            low = value > 0 if name in _POSITIVE else value >= 0
            self._require(name, math.isfinite(value) and low, "> 0" if name in _POSITIVE else "≥ 0")
        self._require("scanners", self.scanners in (1, 2), "1 or 2")
        self._require("beams", isinstance(self.beams, int) and self.beams >= 2, "a whole number ≥ 2")
        self._require("fan", self.fan <= 2.0 * math.pi, "≤ 2π")
        self._require("drop_out", isinstance(self.drop_out, int | float) and 0.0 <= self.drop_out < 1.0, "in [0, 1)")
        self._require("min_range", self.min_range < self.max_range, "< max_range")
        self._require("sweep_time", self.sweep_time <= 1.0 / self.scan_rate, "≤ 1 / scan_rate")

    def _require(self, name: str, ok: bool, wanted: str) -> None:
        if not ok:
            raise ConfigError(f"crawler: {name} = {getattr(self, name)}; wanted {wanted}")


DEFAULTS = CrawlerConfig()

PRESETS: dict[str, dict[str, Any]] = {
    "light": {},
    "full": {"beams": 181, "scan_rate": 37.5},
    "two-scanners": {"scanners": 2},
}
"""Sensors by name: ``light`` (61 beams at 12.5 Hz, the default), ``full`` (181 at 37.5 Hz), ``two-scanners``."""


def crawler_preset(name: str = "light", **changes: Any) -> CrawlerConfig:
    """A preset with some parameters changed."""
    if name not in PRESETS:
        raise UnknownNameError("preset of the crawler", name, PRESETS)
    known = {f.name for f in dataclasses.fields(CrawlerConfig)}
    for key in changes:
        if key not in known:
            raise ConfigError(f"crawler: unknown parameter {key!r}; known: {', '.join(sorted(known))}")
    return CrawlerConfig(**{**PRESETS[name], **changes})
