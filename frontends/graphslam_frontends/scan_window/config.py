"""What steers scan-to-window odometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphslam.core.errors import ConfigError

MOST_STEPS = 60
"""Steps of the window at most: of faster scans only every so many become surfaces."""
DISTANCES = (1.0, 0.5, 0.3)
"""Greatest distance of a point from its surface in each iteration [m]."""
SPENT = 1.7
"""σ of a residual in multiples of the spread of the residuals: steps share surfaces, whose errors last."""
LEAST_POINTS = 20
"""A scan with fewer points on surfaces is lost: it corrects nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanWindowConfig:
    """How each scan is put on the surfaces of the window before it."""

    seconds: float = 24.0
    """Age of the oldest surfaces of the window [s]."""
    lay: float | None = None
    """Scans become surfaces together, so many seconds of them at a time, when those of the next lot are there too [s].
    A surface needs neighbours on all sides, and one that was just seen says nothing of how far the path has drifted;
    but what lies behind by then must still be in view. None: 4 s in space, where scanners spin as slowly, and 1 s in
    the plane, where one scan sees all that it can."""
    points: int = 250
    """Points of a scan that are looked for on surfaces."""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.seconds) and self.seconds > 0):
            raise ConfigError(f"window: seconds = {self.seconds}; wanted > 0")
        if self.points < 6:
            raise ConfigError(f"window: points = {self.points}; wanted ≥ 6")
        if self.lay is not None and not self.spacing <= self.lay <= self.seconds:
            raise ConfigError(f"window: lay = {self.lay} s; wanted between two steps ({self.spacing} s) and seconds")

    @property
    def spacing(self) -> float:
        """Least time between steps that become surfaces [s]."""
        return self.seconds / MOST_STEPS
