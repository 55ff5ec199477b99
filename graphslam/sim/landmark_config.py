"""Configuration of world, vehicle, sensors and noise of the landmark field, with range checks."""

from __future__ import annotations

import math
from dataclasses import dataclass

from graphslam.core.errors import ConfigError

_POSITIVE = (
    *("lap_length", "laps", "wheelbase", "speed", "control_rate", "max_steering", "steering_rate", "look_ahead"),
    *("max_range", "scan_rate", "sigma_speed", "sigma_steering", "sigma_range", "sigma_bearing", "gps_sigma"),
    *("pair_distance", "row_lateral", "speed_factor"),
)
_NOT_NEGATIVE = (
    *("route_waves", "landmarks", "min_range", "clutter_rate", "noise_scale", "gps_rate", "row_spacing", "row_jitter"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class LandmarkFieldConfig:
    """World, vehicle, sensors and noise of the landmark field; the defaults are world ``A``."""

    lap_length: float = 2230.0
    """Length of one lap of the route [m]."""
    laps: float = 2.0
    """Distance driven / lap_length; above 1 the loop is closed."""
    route_waves: int = 9
    """Waves per lap: r(θ) = R (1 + route_amplitude · sin(route_waves · θ))."""
    route_amplitude: float = 0.05
    """Wave height relative to the mean radius R."""

    landmarks: int = 554
    """Number of features, uniform along the route, on either side with equal probability."""
    lateral_min: float = 3.0
    """Least lateral distance of a feature from the route [m]."""
    lateral_max: float = 20.0
    """Greatest lateral distance of a feature from the route [m]; uniform between the two."""
    pair_fraction: float = 0.0
    """Share of ``landmarks`` that form close pairs (a stem and its twin), in [0, 1]."""
    pair_distance: float = 1.5
    """Distance between the two of a pair [m], in any direction that does not bring the twin nearer to the route."""
    row_spacing: float = 0.0
    """An avenue of trees in addition to the features above: spacing of the trees on either side of the route [m],
    adjusted to a whole number of periods per lap; 0 = none. A map shifted by one period looks the same."""
    row_lateral: float = 6.0
    """Lateral distance of either row from the route [m]."""
    row_jitter: float = 0.1
    """σ of each tree of a row along and across the row [m]."""
    layout_seed: int | None = None
    """Seed of the feature layout. None: the run's own seed. A number keeps the layout fixed over Monte-Carlo runs."""

    wheelbase: float = 4.0
    """L of φ' = φ + V dt sin(G)/L [m]."""
    speed: float = 3.0
    """True speed V, constant [m/s]."""
    control_rate: float = 40.0
    """Controls per second [Hz]; dt = 1/control_rate."""
    max_steering: float = math.radians(30.0)
    """Limit of the true steering angle: |G| ≤ max_steering [rad]."""
    steering_rate: float = math.radians(20.0)
    """Limit of its rate: |ΔG| ≤ steering_rate · dt [rad/s]."""
    look_ahead: float = 6.0
    """Distance to the point of the route that the vehicle steers towards [m]."""

    max_range: float = 30.0
    """Features farther than this are not observed [m]."""
    min_range: float = 1.0
    """Features nearer than this are not observed [m]."""
    field_of_view: float = math.pi
    """Full opening angle, centred on the heading: |bearing| ≤ field_of_view/2 [rad]."""
    scan_rate: float = 5.0
    """Scans per second [Hz]; divides control_rate. The first scan comes one period after the start."""
    detection_probability: float = 1.0
    """Probability that a visible feature is reported, independent per scan and feature."""
    clutter_rate: float = 0.0
    """Mean number of false observations per scan (Poisson), uniform over the area of the sensor's sector; id -1."""

    sigma_speed: float = 0.3
    """σ of the measured speed, independent per control record [m/s]."""
    sigma_steering: float = math.radians(3.0)
    """σ of the measured steering angle, independent per control record [rad]."""
    sigma_range: float = 0.5
    """σ of a measured range, independent per observation [m]."""
    sigma_bearing: float = math.radians(5.0)
    """σ of a measured bearing, independent per observation [rad]."""
    speed_factor: float = 1.0
    """Ratio of measured to true speed (miscalibrated wheel): a systematic error not covered by the nominal σ."""
    steering_bias: float = 0.0
    """Added to every measured steering angle [rad]; systematic as well."""
    noise_scale: float = 1.0
    """Factor on every random error, but not on the nominal σ: 1 is consistent, 0 gives exact data to check models with,
    2 errors twice as large as their nominal σ."""

    gps_rate: float = 0.0
    """GPS fixes per second [Hz]; 0 is no GPS. Divides control_rate."""
    gps_sigma: float = 1.0
    """σ of each coordinate of a fix, independent per fix [m]."""
    gps_lever: tuple[float, float] = (0.0, 0.0)
    """Antenna in the base frame [m]."""
    gps_frame: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """T_gps_base0: pose of the first base in the frame of the fixes [m, m, rad]."""

    def __post_init__(self) -> None:
        for name, n in (("gps_lever", 2), ("gps_frame", 3)):  # a configuration file gives lists
            value = tuple(float(v) for v in getattr(self, name))
            self._require(name, len(value) == n and all(map(math.isfinite, value)), f"{n} finite numbers")
            object.__setattr__(self, name, value)
        for name in _POSITIVE:
            self._require(name, getattr(self, name) > 0, "> 0")
        for name in _NOT_NEGATIVE:
            self._require(name, getattr(self, name) >= 0, "≥ 0")
        for name in [*_POSITIVE, *_NOT_NEGATIVE, "lateral_max", "steering_bias"]:
            self._require(name, math.isfinite(getattr(self, name)), "a finite number")
        self._require("route_amplitude", 0 <= self.route_amplitude < 1, "in [0, 1)")
        self._require("lateral_min", 0 <= self.lateral_min <= self.lateral_max, "in [0, lateral_max]")
        self._require("pair_fraction", 0 <= self.pair_fraction <= 1, "in [0, 1]")
        self._require("row_spacing", self.row_spacing <= self.lap_length / 2, "≤ lap_length / 2")
        self._require("row_jitter", self.row_jitter < self.row_lateral / 3, "< row_lateral / 3")
        self._require("min_range", self.min_range < self.max_range, "< max_range")
        self._require("field_of_view", 0 < self.field_of_view <= 2 * math.pi, "in (0, 2π]")
        self._require("detection_probability", 0 <= self.detection_probability <= 1, "in [0, 1]")
        self._require("look_ahead", self.look_ahead < self.lap_length / 4, "< lap_length / 4")
        self._require("scan_rate", _divides(self.scan_rate, self.control_rate), "a divisor of control_rate")
        if self.gps_rate:
            self._require("gps_rate", _divides(self.gps_rate, self.control_rate), "0 or a divisor of control_rate")
        self._require("laps", self.steps >= self.scan_stride, "long enough for one scan")

    def _require(self, name: str, ok: bool, wanted: str) -> None:
        if not ok:
            raise ConfigError(f"landmark field: {name} = {getattr(self, name)}; wanted {wanted}")

    @property
    def distance(self) -> float:
        """Distance driven [m]."""
        return self.laps * self.lap_length

    @property
    def steps(self) -> int:
        """Number of control steps."""
        return round(self.distance / self.speed * self.control_rate)

    @property
    def row_periods(self) -> int:
        """Trees of one row along the lap."""
        return round(self.lap_length / self.row_spacing) if self.row_spacing else 0

    @property
    def features(self) -> int:
        """All features: ``landmarks`` and both rows."""
        return self.landmarks + 2 * self.row_periods

    @property
    def scan_stride(self) -> int:
        """Control steps per scan."""
        return round(self.control_rate / self.scan_rate)


def _divides(rate: float, base: float) -> bool:
    ratio = base / rate
    return ratio >= 1 - 1e-9 and abs(ratio - round(ratio)) < 1e-9 * ratio
