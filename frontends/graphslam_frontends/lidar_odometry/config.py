"""Configuration of LiDAR odometry."""

from __future__ import annotations

from dataclasses import dataclass

from graphslam.core.config import check_options
from graphslam.core.errors import ConfigError

SPACING = 0.2
"""One point per cube of this edge is kept [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LidarOdometryConfig:
    """Matching of scans to the map of earlier scans. One set for hand-held, wheeled and car-mounted lidars."""

    max_range: float = 80.0
    """Points farther away are ignored [m]."""
    min_range: float = 0.5
    """Nearer points, such as the robot itself, are ignored [m]."""
    most_points: int = 3000
    """Most points matched per scan."""
    levels: tuple[float, ...] = (2.0, 1.0, 0.5)
    """Edges of the cells, coarse to fine [m]."""
    window: float = 50.0
    """Cells of the last this many metres of path are kept [m], and those of the last 100 scans in any case."""
    deskew: bool = True
    """Deskew points to the stamp of the scan, if they have times of their own."""

    def __post_init__(self) -> None:
        check_options(self, "lidar odometry: ", {"> 0": "max_range window", "≥ 0": "min_range", "≥ 100": "most_points"})
        if not self.min_range < self.max_range:
            raise ConfigError(f"lidar odometry: min_range = {self.min_range}; wanted 0 … max_range {self.max_range}")
        if not self.levels or any(not a > b for a, b in zip(self.levels, self.levels[1:])) or self.levels[-1] <= 0:
            raise ConfigError(f"lidar odometry: levels = {self.levels}; wanted edges in metres, from coarse to fine")
