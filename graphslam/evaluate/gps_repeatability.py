"""Segments of GPS fixes: runs of fixes without a pause."""

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
