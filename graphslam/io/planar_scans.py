"""Resampling of planar scans with different beam layouts to the most frequent layout."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from graphslam.core.geometry import Array

Ranges = npt.NDArray[np.float32]


def resample_beams(ranges: Ranges, own: Array, beams: Array) -> Ranges:
    """Resample a scan to other beams: range of the nearest beam within one step, otherwise NaN.

    Parameters
    ----------
    ranges, own : (n,)
        Ranges of the scan [m] and their increasing directions [rad].
    beams : (m,)
        New directions [rad].
    """
    k = np.clip(np.searchsorted(own, beams), 1, len(own) - 1)
    k = k - (beams - own[k - 1] < own[k] - beams)
    near = np.abs(own[k] - beams) <= max(own[1] - own[0], beams[1] - beams[0])
    return np.where(near, ranges[k], np.nan).astype(np.float32)


def unify_layout(scans: Sequence[tuple[Ranges, Array]]) -> tuple[Ranges, Array, int]:
    """Scans with different beams as one table, in the most frequent layout ``beams``.

    Parameters
    ----------
    scans : sequence of (ranges, directions)
        Directions increase [rad].

    Returns
    -------
    ranges : (k, m)
    beams : (m,)
    moved : int
        Number of resampled scans.
    """
    keys = [(len(b), float(b[0]), float(b[-1])) for _, b in scans]
    counts = Counter(keys)
    usual = max(counts, key=lambda k: (counts[k], k))
    beams = scans[keys.index(usual)][1]
    rows = [r if k == usual else resample_beams(r, b, beams) for (r, b), k in zip(scans, keys)]
    return np.stack(rows), beams, len(scans) - counts[usual]
