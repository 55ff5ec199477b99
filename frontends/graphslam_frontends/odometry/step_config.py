"""Configuration of steps."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from graphslam.core.errors import ConfigError
from graphslam_frontends.odometry.dead_reckoning import DeadReckoningNoise
from graphslam_frontends.odometry.motion import MotionNoise


@dataclass(frozen=True, slots=True, kw_only=True)
class StepConfig:
    """How a log becomes steps."""

    period: float | None = 0.4
    """Length of a step [s]; None: one step for every record of the first scanner, at its stamp."""
    max_range: float | None = None
    """Beams are cut at it: what lies behind is not known to be there [m]; None: the sensor's own."""
    min_range: float = 0.1
    """Nearer things are the robot itself or dirt: dropped [m]."""
    most_points: int = 400
    """Beams kept of a step, spread evenly over it."""
    range_sigma: float = 0.03
    """σ of a range, for sensors that do not state theirs [m]."""
    silent: Literal["free", "unknown"] = "free"
    """What a beam says that came back with no range at all: that nothing is there as far as it reaches, or nothing. Old
    laser scanners lose beams on glass and dark walls; taken for free space they wipe rooms out of a map."""
    scanners: tuple[str, ...] = ()
    """Streams of beams; none: all spinning scanners, else all clouds, else all planar scanners."""
    motion: tuple[str, ...] = ()
    """Streams of motion: an IMU and wheels, or one of odometry or controls; none: the best the log has."""
    noise: DeadReckoningNoise = field(default_factory=DeadReckoningNoise)
    """Of an IMU and wheels."""
    controls: MotionNoise = field(default_factory=MotionNoise)
    """Of controls in the plane; recorded odometry takes its floors."""
    yaw_bias: float = 0.0
    """Deliberate error added to the yaw rate of all motion [rad/s]; named in the steps' name."""
    lasting_yaw_bias: float = 0.0
    """σ of an error of the yaw rate of recorded odometry or controls that lasts [rad/s]; ``yaw_bias`` counts too."""
    lasting_scale: float = 0.0
    """σ of an error of its distances that lasts, a share of them."""
    yaw_per_metre: float = 0.0
    """What recorded odometry in the plane turns too much for each metre driven: taken out [rad/m]. Wheels of unequal
    size do that."""
    match_scans: bool = False
    """In the plane: fuse the motion with matches of neighbouring scans
    (:mod:`graphslam_frontends.odometry.scan_matching`)."""
    odometry_tilt_sigma: float = 0.0
    """σ of roll and pitch of recorded odometry in space that saw gravity (lidar or visual with inertial): its poses
    then tell them, the first being level [rad]; 0: it saw none. ``yaw_bias`` leaves them alone, as gravity would."""
    level_floors: bool = False
    """The floors driven on are level on the whole, as in buildings: what gravity's roll and pitch show in the median
    over the way is an error that lasts, and is taken out. Heights then drift by a third of what they did, or less."""
    longest_record: float = 20.0
    """Longest gap in the records of the motion that is bridged [s]. In a gap the motion is a guess with a covariance
    that says so; it is counted, and a line of the verdict. Records of odometry tell the whole motion, not how it
    went."""

    def __post_init__(self) -> None:
        positive = {"period": self.period, "max_range": self.max_range}
        for name in ("range_sigma", "longest_record"):
            positive[name] = getattr(self, name)
        for name, value in positive.items():
            if value is not None and not (np.isfinite(value) and value > 0):
                raise ConfigError(f"steps: {name} = {value}; wanted > 0")
        for name in ("min_range", "lasting_yaw_bias", "lasting_scale", "odometry_tilt_sigma"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise ConfigError(f"steps: {name} = {getattr(self, name)}; wanted ≥ 0")
        for name in ("yaw_bias", "yaw_per_metre"):
            if not np.isfinite(getattr(self, name)):
                raise ConfigError(f"steps: {name} = {getattr(self, name)}; wanted a finite number")
        if self.silent not in ("free", "unknown"):
            raise ConfigError(f"steps: silent = {self.silent!r}; known: free, unknown")
        if self.most_points < 1:
            raise ConfigError(f"steps: most_points = {self.most_points}; wanted ≥ 1")
        if self.max_range is not None and self.max_range <= self.min_range:
            raise ConfigError(f"steps: max_range = {self.max_range}; wanted > min_range {self.min_range}")
