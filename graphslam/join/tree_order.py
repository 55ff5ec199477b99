"""One elimination order for every join of a binary tree.

When landmarks bear ids, all that a tree of joins will ever couple is known before the first join: what stands in one
submap, and the inner start of every joined half with the whole of that half. One fill-reducing order of that union
serves all joins: the graph of a part is a part of the graph, so under the same order its fill-in is a part of the
fill-in.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from graphslam.join.submap_kernels import adjacency
from graphslam.linear.symmetric_factor import elimination_order

Ids = npt.NDArray[np.int64]


def tree_ranks(ids: Sequence[Ids]) -> list[npt.NDArray[np.int64]]:
    """When each node of every submap is eliminated.

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
    half = 2  # submaps in a full half; a half of one couples with its start in any case
    while half < m:
        # The right halves of this level begin at half, 3 half, …; their start is the end pose before.
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
