"""Join two maps in information form (Combined SLAM B6, eq. 13–16): exactly sparse, linearised once.

Map B is one measurement of the global quantities, seen from the last pose of map A: ``x_B = H(X) + v``,
``v ~ N(0, I_B⁻¹)``. The end poses and new landmarks of B enter A with rows and columns of zeros (zero information), at
the values B gives them, and then

    I ← I + ∇Hᵀ I_B ∇H,        X ← X + I⁻¹ ∇Hᵀ I_B (x_B - H(X)),

which is eq. 16 with ``i = I X`` (eq. 13) subtracted on both sides: in this residual form a heading can be wrapped.
Nothing is marginalised out, so ``I`` keeps only the couplings that submaps made.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from graphslam.join import kernels
from graphslam.join.joined_map import JoinedMap, JoinTimes
from graphslam.linear.symmetric_factor import elimination_order

Index = npt.NDArray[np.intp]

# A kept order is given up when the factor has this much more fill-in than under the last fresh one.
_STALE = 1.3
# Below this a difference between B and its own prediction is arithmetic, not news.
_ROUNDING = 1e-12


def match_by_id(a: JoinedMap, b: JoinedMap) -> Index:
    """For every landmark of B the landmark of A with the same id, or -1 ``(L_b,)``."""
    if len(a.ids) == 0:
        return np.full(len(b.ids), -1, dtype=np.intp)
    order = np.argsort(a.ids)
    at = np.minimum(np.searchsorted(a.ids[order], b.ids), len(a.ids) - 1)
    candidate = order[at]
    return np.where(a.ids[candidate] == b.ids, candidate, -1).astype(np.intp)


def join_maps(a: JoinedMap, b: JoinedMap, match: Index, times: JoinTimes | None = None) -> JoinedMap:
    """Join B, which starts where A ends, to A.

    Parameters
    ----------
    a, b : JoinedMap
    match : (L_b,)
        Landmark of A that each landmark of B is, or -1 for a new one. Several of B may not be one of A.
    times : JoinTimes, optional
        Where to add the time spent.

    Returns
    -------
    JoinedMap
        In the frame of A's first base.
    """
    times = times or JoinTimes()
    with times.measure("update"):
        joined, gradient = _assemble(a, b, match)
    if gradient is None:  # nothing in B was known before: the mean stays, and no factorisation is needed
        return joined
    with times.measure("recovery"):
        _keep_order_sparse(joined)
        joined.x += joined.factor().solve(gradient)  # eq. 13
    return joined


def _assemble(a: JoinedMap, b: JoinedMap, match: Index) -> tuple[JoinedMap, npt.NDArray[np.float64] | None]:
    """The joined map at its values before the update, and ``∇Hᵀ I_B (x_B - H(X))`` there (None: zero)."""
    N, m_b = len(a.width), len(b.pose_node)
    new = np.flatnonzero(match < 0)
    image = np.empty(len(b.width), dtype=np.int64)
    pose_node = N + np.arange(m_b)
    image[b.pose_node] = pose_node
    landmark_node = np.empty(len(match), dtype=np.int64)
    landmark_node[match >= 0] = a.landmark_node[match[match >= 0]]
    landmark_node[new] = N + m_b + np.arange(len(new))
    image[b.landmark_node] = landmark_node
    x, width, ptr, neighbours, block, values, gradient, news = kernels.join_blocks(
        _blocks(a), _blocks(b), image, int(a.pose_node[-1]), _ROUNDING
    )
    place = np.where(match >= 0, match, len(a.landmark_node) + np.cumsum(match < 0) - 1).astype(np.intp)
    came = image[b.order]
    rank = None
    if a.rank is not None and b.rank is not None:
        rank = np.append(a.rank, np.zeros(len(width) - N, dtype=np.int64))
        rank[image] = b.rank
    joined = JoinedMap(
        x=x,
        width=width,
        ptr=ptr,
        neighbours=neighbours,
        block=block,
        values=values,
        pose_node=np.concatenate([a.pose_node, pose_node]),
        landmark_node=np.concatenate([a.landmark_node, landmark_node[new]]),
        ids=np.concatenate([a.ids, b.ids[new]]),
        entry_landmark=np.append(a.entry_landmark, place[b.entry_landmark]),
        entry_count=np.append(a.entry_count, b.entry_count),
        order=np.append(a.order, came[came >= N]) if rank is None else np.argsort(rank),
        fill=max(a.fill, b.fill),
        rank=rank,
    )
    return joined, gradient if news else None


def _keep_order_sparse(joined: JoinedMap) -> None:
    """Keep the elimination order as long as it does not cost much more fill-in than the last fresh one did."""
    if joined.rank is None and joined.symbolic().nnz / len(joined.values) > _STALE * joined.fill:
        owner = np.repeat(np.arange(len(joined.width)), np.diff(joined.ptr))
        joined.reorder(elimination_order(owner, joined.neighbours, len(joined.width)).astype(np.int64))


def _blocks(m: JoinedMap) -> kernels.BlockMap:
    return kernels.BlockMap(m.x, m.width, m.ptr, m.neighbours, m.block, m.values)
