"""Which GPS fixes become factors and which are kept back to score the map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from graphslam.app.run.config import GpsConfig
from graphslam.core.records import Gps
from graphslam.evaluate.gps_floor import fix_segments

Mask = npt.NDArray[np.bool_]


def used_fixes(gps: Gps, config: GpsConfig) -> Mask:
    """Fixes that become factors ``(n,)``; the others are withheld."""
    n = len(gps.times)
    index = np.arange(n)
    segment = fix_segments(gps.times, config.segment_gap)
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
