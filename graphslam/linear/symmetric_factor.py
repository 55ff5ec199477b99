"""General sparse symmetric positive-definite systems, and fill-reducing elimination orders.

SuperLU in symmetric mode (diagonal pivots, minimum degree on ``A + Aᵀ``) is used as sparse Cholesky of matrices that
are solved once. Map joining and the batch solver factorise one pattern many times; they use only the order
(:mod:`~graphslam.linear.block_cholesky`).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from graphslam.core.errors import IndeterminateError
from graphslam.core.geometry import Array

Index = npt.NDArray[np.intp]

# Right-hand sides solved at once: 64 columns of a 10⁴ system are 5 MB; more are not faster.
_COLUMNS = 64


class SymmetricFactor:
    """Factorisation of a sparse symmetric positive-definite matrix ``(n, n)``.

    Parameters
    ----------
    matrix : csc_matrix (n, n)
        Both triangles.
    """

    def __init__(self, matrix: sp.csc_matrix) -> None:
        try:
            self._lu = spla.splu(
                matrix,
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
        except RuntimeError as error:
            raise IndeterminateError(f"information matrix {matrix.shape} cannot be factorised ({error})") from None
        self.shape = matrix.shape

    @property
    def nnz(self) -> int:
        """Stored entries of both triangular factors (SuperLU's own count)."""
        return int(self._lu.nnz)

    @property
    def order(self) -> Index:
        """Elimination order: ``order[i]`` is the unknown that is eliminated i-th."""
        return np.argsort(self._lu.perm_c).astype(np.intp)

    def solve(self, rhs: Array) -> Array:
        """``A⁻¹ rhs`` for ``rhs`` ``(n,)`` or ``(n, k)``."""
        return np.asarray(self._lu.solve(np.asarray(rhs, dtype=np.float64)))

    def inverse_block(self, indices: npt.ArrayLike) -> Array:
        """Rows and columns ``indices`` ``(k,)`` of ``A⁻¹`` by sparse solves, not the whole inverse (Algorithm 1)."""
        ix = np.asarray(indices, dtype=np.intp)
        block = np.empty((len(ix), len(ix)))
        for first in range(0, len(ix), _COLUMNS):
            columns = ix[first : first + _COLUMNS]
            unit = np.zeros((self.shape[0], len(columns)))
            unit[columns, np.arange(len(columns))] = 1.0
            block[:, first : first + len(columns)] = self.solve(unit)[ix]
        return 0.5 * (block + block.T)

    def inverse_diagonal_blocks(self, first: npt.ArrayLike, width: int) -> Array:
        """Blocks ``(k, width, width)`` of ``A⁻¹`` on the diagonal that start at ``first`` ``(k,)``."""
        at = np.asarray(first, dtype=np.intp)
        blocks = np.zeros((len(at), width, width))
        some = max(1, _COLUMNS // width)
        within = np.arange(width)
        for k in range(0, len(at), some):
            rows = at[k : k + some, None] + within
            unit = np.zeros((self.shape[0], rows.size))
            unit[rows.ravel(), np.arange(rows.size)] = 1.0
            X = self.solve(unit).reshape(self.shape[0], len(rows), width)
            B = X[rows, np.arange(len(rows))[:, None]]
            blocks[k : k + some] = 0.5 * (B + B.swapaxes(1, 2))
        return blocks


def elimination_order(rows: Index, columns: Index, n: int) -> Index:
    """Minimum-degree order of a symmetric pattern, from its entries in either or both triangles.

    Parameters
    ----------
    rows, columns : (k,)
        Entries can be repeated.

    Returns
    -------
    (n,)
        ``order[i]`` is the node that is eliminated i-th.
    """
    ones = np.ones(len(rows))
    pattern = sp.csc_matrix((ones, (rows, columns)), shape=(n, n))
    pattern = sp.csc_matrix(pattern + pattern.T)
    # Any values without a zero pivot are fine: make the diagonal dominant.
    dominant = np.asarray(pattern.sum(axis=0)).ravel() + 1.0
    return SymmetricFactor(sp.csc_matrix(pattern + sp.diags(dominant, format="csc"))).order
