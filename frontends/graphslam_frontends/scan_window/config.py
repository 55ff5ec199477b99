"""What steers scan-to-window odometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphslam.core.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanWindowConfig:
    """How each scan is put on the surfaces of the window before it."""

    seconds: float = 24.0
    """Age of the oldest surfaces of the window [s]."""
    most_steps: int = 60
    """Steps of the window at most: of faster scans only every so many become surfaces."""
    lay: float | None = None
    """Scans become surfaces together, so many seconds of them at a time, when those of the next lot are there too [s].
    A surface needs neighbours on all sides, and one that was just seen says nothing of how far the path has drifted;
    but what lies behind by then must still be in view. None: 4 s in space, where scanners spin as slowly, and 1 s in
    the plane, where one scan sees all that it can."""
    points: int = 250
    """Points of a scan that are looked for on surfaces."""
    distances: tuple[float, ...] = (1.0, 0.5, 0.3)
    """Greatest distance of a point from its surface in each iteration [m]."""
    spent: float = 1.7
    """σ of a residual in multiples of the spread of the residuals: steps share surfaces, whose errors last."""
    least_points: int = 20
    """A scan with fewer points on surfaces is lost: it corrects nothing."""

    def __post_init__(self) -> None:
        for name in ("seconds", "spent"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ConfigError(f"window: {name} = {value}; wanted > 0")
        if not self.distances or not all(np.isfinite(d) and d > 0 for d in self.distances):
            raise ConfigError(f"window: distances = {self.distances}; wanted at least one, all > 0 m")
        for name, least in (("most_steps", 2), ("points", 6), ("least_points", 6)):
            if getattr(self, name) < least:
                raise ConfigError(f"window: {name} = {getattr(self, name)}; wanted ≥ {least}")
        if self.lay is not None and not self.spacing <= self.lay <= self.seconds:
            raise ConfigError(f"window: lay = {self.lay} s; wanted between two steps ({self.spacing} s) and seconds")

    @property
    def spacing(self) -> float:
        """Least time between steps that become surfaces [s]."""
        return self.seconds / self.most_steps
