"""Where the entries of a block-sparse symmetric matrix go: worked out once, refreshed by two vector operations.

The matrix is made of node blocks (poses of 3 scalars, landmarks of 2). Values arrive as one long vector in a fixed
order; :meth:`BlockPattern.assemble` sums them into the upper half of the matrix and mirrors that into CSC form, with
the unknowns in a fill-reducing elimination order so that the factorisation need not look for one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from graphslam.core.geometry import Array
from graphslam.graph.symmetric_factor import SymmetricFactor, elimination_order

Index = npt.NDArray[np.intp]
Entries = tuple[Index, int, Index, int]
"""Row nodes, row component, column nodes, column component of a family of values."""


class BlockPattern:
    """Pattern of a symmetric matrix of node blocks.

    Parameters
    ----------
    sizes : (N,)
        Scalars per node; node i stands at ``sum(sizes[:i])`` in the caller's vectors.
    rows, columns : (k,)
        Pairs of nodes that share a block, in any order and number. The diagonal is always there.

    Attributes
    ----------
    permutation : (n,)
        ``permutation[i]`` is the caller's index of the scalar that is eliminated i-th.
    nnz : int
        Stored entries of the matrix (both triangles).
    """

    def __init__(self, sizes: Index, rows: Index, columns: Index) -> None:
        N = len(sizes)
        self._sizes = np.asarray(sizes, dtype=np.intp)
        order = elimination_order(rows, columns, N)
        self._position = np.empty(N, dtype=np.intp)
        self._position[order] = np.arange(N)
        size = self._sizes[order]  # from here on nodes are named by their position
        self._offset = np.concatenate([[0], np.cumsum(size)])
        self.size = int(self._offset[-1])
        start = np.concatenate([[0], np.cumsum(self._sizes)])[:-1]
        within = np.arange(self.size) - np.repeat(self._offset[:-1], size)
        self.permutation = np.repeat(start[order], size) + within

        a, b = self._position[rows], self._position[columns]
        nodes = np.arange(N)
        keys = np.concatenate([np.minimum(a, b) * N + np.maximum(a, b), nodes * (N + 1)])
        self._keys = np.unique(keys)
        i, j = np.divmod(self._keys, N)
        self._half = np.concatenate([[0], np.cumsum(size[i] * size[j])])
        self._lay_out_columns(i, j, size)

    def _lay_out_columns(self, i: Index, j: Index, size: Index) -> None:
        """CSC arrays, and for each of their entries where it stands in the half."""
        base, off = self._half[:-1], i != j
        row = np.concatenate([i, j[off]])
        column = np.concatenate([j, i[off]])
        # An entry (r, c) of block (row, column) stands at base + r·step_r + c·step_c of the half.
        step_r = np.concatenate([size[j], np.ones(int(off.sum()), dtype=np.intp)])
        step_c = np.concatenate([np.ones(len(j), dtype=np.intp), size[j[off]]])
        base = np.concatenate([base, base[off]])
        sort = np.lexsort((row, column))
        row, column, step_r, step_c, base = row[sort], column[sort], step_r[sort], step_c[sort], base[sort]
        height = np.bincount(column, size[row], len(size)).astype(np.intp)  # entries in each column of a node
        first = np.concatenate([[0], np.cumsum(height * size)])
        above = np.cumsum(size[row]) - size[row]
        above -= np.concatenate([[0], np.cumsum(height)])[:-1][column]
        count = size[row] * size[column]
        block = np.repeat(np.arange(len(row)), count)
        e = np.arange(len(block)) - np.repeat(np.cumsum(count) - count, count)
        r, c = e % size[row[block]], e // size[row[block]]
        at = first[column[block]] + c * height[column[block]] + above[block] + r
        self.nnz = len(block)
        self._gather = np.empty(self.nnz, dtype=np.intp)
        self._gather[at] = base[block] + r * step_r[block] + c * step_c[block]
        self._indices = np.empty(self.nnz, dtype=np.int32)
        self._indices[at] = self._offset[row[block]] + r
        self._indptr = np.concatenate([[0], np.cumsum(np.repeat(height, size))]).astype(np.int32)
        columns = np.repeat(np.arange(self.size), np.diff(self._indptr))
        self._diagonal = np.flatnonzero(self._indices == columns)

    def upper(self, a: Index, b: Index) -> npt.NDArray[np.bool_]:
        """Which of the node pairs stand in the stored half; of (a, b) and (b, a) exactly one does, unless a is b."""
        return np.asarray(self._position[a] <= self._position[b])

    def place(self, families: Sequence[Entries]) -> None:
        """Fix the order in which values will arrive. Off the diagonal a value is given once, for either triangle."""
        slots = []
        for row, r, column, c in families:
            a, b = self._position[row], self._position[column]
            swap = a > b
            lo, hi = np.where(swap, b, a), np.where(swap, a, b)
            r_lo, c_hi = np.where(swap, c, r), np.where(swap, r, c)
            block = np.searchsorted(self._keys, lo * len(self._sizes) + hi)
            width = self._offset[hi + 1] - self._offset[hi]
            slots.append(self._half[block] + r_lo * width + c_hi)
        self._slots = np.concatenate(slots)

    def assemble(self, values: Array) -> Array:
        """Sum ``values``, in the order fixed by :meth:`place`, into the data of the CSC matrix ``(nnz,)``."""
        half = np.bincount(self._slots, values, self._half[-1])
        return np.asarray(half[self._gather])

    def diagonal(self, data: Array) -> Array:
        """The diagonal ``(n,)`` of the assembled matrix, in elimination order."""
        return data[self._diagonal]

    def factor(self, data: Array, damping: float = 0.0) -> SymmetricFactor:
        """Factor ``A + damping · diag(A)`` in elimination order."""
        if damping > 0.0:
            data = data.copy()
            data[self._diagonal] *= 1.0 + damping
        A = sp.csc_matrix((data, self._indices, self._indptr), shape=(self.size, self.size))
        return SymmetricFactor(A, ordered=True)

    def matrix(self, data: Array) -> sp.csc_matrix:
        """The assembled matrix with its unknowns in the caller's order."""
        A = sp.csc_matrix((data, self._indices, self._indptr), shape=(self.size, self.size)).tocoo()
        return sp.csc_matrix((A.data, (self.permutation[A.row], self.permutation[A.col])), shape=A.shape)
