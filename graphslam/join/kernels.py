"""Numba kernels: join of two maps in information form. Plain arrays only.

Maps are block matrices over nodes: a pose is (x, y, θ), a landmark (x, y); Every pair of neighbours is stored twice,
each block with the rows of the list's node.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from graphslam.core.jit import callee, njit
from graphslam.graph.normal_kernels import inverse_left_jacobian_kernel

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


class BlockMap(NamedTuple):
    """A map in information form."""

    x: Array
    """(n,): mean."""
    width: Index
    """(N,): scalars per node."""
    ptr: Index
    """(N + 1,): neighbour lists."""
    idx: Index
    block: Index
    """Offsets of the blocks of each list in ``value``; they are consecutive."""
    value: Array


@callee
def _begin_of(width: Index) -> Index:
    """Offset of each node among the scalars, and their total ``(N + 1,)``."""
    at = np.zeros(len(width) + 1, np.int64)
    at[1:] = np.cumsum(width)
    return at


@njit
def join_blocks(
    known: BlockMap, new: BlockMap, image: Index, start: int, rounding: float, pull: Array
) -> tuple[Array, Index, Index, Index, Index, Array, Array, bool]:
    """Add map B, seen from node ``start`` of map A, to A (eq. 15–16).

    Parameters
    ----------
    known, new : BlockMap
        A, and B in the frame of ``start``.
    image : (N_b,)
        Node of the joined map for each node of B: a landmark of A, or at least N for new nodes.
    start : int
        The pose of A that is the base of B.
    rounding : float
        Innovations smaller than this, relative to 1 + the value, are rounding errors and count as zero.
    pull : (n_b,)
        Added to ``I_B ν``: the negative gradient of a relinearised map (:func:`relinearise_in_chart`).

    Returns
    -------
    x, width, ptr, idx, block, value
        Joined map before the update of its mean.
    gradient : (n,)
        ``∇Hᵀ (I_B (z - H(X)) + pull)`` there.
    news : bool
        Whether an innovation differs from zero.
    """
    x, width, ptr, idx, block, value = known
    z, b_width, b_ptr, b_idx, b_block, b_value = new
    N, NB = len(width), len(b_width)
    total = N
    for b in range(NB):
        if image[b] >= N:
            total += 1
    new_width = np.empty(total, np.int64)
    new_width[:N] = width
    source = np.full(total, -1, np.int64)  # node of B behind each node
    for b in range(NB):
        new_width[image[b]] = b_width[b]
        source[image[b]] = b
    at, b_at = _begin_of(new_width), _begin_of(b_width)
    out = np.empty(at[total])
    out[: len(x)] = x
    sx, sy, st = x[at[start]], x[at[start] + 1], x[at[start] + 2]
    c, s = np.cos(st), np.sin(st)

    # New nodes get their value from B; known ones give an innovation. M is the Jacobian with respect to the start.
    n = b_at[NB]
    nu = np.zeros(n)
    M = np.zeros((n, 3))
    news = False
    for b in range(NB):
        v, i = b_at[b], at[image[b]]
        if image[b] >= N:
            out[i] = sx + c * z[v] - s * z[v + 1]
            out[i + 1] = sy + s * z[v] + c * z[v + 1]
            qx, qy = z[v], z[v + 1]
            if b_width[b] == 3:
                out[i + 2] = st + z[v + 2]
        else:
            dx, dy = out[i] - sx, out[i + 1] - sy
            qx, qy = c * dx + s * dy, c * dy - s * dx
            nu[v], nu[v + 1] = z[v] - qx, z[v + 1] - qy
            for p in range(2):
                if abs(nu[v + p]) < rounding * (1.0 + abs(z[v + p])):
                    nu[v + p] = 0.0
                else:
                    news = True
        M[v, 0], M[v, 1], M[v, 2] = -c, -s, qy
        M[v + 1, 0], M[v + 1, 1], M[v + 1, 2] = s, -c, -qx
        if b_width[b] == 3:
            M[v + 2, 2] = -1.0

    # I_B (ν, M), rotated into the frame of A
    gradient = np.zeros(at[total])
    V = np.zeros((n, 3))
    own = np.zeros((3, 3))
    gs = np.zeros(3)
    for b in range(NB):
        v, wb = b_at[b], b_width[b]
        u = np.zeros(3)
        for p in range(wb):
            u[p] = pull[v + p]
        for e in range(b_ptr[b], b_ptr[b + 1]):
            h, wh, k = b_at[b_idx[e]], b_width[b_idx[e]], b_block[e]
            for p in range(wb):
                for q in range(wh):
                    f = b_value[k + p * wh + q]
                    u[p] += f * nu[h + q]
                    for d in range(3):
                        V[v + p, d] += f * M[h + q, d]
        for p in range(wb):
            for d in range(3):
                gs[d] += M[v + p, d] * u[p]
                for d2 in range(3):
                    own[d, d2] += M[v + p, d] * V[v + p, d2]
        i = at[image[b]]
        gradient[i] += c * u[0] - s * u[1]
        gradient[i + 1] += s * u[0] + c * u[1]
        if wb == 3:
            gradient[i + 2] += u[2]
        for d in range(3):
            f, g = V[v, d], V[v + 1, d]
            V[v, d], V[v + 1, d] = c * f - s * g, s * f + c * g
    for d in range(3):
        gradient[at[start] + d] += gs[d]

    # Lists and blocks of the joined map, row by row. Rows of A without part of B are copied, and in rows of new nodes
    # every neighbour is new; only rows of both need a lookup of existing entries.
    room = len(idx) + len(b_idx) + 2 * NB + 1
    new_ptr = np.zeros(total + 1, np.int64)
    new_idx = np.empty(room, np.int64)
    new_block = np.empty(room, np.int64)
    new_value = np.empty(len(value) + len(b_value) + 6 * n + 9)
    where = np.full(total, -1, np.int64)  # entry of each neighbour in the current row's list
    e, k = 0, 0
    T = np.empty((3, 3))
    for i in range(total):
        wi, first, b = new_width[i], e, source[i]
        if i < N:
            f0, f1 = ptr[i], ptr[i + 1]
            shared = b >= 0 or i == start
            size = 0
            for f in range(f0, f1):
                j = idx[f]
                new_idx[e], new_block[e] = j, k + block[f] - block[f0]
                if shared:
                    where[j] = e
                e += 1
                size += wi * width[j]
            for p in range(size):
                new_value[k + p] = value[block[f0] + p]
            k += size
        if b >= 0:
            for f in range(b_ptr[b], b_ptr[b + 1]):
                j, wj, v = image[b_idx[f]], b_width[b_idx[f]], b_block[f]
                fresh = i >= N or where[j] < first
                if fresh:
                    new_idx[e], new_block[e] = j, k
                    where[j] = e
                    to = k
                    e += 1
                    k += wi * wj
                else:
                    to = new_block[where[j]]
                for q in range(wj):  # T_b W T_jᵀ: rows, then columns
                    fx, fy = b_value[v + q], b_value[v + wj + q]
                    T[0, q], T[1, q] = c * fx - s * fy, s * fx + c * fy
                    if wi == 3:
                        T[2, q] = b_value[v + 2 * wj + q]
                for p in range(wi):
                    fx, fy = T[p, 0], T[p, 1]
                    gx, gy = c * fx - s * fy, s * fx + c * fy
                    at_p = to + p * wj
                    if fresh:
                        new_value[at_p], new_value[at_p + 1] = gx, gy
                        if wj == 3:
                            new_value[at_p + 2] = T[p, 2]
                    else:
                        new_value[at_p] += gx  # only landmarks are in both maps: two columns
                        new_value[at_p + 1] += gy
            fresh = i >= N or where[start] < first
            if fresh:
                new_idx[e], new_block[e] = start, k
                where[start] = e
                to = k
                e += 1
                k += 3 * wi
            else:
                to = new_block[where[start]]
            for p in range(wi):
                for d in range(3):
                    old = 0.0 if fresh else new_value[to + 3 * p + d]
                    new_value[to + 3 * p + d] = old + V[b_at[b] + p, d]
        if i == start:
            for h in range(NB):
                j, wj = image[h], b_width[h]
                if where[j] < first:
                    new_idx[e], new_block[e] = j, k
                    where[j] = e
                    for p in range(3 * wj):
                        new_value[k + p] = 0.0
                    e += 1
                    k += 3 * wj
                to = new_block[where[j]]
                for p in range(wj):
                    for d in range(3):
                        new_value[to + d * wj + p] += V[b_at[h] + p, d]
            to = new_block[where[start]]
            for d in range(3):
                for d2 in range(3):
                    new_value[to + 3 * d + d2] += own[d, d2]
        new_ptr[i + 1] = e
    return out, new_width, new_ptr, new_idx[:e].copy(), new_block[:e].copy(), new_value[:k].copy(), gradient, news


@njit
def predict_nodes(known: BlockMap, new: BlockMap, image: Index, start: int, values: Array) -> Array:
    """``H(X)``: the nodes of map B ``(n_b,)`` as seen from node ``start`` of the joined map at its ``values`` ``(n,)``.

    On the first call ``values`` has only the nodes of A; new nodes then have their values of B.
    """
    N = len(known.width)
    at = np.zeros(len(image) + N + 1, np.int64)
    n = 0
    for i in range(N):
        at[i] = n
        n += known.width[i]
    for b in range(len(image)):
        if image[b] >= N:
            at[image[b]] = new.width[b]
    for i in range(N, len(at)):
        w = at[i]
        at[i] = n
        n += w
    sx, sy, st = values[at[start]], values[at[start] + 1], values[at[start] + 2]
    c, s = np.cos(st), np.sin(st)
    out = new.x.copy()
    v = 0
    for b in range(len(image)):
        i = at[image[b]]
        if i < len(values):
            dx, dy = values[i] - sx, values[i + 1] - sy
            out[v], out[v + 1] = c * dx + s * dy, c * dy - s * dx
            if new.width[b] == 3:
                out[v + 2] = values[i + 2] - st
        v += new.width[b]
    return out


@callee
def _arcs(m: BlockMap, anchor: Index, x: Array) -> tuple[Array, Array]:
    """``a, b`` of V⁻¹ and the column of the anchor's heading ``(N, 4)`` of each node at x; gradient ``Jᵀ I u``."""
    mean, width, ptr, idx, block, value = m
    N = len(width)
    at = _begin_of(width)
    arc = np.empty((N, 4))
    u = np.empty(at[N])
    for i in range(N):
        k, p = at[i], at[anchor[i]] + 2
        d = x[p] - mean[p]
        d -= 2.0 * np.pi * np.floor((d + np.pi) / (2.0 * np.pi))
        a, b, slope = inverse_left_jacobian_kernel(d)
        ex, ey = x[k] - mean[k], x[k + 1] - mean[k + 1]
        arc[i] = a, b, slope * ex + 0.5 * ey, slope * ey - 0.5 * ex
        u[k], u[k + 1] = a * ex + b * ey, a * ey - b * ex
        if width[i] == 3:
            u[k + 2] = d

    gradient = np.zeros(at[N])
    for i in range(N):
        k, wi = at[i], width[i]
        y0, y1, y2 = 0.0, 0.0, 0.0
        for e in range(ptr[i], ptr[i + 1]):
            j, f = at[idx[e]], block[e]
            wj = width[idx[e]]
            for q in range(wj):
                y0 += value[f + q] * u[j + q]
                y1 += value[f + wj + q] * u[j + q]
                if wi == 3:
                    y2 += value[f + 2 * wj + q] * u[j + q]
        a, b, hx, hy = arc[i]
        gradient[k] += a * y0 - b * y1
        gradient[k + 1] += b * y0 + a * y1
        gradient[at[anchor[i]] + 2] += hx * y0 + hy * y1 + y2
    return arc, gradient


@callee
def _nodes_on_poses(anchor: Index) -> tuple[Index, Index]:
    """Nodes with anchor i: ``hanging[begin[i] : begin[i + 1]]``."""
    N = len(anchor)
    begin = np.zeros(N + 1, np.int64)
    for i in range(N):
        if anchor[i] != i:
            begin[anchor[i] + 1] += 1
    for i in range(N):
        begin[i + 1] += begin[i]
    fill = begin[:-1].copy()
    attached = np.empty(begin[N], np.int64)
    for i in range(N):
        if anchor[i] != i:
            attached[fill[anchor[i]]] = i
            fill[anchor[i]] += 1
    return begin, attached


@njit
def relinearise_in_chart(m: BlockMap, anchor: Index, x: Array) -> tuple[BlockMap, Array]:
    """Gauss–Newton system, at other values, of a map that is Gaussian in the group chart about its mean.

    With u the chart's difference of ``x`` from the mean (:mod:`graphslam.core.charts`) and J its derivative, the
    objective is ``uᵀ I u``: its matrix at x is ``Jᵀ I J`` and its gradient ``Jᵀ I u``. A node moves along the arc of
    its anchor's heading, so the anchor's column couples with all neighbours of the node.

    Parameters
    ----------
    anchor : (N,)
        Anchor pose of each node; of a pose itself.
    x : (n,)

    Returns
    -------
    BlockMap
        At ``x``.
    gradient : (n,)
    """
    _, width, ptr, idx, block, value = m
    N = len(width)
    arc, gradient = _arcs(m, anchor, x)
    begin, attached = _nodes_on_poses(anchor)
    new_ptr = np.zeros(N + 1, np.int64)
    seen = np.full(N, -1, np.int64)
    room = 0
    for sweep in range(2):  # count, then write
        if sweep:
            new_idx = np.empty(new_ptr[N], np.int64)
            new_block = np.empty(new_ptr[N], np.int64)
            out = np.zeros(room)
            seen[:] = -1
        else:
            new_idx, new_block, out = np.empty(N, np.int64), np.empty(0, np.int64), np.empty(0)
        e, k = 0, 0
        for r in range(N):
            first = e
            wr = width[r]
            base = e if sweep else 0  # while counting, only one row is stored
            count = 0
            for part in range(-1, begin[r + 1] - begin[r]):
                i = r if part < 0 else attached[begin[r] + part]
                for f in range(ptr[i], ptr[i + 1]):
                    j = idx[f]
                    if seen[j] < first:
                        seen[j] = first + count
                        new_idx[base + count] = j
                        count += 1
            direct = count
            for c in range(direct):
                j = anchor[new_idx[base + c]]
                if seen[j] < first:
                    seen[j] = first + count
                    new_idx[base + count] = j
                    count += 1
            e += count
            new_ptr[r + 1] = e
            if not sweep:
                for c in range(count):
                    room += wr * width[new_idx[c]]
                continue
            for c in range(first, e):
                new_block[c] = k
                k += wr * width[new_idx[c]]
            # Jᵀ I: rows of the node, then the heading row from all nodes with this anchor
            a, b, hx, hy = arc[r]
            for f in range(ptr[r], ptr[r + 1]):
                wj, v, t = width[idx[f]], block[f], new_block[seen[idx[f]]]
                for q in range(wj):
                    y0, y1 = value[v + q], value[v + wj + q]
                    out[t + q], out[t + wj + q] = a * y0 - b * y1, b * y0 + a * y1
                    if wr == 3:
                        out[t + 2 * wj + q] = value[v + 2 * wj + q] + hx * y0 + hy * y1
            for h in range(begin[r], begin[r + 1]):
                i = attached[h]
                hx, hy = arc[i, 2], arc[i, 3]
                for f in range(ptr[i], ptr[i + 1]):
                    wj, v, t = width[idx[f]], block[f], new_block[seen[idx[f]]]
                    for q in range(wj):
                        out[t + 2 * wj + q] += hx * value[v + q] + hy * value[v + wj + q]
            # times J: the same by columns
            for c in range(first, first + direct):
                j = new_idx[c]
                wj, t = width[j], new_block[c]
                a, b, hx, hy = arc[j]
                to = new_block[seen[anchor[j]]] + 2
                for p in range(wr):
                    y0, y1 = out[t + p * wj], out[t + p * wj + 1]
                    out[to + 3 * p] += hx * y0 + hy * y1
                    out[t + p * wj], out[t + p * wj + 1] = a * y0 - b * y1, b * y0 + a * y1
    return BlockMap(x, width, new_ptr, new_idx, new_block, out), gradient


@njit
def cut_into_blocks(A: Array, width: Index) -> Array:
    """Convert a dense matrix ``(n, n)`` to row-major blocks, by rows of nodes ``(n²,)``."""
    out = np.empty(A.size)
    k, r = 0, 0
    for i in range(len(width)):
        c = 0
        for j in range(len(width)):
            for p in range(width[i]):
                for q in range(width[j]):
                    out[k] = A[r + p, c + q]
                    k += 1
            c += width[j]
        r += width[i]
    return out
