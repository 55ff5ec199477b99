"""Checks of scans: without returns, equal ranges in all beams, repeated scans, wrong unit."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from graphslam.core.findings import Finding
from graphslam.core.geometry import Array
from graphslam.core.log import SensorLog
from graphslam.core.point_clouds import PointClouds
from graphslam.core.range_scans import RangeScans
from graphslam.core.records import LaserScans
from graphslam_frontends.odometry.deskew import repeated_clouds, repeated_scans

Scanner = LaserScans | RangeScans | PointClouds
Mask = npt.NDArray[np.bool_]

SILENT = 5.0
"""Time without any return that is reported [s]."""
CONSTANT = 1e-3
"""Ranges of one scan within this interval are not a measurement [m]: the noise of a range finder is larger."""
LEAST_BEAMS = 8
"""Least number of beams with a return in a scan that is called constant."""
NEAREST, FARTHEST = 0.1, 1000.0
"""Plausible limits of the median range [m]."""
OF_A_MAP = 1e5
"""Points farther away [m] are in coordinates of a map: no lidar sees 100 m, written in millimetres, on the whole."""
MOST_CLOUDS = 100
"""Clouds that are decoded for these checks, evenly over the stream: a recording can have 10⁷ points."""
SOME = 0.01
"""Share of faulty scans above which the fault is reported."""


def check_beams(stream: Scanner, name: str, log: SensorLog) -> list[Finding]:
    """Check the scans of one scanner.

    Parameters
    ----------
    stream : LaserScans, RangeScans or PointClouds
    name : str
        Name of the stream in the messages.
    """
    if len(stream.times) == 0:
        return [Finding("bad", "scans-missing", f"{name}: no scans.")]
    if isinstance(stream, PointClouds):
        every = -(-len(stream) // MOST_CLOUDS)
        same = repeated_clouds(stream.cloud(k) for k in range(min(len(stream), MOST_CLOUDS)))
        stream = stream.take(slice(None, None, every))
    else:
        same = repeated_scans(stream.ranges, stream.max_range)
    least, middle, most, count = _ranges(stream)
    return [
        *_silent(stream, name, count),
        *_constant(name, least, most, count),
        *_repeated(name, same),
        *_unit(name, middle[count > 0]),
    ]


def _ranges(stream: Scanner) -> tuple[Array, Array, Array, npt.NDArray[np.int64]]:
    """Least, median and greatest range of the returns of each scan, and how many there are."""
    n = len(stream.times)
    low, middle, high = np.full(n, np.nan), np.full(n, np.nan), np.full(n, np.nan)
    count = np.zeros(n, dtype=np.int64)
    for k in range(n):
        if isinstance(stream, PointClouds):
            r = np.linalg.norm(stream.cloud(k) - stream.origin, axis=1)
        else:
            r = stream.ranges[k]
            with np.errstate(invalid="ignore"):
                r = r[(r > 0) & (r < stream.max_range)]
        count[k] = len(r)
        if len(r):
            low[k], middle[k], high[k] = r.min(), np.median(r), r.max()
    return low, middle, high, count


def _silent(stream: Scanner, name: str, count: npt.NDArray[np.int64]) -> list[Finding]:
    t, none = stream.times, count == 0
    edges = np.flatnonzero(np.diff(np.concatenate([[False], none, [False]]).astype(np.int8)))
    runs = [(a, b) for a, b in edges.reshape(-1, 2)]
    if not runs:
        return []
    last = len(t) - 1
    lengths = [float(t[min(b, last)] - t[a]) for a, b in runs]
    worst = int(np.argmax(lengths))
    share = float(none.mean())
    if share < 0.5 and lengths[worst] < SILENT:
        return []
    counts = f"scans of {name} without a return: {int(none.sum())} of {len(t)}"
    where = f"longest stretch {lengths[worst]:.1f} s from {t[runs[worst][0]]:.2f} s"
    if isinstance(stream, PointClouds):
        cause = "the clouds are empty"
    else:
        r = stream.ranges[none]
        kinds = {"no reading": np.isnan(r), "at or beyond max_range": r >= stream.max_range, "zero or less": r <= 0}
        most = max(kinds, key=lambda k: int(kinds[k].sum()))
        cause = f"most beams there are {most}"
        if most == "at or beyond max_range":
            cause += f", {stream.max_range:g} m (are the ranges in millimetres?)"
    text = f"{counts}; {where}; {cause} — the path there is that of the odometry."
    return [Finding("bad" if share > 0.5 else "look", "scans-silent", text)]


def _constant(name: str, low: Array, high: Array, count: npt.NDArray[np.int64]) -> list[Finding]:
    flat = (count >= LEAST_BEAMS) & (high - low < CONSTANT)
    if flat.mean() <= SOME:
        return []
    text = (
        f"scans of {name} with one range in all beams: {int(flat.sum())} of {len(flat)} "
        f"({np.median(low[flat]):.3g} m) — the sensor or its driver is stuck. Leave the stream out, or repair it."
    )
    return [Finding("bad", "scans-constant", text)]


def _repeated(name: str, same: Mask) -> list[Finding]:
    share = float(same.mean())
    if share <= SOME:
        return []
    text = (
        f"scans of {name} equal to the one before: {int(same.sum())} of {len(same)} — the driver sends scans twice, or "
        "the sensor is stuck. Front ends on grids ignore them."
    )
    return [Finding("bad" if share > 0.5 else "look", "scans-repeated", text)]


def _unit(name: str, middle: Array) -> list[Finding]:
    if not len(middle):
        return []
    usual = float(np.median(middle))
    if NEAREST <= usual <= FARTHEST:
        return []
    text = f"median range of {name}: {usual:.3g} m [{NEAREST:g}, {FARTHEST:g}] — "
    if not usual < OF_A_MAP:
        text += "the points seem to be in coordinates of a map (UTM). Give each scan in the frame of its scanner."
        return [Finding("bad", "scans-of-a-map", text)]
    unit = "kilometres" if usual < NEAREST else "millimetres"
    return [Finding("bad", "scans-unit", text + f"the ranges seem to be in {unit}. Convert them to metres.")]
