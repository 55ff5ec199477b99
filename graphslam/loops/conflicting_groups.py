"""Decide between two groups of loops that contradict each other, by their agreement with the rest of the graph.

Loops with the same wrong association agree with each other, so their number is weak evidence: ten loops of one mistake
are one mistake. Better evidence is how much the chain must be deformed for either side. Relative to the posterior
without both sides, every loop of a side has a χ² of the same error, the common motion of the side; its median
represents the side, and the difference of the two is twice the log-odds. The number of loops has a small weight. If
neither side is clearly better, the result is ambiguous and neither is accepted.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from graphslam.core.geometry import Array
from graphslam.loops.map_overlap_test import ERROR

DOUBT = 4.0
"""A side is accepted if the other's score is larger by this: odds of e² to 1."""
MAJORITY = 1.0
"""χ² equivalent of one more loop."""
CLASH = 0.9999
"""Two correct loops contradict each other with one minus this probability."""

NEARBY = 20
"""Loops are in one group if their ends are at most this many nodes apart, summed over both ends."""
SHUTS_OUT = 0.25
"""A loop that contradicts this share of an excluded group is a rival of that group."""
OUTNUMBERED = 4
"""Largest ratio of rivals to loops of a group; with more rivals the group is assumed wrong."""

AMBIGUOUS = "ambiguous"
"""Start of the reason of loops that are undecided …"""
LOST = ("dispute", AMBIGUOUS)
"""… and of all loops that lost a dispute."""

Outcome = Literal["stays", "changes", "ambiguous"]


def find_conflicting_groups(
    D2: Array, inside: int, ends: npt.NDArray[np.int64], clash: float, least: int = 2
) -> list[tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]]:
    """Groups of loops that contradict loops in the graph.

    Parameters
    ----------
    D2 : (l, l)
        χ² of all pairs, loops in the graph first.
    inside : int
        Number of loops in the graph.
    ends : (l, 2)
    clash : float
        Two loops contradict each other above this.
    least : int
        Minimum number of loops of a group outside the graph.

    Returns
    -------
    list of (rows, rows)
        In the graph, and outside: groups of neighbours that agree, the largest first, each with its rivals in the
        graph. Groups with too many rivals are omitted.
    """
    out = np.arange(inside, len(D2))
    agree = ~(D2[inside:, inside:] > clash)
    apart = np.abs(ends[out, None] - ends[None, out]).sum(axis=2)
    _, label = connected_components(sp.csr_matrix(agree & agree.T & (apart <= NEARBY)), directed=False)
    found = []
    for name in np.argsort(-np.bincount(label), kind="stable"):
        group = out[label == name]
        rivals = np.flatnonzero((D2[:inside, group] > clash).mean(axis=1) > SHUTS_OUT)
        if len(group) >= least and 0 < len(rivals) <= OUTNUMBERED * len(group):
            found.append((rivals, group))
    return found


def choose_group(inside: Array, outside: Array, maps: float = 0.0) -> tuple[Outcome, str]:
    """Choose one of two contradictory sides, with the reason as text.

    Parameters
    ----------
    inside, outside : (a,), (b,)
        χ² of the loops of the side in the graph and of the other, relative to the graph without both.
    maps : float
        Log-likelihood ratio of the maps in favour of the other side
        (:func:`graphslam.loops.map_overlap_test.overlap_log_likelihood_ratio`). A single loop can replace the side in
        the graph only by this.
    """
    own, other = float(np.median(inside)), float(np.median(outside))
    score = own - other + MAJORITY * (len(outside) - len(inside))
    words = f"without either, χ² {own:.1f} of {len(inside)} in the graph, {other:.1f} of {len(outside)} outside"
    if abs(maps) > -math.log(ERROR):
        reason = f"dispute: the maps say so by a log-ratio of {abs(maps):.1f}; {words}"
        return ("changes" if maps > 0 else "stays"), reason
    if len(outside) == 1:
        return "stays", f"dispute: {words}"
    if score > DOUBT:
        return "changes", f"dispute: {words}"
    if score < -DOUBT:
        return "stays", f"dispute: {words}"
    return "ambiguous", f"{AMBIGUOUS}, two groups: {words}"
