"""Numba kernels of pose graphs that are a chain with loops: the poses between loop ends are eliminated along the chain.

Blocks as in :mod:`~graphslam.skeleton.chain_kernels`. Plain arrays only.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from graphslam.skeleton.chain_kernels import Chain, _cholesky, linearise
from graphslam.skeleton.landmark_kernels import Poses


@nb.njit(cache=True, nogil=True)
def linearise_loops(chain, ends, poses, diagonal, between, g):
    """Add loops to ``diagonal (N, 6, 6)`` and half the gradient ``g (N, 6)``; their blocks to ``between (L, 6, 6)``.

    Parameters
    ----------
    chain : Chain
        Measurements of the loops, in place of those between neighbours.
    ends : (L, 2)

    Returns
    -------
    float
        Σ rᵀ Ω r.
    """
    R, p = np.empty((2, 3, 3)), np.empty((2, 3))
    pair = Poses(R, p)
    two, one, gradient = np.empty((2, 6, 6)), np.empty((1, 6, 6)), np.empty((2, 6))
    up, nothing = np.zeros((2, 3)), np.zeros(1)
    total = 0.0
    for e in range(len(ends)):
        i, j = ends[e, 0], ends[e, 1]
        R[0], R[1] = poses.rotation[i], poses.rotation[j]
        p[0], p[1] = poses.position[i], poses.position[j]
        two[:] = 0.0
        one[:] = 0.0
        gradient[:] = 0.0
        f = e if len(chain.information) > 1 else 0
        single = Chain(
            chain.rotation[e : e + 1], chain.translation[e : e + 1], chain.information[f : f + 1], up, nothing
        )
        total += linearise(single, pair, True, two, one, gradient)
        diagonal[i] += two[0]
        diagonal[j] += two[1]
        between[e] = one[0]
        g[i] += gradient[0]
        g[j] += gradient[1]
    return total


@nb.njit(cache=True, nogil=True)
def eliminate(diagonal, upper, x, kept, reduced, rhs):
    """Eliminate all poses between kept ones; ``diagonal``, ``upper`` and ``x`` hold what :func:`substitute` needs.

    Parameters
    ----------
    diagonal, upper, x : (N, 6, 6), (N - 1, 6, 6), (N, 6)
        Matrix and right-hand side; changed.
    kept : (K,)
        Rising, with the first and the last pose.
    reduced : (diagonal (K, 6, 6), upper (K - 1, 6, 6))
        What is left for the kept poses, and for each and the next: out.
    rhs : (K, 6)
        Out.

    Returns
    -------
    int
        First pose that nothing holds, or -1.
    """
    left, right = reduced
    E, U, W, V = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 13)), np.empty((6, 13))
    for c in range(len(kept)):
        a = kept[c]
        left[c] = diagonal[a]
        rhs[c] = x[a]
        if c + 1 == len(kept):
            break
        b = kept[c + 1]
        E[:] = upper[a]
        for k in range(a + 1, b):
            D = diagonal[k]
            if not _cholesky(D):
                return k
            # W = D⁻¹ [Eᵀ, U, x], row by row, so that whole rows are worked on at once
            for r in range(6):
                for col in range(6):
                    U[r, col] = upper[k, r, col]
                    W[r, col] = E[col, r]
                    W[r, 6 + col] = U[r, col]
                W[r, 12] = x[k, r]
            for r in range(6):
                for m in range(r):
                    f = D[r, m]
                    for col in range(13):
                        W[r, col] -= f * W[m, col]
                f = 1.0 / D[r, r]
                for col in range(13):
                    W[r, col] *= f
            for r in range(5, -1, -1):
                for m in range(r + 1, 6):
                    f = D[m, r]
                    for col in range(13):
                        W[r, col] -= f * W[m, col]
                f = 1.0 / D[r, r]
                for col in range(13):
                    W[r, col] *= f
            # V = E W: what the pose leaves to the kept one before it, and to its tie to the next
            for r in range(6):
                for col in range(13):
                    V[r, col] = 0.0
                for m in range(6):
                    f = E[r, m]
                    for col in range(13):
                        V[r, col] += f * W[m, col]
            for r in range(6):
                for col in range(6):
                    left[c, r, col] -= V[r, col]
                    E[r, col] = -V[r, 6 + col]
                    D[r, col] = W[r, col]  # the factor is not needed any more
                    upper[k, r, col] = W[r, 6 + col]
                rhs[c, r] -= V[r, 12]
                x[k, r] = W[r, 12]
            for m in range(6):
                for r in range(6):
                    f = U[m, r]
                    for col in range(6):
                        diagonal[k + 1, r, col] -= f * W[m, 6 + col]
                    x[k + 1, r] -= f * W[m, 12]
        right[c] = E
    return -1


@nb.njit(cache=True, nogil=True)
def substitute(diagonal, upper, x, kept, solved):
    """Fill ``x (N, 6)`` from the kept poses ``solved (K, 6)``, segment by segment."""
    for c in range(len(kept)):
        x[kept[c]] = solved[c]
    for c in range(len(kept) - 1):
        a, b = kept[c], kept[c + 1]
        for k in range(b - 1, a, -1):
            for r in range(6):
                s = x[k, r]
                for m in range(6):
                    s -= diagonal[k, r, m] * x[a, m] + upper[k, r, m] * x[k + 1, m]
                x[k, r] = s
