"""Configuration of the refinement."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from graphslam.core.config import check_options

DISTANCES = (1.0, 0.6, 0.4, 0.3)
"""Largest distance of a pair in each round with all traversals [m]."""
MOST_BEAMS = 3_000_000
"""Largest number of beams from which surfaces are made; more are thinned evenly, which bounds the memory."""

CHECKED_BEAMS = 400_000
"""Largest number of beams of a check whether scans contradict a path."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RefineConfig:
    """Options of the refinement of a solved path with its scans."""

    use: Literal[True, False, "always"] = True
    """Refine the solved path of runs whose front end uses scans (``lidar-odometry``: only if they contradict the graph;
    always: in any case); false: the path of the graph is the result."""
    reach: float | None = None
    """Chunks with a smaller distance of their centres may observe the same surfaces [m]; None: the range below which
    three quarters of the returns of the log are, at least 10 m and at most 30 m."""
    spacing: float = 0.2
    """2-D: path length between nodes [m]. Steps between nodes, whole scans of the same place, follow the odometry."""
    turn: float = 0.1
    """2-D: rotation between nodes [rad]; a node is set when either limit is reached."""
    every: int = 2
    """Every n-th point is matched to surfaces of other steps; all points are used to make the surfaces."""
    most_points: int = 400_000
    """Largest number of points that are matched; more are thinned evenly."""

    def __post_init__(self) -> None:
        check_options(self, "refine: ", {"> 0": "reach spacing turn", "≥ 1": "every most_points"})
