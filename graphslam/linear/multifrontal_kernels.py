"""Numba kernels: Cholesky factorisation of a block-sparse symmetric matrix by dense fronts. Plain arrays only.

Nodes are eliminated as blocks (a pose has three scalars, a landmark two). Nodes with nearly the same neighbours form a
*supernode*; its columns are one dense panel, and its Schur complement (update matrix) is a dense square that is passed
to its parent in the elimination tree (multifrontal method). The elimination order is given; it is only refined to a
postorder of the tree, with the same fill-in.

Names: node = index of the caller; position = elimination rank of a node (after postordering); scalars are numbered in
elimination order.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from graphslam.core.jit import callee, njit
from graphslam.linear.product_kernels import BLOCK, subtract_product

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

LARGE = 64
"""Fronts with at least this number of rows use block products."""


@callee
def _earlier(position: Index, ptr: Index, idx: Index) -> tuple[Index, Index]:
    """For every position its neighbours at earlier positions, from lists that contain each pair at least once."""
    N = len(position)
    count = np.zeros(N + 1, np.int64)
    for i in range(N):
        for e in range(ptr[i], ptr[i + 1]):
            if position[idx[e]] > position[i]:
                count[position[idx[e]] + 1] += 1
    start = np.cumsum(count)
    fill = start[:-1].copy()
    out = np.empty(start[N], np.int64)
    for i in range(N):
        for e in range(ptr[i], ptr[i + 1]):
            k = position[idx[e]]
            if k > position[i]:
                out[fill[k]] = position[i]
                fill[k] += 1
    return start, out


@callee
def _tree(start: Index, earlier: Index) -> Index:
    """Elimination tree: parent position or -1 (path compression through ``ancestor``)."""
    N = len(start) - 1
    parent = np.full(N, -1, np.int64)
    ancestor = np.full(N, -1, np.int64)
    for k in range(N):
        for e in range(start[k], start[k + 1]):
            i = earlier[e]
            while i != -1 and i < k:
                above = ancestor[i]
                ancestor[i] = k
                if above == -1:
                    parent[i] = k
                i = above
    return parent


@callee
def _postorder(parent: Index) -> Index:
    """Positions in postorder: children before their parent, each subtree contiguous."""
    N = len(parent)
    head = np.full(N, -1, np.int64)
    after = np.full(N, -1, np.int64)
    for k in range(N - 1, -1, -1):
        if parent[k] >= 0:
            after[k] = head[parent[k]]
            head[parent[k]] = k
    order = np.empty(N, np.int64)
    stack = np.empty(N, np.int64)
    done = 0
    for root in range(N):
        if parent[root] != -1:
            continue
        top = 0
        stack[0] = root
        while top >= 0:
            k = stack[top]
            child = head[k]
            if child == -1:
                order[done] = k
                done += 1
                top -= 1
            else:
                head[k] = after[child]
                top += 1
                stack[top] = child
    return order


@callee
def _columns(
    start: Index, earlier: Index, turned: tuple[Index, Index], up: Index, offset: Index
) -> tuple[Index, Index, Index, Index, int]:
    """Positions below each column of L, ``below[below_ptr[k] : below_ptr[k + 1]]``, counts and scalars; total entries.

    ``turned`` maps the postorder to the order of ``start`` and ``earlier``, and back.
    """
    post, rank = turned
    N = len(up)
    # Structure of every column of L: k belongs to all on the tree path from its earlier neighbours up to k.
    count = np.zeros(N, np.int64)
    seen = np.full(N, -1, np.int64)
    for k in range(N):
        old = post[k]
        seen[k] = k
        for e in range(start[old], start[old + 1]):
            i = rank[earlier[e]]
            while seen[i] != k:
                seen[i] = k
                count[i] += 1
                i = up[i]
    below_ptr = np.zeros(N + 1, np.int64)
    for k in range(N):
        below_ptr[k + 1] = below_ptr[k] + count[k]
    below = np.empty(below_ptr[N], np.int64)
    fill = below_ptr[:-1].copy()
    scalars = np.zeros(N, np.int64)  # rows below each node
    seen[:] = -1
    entries = 0
    for k in range(N):
        old = post[k]
        seen[k] = k
        w = offset[k + 1] - offset[k]
        for e in range(start[old], start[old + 1]):
            i = rank[earlier[e]]
            while seen[i] != k:
                seen[i] = k
                below[fill[i]] = k
                fill[i] += 1
                scalars[i] += w
                entries += w * (offset[i + 1] - offset[i])
                i = up[i]
        entries += w * (w + 1) // 2
    return count, scalars, below_ptr, below, int(entries)


@callee
def _supernodes(up: Index, offset: Index, scalars: Index, slack: int) -> tuple[Index, Index]:
    """Supernode of each position, and the first position of each."""
    N = len(up)
    # Supernodes: a node is merged with its child if their rows are equal up to the slack.
    super_of = np.empty(N, np.int64)
    first = np.empty(N + 1, np.int64)
    S = 0
    for k in range(N):
        joins = False
        if k > 0 and up[k - 1] == k:
            extra = scalars[k] + (offset[k + 1] - offset[k]) - scalars[k - 1]
            joins = extra * (offset[k] - offset[first[S - 1]]) <= slack
        if not joins:
            first[S] = k
            S += 1
        super_of[k] = S - 1
    first[S] = N
    return super_of, first[: S + 1].copy()


@njit
def analyse_blocks(
    order: Index, width: Index, ptr: Index, idx: Index, slack: int
) -> tuple[Index, Index, Index, Index, Index, Index, Index, Index]:
    """Symbolic factorisation.

    Parameters
    ----------
    order : (N,)
        ``order[k]`` is the node that is eliminated k-th.
    width : (N,)
        Scalars of each node.
    ptr : (N + 1,); idx : (nb,)
        Neighbours of every node; each pair at least once, the node itself allowed.
    slack : int
        A node is merged with the previous supernode if that adds at most this number of zero rows to the panel.

    Returns
    -------
    order : (N,)
        The postordered order.
    offset : (N + 1,)
        First scalar of each position.
    first : (S + 1,)
        First position of each supernode.
    parent : (S,)
        Parent supernode or -1.
    row_ptr : (S + 1,); rows : (r,)
        Positions of the nodes of each panel: the supernode's own, then those below, ascending.
    panel_ptr : (S + 1,)
        Offset of each panel (columns × rows scalars) in the entries of the factor.
    sizes : (3,)
        Most rows of a front, most scalars on the stack, entries of the factor without the slack.
    """
    N = len(order)
    position = np.empty(N, np.int64)
    for k in range(N):
        position[order[k]] = k
    start, earlier = _earlier(position, ptr, idx)
    parent = _tree(start, earlier)
    post = _postorder(parent)
    rank = np.empty(N, np.int64)
    for k in range(N):
        rank[post[k]] = k
    new_order = np.empty(N, np.int64)
    up = np.full(N, -1, np.int64)
    offset = np.zeros(N + 1, np.int64)
    for k in range(N):
        new_order[k] = order[post[k]]
        if parent[post[k]] >= 0:
            up[k] = rank[parent[post[k]]]
        offset[k + 1] = offset[k] + width[new_order[k]]
    count, scalars, below_ptr, below, entries = _columns(start, earlier, (post, rank), up, offset)
    super_of, first = _supernodes(up, offset, scalars, slack)
    S = len(first) - 1
    above = np.full(S, -1, np.int64)
    row_ptr = np.zeros(S + 1, np.int64)
    panel_ptr = np.zeros(S + 1, np.int64)
    for s in range(S):
        last = first[s + 1] - 1
        if up[last] >= 0:
            above[s] = super_of[up[last]]
        row_ptr[s + 1] = row_ptr[s] + (first[s + 1] - first[s]) + count[last]
        w = offset[first[s + 1]] - offset[first[s]]
        panel_ptr[s + 1] = panel_ptr[s] + w * (w + scalars[last])
    rows = np.empty(row_ptr[S], np.int64)
    sizes = np.zeros(3, np.int64)
    square = np.zeros(S, np.int64)
    pending = np.zeros(S, np.int64)  # update matrices of the children on top of the stack
    height = 0
    for s in range(S):
        q = row_ptr[s]
        for k in range(first[s], first[s + 1]):
            rows[q] = k
            q += 1
        last = first[s + 1] - 1
        for e in range(below_ptr[last], below_ptr[last + 1]):
            rows[q] = below[e]
            q += 1
        w = offset[first[s + 1]] - offset[first[s]]
        sizes[0] = max(sizes[0], w + scalars[last])
        square[s] = scalars[last] ** 2
        height += square[s] - pending[s]
        sizes[1] = max(sizes[1], height + pending[s])
        if above[s] >= 0:
            pending[above[s]] += square[s]
        else:
            height -= square[s]
    sizes[2] = entries
    return new_order, offset, first, above, row_ptr, rows, panel_ptr, sizes


@callee(fastmath={"contract"})
def _eliminate_columns(F: Array, first: int, end: int, r: int) -> int:
    """Cholesky of the columns ``first`` to ``end`` of a front with ``r`` rows, among themselves."""
    for c in range(first, end):
        d = F[c, c]
        if not d > 0.0:
            return c + 1
        d = np.sqrt(d)
        F[c, c] = d
        inverse = 1.0 / d
        for i in range(c + 1, r):
            F[c, i] *= inverse
        for b in range(c + 1, end):
            f = F[c, b]
            for i in range(b, r):
                F[b, i] -= f * F[c, i]
    return 0


@callee(fastmath={"contract"})
def _eliminate(F: Array, w: int, r: int) -> int:
    """Partial Cholesky of the first ``w`` of ``r`` columns of a front, ``F[c, i]`` = row i ≥ c of column c."""
    if r >= LARGE:
        for first in range(0, w, BLOCK):
            end = min(first + BLOCK, w)
            bad = _eliminate_columns(F, first, end, r)
            if bad:
                return bad
            subtract_product(F[first:end, end:r], F[first:end, end:r], F[end:r, end:r], True)
        return 0
    bad = _eliminate_columns(F, 0, w, r)
    if bad:
        return bad
    # Update of the other columns: four at once, to reduce memory access.
    k = 0
    while k + 4 <= w:
        for b in range(w, r):
            f0, f1, f2, f3 = F[k, b], F[k + 1, b], F[k + 2, b], F[k + 3, b]
            for i in range(b, r):
                F[b, i] -= f0 * F[k, i] + f1 * F[k + 1, i] + f2 * F[k + 2, i] + f3 * F[k + 3, i]
        k += 4
    while k < w:
        for b in range(w, r):
            f0 = F[k, b]
            for i in range(b, r):
                F[b, i] -= f0 * F[k, i]
        k += 1
    return 0


class SymbolicAnalysis(NamedTuple):
    """Arrays from :func:`analyse_blocks`."""

    order: Index
    offset: Index
    first: Index
    parent: Index
    row_ptr: Index
    rows: Index
    panel_ptr: Index
    sizes: Index


class BlockMatrix(NamedTuple):
    """A sparse block matrix."""

    ptr: Index
    idx: Index
    """Neighbours as given to :func:`analyse_blocks`; those at an earlier position are skipped (their lists have the
    pair)."""
    block: Index
    """(nb,): offset of each pair's block in ``value``: rows of the node, columns of the neighbour, row-major."""
    value: Array
    """(k,)"""


@njit
def factorise_blocks(analysis: SymbolicAnalysis, matrix: BlockMatrix, damping: float, L: Array) -> int:
    """Numeric factorisation of ``A + damping · diag(A)`` into the panels ``L``.

    Parameters
    ----------
    L : (panel_ptr[-1],)
        Output: all rows of every panel, column by column; entries above the diagonal are undefined.

    Returns
    -------
    int
        0, or 1 + the position of the node whose pivot is not positive.
    """
    order, offset, first, parent, row_ptr, rows, panel_ptr, sizes = analysis
    ptr, idx, block, value = matrix
    N, S = len(order), len(parent)
    position = np.empty(N, np.int64)
    for k in range(N):
        position[order[k]] = k
    local = np.empty(N, np.int64)  # first row of each node in the current front
    front = np.empty(sizes[0] * sizes[0])
    stack = np.empty(sizes[1])
    waiting = np.empty(S, np.int64)  # supernodes whose update matrices are on the stack
    height, top = 0, 0
    for s in range(S):
        a, z = row_ptr[s], row_ptr[s + 1]
        r = 0
        for q in range(a, z):
            local[rows[q]] = r
            r += offset[rows[q] + 1] - offset[rows[q]]
        w = offset[first[s + 1]] - offset[first[s]]
        F = front[: r * r].reshape(r, r)
        F[:] = 0.0
        for k in range(first[s], first[s + 1]):
            i = order[k]
            wi = offset[k + 1] - offset[k]
            for e in range(ptr[i], ptr[i + 1]):
                kj = position[idx[e]]
                if kj < k:
                    continue
                wj = offset[kj + 1] - offset[kj]
                li, lj, v = local[k], local[kj], block[e]
                for p in range(wi):
                    for q in range(wj):
                        F[li + p, lj + q] += value[v + p * wj + q]
        if damping > 0.0:
            for c in range(w):
                F[c, c] *= 1.0 + damping
        while top > 0 and parent[waiting[top - 1]] == s:  # extend-add of the children's update matrices
            t = waiting[top - 1]
            own = first[t + 1] - first[t]
            b, y = row_ptr[t] + own, row_ptr[t + 1]
            n = 0
            for q in range(b, y):
                n += offset[rows[q] + 1] - offset[rows[q]]
            height -= n * n
            U = stack[height : height + n * n].reshape(n, n)
            at = 0
            for q in range(b, y):
                lq = local[rows[q]]
                for u in range(offset[rows[q] + 1] - offset[rows[q]]):
                    to = at
                    for p in range(q, y):
                        lp, wp = local[rows[p]], offset[rows[p] + 1] - offset[rows[p]]
                        for v in range(wp):
                            F[lq + u, lp + v] += U[at + u, to + v]
                        to += wp
                at += offset[rows[q] + 1] - offset[rows[q]]
            top -= 1
        bad = _eliminate(F, w, r)
        if bad:
            c = offset[first[s]] + bad - 1
            k = first[s]
            while offset[k + 1] <= c:
                k += 1
            return 1 + k
        panel = L[panel_ptr[s] : panel_ptr[s + 1]].reshape(w, r)
        panel[:] = F[:w]
        n = r - w
        if parent[s] >= 0:
            U = stack[height : height + n * n].reshape(n, n)
            for c in range(n):
                U[c, c:] = F[w + c, w + c :]
            height += n * n
            waiting[top] = s
            top += 1
    return 0


@njit
def panel_scalars(offset: Index, row_ptr: Index, rows: Index) -> tuple[Index, Index]:
    """Scalars of the rows of every panel: ``(S + 1,)`` and ``(q,)``."""
    S = len(row_ptr) - 1
    start = np.zeros(S + 1, np.int64)
    for s in range(S):
        start[s + 1] = start[s]
        for q in range(row_ptr[s], row_ptr[s + 1]):
            start[s + 1] += offset[rows[q] + 1] - offset[rows[q]]
    out = np.empty(start[S], np.int64)
    k = 0
    for q in range(len(rows)):
        for c in range(offset[rows[q]], offset[rows[q] + 1]):
            out[k] = c
            k += 1
    return start, out
