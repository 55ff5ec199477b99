"""Storage pattern of a block-sparse symmetric matrix: computed once, used for many sets of values.

The matrix consists of node blocks (poses with 3 scalars, landmarks with 2). The block of a pair of nodes is stored
once. The elimination order and the symbolic factorisation are computed once.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from graphslam.core.geometry import Array
from graphslam.join import submap_kernels as kernels
from graphslam.linear.block_cholesky import BlockFactor, BlockSymbolic
from graphslam.linear.symmetric_factor import elimination_order

Index = npt.NDArray[np.int64]


class BlockPattern:
    """Pattern of a symmetric matrix of node blocks.

    Parameters
    ----------
    width : (N,)
        Scalars per node; node i begins at ``sum(width[:i])`` in vectors.
    ptr : (N + 1,)
    neighbours : (nb,)
        Neighbours of every node, including itself; every pair is in both lists.

    Attributes
    ----------
    block, flip : (nb,)
        Offset of the block of each listed pair in the values, and whether it has the neighbour's rows.
    entries : int
        Length of the values.
    nnz : int
        Stored entries of the matrix, both triangles.
    order : (N,)
        Elimination order of the nodes.
    size : int
        Number of scalars.
    """

    def __init__(self, width: Index, ptr: Index, neighbours: Index) -> None:
        self.width, self.ptr, self.neighbours = width, ptr, neighbours
        N = len(width)
        owner = np.repeat(np.arange(N), np.diff(ptr))
        self.order = elimination_order(owner, neighbours, N).astype(np.int64)
        position = np.empty(N, dtype=np.int64)
        position[self.order] = np.arange(N)
        self.block, self.flip, entries = kernels.half_blocks(position, width, ptr, neighbours)
        self.entries = int(entries)
        self.nnz = int(np.sum(width[owner] * width[neighbours]))
        self.size = int(np.sum(width))

    @cached_property
    def symbolic(self) -> BlockSymbolic:
        """Symbolic factorisation."""
        return BlockSymbolic(self.order, self.width, self.ptr, self.neighbours)

    def factor(self, values: Array, damping: float = 0.0) -> BlockFactor:
        """Factor ``A + damping · diag(A)``."""
        return self.symbolic.factor(self.block, values, damping)

    def matrix(self, values: Array) -> sp.csc_matrix:
        """The matrix ``(size, size)``, both triangles, nodes in the caller's order."""
        nodes = np.arange(len(self.width))
        return csc_of_blocks(nodes, self.width, self.ptr, self.neighbours, self.block, self.flip, values)


def csc_of_blocks(
    nodes: Index, width: Index, ptr: Index, neighbours: Index, block: Index, flip: Index, values: Array
) -> sp.csc_matrix:
    """A block matrix as CSC with its nodes in the order ``nodes`` (see :func:`submap_kernels.to_csc`)."""
    indptr, indices, data = kernels.to_csc(nodes, width, ptr, neighbours, block, flip, values)
    n = len(indptr) - 1
    A = sp.csc_matrix((data, indices.astype(np.int32), indptr.astype(np.int32)), shape=(n, n))
    A.has_sorted_indices = True
    return A
