"""Two groups of loops that cannot both be right: which of them does the rest of the graph bear out, if any?

Loops that take one place for another agree with each other, so their number says little: ten loops of one mistake are
one mistake. What does tell is how far the chain had to be bent for either side. With the posterior of everything but
the two sides, every loop of a side has a χ² of the same error, the side's common motion; its median stands for the
side, and the difference of the two is twice the logarithm of their odds. Number counts a little. Where neither speaks
clearly the answer is that it is not known, and neither side is believed.
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
"""A side is believed if the other's χ² is greater by so much: odds of e² to 1."""
MAJORITY = 1.0
"""χ² that a loop more is worth."""
CLASH = 0.9999
"""Two right loops contradict each other with one minus this probability."""

NEARBY = 20
"""Loops are of one group whose ends are so many nodes apart, both together."""
SHUTS_OUT = 0.25
"""A loop that contradicts this share of a group that was shut out is a rival of that group."""
OUTNUMBERED = 4
"""A group with so many times as many rivals is wrong."""

AMBIGUOUS = "ambiguous"
"""What begins the reasons of loops of which nothing tells whether they are right …"""
SETTLED = ("dispute", AMBIGUOUS)
"""… and of all that lost a dispute."""

Outcome = Literal["stays", "changes", "ambiguous"]


def find_conflicting_groups(
    D2: Array, inside: int, ends: npt.NDArray[np.int64], clash: float, least: int = 2
) -> list[tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]]:
    """Sides that contradict each other.

    Parameters
    ----------
    D2 : (l, l)
        χ² of all pairs, loops in the graph first.
    inside : int
        How many of them there are.
    ends : (l, 2)
    clash : float
        Two loops contradict each other beyond this.
    least : int
        Loops of a group outside.

    Returns
    -------
    list of (rows, rows)
        In the graph, and outside: groups of neighbours that agree, the largest first, each with those that
        shut out a good part of it. Not where these are too many to be one mistake.
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
    """Which of two sides is believed, and why in words.

    Parameters
    ----------
    inside, outside : (a,), (b,)
        χ² of the loops of the side in the graph and of the other, against the graph without either.
    maps : float
        Log of how much likelier the maps are with the other side
        (:func:`graphslam.loops.map_overlap_test.overlap_log_likelihood_ratio`). Against one loop alone nothing else
        speaks.
    """
    own, other = float(np.median(inside)), float(np.median(outside))
    score = own - other + MAJORITY * (len(outside) - len(inside))
    words = f"without either, χ² {own:.1f} of {len(inside)} in the graph, {other:.1f} of {len(outside)} outside"
    if abs(maps) > -math.log(ERROR):
        said = f"dispute: the maps say so by a log-ratio of {abs(maps):.1f}; {words}"
        return ("changes" if maps > 0 else "stays"), said
    if len(outside) == 1:
        return "stays", f"dispute: {words}"
    if score > DOUBT:
        return "changes", f"dispute: {words}"
    if score < -DOUBT:
        return "stays", f"dispute: {words}"
    return "ambiguous", f"{AMBIGUOUS}, two groups: {words}"
