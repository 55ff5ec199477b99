"""Configuration of the refinement."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from graphslam.core.errors import ConfigError

DISTANCES = (1.0, 0.6, 0.4, 0.3)
"""Greatest distance of a pair in each round over all passes [m]."""
MOST_BEAMS = 3_000_000
"""Of so many beams in the log at most surfaces are made; more are thinned evenly, which bounds the memory."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RefineConfig:
    """How the solved path is refined by the scans themselves."""

    use: Literal[True, False, "always"] = True
    """Refine the solved path of runs whose front end works on scans (``lidar-odometry``: only where they contradict the
    graph; always: also elsewhere); false: the path of the graph is the result."""
    reach: float | None = None
    """Chunks whose centres are nearer than this may see the same surfaces [m]; None: the range that three quarters of
    the returns of the log stay below, 10 m at least and 30 m at most."""
    spacing: float = 0.2
    """In the plane: way from node to node [m]. Steps between, whole scans of the same place, follow the odometry."""
    turn: float = 0.1
    """In the plane: turn from node to node [rad]; whichever of the two is reached first."""
    every: int = 2
    """Every how many of the points is looked for on surfaces of other steps; all points make the surfaces."""
    most_points: int = 400_000
    """Of so many points in the log at most; more are thinned evenly."""

    def __post_init__(self) -> None:
        if self.use not in (True, False, "always"):
            raise ConfigError(f"refine: use = {self.use!r}; wanted true, false or always")
        for name in ("reach", "spacing", "turn"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise ConfigError(f"refine: {name} = {value}; wanted > 0")
        for name in ("every", "most_points"):
            if getattr(self, name) < 1:
                raise ConfigError(f"refine: {name} = {getattr(self, name)}; wanted ≥ 1")
