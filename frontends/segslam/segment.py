"""Segments as values: how a particle enters one, and what is known of one that is closed."""

from __future__ import annotations

from dataclasses import dataclass

from graphslam.core.geometry import Array

NEW, MATCH, SAME = 0, 1, 2
"""How a segment was entered (A2): an empty map; an older one, by registration; the one it comes from, which goes on."""
KINDS = ("new", "match", "same")


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """How one particle enters a segment.

    Parameters
    ----------
    T_entry : (7,) or (3,)
        ``T_segment_body`` at the boundary.
    kind : {NEW, MATCH, SAME}
    source : int
        The older segment whose map is entered; -1 of a new one.
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
    """What is known of one closed segment; arrays are views and must not be written to.

    Parameters
    ----------
    index : int
    interval : (start, end)
        Steps of its two boundaries.
    t_start, t_end : float
        [s]
    kind : str
        "new", "match" or "same".
    source, previous : int
        The segment whose map it entered (its parent), and the one its particle came from; -1 = none.
    T_entry, T_exit : (7,) or (3,)
        ``T_segment_body`` at the boundaries.
    path : (end - start + 1, 7 or 3)
        ``T_segment_body`` at every step, boundaries included.
    length : float
        Path length by odometry [m].
    weight : float
        Share of the particles' weight when it was closed.
    match_covariance : (d, d) or None
    fitness : float
    locked : bool
        Its map is localised in, not updated.
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
    locked: bool
