"""Numba kernels: Gauss-Newton blocks of landmark submaps, and their assembly. Plain arrays only."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from graphslam.core.jit import njit

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


@njit
def inverse_left_jacobian_kernel(d: float) -> tuple[float, float, float]:
    """``a``, ``b``, ``da/dd`` of ``V(d)⁻¹ = a I - b S`` (:mod:`graphslam.core.charts`)."""
    h = 0.5 * d
    if abs(h) < 1e-3:
        return 1.0 - h * h / 3.0 - h**4 / 45.0, h, -h / 3.0 - 2.0 * h**3 / 45.0
    c, s = np.cos(h), np.sin(h)
    return h * c / s, h, 0.5 * (c / s - h / (s * s))


class SubmapFactorArrays(NamedTuple):
    """Landmark submaps one after the other."""

    start: Index
    """(S,): node of each."""
    entry_offset: Index
    """(S + 1,)"""
    entry_row: Index
    """(E,): rows of the points."""
    z: Array
    """Measurements, flat …"""
    z_offset: Index
    """… and where they begin."""
    info: Array
    """Information matrices, flat and row-major …"""
    info_offset: Index
    """… and where they begin."""
    group: npt.NDArray[np.bool_]
    """(S,): the residual is taken in the group chart."""
    constant: int
    """Rows of the points from this one on are pairs of constants: they have no frame, and no chart."""


class SubmapBlocks(NamedTuple):
    """What is computed of them: out."""

    H: Array
    """Blocks ``(6 + 2n)²``, flat."""
    H_offset: Index
    g: Array
    """Gradients ``6 + 2n``, flat."""
    g_offset: Index
    chi2: Array
    """(S,)"""


@njit
def submap_blocks(poses: Array, points: Array, submaps: SubmapFactorArrays, hessian: bool, out: SubmapBlocks) -> None:
    """Objective, gradient block and Gauss-Newton block of every submap (eq. 15–16, right tangents).

    Local variables of submap s are ``[x_start (3), x_{start+1} (3), entry_1 (2), …]``; an entry that stands twice is
    two local variables here and is added up by the assembly.

    Parameters
    ----------
    poses : (m + 1, 3); points : (n, 2)
    hessian : bool
        Fill H as well.
    """
    start, entry_offset, entry_row, z, z_offset, info, info_offset, group, constant = submaps
    H, H_offset, g, g_offset, chi2 = out
    for s in range(start.shape[0]):
        a, b = start[s], start[s] + 1
        e0, e1 = entry_offset[s], entry_offset[s + 1]
        n = e1 - e0
        m = 3 + 2 * n
        d = 6 + 2 * n
        z0 = z_offset[s]
        L = info[info_offset[s] : info_offset[s] + m * m].reshape(m, m)
        ca, sa = np.cos(poses[a, 2]), np.sin(poses[a, 2])
        t = poses[b, 2] - poses[a, 2] - z[z0 + 2]
        t = np.pi - ((np.pi - t) % (2.0 * np.pi))
        va, vb, slope, half = 1.0, 0.0, 0.0, 0.0
        if group[s]:
            va, vb, slope = inverse_left_jacobian_kernel(t)
            half = 0.5
        # q: everything in the start frame; r = H(X) - z (eq. 15) in its chart; h: what it changes by with the heading
        q = np.empty((n + 1, 2))
        h = np.empty((n + 1, 2))
        r = np.empty(m)
        places = n  # constants stand last
        while places > 0 and entry_row[e0 + places - 1] >= constant:
            places -= 1
            row, k = entry_row[e0 + places], 3 + 2 * places
            r[k], r[k + 1] = points[row, 0] - z[z0 + k], points[row, 1] - z[z0 + k + 1]
        for i in range(places + 1):
            if i == 0:
                dx, dy = poses[b, 0] - poses[a, 0], poses[b, 1] - poses[a, 1]
            else:
                row = entry_row[e0 + i - 1]
                dx, dy = points[row, 0] - poses[a, 0], points[row, 1] - poses[a, 1]
            q[i, 0] = ca * dx + sa * dy
            q[i, 1] = -sa * dx + ca * dy
            k = 0 if i == 0 else 1 + 2 * i
            ex, ey = q[i, 0] - z[z0 + k], q[i, 1] - z[z0 + k + 1]
            r[k], r[k + 1] = va * ex + vb * ey, va * ey - vb * ex
            h[i, 0], h[i, 1] = slope * ex + half * ey, slope * ey - half * ex
        r[2] = t
        Lr = L @ r
        chi2[s] = np.dot(r, Lr)
        if not hessian:
            continue
        ce, se = np.cos(poses[b, 2] - poses[a, 2]), np.sin(poses[b, 2] - poses[a, 2])
        M = np.zeros((m, d))  # Λ J, column block by column block
        for row in range(m):
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
                c = 3 if i == 0 else 4 + 2 * i
                if i == 0:  # d/dx_end: R_sᵀ R_e
                    M[row, 3] = lx * ce + ly * se
                    M[row, 4] = -lx * se + ly * ce
                else:  # d/dl: R_sᵀ
                    M[row, c] = lx * ca - ly * sa
                    M[row, c + 1] = lx * sa + ly * ca
            for k in range(3 + 2 * places, m):
                M[row, k + 3] = L[row, k]
            M[row, 0], M[row, 1], M[row, 2] = -sx, -sy, st - turn
            M[row, 5] = turn
        h0 = H_offset[s]
        g0 = g_offset[s]
        B = H[h0 : h0 + d * d].reshape(d, d)
        for c in range(d):  # Jᵀ M, the same sparsity of J applied to rows
            sx, sy, st = 0.0, 0.0, 0.0
            turn = M[2, c]
            for i in range(places + 1):
                k = 0 if i == 0 else 1 + 2 * i
                lx, ly = M[k, c], M[k + 1, c]
                turn += lx * h[i, 0] + ly * h[i, 1]
                lx, ly = va * lx - vb * ly, vb * lx + va * ly
                sx += lx
                sy += ly
                st += lx * q[i, 1] - ly * q[i, 0]
                if i == 0:
                    B[3, c] = lx * ce + ly * se
                    B[4, c] = -lx * se + ly * ce
                else:
                    B[4 + 2 * i, c] = lx * ca - ly * sa
                    B[5 + 2 * i, c] = lx * sa + ly * ca
            for k in range(3 + 2 * places, m):
                B[k + 3, c] = M[k, c]
            B[0, c], B[1, c], B[2, c] = -sx, -sy, st - turn
            B[5, c] = turn
        for c in range(d):
            v = 0.0
            for row in range(m):
                v += M[row, c] * r[row]
            g[g0 + c] = v


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
