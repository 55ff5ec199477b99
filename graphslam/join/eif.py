"""Join two maps in information form (Combined SLAM B6, eq. 13–16): exactly sparse, linearised once.

Map B is one measurement of the global quantities, seen from the last pose of map A: ``x_B = H(X) + v``,
``v ~ N(0, I_B⁻¹)``. The end poses and new landmarks of B are added to A with zero information, at their values from B,
and then

    I ← I + ∇Hᵀ I_B ∇H,        X ← X + I⁻¹ ∇Hᵀ I_B (x_B - H(X)),

which is eq. 16 with ``i = I X`` (eq. 13) subtracted on both sides: in this residual form a heading can be wrapped.
Nothing is marginalised out, so ``I`` has only the couplings from the submaps.

Maps that are Gaussian in the group chart (:mod:`graphslam.core.charts`) are joined in it: every landmark is expressed
in the frame of the end pose of the submap that observed it first, and B's observation is relinearised at the joint
estimate of A and B. This is an iterated information filter.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from graphslam.core.geometry import Array
from graphslam.join import kernels
from graphslam.join.joined_map import JoinedMap, JoinTimes
from graphslam.linear.symmetric_factor import elimination_order

Index = npt.NDArray[np.intp]

# The elimination order is recomputed when the fill-in exceeds that of the last new order by this factor.
_STALE = 1.3
# Smaller relative differences between B and its prediction are rounding errors.
_ROUNDING = 1e-12


def match_by_id(a: JoinedMap, b: JoinedMap) -> Index:
    """Landmark of A with the same id as each landmark of B, or -1 ``(L_b,)``."""
    if len(a.ids) == 0:
        return np.full(len(b.ids), -1, dtype=np.intp)
    order = np.argsort(a.ids)
    at = np.minimum(np.searchsorted(a.ids[order], b.ids), len(a.ids) - 1)
    candidate = order[at]
    return np.where(a.ids[candidate] == b.ids, candidate, -1).astype(np.intp)


_PASSES = 3
# … or until a step is below this many standard deviations, on average over the map.
_STEP = 1e-3


def join_maps(a: JoinedMap, b: JoinedMap, match: Index, times: JoinTimes | None = None) -> JoinedMap:
    """Join B, which starts where A ends, to A.

    Parameters
    ----------
    match : (L_b,)
        Landmark of A for each landmark of B, or -1 for a new one; no landmark of A twice.
    times : JoinTimes, optional
        The run time is added to it.

    Returns
    -------
    JoinedMap
        In the frame of A's first base.
    """
    times = times or JoinTimes()
    if a.anchor is not None and b.anchor is not None:
        return _join_along_arcs(a, b, match, times)
    with times.measure("update"):
        joined, gradient, news = _assemble(a, b, match, block_map_of(a), block_map_of(b), np.zeros(len(b.x)))
    if not news:  # no common landmarks: the mean is unchanged, and no factorisation is needed
        return joined
    with times.measure("recovery"):
        _keep_order_sparse(joined)
        joined.x += joined.factor().solve(gradient)  # eq. 13
    return joined


def _join_along_arcs(a: JoinedMap, b: JoinedMap, match: Index, times: JoinTimes) -> JoinedMap:
    """Join in the group chart.

    A and B are Gaussian in their own charts. A few Gauss–Newton passes find the joint mean, and the joint information
    is evaluated there.
    """
    assert a.anchor is not None
    assert b.anchor is not None
    first, second, start = block_map_of(a), block_map_of(b), int(a.pose_node[-1])
    x, image, left = a.x, _image(a, b, match)[0], _PASSES
    joined: JoinedMap | None = None
    while True:
        with times.measure("update"):
            seen = kernels.predict_nodes(first, second, image, start, x)
            if joined is None and np.all(np.abs(seen - b.x) < _ROUNDING * (1.0 + np.abs(b.x))):
                return _assemble(a, b, match, first, second, np.zeros(len(b.x)))[0]  # no new information
            ours, g_a = kernels.relinearise_in_chart(first, a.anchor, x[: len(a.x)])
            theirs, g_b = kernels.relinearise_in_chart(second, b.anchor, seen)
            if joined is None:
                joined, gradient, _ = _assemble(a, b, match, ours, theirs, -g_b)
            else:  # all passes have the same pattern
                system = kernels.join_blocks(ours, theirs, image, start, _ROUNDING, -g_b)
                gradient = system[6]
                joined.take_values(system[0], system[5])
        if left == 0:
            return joined
        with times.measure("recovery"):
            if left == _PASSES:
                _keep_order_sparse(joined)
            gradient[: len(g_a)] -= g_a
            step = joined.factor().solve(gradient)
            x = _along_arcs(joined, step)
            left = 0 if gradient @ step < _STEP**2 * len(step) else left - 1


def _along_arcs(m: JoinedMap, step: Array) -> Array:
    """Values ``(n,)`` of a map after a step: headings are added, positions move along the arcs of their anchors."""
    assert m.anchor is not None
    at = np.cumsum(m.width) - m.width
    pose = m.width == 3
    d = step[at[m.anchor] + 2]
    small = np.abs(d) < 1e-6
    safe = np.where(small, 1.0, d)
    along = np.where(small, 1.0, np.sin(safe) / safe)  # V = along I + across S
    across = np.where(small, 0.5 * d, (1.0 - np.cos(safe)) / safe)
    x = m.x.copy()
    x[at] += along * step[at] - across * step[at + 1]
    x[at + 1] += across * step[at] + along * step[at + 1]
    x[at[pose] + 2] += step[at[pose] + 2]
    return x


def _assemble(
    a: JoinedMap, b: JoinedMap, match: Index, ours: kernels.BlockMap, theirs: kernels.BlockMap, pull: Array
) -> tuple[JoinedMap, Array, bool]:
    """The joined map before the update of its mean, ``∇Hᵀ (I_B (x_B - H(X)) + pull)``, and whether that is not zero."""
    N = len(a.width)
    new = np.flatnonzero(match < 0)
    image, pose_node, landmark_node = _image(a, b, match)
    x, width, ptr, neighbours, block, values, gradient, news = kernels.join_blocks(
        ours, theirs, image, int(a.pose_node[-1]), _ROUNDING, pull
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
        anchor=_anchors(a, b, image, len(width)),
        rank=rank,
    )
    return joined, gradient, bool(news)


def _image(a: JoinedMap, b: JoinedMap, match: Index) -> tuple[Index, Index, Index]:
    """Node of the joined map for each node of B ``(N_b,)``, each of its poses, and each of its landmarks."""
    N, m_b = len(a.width), len(b.pose_node)
    new = np.flatnonzero(match < 0)
    image = np.empty(len(b.width), dtype=np.int64)
    image[b.pose_node] = pose_node = N + np.arange(m_b)
    landmark_node = np.empty(len(match), dtype=np.int64)
    landmark_node[match >= 0] = a.landmark_node[match[match >= 0]]
    landmark_node[new] = N + m_b + np.arange(len(new))
    image[b.landmark_node] = landmark_node
    return image, pose_node, landmark_node


def _anchors(a: JoinedMap, b: JoinedMap, image: Index, nodes: int) -> Index | None:
    """Anchor of each node of the joined map: as in A, for new nodes as in B."""
    if a.anchor is None or b.anchor is None:
        return None
    anchor = np.empty(nodes, dtype=np.int64)
    anchor[image] = image[b.anchor]
    anchor[: len(a.anchor)] = a.anchor
    return anchor


def _keep_order_sparse(joined: JoinedMap) -> None:
    """Keep the elimination order unless its fill-in is much larger than that of the last new order."""
    if joined.rank is None and joined.symbolic().nnz / len(joined.values) > _STALE * joined.fill:
        owner = np.repeat(np.arange(len(joined.width)), np.diff(joined.ptr))
        joined.reorder(elimination_order(owner, joined.neighbours, len(joined.width)).astype(np.int64))


def block_map_of(m: JoinedMap) -> kernels.BlockMap:
    return kernels.BlockMap(m.x, m.width, m.ptr, m.neighbours, m.block, m.values)
