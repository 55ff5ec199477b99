"""Configuration of scan-to-window odometry."""

from __future__ import annotations

from dataclasses import dataclass

from graphslam.core.config import check_options
from graphslam.core.errors import ConfigError

MOST_STEPS = 60
"""Most steps in the window; with a faster scanner not all steps become surfaces."""
DISTANCES = (1.0, 0.5, 0.3)
"""Greatest distance between a point and its surface in each iteration [m]."""
SPENT = 1.7
"""σ of a residual, in multiples of the spread of the residuals: steps share surfaces with correlated errors."""
LEAST_POINTS = 20
"""A scan with fewer points on surfaces is lost: it is not used for a correction."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanWindowConfig:
    """Matching of each scan to the surfaces of the window before it."""

    seconds: float = 24.0
    """Age of the oldest surfaces of the window [s]."""
    lay: float | None = None
    """Scans become surfaces in batches of this duration [s], when the next batch is complete too. A surface needs
    neighbours on all sides, and a surface seen just now does not show the drift of the path; but it must still be in
    view. None: 4 s in 3-D, because scanners spin slowly there, and 1 s in 2-D, where one scan covers the whole field of
    view."""
    points: int = 250
    """Most points of a scan to match to surfaces."""

    def __post_init__(self) -> None:
        check_options(self, "window: ", {"> 0": "seconds", "≥ 6": "points"})
        if self.lay is not None and not self.spacing <= self.lay <= self.seconds:
            raise ConfigError(f"window: lay = {self.lay} s; wanted between two steps ({self.spacing} s) and seconds")

    @property
    def spacing(self) -> float:
        """Least time between steps that become surfaces [s]."""
        return self.seconds / MOST_STEPS
