"""How good the GPS is by itself: the floor under every residual against it.

A residual is the error of the map minus that of the fix, and one pass cannot tell them apart. Two passes over one
place can: there the map is the same point of the same ground, known to centimetres *relative to itself*, so the
difference of the two residuals is the difference of two fixes of different times. Its size, over √2, is the error of
one fix that no map can go below.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array

Ints = npt.NDArray[np.int64]


def fix_segments(times: Array, gap: float = 2.0) -> Ints:
    """Number of the segment of every fix ``(n,)``: a pause longer than ``gap`` [s] starts a new one."""
    if not gap > 0:
        raise DataError("gap between segments is not positive", got=gap, wanted="> 0 s")
    if len(times) == 0:
        return np.zeros(0, dtype=np.int64)
    return np.concatenate([[0], np.cumsum(np.diff(times) > gap)]).astype(np.int64)
