"""Segments: how a particle enters one, and the data of a closed one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from graphslam.core.errors import DataError, GeometryError
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of

NEW, MATCH, SAME = 0, 1, 2
"""Kind of entry (A2): an empty map; an older one, by registration; or the map of the previous segment, continued."""
KINDS = ("new", "match", "same")


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmentEntry:
    """Entry of a particle into a segment.

    Parameters
    ----------
    T_entry : (7,) or (3,)
        ``T_segment_body`` at the boundary.
    kind : {NEW, MATCH, SAME}
    source : int
        The older segment whose map is entered; -1 for a new map.
    covariance : (d, d) or None
        Of ``T_entry`` of a match, right tangent.
    fitness : float
        Of a match, 0 … 1.
    """

    T_entry: Array
    kind: int = NEW
    source: int = -1
    covariance: Array | None = None
    fitness: float = float("nan")


@dataclass(frozen=True, slots=True, kw_only=True)
class Segment:
    """Data of a closed segment; arrays are read-only views.

    Parameters
    ----------
    interval : (start, end)
        Steps of its two boundaries.
    t_start, t_end : float
        [s]
    kind : str
        "new", "match" or "same".
    source, previous : int
        The segment whose map it entered (its parent), and the previous segment of its particle; -1 = none.
    T_entry, T_exit : (7,) or (3,)
        ``T_segment_body`` at the boundaries.
    path : (end - start + 1, 7 or 3)
        ``T_segment_body`` at every step, boundaries included.
    length : float
        Path length by odometry [m].
    weight : float
        Sum of the weights of its particles when it was closed.
    match_covariance : (d, d) or None
    """

    index: int
    interval: tuple[int, int]
    t_start: float
    t_end: float
    kind: str
    source: int
    previous: int
    T_entry: Array
    T_exit: Array
    path: Array
    length: float
    weight: float
    match_covariance: Array | None
    fitness: float


def check_path(path: Any, entry: SegmentEntry | None, particle: int, interval: tuple[int, int], last: int) -> Array:
    """Check the path ``(n, 7)`` or ``(n, 3)`` of a particle through a segment that it leaves, in the segment's frame.

    Parameters
    ----------
    path : (n, 7) or (n, 3)
    entry : SegmentEntry or None
        How the particle entered.
    interval : (start, end)
        Steps.
    last : int
        The last step of the log.
    """
    start, step = interval
    if entry is None:
        raise DataError(f"particle {particle} leaves a segment that it never entered", where=f"step {step}")
    n = step - start + 1
    if n < 2 or step > last:
        raise DataError(
            f"segment of particle {particle} is empty or ends outside the path", got=f"steps {start} … {step}"
        )
    group = group_of(entry.T_entry)
    rows = np.ascontiguousarray(path, dtype=np.float64)
    if rows.shape != (n, group.size) or not np.all(np.isfinite(rows)):
        raise GeometryError(
            f"path of particle {particle} is impossible", got=rows.shape, wanted=f"({n}, {group.size}) finite poses"
        )
    if np.abs(group.log(group.between(entry.T_entry, rows[0]))).max() > 1e-6:
        raise GeometryError(
            f"path of particle {particle} does not begin where it entered: is it in the frame of the segment before?",
            got=rows[0].tolist(),
            wanted=np.asarray(entry.T_entry).tolist(),
        )
    return rows
