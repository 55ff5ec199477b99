"""Two orders of joining (Combined SLAM B6, B9): one after the other, or pairwise up a binary tree."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from tqdm.auto import tqdm

from graphslam.core.submap import Submap
from graphslam.join.association import Association, associate
from graphslam.join.eif import join_maps, match_by_id
from graphslam.join.joined_map import (
    JoinedMap,
    JoinResult,
    JoinTimes,
    OnJoin,
    check_chain,
    finish,
)
from graphslam.join.tree_order import tree_ranks


def _join(a: JoinedMap, b: JoinedMap, association: Association | None, times: JoinTimes) -> JoinedMap:
    with times.measure("association"):
        match = match_by_id(a, b) if association is None else associate(a, b, association)
    return join_maps(a, b, match, times)


def join_sequential(
    submaps: Sequence[Submap],
    *,
    association: Association | None = None,
    on_join: OnJoin | None = None,
    progress: bool = False,
) -> JoinResult:
    """Join submaps one after the other: every submap is a measurement of the map so far.

    Parameters
    ----------
    submaps : sequence of Submap
    association : Association, optional
        Recognise landmarks; default: by the ids they bear.
    on_join : callable, optional
        ``on_join(k, view)`` is called after submap k (from 0, the first included) is in, outside the clock; the
        :class:`~graphslam.join.joined_map.MapView` is valid during the call only.
    progress : bool
        Show a progress bar.

    Raises
    ------
    DataError, CovarianceError
    """
    identified = association is None
    check_chain(submaps, identified=identified)
    times = JoinTimes()
    with times.measure("update"):
        leaves, matrices = JoinedMap.leaves(submaps, identified=identified)
    joined = leaves[0]
    if on_join is not None:
        on_join(0, joined)
    for k, leaf in enumerate(tqdm(leaves[1:], desc="join", unit="submap", disable=not progress), start=1):
        joined = _join(joined, leaf, association, times)
        if on_join is not None:
            on_join(k, joined)
    return finish(submaps, joined, identified=identified, method="eif-sequential", times=times, information=matrices)


def join_tree(
    submaps: Sequence[Submap], *, association: Association | None = None, progress: bool = False
) -> JoinResult:
    """Join submaps pairwise, then the pairs, and so on: the joined map of B9 is a submap for the next level.

    An odd one out goes up a level by itself. Parameters as in :func:`join_sequential`.
    """
    identified = association is None
    check_chain(submaps, identified=identified)
    times = JoinTimes()
    with times.measure("update"):
        level, matrices = JoinedMap.leaves(submaps, identified=identified)
        if identified:
            for leaf, rank in zip(level, tree_ranks([leaf.ids for leaf in level])):
                leaf.rank, leaf.order = rank, np.argsort(rank)
    with tqdm(total=len(level) - 1, desc="join", unit="join", disable=not progress) as bar:
        while len(level) > 1:
            above = [_join(a, b, association, times) for a, b in zip(level[::2], level[1::2])]
            bar.update(len(above))
            level = above + level[len(level) - len(level) % 2 :]
    return finish(submaps, level[0], identified=identified, method="eif-tree", times=times, information=matrices)
