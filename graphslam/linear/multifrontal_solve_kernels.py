"""Numba kernels: solutions and entries of the inverse from a multifrontal factor. Plain arrays only.

Scalars are numbered in elimination order; ``start`` and ``row`` list the rows of each panel.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from graphslam.core.jit import callee, njit
from graphslam.linear.multifrontal_kernels import LARGE
from graphslam.linear.product_kernels import BLOCK, subtract_product

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


@njit
def solve_lower(own: Index, start: Index, row: Index, panel_ptr: Index, L: Array, x: Array) -> None:
    """``x ← L⁻¹ x`` for ``x`` ``(n,)``; ``own`` ``(S + 1,)`` is the first scalar of every supernode."""
    for s in range(len(own) - 1):
        w, r, at = own[s + 1] - own[s], start[s + 1] - start[s], start[s]
        P = L[panel_ptr[s] : panel_ptr[s + 1]].reshape(w, r)
        for c in range(w):
            v = x[own[s] + c] / P[c, c]
            x[own[s] + c] = v
            for i in range(c + 1, r):
                x[row[at + i]] -= P[c, i] * v


@njit
def solve_upper(own: Index, start: Index, row: Index, panel_ptr: Index, L: Array, x: Array) -> None:
    """``x ← L⁻ᵀ x`` for ``x`` ``(n,)``."""
    for s in range(len(own) - 2, -1, -1):
        w, r, at = own[s + 1] - own[s], start[s + 1] - start[s], start[s]
        P = L[panel_ptr[s] : panel_ptr[s + 1]].reshape(w, r)
        for c in range(w - 1, -1, -1):
            v = x[own[s] + c]
            for i in range(c + 1, r):
                v -= P[c, i] * x[row[at + i]]
            x[own[s] + c] = v / P[c, c]


@njit(nogil=True, fastmath={"contract"})
def solve_lower_units(
    own: Index, start: Index, row: Index, parent: Index, panel_ptr: Index, L: Array, unit: Index, J: Array
) -> tuple[Array, Index]:
    """``L⁻¹ E J`` for unit columns E at ``unit`` ``(m,)`` and ``J (m, k)``: its nonzero rows, and their indices.

    Only the supernodes from a unit's own to the root are visited.
    """
    S, k = len(own) - 1, J.shape[1]
    visited = np.zeros(S, np.bool_)
    count = 0
    for u in unit:
        s = np.searchsorted(own, u, side="right") - 1
        while s >= 0 and not visited[s]:
            visited[s] = True
            count += own[s + 1] - own[s]
            s = parent[s]
    place = np.full(own[S], -1, np.int64)
    which = np.empty(count, np.int64)
    n = 0
    for s in range(S):
        if visited[s]:
            for c in range(own[s], own[s + 1]):
                place[c] = n
                which[n] = c
                n += 1
    W = np.zeros((count, k))
    for j in range(len(unit)):
        W[place[unit[j]]] += J[j]
    for s in range(S):
        if not visited[s]:
            continue
        w, r, at = own[s + 1] - own[s], start[s + 1] - start[s], start[s]
        P = L[panel_ptr[s] : panel_ptr[s + 1]].reshape(w, r)
        for c in range(w):
            v = W[place[own[s] + c]]
            inverse = 1.0 / P[c, c]
            for j in range(k):
                v[j] *= inverse
            for i in range(c + 1, r):
                f = P[c, i]
                y = W[place[row[at + i]]]
                for j in range(k):
                    y[j] -= f * v[j]
    return W, which


class FactorPanels(NamedTuple):
    """Arrays of a factor."""

    own: Index
    start: Index
    row: Index
    parent: Index
    panel_ptr: Index
    L: Array


@callee(fastmath={"contract"})
def _solve_upper(P: Array, X: Array, first: int, end: int) -> None:
    """``X ← L⁻ᵀ X`` for the columns ``first`` to ``end`` of a panel, and the same rows of ``X`` ``(w, m)``."""
    for c in range(end - 1, first - 1, -1):
        for b in range(c + 1, end):
            f = P[c, b]
            for i in range(X.shape[1]):
                X[c, i] -= f * X[b, i]
        inverse = 1.0 / P[c, c]
        for i in range(X.shape[1]):
            X[c, i] *= inverse


@njit(fastmath={"contract"})
def inverse_diagonal(panels: FactorPanels, begin: Index, width: int, most: int) -> Array:
    """Diagonal blocks of the inverse without the rest of it (selected inversion, from the root down).

    With a panel's own scalars S and those below R, ``Y = L_RS L_SS⁻¹``: ``Z_RS = -Z_RR Y`` and
    ``Z_SS = L_SS⁻ᵀ L_SS⁻¹ - Yᵀ Z_RS``; ``Z_RR`` is inside the front of the parent, which is kept until all its children
    are processed.

    Parameters
    ----------
    begin : (k,)
        First scalar of each block; a block is inside one supernode.
    width : int
        Scalars of a block.
    most : int
        Most rows of a front.

    Returns
    -------
    (k, width, width)
    """
    own, start, row, parent, panel_ptr, L = panels
    S = len(own) - 1
    out = np.zeros((len(begin), width, width))
    by_super = np.argsort(begin)
    left = np.zeros(S, np.int64)  # remaining children
    for s in range(S):
        if parent[s] >= 0:
            left[parent[s]] += 1
    base = np.zeros(S, np.int64)  # offset of the front of s on the stack
    stack = np.empty(4 * most * most)
    height, q = 0, len(begin) - 1
    local = np.empty(own[S], np.int64)
    for s in range(S - 1, -1, -1):
        w, r, at = own[s + 1] - own[s], start[s + 1] - start[s], start[s]
        n = r - w
        P = L[panel_ptr[s] : panel_ptr[s + 1]].reshape(w, r)
        if height + r * r > len(stack):
            stack = np.concatenate((stack[:height], np.empty(2 * len(stack) + r * r - height)))
        base[s] = height
        Z = stack[height : height + r * r].reshape(r, r)
        height += r * r
        if parent[s] >= 0:
            t = parent[s]
            rt = start[t + 1] - start[t]
            T = stack[base[t] : base[t] + rt * rt].reshape(rt, rt)
            for i in range(rt):
                local[row[start[t] + i]] = i
            for i in range(n):
                li = local[row[at + w + i]]
                for j in range(n):
                    Z[w + i, w + j] = T[li, local[row[at + w + j]]]
        X = np.zeros((w, n + w))  # L_SS⁻ᵀ (L_RSᵀ, I): Yᵀ, and the inverse of L_SS, upper
        X[:, :n] = P[:, w:]
        for c in range(w):
            X[c, n + c] = 1.0
        if r < LARGE:
            _solve_upper(P, X, 0, w)
            for c in range(w):
                for i in range(n):
                    v = 0.0
                    for j in range(n):
                        v -= Z[w + i, w + j] * X[c, j]
                    Z[c, w + i] = v
                    Z[w + i, c] = v
            for c in range(w):
                for b in range(c, w):
                    v = 0.0
                    for d in range(b, w):
                        v += X[c, n + d] * X[b, n + d]
                    for i in range(n):
                        v -= X[c, i] * Z[b, w + i]
                    Z[c, b] = v
                    Z[b, c] = v
        else:
            for end in range(w, 0, -BLOCK):
                b = max(0, end - BLOCK)
                if end < w:
                    subtract_product(P[b:end, end:w].T, X[end:w], X[b:end], False)
                _solve_upper(P, X, b, end)
            Z[:w] = 0.0
            subtract_product(X[:, :n].T, Z[w:, w:], Z[:w, w:], False)
            subtract_product(-X[:, n:].T, X[:, n:].T, Z[:w, :w], True)
            subtract_product(X[:, :n].T, Z[:w, w:].T, Z[:w, :w], True)
            for c in range(w):
                for i in range(c + 1, r):
                    Z[i, c] = Z[c, i]
        while q >= 0 and begin[by_super[q]] >= own[s]:
            k = by_super[q]
            for i in range(width):
                for j in range(width):
                    out[k, i, j] = Z[begin[k] - own[s] + i, begin[k] - own[s] + j]
            q -= 1
        t = s
        while t >= 0 and left[t] == 0:
            height = base[t]
            t = parent[t]
            if t >= 0:
                left[t] -= 1
    return out
