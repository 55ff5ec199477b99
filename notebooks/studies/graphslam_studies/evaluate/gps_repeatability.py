"""How well GPS fixes agree where a vehicle returns to a place."""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from graphslam.core.errors import DataError
from graphslam.evaluate.gps import GpsResiduals
from graphslam.evaluate.gps_repeatability import fix_segments


def segment_table(residuals: GpsResiduals, *, gap: float = 2.0) -> pd.DataFrame:
    """One row a segment: begin and end [s], fixes, mean residual east and north, its length, scatter within [m].

    ``scatter`` is the root mean square distance of the segment's residuals from their own mean: small where a segment
    is biased rather than noisy.
    """
    segment = fix_segments(residuals.times, gap)
    rows = []
    for k in range(int(segment.max(initial=-1)) + 1):
        r, t = residuals.residuals[segment == k], residuals.times[segment == k]
        mean = r.mean(axis=0)
        scatter = float(np.sqrt(np.mean(np.sum((r - mean) ** 2, axis=1))))
        rows.append((k, t[0], t[-1], len(r), mean[0], mean[1], float(np.hypot(*mean)), scatter))
    columns = ["segment", "t_start", "t_end", "fixes", "east", "north", "bias", "scatter"]
    return pd.DataFrame(rows, columns=columns)


def revisit_disagreement(
    residuals: GpsResiduals, *, radius: float = 2.0, min_pairs: int = 1, gap: float = 2.0
) -> pd.DataFrame:
    """Disagreement between fixes of different segments at the same place of the map.

    Parameters
    ----------
    residuals : GpsResiduals
        Of a map that is good to much less than the GPS over the revisits.
    radius : float
        Two map points this near are one place [m].
    min_pairs : int
        Pairs of segments with fewer pairs of fixes are left out.
    gap : float
        See :func:`fix_segments`.

    Returns
    -------
    DataFrame
        One row a pair of segments: ``first, second, pairs`` and the median ``disagreement`` [m] of their fixes. Pairs
        of fixes of two segments are anything but independent: the row is the unit.
    """
    if not radius > 0:
        raise DataError("radius of a place is not positive", got=radius, wanted="> 0 m")
    segment = fix_segments(residuals.times, gap)
    columns = ["first", "second", "pairs", "disagreement"]
    ij = cKDTree(residuals.points).query_pairs(radius, output_type="ndarray") if len(segment) else np.zeros((0, 2), int)
    ij = ij[segment[ij[:, 0]] != segment[ij[:, 1]]]
    if len(ij) == 0:
        return pd.DataFrame({c: np.zeros(0, dtype=np.int64 if c != "disagreement" else float) for c in columns})
    d = np.linalg.norm(residuals.residuals[ij[:, 0]] - residuals.residuals[ij[:, 1]], axis=1)
    ends = np.sort(segment[ij], axis=1)
    table = pd.DataFrame({"first": ends[:, 0], "second": ends[:, 1], "disagreement": d})
    found = table.groupby(["first", "second"])["disagreement"].agg(["size", "median"]).reset_index()
    found.columns = pd.Index(columns)
    return found[found["pairs"] >= min_pairs].reset_index(drop=True)
