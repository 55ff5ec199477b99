"""Numba kernel: one join of two maps in information form. Plain arrays only.

Maps are block matrices over nodes: a pose is (x, y, θ), a landmark (x, y); a pose node is 3 wide, a landmark 2. Every
pair of neighbours is stored both ways, each with the rows of the node whose list it is in.
"""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


class BlockMap(NamedTuple):
    """A map in information form."""

    x: Array
    """(n,): mean."""
    width: Index
    """(N,): of the nodes."""
    ptr: Index
    """(N + 1,): neighbour lists."""
    idx: Index
    block: Index
    """Where the blocks of each list begin in ``value``; they stand one after the other."""
    value: Array


@nb.njit(cache=True)
def join_blocks(
    known: BlockMap, new: BlockMap, image: Index, start: int, rounding: float
) -> tuple[Array, Index, Index, Index, Index, Array, Array, bool]:
    """Add map B, seen from node ``start`` of map A, to A (eq. 15–16).

    Parameters
    ----------
    known, new : BlockMap
        A, and B in the frame of ``start``.
    image : (N_b,)
        Node of the joined map that each node of B is: a landmark of A, or N and above for what is new.
    start : int
        The pose of A where B begins.
    rounding : float
        Innovations smaller than this, relative to 1 + the value, are arithmetic and count as zero.

    Returns
    -------
    x, width, ptr, idx, block, value
        Joined map before the update of its mean.
    gradient : (n,)
        ``∇Hᵀ I_B (z - H(X))`` there.
    news : bool
        Whether it differs from zero.
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
    at = np.zeros(total + 1, np.int64)
    b_at = np.zeros(NB + 1, np.int64)
    for i in range(total):
        at[i + 1] = at[i] + new_width[i]
    for b in range(NB):
        b_at[b + 1] = b_at[b] + b_width[b]
    out = np.empty(at[total])
    out[: len(x)] = x
    sx, sy, st = x[at[start]], x[at[start] + 1], x[at[start] + 2]
    c, s = np.cos(st), np.sin(st)

    # What is new takes its first value from B; what is known gives an innovation. M is the Jacobian of the start.
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

    # I_B (ν, M), turned into the frame of A
    gradient = np.zeros(at[total])
    V = np.zeros((n, 3))
    own = np.zeros((3, 3))
    gs = np.zeros(3)
    for b in range(NB):
        v, wb = b_at[b], b_width[b]
        u = np.zeros(3)
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

    # Lists and blocks of the joined map, row by row. Rows of A that B does not touch are copied whole, and in rows of
    # new nodes every neighbour is new; only rows that both have a part in must look up what stands there already.
    room = len(idx) + len(b_idx) + 2 * NB + 1
    new_ptr = np.zeros(total + 1, np.int64)
    new_idx = np.empty(room, np.int64)
    new_block = np.empty(room, np.int64)
    new_value = np.empty(len(value) + len(b_value) + 6 * n + 9)
    where = np.full(total, -1, np.int64)  # entry of each neighbour in the list of the row at hand
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


@nb.njit(cache=True)
def cut_into_blocks(A: Array, width: Index) -> Array:
    """A dense matrix ``(n, n)`` as row-major blocks, one row of nodes after the other ``(n²,)``."""
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


@nb.njit(cache=True)
def both_ways(width: Index, ptr: Index, idx: Index, block: Index, flip: Index, value: Array) -> tuple[Index, Array]:
    """Blocks that are stored once for each pair (``flip`` = 1: with the neighbour's rows) as blocks stored both ways.

    Returns
    -------
    block : (nb,); value : (k,)
        As in :func:`join_blocks`.
    """
    total = 0
    for i in range(len(width)):
        for e in range(ptr[i], ptr[i + 1]):
            total += width[i] * width[idx[e]]
    out_block = np.empty(len(idx), np.int64)
    out = np.empty(total)
    k = 0
    for i in range(len(width)):
        wi = width[i]
        for e in range(ptr[i], ptr[i + 1]):
            wj, v = width[idx[e]], block[e]
            out_block[e] = k
            for p in range(wi):
                for q in range(wj):
                    out[k] = value[v + q * wi + p] if flip[e] else value[v + p * wj + q]
                    k += 1
    return out_block, out
