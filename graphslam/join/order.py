"""Orders of joining (Combined SLAM B6, B9): in sequence, or pairwise in a binary tree."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from graphslam.core.progress import Bar
from graphslam.core.submap import Submap
from graphslam.join.association import MapAssociationConfig
from graphslam.join.joined_map import JoinedMap, JoinResult, JoinTimes, OnJoin, check_chain, finish_map
from graphslam.join.parallel import join_leaves, join_two
from graphslam.join.submap_kernels import adjacency
from graphslam.linear.symmetric_factor import elimination_order

if TYPE_CHECKING:
    from distributed import Client


def join_sequential(
    submaps: Sequence[Submap],
    *,
    association: MapAssociationConfig | None = None,
    on_join: OnJoin | None = None,
    classical: bool = False,
    progress: bool = False,
) -> JoinResult:
    """Join submaps in sequence: every submap is a measurement of the current map.

    Submaps that are Gaussian in the group chart are joined in it (:mod:`graphslam.join.eif`).

    Parameters
    ----------
    association : MapAssociationConfig, optional
        Data association; default: by the landmark ids.
    on_join : callable, optional
        ``on_join(k, view)`` is called after submap k (from 0) was joined, and is not timed; the
        :class:`~graphslam.join.joined_map.JoinedMapView` is valid only during the call.
    classical : bool
        Join as in the paper, for any chart of the submaps: Cartesian, each join linearised once.
    progress : bool
        Show a progress bar.
    """
    identified = association is None
    check_chain(submaps, identified=identified)
    times = JoinTimes()
    with times.measure("update"):
        leaves, matrices = JoinedMap.leaves(submaps, identified=identified, classical=classical)
    joined = leaves[0]
    if on_join is not None:
        on_join(0, joined)
    for k, leaf in enumerate(Bar(leaves[1:], name="join", unit="submap", shown=progress), start=1):
        joined = join_two(joined, leaf, association, times)
        if on_join is not None:
            on_join(k, joined)
    return finish_map(
        submaps,
        joined,
        identified=identified,
        method=_name("eif-sequential", classical),
        times=times,
        information=matrices,
    )


def join_tree(
    submaps: Sequence[Submap],
    *,
    association: MapAssociationConfig | None = None,
    executor: str | Executor | Client | None = None,
    workers: int | None = None,
    classical: bool = False,
    progress: bool = False,
) -> JoinResult:
    """Join submaps pairwise, then the pairs, and so on: a joined map (B9) is a submap for the next level.

    An unpaired map moves up one level. The result is bitwise equal with all executors.

    Parameters
    ----------
    submaps, association, classical, progress
        As in :func:`join_sequential`.
    executor : optional
        Where the joins run: in this process (default); ``"processes"``, a pool of spawned processes for this tree; a
        shared ``concurrent.futures`` executor or Dask client; or the address of a Dask scheduler, which gets the tree
        as one task graph. In one process a few thousand submaps take about a second: the others are faster only if a
        pool is reused, or with data association (see :mod:`graphslam.join.parallel`).
    workers : int, optional
        Processes of a new pool; without ``executor`` it implies ``"processes"``. Default: number of processors.

    Returns
    -------
    JoinResult
        ``times`` are CPU seconds of all processes, ``seconds`` the longest path in the tree.
    """
    identified = association is None
    check_chain(submaps, identified=identified)
    times = JoinTimes()
    with times.measure("update"):
        leaves, matrices = JoinedMap.leaves(submaps, identified=identified, classical=classical)
        if identified:
            for leaf, rank in zip(leaves, tree_ranks([leaf.ids for leaf in leaves])):
                leaf.rank, leaf.order = rank, np.argsort(rank)
    joined, spent = join_leaves(leaves, association, executor, workers, progress)
    for part, seconds in times.parts.items():
        spent.parts[part] += seconds
    spent.wall += times.wall
    return finish_map(
        submaps, joined, identified=identified, method=_name("eif-tree", classical), times=spent, information=matrices
    )


def _name(method: str, classical: bool) -> str:
    return f"{method}-classical" if classical else method


Ids = npt.NDArray[np.int64]


def tree_ranks(ids: Sequence[Ids]) -> list[npt.NDArray[np.int64]]:
    """Elimination rank of each node of every submap.

    Parameters
    ----------
    ids : sequence of (n_k,) int64
        Landmark ids of every submap, each once.

    Returns
    -------
    list of (1 + n_k,) int64
        Rank of the end pose, then of the landmarks.
    """
    m = len(ids)
    known, landmark = np.unique(np.concatenate(ids), return_inverse=True)
    N = m + len(known)
    counts = np.array([1 + len(i) for i in ids], dtype=np.int64)
    ptr = np.concatenate([[0], np.cumsum(counts)])
    owner = np.repeat(np.arange(m), counts)
    node = owner.astype(np.int64)
    is_landmark = np.ones(len(node), dtype=bool)
    is_landmark[ptr[:-1]] = False
    node[is_landmark] = m + landmark.ravel()
    list_ptr, neighbours = adjacency(N, ptr, node)
    rows, columns = [np.repeat(np.arange(N), np.diff(list_ptr))], [neighbours]
    half = 2  # submaps in a full half; a half of one is coupled with its start anyway
    while half < m:
        # The right halves of this level begin at half, 3 half, …; their start is the previous end pose.
        begins = np.arange(half, m, 2 * half)
        which = np.searchsorted(begins, owner, side="right") - 1
        inside = (which >= 0) & (owner < begins[which] + half)
        pairs = np.unique((begins[which[inside]] - 1) * N + node[inside])
        rows.append(pairs // N)
        columns.append(pairs % N)
        half *= 2
    order = elimination_order(np.concatenate(rows), np.concatenate(columns), N)
    rank = np.empty(N, dtype=np.int64)
    rank[order] = np.arange(N)
    return np.split(rank[node], ptr[1:-1])
