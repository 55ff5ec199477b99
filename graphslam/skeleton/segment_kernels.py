"""Numba kernels for combining links to segments: a path of links acts on its two ends like one link.

Poses are perturbed in the world frame as in :mod:`~graphslam.skeleton.chain_kernels`. The residual of a link from pose
i to pose j is r; its derivative is ``J Δ`` with ``Δ = (w_j - w_i, u_j - u_i - w_i × (p_j - p_i))`` and
``J = diag(J_r⁻¹(r) R_jᵀ, R_iᵀ)``. Twists about one point add up along a path, so the covariances of its links are
summed: with ``G`` = ``J⁻¹``, then the shift to the path's first pose, the path is one link of covariance ``Σ G Ω⁻¹ Gᵀ``
and residual ``Σ G r``. This is the exact elimination of all poses in between. Plain arrays only.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from graphslam.core.jit import callee, njit
from graphslam.skeleton.chain_kernels import Array, _cholesky, _log, _solve
from graphslam.skeleton.landmark_kernels import _nine

Index = npt.NDArray[np.int64]


class SegmentLinks(NamedTuple):
    """Relative poses, and the segments that they form."""

    ends: Index
    """(E, 2): poses i and j of each."""
    first: Index
    """(S + 1,): first link of each segment; a segment starts at the end of the previous one."""
    rotation: Array
    """(E, 3, 3): rotation from i to j, in the frame of i …"""
    translation: Array
    """(E, 3): … and translation [m]."""
    covariance: Array
    """(1, 6, 6) or (E, 6, 6): covariance of rotation vector, then translation."""
    information: Array
    """Its inverse."""


@callee(error_model="numpy")
def _residual(links, e, turns, shift, scratch, r):
    """Write the residual (6,) of link e between two rotations, p_j - p_i = ``shift`` in the world."""
    Ra, Rb = turns
    dx, dy, dz = shift
    A, E = scratch
    Z = _nine(links.rotation, e)
    # E = Zᵀ Raᵀ Rb
    for i in range(3):
        for j in range(3):
            A[i, j] = Ra[i] * Rb[j] + Ra[3 + i] * Rb[3 + j] + Ra[6 + i] * Rb[6 + j]
    for i in range(3):
        for j in range(3):
            E[i, j] = Z[i] * A[0, j] + Z[3 + i] * A[1, j] + Z[6 + i] * A[2, j]
    _log(E, r)
    for i in range(3):
        r[3 + i] = Ra[i] * dx + Ra[3 + i] * dy + Ra[6 + i] * dz - links.translation[e, i]


@callee(error_model="numpy")
def _turned(Rb, r, B):
    """Write ``R_j J_r(r)`` (3, 3), J_r the right Jacobian of the rotation residual."""
    x, y, z = r[0], r[1], r[2]
    t2 = x * x + y * y + z * z
    if t2 < 1e-2:
        b = 0.5 - t2 * (1.0 / 24.0 - t2 * (1.0 / 720.0 - t2 / 40320.0))
        c = 1.0 / 6.0 - t2 * (1.0 / 120.0 - t2 * (1.0 / 5040.0 - t2 / 362880.0))
    else:
        t = np.sqrt(t2)
        b, c = 2.0 * np.sin(0.5 * t) ** 2 / t2, (t - np.sin(t)) / (t2 * t)
    # J_r = I - b [r]× + c [r]×²
    j00, j01, j02 = 1.0 - c * (y * y + z * z), c * x * y + b * z, c * x * z - b * y
    j10, j11, j12 = c * x * y - b * z, 1.0 - c * (x * x + z * z), c * y * z + b * x
    j20, j21, j22 = c * x * z + b * y, c * y * z - b * x, 1.0 - c * (x * x + y * y)
    for i in range(3):
        u, v, w = Rb[3 * i], Rb[3 * i + 1], Rb[3 * i + 2]
        B[i, 0] = u * j00 + v * j10 + w * j20
        B[i, 1] = u * j01 + v * j11 + w * j21
        B[i, 2] = u * j02 + v * j12 + w * j22


@njit(nogil=True, error_model="numpy")
def join_links(links, poses, covariance, misfit):
    """Combine the links of each segment to one.

    Parameters
    ----------
    links : SegmentLinks
    poses : Poses
    covariance, misfit : (S, 6, 6), (S, 6)
        Output: of ``y = (w_b - w_a, u_b - u_a - w_b × (p_b - p_a))`` for the ends a and b of each segment, and
        ``Σ G r``. The cost of the segment is ``(y + misfit)ᵀ covariance⁻¹ (y + misfit)``, minimised over the poses
        between.

    Returns
    -------
    float
        Σ rᵀ Ω r over all links.
    """
    r, f = np.empty(6), np.empty(6)
    B, N, M, A, X = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    P, Q = poses.rotation, poses.position
    mixed = False
    for k in range(len(links.covariance)):
        for i in range(3):
            for j in range(3):
                mixed |= links.covariance[k, i, 3 + j] != 0.0
    single, total = len(links.information) == 1, 0.0
    for s in range(len(links.first) - 1):
        V, c = covariance[s], misfit[s]
        V[:] = 0.0
        c[:] = 0.0
        a = links.ends[links.first[s], 0]
        for e in range(links.first[s], links.first[s + 1]):
            i, j = links.ends[e, 0], links.ends[e, 1]
            Ra, Rb = _nine(P, i), _nine(P, j)
            shift = Q[j, 0] - Q[i, 0], Q[j, 1] - Q[i, 1], Q[j, 2] - Q[i, 2]
            _residual(links, e, (Ra, Rb), shift, (A, X), r)
            k = 0 if single else e
            for m in range(6):
                f[m] = 0.0
                for n in range(6):
                    f[m] += links.information[k, m, n] * r[n]
                total += r[m] * f[m]
            _turned(Rb, r, B)
            S = links.covariance[k]
            # N = B Σ_ww Bᵀ, M = Ra Σ_uu Raᵀ
            for m in range(3):
                x = B[m, 0] * S[0, 0] + B[m, 1] * S[1, 0] + B[m, 2] * S[2, 0]
                y = B[m, 0] * S[0, 1] + B[m, 1] * S[1, 1] + B[m, 2] * S[2, 1]
                z = B[m, 0] * S[0, 2] + B[m, 1] * S[1, 2] + B[m, 2] * S[2, 2]
                for n in range(3):
                    N[m, n] = x * B[n, 0] + y * B[n, 1] + z * B[n, 2]
                x = Ra[3 * m] * S[3, 3] + Ra[3 * m + 1] * S[4, 3] + Ra[3 * m + 2] * S[5, 3]
                y = Ra[3 * m] * S[3, 4] + Ra[3 * m + 1] * S[4, 4] + Ra[3 * m + 2] * S[5, 4]
                z = Ra[3 * m] * S[3, 5] + Ra[3 * m + 1] * S[4, 5] + Ra[3 * m + 2] * S[5, 5]
                for n in range(3):
                    M[m, n] = x * Ra[3 * n] + y * Ra[3 * n + 1] + z * Ra[3 * n + 2]
            lx, ly, lz = Q[j, 0] - Q[a, 0], Q[j, 1] - Q[a, 1], Q[j, 2] - Q[a, 2]
            # shifted to the segment's first pose by H = [l]×: wu = X + N Hᵀ, uu = M + H (X + N Hᵀ) + Xᵀ Hᵀ
            for m in range(3):
                x, y, z = N[m, 0], N[m, 1], N[m, 2]
                A[m, 0], A[m, 1], A[m, 2] = ly * z - lz * y, lz * x - lx * z, lx * y - ly * x
            if mixed:
                for m in range(3):
                    x = B[m, 0] * S[0, 3] + B[m, 1] * S[1, 3] + B[m, 2] * S[2, 3]
                    y = B[m, 0] * S[0, 4] + B[m, 1] * S[1, 4] + B[m, 2] * S[2, 4]
                    z = B[m, 0] * S[0, 5] + B[m, 1] * S[1, 5] + B[m, 2] * S[2, 5]
                    for n in range(3):
                        X[m, n] = x * Ra[3 * n] + y * Ra[3 * n + 1] + z * Ra[3 * n + 2]
                        A[m, n] += X[m, n]
                for n in range(3):
                    x, y, z = X[0, n], X[1, n], X[2, n]
                    M[n, 0] += ly * z - lz * y
                    M[n, 1] += lz * x - lx * z
                    M[n, 2] += lx * y - ly * x
            for n in range(3):
                x, y, z = A[0, n], A[1, n], A[2, n]
                M[0, n] += ly * z - lz * y
                M[1, n] += lz * x - lx * z
                M[2, n] += lx * y - ly * x
            for m in range(3):
                for n in range(3):
                    V[m, n] += N[m, n]
                    V[m, 3 + n] += A[m, n]
                    V[3 + m, 3 + n] += M[m, n]
            # B r = R_j r, because J_r(r) r = r
            x = Rb[0] * r[0] + Rb[1] * r[1] + Rb[2] * r[2]
            y = Rb[3] * r[0] + Rb[4] * r[1] + Rb[5] * r[2]
            z = Rb[6] * r[0] + Rb[7] * r[1] + Rb[8] * r[2]
            c[0], c[1], c[2] = c[0] + x, c[1] + y, c[2] + z
            c[3] += Ra[0] * r[3] + Ra[1] * r[4] + Ra[2] * r[5] + ly * z - lz * y
            c[4] += Ra[3] * r[3] + Ra[4] * r[4] + Ra[5] * r[5] + lz * x - lx * z
            c[5] += Ra[6] * r[3] + Ra[7] * r[4] + Ra[8] * r[5] + lx * y - ly * x
        for m in range(3):
            for n in range(3):
                V[3 + m, n] = V[n, 3 + m]
    return total


@njit(nogil=True)
def add_end_blocks(ends, position, covariance, misfit, place, blocks, g):
    """Add combined links to the matrix and half the gradient of the poses at their ends.

    Parameters
    ----------
    ends : (S, 2)
        Ends of each segment, among K poses.
    position : (K, 3)
    covariance, misfit : (S, 6, 6), (S, 6)
        From :func:`join_links`; the covariances are replaced by their inverses.
    place : (diagonal (K,), between (S,))
        Index in ``blocks (nb, 6, 6)`` of the block of each pose and of each segment, whose rows belong to the pose with
        the smaller number. Blocks are added.
    g : (K, 6)
        Added to.

    Returns
    -------
    energy : float
        Σ misfitᵀ covariance⁻¹ misfit.
    bad : int
        The first segment whose covariance is not positive definite, or -1.
    """
    diagonal, between = place
    L, x, f = np.empty((6, 6)), np.empty(6), np.empty(6)
    Y = np.empty((6, 6))
    energy = 0.0
    for s in range(len(ends)):
        a, b = ends[s, 0], ends[s, 1]
        M = covariance[s]
        L[:] = M
        if not _cholesky(L):
            return energy, s
        for c in range(6):
            x[:] = 0.0
            x[c] = 1.0
            _solve(L, x)
            for r in range(6):
                M[r, c] = x[r]
        for r in range(6):
            f[r] = 0.0
            for c in range(6):
                f[r] += M[r, c] * misfit[s, c]
            energy += f[r] * misfit[s, r]
        dx, dy, dz = position[b, 0] - position[a, 0], position[b, 1] - position[a, 1], position[b, 2] - position[a, 2]
        # y = X δ_b - δ_a, X = [[I, 0], [[d]×, I]]; Y = M X
        for r in range(6):
            p, q, t = M[r, 3], M[r, 4], M[r, 5]
            Y[r, 0] = M[r, 0] + q * dz - t * dy
            Y[r, 1] = M[r, 1] + t * dx - p * dz
            Y[r, 2] = M[r, 2] + p * dy - q * dx
            Y[r, 3], Y[r, 4], Y[r, 5] = p, q, t
        A, B, E = blocks[diagonal[a]], blocks[diagonal[b]], blocks[between[s]]
        for c in range(6):
            p, q, t = Y[3, c], Y[4, c], Y[5, c]
            B[0, c] += Y[0, c] + dz * q - dy * t
            B[1, c] += Y[1, c] + dx * t - dz * p
            B[2, c] += Y[2, c] + dy * p - dx * q
            B[3, c] += p
            B[4, c] += q
            B[5, c] += t
        for r in range(6):
            for c in range(6):
                A[r, c] += M[r, c]
                if a < b:
                    E[r, c] -= Y[r, c]
                else:
                    E[c, r] -= Y[r, c]
            g[a, r] -= f[r]
        g[b, 0] += f[0] + dz * f[4] - dy * f[5]
        g[b, 1] += f[1] + dx * f[5] - dz * f[3]
        g[b, 2] += f[2] + dy * f[3] - dx * f[4]
        g[b, 3] += f[3]
        g[b, 4] += f[4]
        g[b, 5] += f[5]
    return energy, -1


@njit(nogil=True, error_model="numpy")
def follow_links(links, poses, information, misfit, x):
    """Fill the steps ``x (N, 6)`` of all poses inside segments from those of their ends.

    Parameters
    ----------
    links : SegmentLinks
    poses : Poses
    information, misfit : (S, 6, 6), (S, 6)
        From :func:`join_links` and :func:`add_end_blocks`, at the same poses.
    x : (N, 6)
        In: the steps of the poses at the ends of segments.
    """
    r, h, y, f = np.empty(6), np.empty(6), np.empty(6), np.empty(6)
    A, B, E = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    P, Q = poses.rotation, poses.position
    single = len(links.covariance) == 1
    for s in range(len(links.first) - 1):
        a, b = links.ends[links.first[s], 0], links.ends[links.first[s + 1] - 1, 1]
        dx, dy, dz = Q[b, 0] - Q[a, 0], Q[b, 1] - Q[a, 1], Q[b, 2] - Q[a, 2]
        for k in range(6):
            y[k] = misfit[s, k] + x[b, k] - x[a, k]
        y[3] += dy * x[b, 2] - dz * x[b, 1]
        y[4] += dz * x[b, 0] - dx * x[b, 2]
        y[5] += dx * x[b, 1] - dy * x[b, 0]
        # the wrench of a segment is constant along it
        for m in range(6):
            f[m] = 0.0
            for n in range(6):
                f[m] += information[s, m, n] * y[n]
        wx, wy, wz = x[a, 0], x[a, 1], x[a, 2]
        ux, uy, uz = x[a, 3], x[a, 4], x[a, 5]
        for e in range(links.first[s], links.first[s + 1] - 1):
            i, j = links.ends[e, 0], links.ends[e, 1]
            Ra, Rb = _nine(P, i), _nine(P, j)
            dx, dy, dz = Q[j, 0] - Q[i, 0], Q[j, 1] - Q[i, 1], Q[j, 2] - Q[i, 2]
            _residual(links, e, (Ra, Rb), (dx, dy, dz), (A, E), r)
            _turned(Rb, r, B)
            lx, ly, lz = Q[j, 0] - Q[a, 0], Q[j, 1] - Q[a, 1], Q[j, 2] - Q[a, 2]
            # h = Gᵀ f, then the change of the residual, Ω⁻¹ h - r
            p, q, t = f[0] - ly * f[5] + lz * f[4], f[1] - lz * f[3] + lx * f[5], f[2] - lx * f[4] + ly * f[3]
            for m in range(3):
                h[m] = B[0, m] * p + B[1, m] * q + B[2, m] * t
                h[3 + m] = Ra[m] * f[3] + Ra[3 + m] * f[4] + Ra[6 + m] * f[5]
            S = links.covariance[0 if single else e]
            for m in range(6):
                y[m] = -r[m]
                for n in range(6):
                    y[m] += S[m, n] * h[n]
            # Δ = J⁻¹ of it; translation first, because it depends on the rotation of pose i
            ux += wy * dz - wz * dy + Ra[0] * y[3] + Ra[1] * y[4] + Ra[2] * y[5]
            uy += wz * dx - wx * dz + Ra[3] * y[3] + Ra[4] * y[4] + Ra[5] * y[5]
            uz += wx * dy - wy * dx + Ra[6] * y[3] + Ra[7] * y[4] + Ra[8] * y[5]
            wx += B[0, 0] * y[0] + B[0, 1] * y[1] + B[0, 2] * y[2]
            wy += B[1, 0] * y[0] + B[1, 1] * y[1] + B[1, 2] * y[2]
            wz += B[2, 0] * y[0] + B[2, 1] * y[1] + B[2, 2] * y[2]
            x[j, 0], x[j, 1], x[j, 2], x[j, 3], x[j, 4], x[j, 5] = wx, wy, wz, ux, uy, uz
