"""Configuration of steps."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from graphslam.core.config import check_options
from graphslam.core.errors import ConfigError
from graphslam_frontends.odometry.dead_reckoning import DeadReckoningNoise
from graphslam_frontends.odometry.motion import MotionNoise


@dataclass(frozen=True, slots=True, kw_only=True)
class StepConfig:
    """Conversion of a log to steps."""

    period: float | None = 0.4
    """Length of a step [s]; None: one step for every record of the first scanner, at its stamp."""
    max_range: float | None = None
    """Beams are cut at this range; what is behind is unknown [m]; None: that of the sensor."""
    min_range: float = 0.1
    """Nearer returns are the robot itself or dirt and are dropped [m]."""
    most_points: int = 400
    """Most beams per step, evenly subsampled."""
    range_sigma: float = 0.03
    """σ of a range, for sensors that do not give one [m]."""
    silent: Literal["free", "unknown"] = "free"
    """Meaning of a beam without any range: free space up to the maximum range, or unknown. Old laser scanners lose
    beams on glass and dark walls; as free space they erase walls from a map."""
    scanners: tuple[str, ...] = ()
    """Streams of beams; empty: all spinning scanners, else all clouds, else all planar scanners."""
    motion: tuple[str, ...] = ()
    """Streams of motion: an IMU and wheels, or one of odometry or controls; empty: the best of the log."""
    noise: DeadReckoningNoise = field(default_factory=DeadReckoningNoise)
    """Noise of an IMU and wheels."""
    controls: MotionNoise = field(default_factory=MotionNoise)
    """Noise of planar controls; recorded odometry uses its floors."""
    yaw_bias: float = 0.0
    """Deliberate error added to the yaw rate of all motion [rad/s], for tests; it is in the name of the steps."""
    constant_yaw_bias: float = 0.0
    """σ of a constant yaw-rate error of recorded odometry or controls [rad/s]; ``yaw_bias`` is added in quadrature."""
    constant_scale: float = 0.0
    """σ of a constant relative error of their distances."""
    yaw_per_metre: float = 0.0
    """Heading error of planar recorded odometry per metre driven, to subtract [rad/m], for example by unequal wheel
    radii."""
    match_scans: bool = False
    """In 2-D: fuse the motion with matches of neighbouring scans (:mod:`graphslam_frontends.odometry.scan_matching`).
    """
    odometry_tilt_sigma: float = 0.0
    """σ of roll and pitch of 3-D recorded odometry with gravity (lidar or visual with inertial) [rad]: its poses then
    give them, relative to a level first pose; 0: no gravity. ``yaw_bias`` does not change them."""
    level_floors: bool = False
    """Assume floors that are level on average, as in buildings: the median roll and pitch by gravity over the path is a
    constant error and is subtracted. Heights then drift by a third or less."""
    longest_record: float = 20.0
    """Longest gap in the records of the motion that is bridged [s]. In a gap the motion is extrapolated with an
    increased covariance; gaps are counted and reported. Longer gaps are bridged if recorded odometry gives the motion
    over them."""

    def __post_init__(self) -> None:
        ranges = {
            "> 0": "period max_range range_sigma longest_record",
            "≥ 0": "min_range constant_yaw_bias constant_scale odometry_tilt_sigma",
            "finite": "yaw_bias yaw_per_metre",
            "≥ 1": "most_points",
        }
        check_options(self, "steps: ", ranges)
        if self.max_range is not None and self.max_range <= self.min_range:
            raise ConfigError(f"steps: max_range = {self.max_range}; wanted > min_range {self.min_range}")
