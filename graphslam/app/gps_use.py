"""Which GPS fixes become factors and which are kept back to score the map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from graphslam.app.config import GpsConfig
from graphslam.core.records import Gps

Mask = npt.NDArray[np.bool_]


def gps_segments(times: npt.NDArray[np.float64], gap: float) -> npt.NDArray[np.int64]:
    """Segment number of every fix: a pause longer than ``gap`` [s] starts a new one."""
    if len(times) == 0:
        return np.zeros(0, dtype=np.int64)
    return np.concatenate([[0], np.cumsum(np.diff(times) > gap)]).astype(np.int64)


def used_fixes(gps: Gps, config: GpsConfig) -> Mask:
    """Fixes that become factors ``(n,)``; the others are withheld."""
    n = len(gps.times)
    index = np.arange(n)
    segment = gps_segments(gps.times, config.segment_gap)
    masks = {
        "none": np.zeros(n, dtype=bool),
        "all": np.ones(n, dtype=bool),
        "every-second": index % 2 == 0,
        "even-segments": segment % 2 == 0,
        "odd-segments": segment % 2 == 1,
    }
    return masks[config.use]


def split(gps: Gps, config: GpsConfig) -> tuple[Gps, Gps]:
    """(fixes that become factors, fixes withheld)."""
    mask = used_fixes(gps, config)
    used, withheld = gps.take(mask), gps.take(~mask)
    return (used if config.sigma is None else replace(used, sigma=np.full(len(used.times), config.sigma))), withheld
