"""Numba kernels: Gauss-Newton blocks of landmark submaps, and their assembly. Plain arrays only."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from graphslam.core.jit import callee, njit

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


@callee
def inverse_left_jacobian_kernel(d: float) -> tuple[float, float, float]:
    """``a``, ``b``, ``da/dd`` of ``V(d)⁻¹ = a I - b S`` (:mod:`graphslam.core.charts`)."""
    h = 0.5 * d
    if abs(h) < 1e-3:
        return 1.0 - h * h / 3.0 - h**4 / 45.0, h, -h / 3.0 - 2.0 * h**3 / 45.0
    c, s = np.cos(h), np.sin(h)
    return h * c / s, h, 0.5 * (c / s - h / (s * s))


class SubmapFactorArrays(NamedTuple):
    """Landmark submaps in flat arrays."""

    start: Index
    """(S,): start node of each."""
    entry_offset: Index
    """(S + 1,)"""
    entry_row: Index
    """(E,): rows of the points."""
    z: Array
    """Measurements, flat …"""
    z_offset: Index
    """… with their offsets."""
    info: Array
    """Information matrices, flat and row-major …"""
    info_offset: Index
    """… with their offsets."""
    group: npt.NDArray[np.bool_]
    """(S,): the residual is in the group parametrisation."""
    constant: int
    """From this row on, points are pairs of constants, without a frame and parametrisation."""


class SubmapBlocks(NamedTuple):
    """Output arrays of :func:`submap_blocks`."""

    H: Array
    """Blocks ``(6 + 2n)²``, flat."""
    H_offset: Index
    g: Array
    """Gradients ``6 + 2n``, flat."""
    g_offset: Index
    chi2: Array
    """(S,)"""


class SubmapTerms(NamedTuple):
    """Terms of residual and Jacobian of a submap with n entries."""

    q: Array
    """(n + 1, 2): the end and all points in the frame of the start."""
    h: Array
    """(n + 1, 2): derivative of their residuals by the end's heading, due to the parametrisation."""
    r: Array
    """(3 + 2n,): ``H(X) - z`` (eq. 15) in its parametrisation."""


@callee
def submap_terms(
    ends: tuple[Array, Array], points: Array, rows: Index, z: Array, places: int, group: bool, out: SubmapTerms
) -> tuple[float, float, float, float, float, float]:
    """Residual of a submap; returns ``a, b`` of V⁻¹ and cosine and sine of the start's heading and of the turn.

    ``rows`` are those of the entries among the points; from ``places`` on they are pairs of constants, without a frame
    and parametrisation.
    """
    start, end = ends
    q, h, r = out
    ca, sa = np.cos(start[2]), np.sin(start[2])
    t = end[2] - start[2] - z[2]
    t = np.pi - ((np.pi - t) % (2.0 * np.pi))
    va, vb, slope, half = 1.0, 0.0, 0.0, 0.0
    if group:
        va, vb, slope = inverse_left_jacobian_kernel(t)
        half = 0.5
    for i in range(places, len(rows)):
        k = 3 + 2 * i
        r[k], r[k + 1] = points[rows[i], 0] - z[k], points[rows[i], 1] - z[k + 1]
    for i in range(places + 1):
        if i == 0:
            dx, dy = end[0] - start[0], end[1] - start[1]
        else:
            dx, dy = points[rows[i - 1], 0] - start[0], points[rows[i - 1], 1] - start[1]
        q[i, 0] = ca * dx + sa * dy
        q[i, 1] = -sa * dx + ca * dy
        k = 0 if i == 0 else 1 + 2 * i
        ex, ey = q[i, 0] - z[k], q[i, 1] - z[k + 1]
        r[k], r[k + 1] = va * ex + vb * ey, va * ey - vb * ex
        h[i, 0], h[i, 1] = slope * ex + half * ey, slope * ey - half * ex
    r[2] = t
    return va, vb, ca, sa, np.cos(end[2] - start[2]), np.sin(end[2] - start[2])


@callee
def times_submap_jacobian(
    L: Array, terms: SubmapTerms, turns: tuple[float, float, float, float, float, float], places: int, M: Array
) -> None:
    """``M = L J`` ``(k, 6 + 2n)`` for any L ``(k, 3 + 2n)``, right tangents of ``[start (3), end (3), entries…]``.

    ``turns`` is the return value of :func:`submap_terms`.
    """
    q, h, _ = terms
    va, vb, ca, sa, ce, se = turns
    for row in range(L.shape[0]):
        sx, sy, st = 0.0, 0.0, 0.0
        turn = L[row, 2]
        for i in range(places + 1):
            k = 0 if i == 0 else 1 + 2 * i
            lx, ly = L[row, k], L[row, k + 1]
            turn += lx * h[i, 0] + ly * h[i, 1]
            lx, ly = va * lx - vb * ly, vb * lx + va * ly
            sx += lx
            sy += ly
            st += lx * q[i, 1] - ly * q[i, 0]
            if i == 0:  # d/dx_end: R_sᵀ R_e
                M[row, 3] = lx * ce + ly * se
                M[row, 4] = -lx * se + ly * ce
            else:  # d/dl: R_sᵀ
                M[row, 4 + 2 * i] = lx * ca - ly * sa
                M[row, 5 + 2 * i] = lx * sa + ly * ca
        for k in range(3 + 2 * places, L.shape[1]):
            M[row, k + 3] = L[row, k]
        M[row, 0], M[row, 1], M[row, 2] = -sx, -sy, st - turn
        M[row, 5] = turn


@njit
def whiten_submap(
    ends: tuple[Array, Array], points: Array, rows: Index, z: Array, places: int, group: bool, W: Array
) -> tuple[Array, Array]:
    """``W r`` and ``W J`` of one submap; see :func:`submap_terms` and :func:`times_submap_jacobian`."""
    n = len(rows)
    terms = SubmapTerms(np.empty((n + 1, 2)), np.empty((n + 1, 2)), np.empty(3 + 2 * n))
    turns = submap_terms(ends, points, rows, z, places, group, terms)
    M = np.empty((W.shape[0], 6 + 2 * n))
    times_submap_jacobian(W, terms, turns, places, M)
    return W @ terms.r, M


@njit
def submap_blocks(poses: Array, points: Array, submaps: SubmapFactorArrays, hessian: bool, out: SubmapBlocks) -> None:
    """Objective, gradient block and Gauss-Newton block of every submap (eq. 15–16, right tangents).

    Local variables of submap s are ``[x_start (3), x_{start+1} (3), entry_1 (2), …]``; a repeated entry is two local
    variables here, which the assembly adds.

    Parameters
    ----------
    poses : (m + 1, 3); points : (n, 2)
    hessian : bool
        Compute H too.
    """
    start, entry_offset, entry_row, z, z_offset, info, info_offset, group, constant = submaps
    H, H_offset, g, g_offset, chi2 = out
    for s in range(start.shape[0]):
        rows = entry_row[entry_offset[s] : entry_offset[s + 1]]
        n = len(rows)
        m, d = 3 + 2 * n, 6 + 2 * n
        L = info[info_offset[s] : info_offset[s] + m * m].reshape(m, m)
        places = n  # constants are last
        while places > 0 and rows[places - 1] >= constant:
            places -= 1
        terms = SubmapTerms(np.empty((n + 1, 2)), np.empty((n + 1, 2)), np.empty(m))
        r = terms.r
        ends = poses[start[s]], poses[start[s] + 1]
        turns = submap_terms(ends, points, rows, z[z_offset[s] : z_offset[s] + m], places, group[s], terms)
        chi2[s] = np.dot(r, L @ r)
        if not hessian:
            continue
        M = np.zeros((m, d))  # Λ J
        times_submap_jacobian(L, terms, turns, places, M)
        B = H[H_offset[s] : H_offset[s] + d * d].reshape(d, d)
        times_submap_jacobian(M.T, terms, turns, places, B.T)  # Jᵀ M
        for c in range(d):
            v = 0.0
            for row in range(m):
                v += M[row, c] * r[row]
            g[g_offset[s] + c] = v


@njit
def scatter_dense(columns: Index, offset: Index, H: Array, H_offset: Index, A: Array) -> None:
    """Add every block ``H_s`` into ``A[columns_s, columns_s]``; a column of -1 belongs to the fixed first base."""
    for s in range(offset.shape[0] - 1):
        c0, d = offset[s], offset[s + 1] - offset[s]
        h0 = H_offset[s]
        for i in range(d):
            ci = columns[c0 + i]
            if ci < 0:
                continue
            for j in range(d):
                cj = columns[c0 + j]
                if cj >= 0:
                    A[ci, cj] += H[h0 + i * d + j]
