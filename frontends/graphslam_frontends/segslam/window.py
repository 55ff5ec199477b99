"""The look-ahead window: beams of the next seconds, seen from where the body stands now (SegSLAM section 3.2).

The filter runs a few seconds behind the sensors. What lies between is placed by dead reckoning, which is good enough
for so short a time, and serves twice: a map that predicts it badly has ended (A8), and an older map that explains it
may be the same place (A9).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphslam.core.geometry import Array
from graphslam_frontends.grid.weights import evenly_spaced_indices
from graphslam_frontends.odometry.steps import Steps
from graphslam_frontends.segslam.segmentation import LookAheadWindow, gather_window


@dataclass(frozen=True, slots=True, kw_only=True)
class LookAheadScan:
    """What lies ahead of a step.

    Parameters
    ----------
    step : int
        The step of now.
    last : int
        The last step whose beams are in the window; ``step`` where there is none.
    full : bool
        The log reaches to the end of the window. A match of less is not to be believed: with half of its surroundings
        a place looks like others.
    """

    step: int
    last: int
    full: bool
    window: LookAheadWindow

    def source(self, most: int, radius: float) -> Array:
        """Points ``(k, dim)`` that beams met within a radius of the body, at most so many, evenly spread."""
        p = self.window.points
        rows = np.flatnonzero(np.linalg.norm(p, axis=1) <= radius)
        return p[rows[evenly_spaced_indices(len(rows), most)]]


def gather_look_ahead(steps: Steps, step: int, seconds: float) -> LookAheadScan:
    """The window ahead of a step: what beams met in the steps after it, up to so many seconds later.

    Parameters
    ----------
    seconds : float
        W.
    """
    slack = 1e-6  # half a step's rounding of the clock takes no step off
    until = float(steps.times[step]) + seconds
    last = int(np.searchsorted(steps.times, until + slack, side="right")) - 1
    rows = range(step + 1, last + 1)
    window = gather_window(
        steps.odometry.increments[rows.start : rows.stop], [steps.scan(k) for k in rows], steps.max_range
    )
    return LookAheadScan(step=step, last=last, full=bool(steps.times[-1] >= until - slack), window=window)
