"""Numba kernels: products of large dense matrices by products of small blocks. Plain arrays only.

BLAS multiplies 64 × 64 blocks two to four times faster than compiled loops, and products of that size use a single
thread: the result is bitwise equal for any number of threads.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from graphslam.core.jit import callee

Array = npt.NDArray[np.float64]

BLOCK = 64
"""Rows and columns per block."""


@callee
def _pack(A: Array, out: Array) -> None:
    """Pack blocks of columns of ``A`` ``(k, n)`` contiguously, row-major within a block."""
    k, n = A.shape
    at = 0
    for j in range(0, n, BLOCK):
        m = min(BLOCK, n - j)
        for row in range(k):
            for c in range(m):
                out[at + c] = A[row, j + c]
            at += m


@callee
def subtract_product(A: Array, B: Array, C: Array, upper: bool) -> None:
    """``C ← C - Aᵀ B`` for ``A`` ``(k, m)``, ``B`` ``(k, n)``, ``C`` ``(m, n)``.

    With ``upper``, only blocks on and above the diagonal of ``C`` are computed.
    """
    k, m = A.shape
    n = B.shape[1]
    left, right = np.empty(BLOCK * m), np.empty(BLOCK * n)
    product = np.empty(BLOCK * BLOCK)
    for first in range(0, k, BLOCK):
        d = min(BLOCK, k - first)
        _pack(A[first : first + d], left)
        _pack(B[first : first + d], right)
        for i in range(0, m, BLOCK):
            mi = min(BLOCK, m - i)
            X = left[i * d : (i + mi) * d].reshape(d, mi)
            for j in range(i if upper else 0, n, BLOCK):
                nj = min(BLOCK, n - j)
                Y = right[j * d : (j + nj) * d].reshape(d, nj)
                P = product[: mi * nj].reshape(mi, nj)
                np.dot(X.T, Y, P)
                for p in range(mi):
                    for q in range(nj):
                        C[i + p, j + q] -= P[p, q]
