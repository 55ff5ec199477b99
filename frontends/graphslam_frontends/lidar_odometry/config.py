"""Configuration of LiDAR odometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphslam.core.errors import ConfigError

SPACING = 0.2
"""Edge of the cubes of which one point each is matched [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LidarOdometryConfig:
    """How scans are matched to the scans before them. One set for hand-held, wheeled and car-borne lidars."""

    max_range: float = 80.0
    """Points farther away are left out [m]."""
    min_range: float = 0.5
    """… and nearer ones: the carrier itself [m]."""
    most_points: int = 3000
    """Points matched of a scan at most."""
    levels: tuple[float, ...] = (2.0, 1.0, 0.5)
    """Edges of the cells, coarse to fine [m]."""
    window: float = 50.0
    """Way behind from which cells are kept [m]; those of the last hundred scans are kept in any case."""
    deskew: bool = True
    """Move points of a scan to its stamp, where they have stamps of their own."""

    def __post_init__(self) -> None:
        for name in ("max_range", "window"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ConfigError(f"lidar odometry: {name} = {value}; wanted > 0")
        if not 0 <= self.min_range < self.max_range:
            raise ConfigError(f"lidar odometry: min_range = {self.min_range}; wanted 0 … max_range {self.max_range}")
        if not self.levels or any(not a > b for a, b in zip(self.levels, self.levels[1:])) or self.levels[-1] <= 0:
            raise ConfigError(f"lidar odometry: levels = {self.levels}; wanted edges in metres, from coarse to fine")
        if self.most_points < 100:
            raise ConfigError(f"lidar odometry: most_points = {self.most_points}; wanted ≥ 100")
