"""The look-ahead window: beams of the next seconds in the current body frame (SegSLAM section 3.2).

The filter lags behind the sensors by a few seconds. Over so short a time dead reckoning is accurate. The window is used
twice: if the current map predicts it badly, the segment ends (A8); if an older map explains it, that may be the same
place (A9).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphslam.core.geometry import Array
from graphslam_frontends.grid.weights import evenly_spaced_indices
from graphslam_frontends.odometry.growing_steps import SLACK, GrowingSteps
from graphslam_frontends.odometry.steps import Steps
from graphslam_frontends.segslam.segmentation import LookAheadWindow, gather_window


@dataclass(frozen=True, slots=True, kw_only=True)
class LookAheadScan:
    """Look-ahead window of a step.

    Parameters
    ----------
    step : int
        The current step.
    last : int
        The last step with beams in the window; ``step`` if there is none.
    full : bool
        The log extends to the end of the window. Matches of a partial window are not used: with half of its
        surroundings a place looks like others.
    """

    step: int
    last: int
    full: bool
    window: LookAheadWindow

    def source(self, most: int, radius: float) -> Array:
        """Points ``(k, dim)`` of the returns within a radius of the body, at most ``most``, evenly spaced."""
        p = self.window.points
        rows = np.flatnonzero(np.linalg.norm(p, axis=1) <= radius)
        return p[rows[evenly_spaced_indices(len(rows), most)]]


def gather_look_ahead(steps: Steps | GrowingSteps, step: int, seconds: float) -> LookAheadScan:
    """The look-ahead window of a step: the returns of the steps after it, up to ``seconds`` later.

    Parameters
    ----------
    seconds : float
        W.
    """
    until = float(steps.times[step]) + seconds
    last = int(np.searchsorted(steps.times, until + SLACK, side="right")) - 1
    rows = range(step + 1, last + 1)
    window = gather_window(
        steps.odometry.increments[rows.start : rows.stop], [steps.scan(k) for k in rows], steps.max_range
    )
    return LookAheadScan(step=step, last=last, full=bool(steps.times[-1] >= until - SLACK), window=window)
