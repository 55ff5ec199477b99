"""Numba kernels: the pattern of landmark submaps, their Gauss–Newton blocks, and block matrices as CSC. Plain arrays.

Every submap is a list of *entries*: its end pose (3 scalars), then its landmarks (2 each), in the order of its mean and
information matrix. Nodes: end pose of submap k is node k, landmark j node m + j. Submap k starts at node k - 1; the
first starts at the fixed base, which is not a node.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from graphslam.core.jit import callee, njit
from graphslam.graph.normal_kernels import inverse_left_jacobian_kernel

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


@njit
def adjacency(N: int, entry_ptr: Index, entry_node: Index) -> tuple[Index, Index]:
    """Neighbours ``(N + 1,), (nb,)`` of every node, itself first: all nodes of its submaps, and their starts."""
    m = len(entry_ptr) - 1
    count = np.zeros(N + 1, np.int64)
    for k in range(m):
        for e in range(entry_ptr[k], entry_ptr[k + 1]):
            count[entry_node[e] + 1] += 1
        if k:
            count[k] += 1
    start = np.cumsum(count)
    fill = start[:-1].copy()
    inside = np.empty(start[N], np.int64)  # submaps of every node
    for k in range(m):
        if k:
            inside[fill[k - 1]] = k
            fill[k - 1] += 1
        for e in range(entry_ptr[k], entry_ptr[k + 1]):
            inside[fill[entry_node[e]]] = k
            fill[entry_node[e]] += 1
    seen = np.full(N, -1, np.int64)
    ptr = np.zeros(N + 1, np.int64)
    for sweep in range(2):  # count, then write
        if sweep:
            idx = np.empty(ptr[N], np.int64)
            seen[:] = -1
        else:
            idx = np.empty(0, np.int64)
        at = 0
        for i in range(N):
            seen[i] = i
            if sweep:
                idx[at] = i
            at += 1
            for q in range(start[i], start[i + 1]):
                k = inside[q]
                if k and seen[k - 1] != i:
                    seen[k - 1] = i
                    if sweep:
                        idx[at] = k - 1
                    at += 1
                for e in range(entry_ptr[k], entry_ptr[k + 1]):
                    j = entry_node[e]
                    if seen[j] != i:
                        seen[j] = i
                        if sweep:
                            idx[at] = j
                        at += 1
            ptr[i + 1] = at
    return ptr, idx


@njit
def half_blocks(position: Index, width: Index, ptr: Index, idx: Index) -> tuple[Index, Index, int]:
    """Layout of the blocks: every pair is stored once, with the rows of the node that is eliminated first.

    Returns
    -------
    block : (nb,)
        Offset of the block of each listed pair; both directions of a pair share it.
    flip : (nb,)
        1 if the block is stored with the rows of the neighbour.
    """
    block = np.empty(len(idx), np.int64)
    flip = np.zeros(len(idx), np.int64)
    at = 0
    for i in range(len(position)):
        for e in range(ptr[i], ptr[i + 1]):
            if position[idx[e]] >= position[i]:
                block[e] = at
                at += width[i] * width[idx[e]]
    for i in range(len(position)):
        for e in range(ptr[i], ptr[i + 1]):
            j = idx[e]
            if position[j] < position[i]:
                flip[e] = 1
                for f in range(ptr[j], ptr[j + 1]):
                    if idx[f] == i:
                        block[e] = block[f]
                        break
    return block, flip, at


@njit
def entry_slots(
    N: int, entry_ptr: Index, entry_node: Index, pair_ptr: Index, ptr: Index, idx: Index, block: Index, flip: Index
) -> Index:
    """Offset ``(pair_ptr[-1],)`` of the block of every two entries of a submap, -1 if it is stored flipped.

    The list of submap k is a square over ``[start, entries…]``.
    """
    m = len(entry_ptr) - 1
    slot = np.full(pair_ptr[m], -1, np.int64)
    where = np.full(N, -1, np.int64)
    for k in range(m):
        n = entry_ptr[k + 1] - entry_ptr[k] + 1
        for a in range(n):
            i = entry_node[entry_ptr[k] + a - 1] if a else k - 1
            if i < 0:
                continue
            for e in range(ptr[i], ptr[i + 1]):
                where[idx[e]] = -1 if flip[e] else block[e]
            for b in range(n):
                j = entry_node[entry_ptr[k] + b - 1] if b else k - 1
                if j >= 0:
                    slot[pair_ptr[k] + a * n + b] = where[j]
    return slot


@njit
def predict_submaps(
    poses: Array, points: Array, m: int, entry_ptr: Index, entry_node: Index, z: Array, r: Array
) -> None:
    """Residual ``H(X) - z`` of all submaps, in the order of their means (eq. 15)."""
    at = 0
    for k in range(m):
        sx, sy, st = 0.0, 0.0, 0.0
        if k:
            sx, sy, st = poses[k - 1, 0], poses[k - 1, 1], poses[k - 1, 2]
        c, s = np.cos(st), np.sin(st)
        for e in range(entry_ptr[k], entry_ptr[k + 1]):
            j = entry_node[e]
            if j < m:
                dx, dy = poses[j, 0] - sx, poses[j, 1] - sy
            else:
                dx, dy = points[j - m, 0] - sx, points[j - m, 1] - sy
            r[at] = c * dx + s * dy - z[at]
            r[at + 1] = c * dy - s * dx - z[at + 1]
            at += 2
            if j < m:
                turn = poses[j, 2] - st - z[at]
                r[at] = turn - 2.0 * np.pi * np.floor((turn + np.pi) / (2.0 * np.pi))
                at += 1


@njit
def chart_residuals(row_ptr: Index, group: Flags, r: Array) -> None:
    """Convert the differences ``H(X) - z`` of the submaps with ``group`` ``(m,)`` to the group chart, in place."""
    for k in range(len(row_ptr) - 1):
        if not group[k]:
            continue
        first = row_ptr[k]
        a, b, _ = inverse_left_jacobian_kernel(r[first + 2])
        for i in range(row_ptr[k + 1] - first):
            if i == 0 or (i > 2 and i % 2 == 1):
                x, y = r[first + i], r[first + i + 1]
                r[first + i], r[first + i + 1] = a * x + b * y, a * y - b * x


@njit
def submap_chi2(row_ptr: Index, omega: Array, omega_ptr: Index, r: Array, out: Array) -> None:
    """``rᵀ Ω r`` of every submap."""
    for k in range(len(row_ptr) - 1):
        n, a = row_ptr[k + 1] - row_ptr[k], row_ptr[k]
        W = omega[omega_ptr[k] : omega_ptr[k + 1]].reshape(n, n)
        total = 0.0
        for i in range(n):
            v = 0.0
            for j in range(n):
                v += W[i, j] * r[a + j]
            total += v * r[a + i]
        out[k] = total


class SubmapChainArrays(NamedTuple):
    """Arrays of a chain of submaps."""

    entry_ptr: Index
    entry_node: Index
    row_ptr: Index
    """(m + 1,): rows of each in ``z``."""
    z: Array
    """(rows,): measurements."""
    omega: Array
    """… and their offsets."""
    omega_ptr: Index
    """… and where they begin."""
    group: Flags
    """(m,): uses the group chart."""


class SystemSlots(NamedTuple):
    """Offsets of nodes and pairs in the system."""

    node_at: Index
    """(N,): first scalar of each node."""
    pair_ptr: Index
    slot: Index
    """From :func:`entry_slots`."""


U, D, H, WU, WD, WH = range(6)
"""Rows of a submap's work array: residual in its chart (0, 1 end position, 2 end heading, then landmarks), the
Jacobian's columns of the start's and the end's heading, and the products of the three with Ω."""


@callee
def _fill_columns(r: Array, z: Array, group: bool, rows: Array) -> tuple[float, float]:
    """Residual and columns of a submap with Cartesian residual r; ``a, b`` of V⁻¹."""
    va, vb, slope, half = 1.0, 0.0, 0.0, 0.0
    if group:
        va, vb, slope = inverse_left_jacobian_kernel(r[2])
        half = 0.5
    rows[U, 2], rows[D, 2], rows[H, 2] = r[2], -1.0, 1.0
    for e in range((len(r) - 1) // 2):
        i = 0 if e == 0 else 1 + 2 * e
        x, y = r[i], r[i + 1]
        qx, qy = x + z[i], y + z[i + 1]
        rows[U, i], rows[U, i + 1] = va * x + vb * y, va * y - vb * x
        rows[H, i], rows[H, i + 1] = slope * x + half * y, slope * y - half * x
        rows[D, i], rows[D, i + 1] = va * qy - vb * qx - rows[H, i], -va * qx - vb * qy - rows[H, i + 1]
    return va, vb


@callee
def _weigh_columns(W: Array, c: float, s: float, rows: Array, turned: Array) -> tuple[float, float, float]:
    """Products with Ω, rotated by ``T = [c, -s; s, c]``: ``T Ω Tᵀ`` and ``T Ω`` times the columns; rᵀΩr, dᵀΩr, dᵀΩd."""
    n = len(W)
    rr, dd, dr, hh, hd, hr = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        v0, v1, v2 = 0.0, 0.0, 0.0
        for j in range(n):
            v0 += W[i, j] * rows[U, j]
            v1 += W[i, j] * rows[D, j]
            v2 += W[i, j] * rows[H, j]
        rows[WU, i], rows[WD, i], rows[WH, i] = v0, v1, v2
        rr += v0 * rows[U, i]
        dr += v0 * rows[D, i]
        hr += v0 * rows[H, i]
        dd += v1 * rows[D, i]
        hd += v1 * rows[H, i]
        hh += v2 * rows[H, i]
    entries = (n - 1) // 2
    for e in range(entries):  # rows first, then columns
        i = 0 if e == 0 else 1 + 2 * e
        for j in range(n):
            turned[i, j] = c * W[i, j] - s * W[i + 1, j]
            turned[i + 1, j] = s * W[i, j] + c * W[i + 1, j]
    for i in range(n):
        for e in range(entries):
            j = 0 if e == 0 else 1 + 2 * e
            x, y = turned[i, j], turned[i, j + 1]
            turned[i, j], turned[i, j + 1] = c * x - s * y, s * x + c * y
    for e in range(entries):
        i = 0 if e == 0 else 1 + 2 * e
        for w in range(WU, WH + 1):
            x, y = rows[w, i], rows[w, i + 1]
            rows[w, i], rows[w, i + 1] = c * x - s * y, s * x + c * y
    rows[WU, 2], rows[WD, 2], rows[WH, 2] = hr, hd, hh
    for j in range(n):
        turned[2, j] = turned[j, 2] = rows[WH, j]
    return rr, dr, dd


@callee
def _add_entries(slots: Index, at: Index, rows: Array, turned: Array, g: Array, value: Array) -> tuple[float, float]:
    """Add gradient and blocks of a submap's entries, with offsets ``at``; returns the sum of their gradients."""
    gx, gy = 0.0, 0.0
    for e in range(len(at)):
        i = 0 if e == 0 else 1 + 2 * e
        wi = 3 if e == 0 else 2
        for p in range(wi):
            g[at[e] + p] += rows[WU, i + p]
        gx += rows[WU, i]
        gy += rows[WU, i + 1]
        for o in range(len(at)):
            v = slots[e + 1, o + 1]
            if v >= 0:
                j = 0 if o == 0 else 1 + 2 * o
                wj = 3 if o == 0 else 2
                for p in range(wi):
                    for q in range(wj):
                        value[v + p * wj + q] += turned[i + p, j + q]
    return gx, gy


@callee
def _add_start(slots: Index, rows: Array, turned: Array, dd: float, value: Array) -> None:
    """Add the block of a submap's start, and its blocks with every entry: translation, then heading."""
    entries = len(slots) - 1
    sxx, sxy, syy, sxt, syt = 0.0, 0.0, 0.0, 0.0, 0.0
    for e in range(entries):
        i = 0 if e == 0 else 1 + 2 * e
        wi = 3 if e == 0 else 2
        one, other = slots[0, e + 1], slots[e + 1, 0]
        for p in range(wi):
            tx, ty = 0.0, 0.0
            for o in range(entries):
                j = 0 if o == 0 else 1 + 2 * o
                tx -= turned[j, i + p]
                ty -= turned[j + 1, i + p]
            if p == 0:
                sxx -= tx
            elif p == 1:
                sxy -= tx
                syy -= ty
            if one >= 0:
                value[one + p] += tx
                value[one + wi + p] += ty
                value[one + 2 * wi + p] += rows[WD, i + p]
            else:
                value[other + 3 * p] += tx
                value[other + 3 * p + 1] += ty
                value[other + 3 * p + 2] += rows[WD, i + p]
        sxt -= rows[WD, i]
        syt -= rows[WD, i + 1]
    own = slots[0, 0]
    for p, v in enumerate((sxx, sxy, sxt, sxy, syy, syt, sxt, syt, dd)):
        value[own + p] += v


@njit
def linearise_submaps(
    poses: Array, submaps: SubmapChainArrays, where: SystemSlots, r: Array, g: Array, value: Array
) -> float:
    """Objective; adds ``JᵀΩr`` to ``g`` and the blocks of ``JᵀΩJ`` to ``value``.

    The Jacobian of a position is ``V(d)⁻¹ Rᵀ``, where d is the residual of the end heading (V = I in a Cartesian
    chart), so a block ``W`` of Ω enters as ``T W Tᵀ`` with ``T = R V⁻ᵀ``; the end heading enters by its own row and by
    V. The translation columns of the start are minus the sum of those of all positions.

    Parameters
    ----------
    poses : (m, 3)
    r : (rows,)
        ``H(X) - z`` of every submap in Cartesian coordinates.
    g, value
        Output.
    """
    entry_ptr, entry_node, row_ptr, z, omega, omega_ptr, group = submaps
    node_at, pair_ptr, slot = where
    m = len(poses)
    f = 0.0
    most = 0
    for k in range(m):
        most = max(most, row_ptr[k + 1] - row_ptr[k])
    room, turned = np.empty((6, most)), np.empty((most, most))
    for k in range(m):
        rows = slice(row_ptr[k], row_ptr[k + 1])
        n, entries = row_ptr[k + 1] - row_ptr[k], entry_ptr[k + 1] - entry_ptr[k]
        W = omega[omega_ptr[k] : omega_ptr[k + 1]].reshape(n, n)
        va, vb = _fill_columns(r[rows], z[rows], group[k], room)
        st = poses[k - 1, 2] if k else 0.0
        c, s = np.cos(st), np.sin(st)
        rr, dr, dd = _weigh_columns(W, c * va - s * vb, s * va + c * vb, room, turned)
        f += rr
        slots = slot[pair_ptr[k] : pair_ptr[k + 1]].reshape(entries + 1, entries + 1)
        gx, gy = _add_entries(slots, node_at[entry_node[entry_ptr[k] : entry_ptr[k + 1]]], room, turned, g, value)
        if k:
            at = node_at[k - 1]
            g[at] -= gx
            g[at + 1] -= gy
            g[at + 2] += dr
            _add_start(slots, room, turned, dd, value)
    return f


@njit
def to_csc(
    nodes: Index, width: Index, ptr: Index, idx: Index, block: Index, flip: Index, value: Array
) -> tuple[Index, Index, Array]:
    """``indptr, indices, data`` of a block matrix with its nodes in the order ``nodes`` ``(N,)``; indices ascend.

    Every pair is in both lists; ``flip`` ``(nb,)`` is 1 if the block has the neighbour's rows.
    """
    N = len(nodes)
    first = np.empty(N, np.int64)
    n = 0
    for i in nodes:
        first[i] = n
        n += width[i]
    indptr = np.zeros(n + 1, np.int64)
    for i in range(N):
        for e in range(ptr[i], ptr[i + 1]):
            for q in range(width[idx[e]]):
                indptr[first[idx[e]] + q + 1] += width[i]
    for c in range(n):
        indptr[c + 1] += indptr[c]
    fill = indptr[:-1].copy()
    indices = np.empty(indptr[n], np.int64)
    data = np.empty(indptr[n])
    for i in nodes:  # rows ascending, so that every column is filled in order
        wi = width[i]
        for p in range(wi):
            for e in range(ptr[i], ptr[i + 1]):
                wj = width[idx[e]]
                for q in range(wj):
                    c = first[idx[e]] + q
                    indices[fill[c]] = first[i] + p
                    data[fill[c]] = value[block[e] + (q * wi + p if flip[e] else p * wj + q)]
                    fill[c] += 1
    return indptr, indices, data
