"""Sparse Cholesky factorisation of matrices of node blocks, with separate symbolic and numeric parts.

For map joining, which factorises many matrices of a few hundred to a few ten thousand scalars: nodes instead of scalars
are ordered and analysed, only one triangle is computed, and a column of the inverse needs a forward substitution only
along the path to the root. SuperLU (:mod:`~graphslam.linear.symmetric_factor`) is for other matrices.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import IndeterminateError
from graphslam.core.geometry import Array
from graphslam.linear import multifrontal_kernels as analysis
from graphslam.linear import multifrontal_solve_kernels as solving

Index = npt.NDArray[np.int64]

# Zeros that a supernode may contain to get larger dense blocks.
_SLACK = 48


class BlockSymbolic:
    """Symbolic factorisation: pattern, order, supernodes.

    Parameters
    ----------
    order : (N,)
        ``order[k]`` is the node that is eliminated k-th.
    width : (N,)
        Scalars of each node; node i begins at ``sum(width[:i])`` in vectors.
    ptr : (N + 1,)
    neighbours : (nb,)
        Pairs of nodes that share a block, each at least in the list of the node that is eliminated first; the diagonal
        is included.

    Attributes
    ----------
    nnz : int
        Entries of the factor.
    size : int
        Number of scalars.
    """

    def __init__(self, order: Index, width: Index, ptr: Index, neighbours: Index) -> None:
        self._ptr, self._idx = ptr, neighbours
        self._parts = analysis.analyse_blocks(order, width, ptr, neighbours, _SLACK)
        post, offset, first, parent, row_ptr, rows, panel_ptr, sizes = self._parts
        self.nnz = int(sizes[2])
        self.size = int(offset[-1])
        self._entries, self._most = int(panel_ptr[-1]), int(sizes[0])
        self._node_at = np.cumsum(width) - width  # caller's scalars
        start, row = analysis.panel_scalars(offset, row_ptr, rows)
        self._solve = (offset[first], start, row)
        self._parent, self._panel_ptr = parent, panel_ptr
        self._post, self._offset = post, offset

    @cached_property
    def permutation(self) -> Index:
        """``permutation[i]`` is the caller's index of the scalar that is eliminated i-th."""
        width = np.diff(self._offset)
        begin = np.repeat(self._node_at[self._post] - self._offset[:-1], width)
        return np.asarray(begin + np.arange(self.size))

    @cached_property
    def _place(self) -> Index:
        place = np.empty(self.size, dtype=np.int64)
        place[self.permutation] = np.arange(self.size)
        return place

    def factor(self, block: Index, value: Array, damping: float = 0.0) -> BlockFactor:
        """Factorise ``A + damping · diag(A)``.

        Parameters
        ----------
        block : (nb,)
            Offset in ``value`` of the block of each pair of ``neighbours``: rows of the list's node, columns of the
            neighbour, row-major. Of a pair, the block in the list of the node that is eliminated first is used.
        value : (k,)
        """
        L = np.empty(self._entries)
        matrix = analysis.BlockMatrix(self._ptr, self._idx, block, value)
        bad = analysis.factorise_blocks(analysis.SymbolicAnalysis(*self._parts), matrix, damping, L)
        if bad:
            node = int(self._post[bad - 1])
            raise IndeterminateError(
                f"information matrix ({self.size}, {self.size}) is not positive definite at scalar "
                f"{int(self._node_at[node])}"
            )
        return BlockFactor(self, L)


class BlockFactor:
    """``A = L Lᵀ``; made by :meth:`BlockSymbolic.factor`."""

    def __init__(self, symbolic: BlockSymbolic, L: Array) -> None:
        self._symbolic, self._L = symbolic, L

    @property
    def nnz(self) -> int:
        """Entries of the factor."""
        return self._symbolic.nnz

    def solve(self, rhs: Array) -> Array:
        """``A⁻¹ rhs`` for ``rhs`` ``(n,)``, in the caller's order."""
        s = self._symbolic
        x = np.asarray(rhs, dtype=np.float64)[s.permutation]
        solving.solve_lower(*s._solve, s._panel_ptr, self._L, x)
        solving.solve_upper(*s._solve, s._panel_ptr, self._L, x)
        out = np.empty_like(x)
        out[s.permutation] = x
        return out

    def inverse_block(self, indices: npt.ArrayLike, J: Array | None = None) -> Array:
        """Rows and columns ``indices`` ``(k,)`` of ``A⁻¹ = L⁻ᵀ L⁻¹``, without the whole inverse (Algorithm 1).

        With ``J (k, m)`` ``Jᵀ B J`` of that block B, for the work of m columns.
        """
        s = self._symbolic
        unit = s._place[np.asarray(indices, dtype=np.intp)]
        J = np.eye(len(unit)) if J is None else np.ascontiguousarray(J)
        W, _ = solving.solve_lower_units(*s._solve, s._parent, s._panel_ptr, self._L, unit, J)
        return np.asarray(W.T @ W)

    def inverse_diagonal_blocks(self, first: npt.ArrayLike, width: int) -> Array:
        """Blocks ``(k, width, width)`` on the diagonal of ``A⁻¹`` that start at the scalars ``first`` ``(k,)``.

        A block is inside one node. Selected inversion: about the cost of one factorisation for all blocks.
        """
        s = self._symbolic
        begin = s._place[np.asarray(first, dtype=np.intp)]
        panels = solving.FactorPanels(*s._solve, s._parent, s._panel_ptr, self._L)
        return np.asarray(solving.inverse_diagonal(panels, begin, width, s._most))
