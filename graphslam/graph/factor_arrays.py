"""A graph's factors as flat arrays, and their Gauss-Newton system at given values.

Batch solving, covariances, diagnosis and the linearisation gap use these vectorised arrays. They are independent of
GTSAM, so that each can check the other.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import cast

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from graphslam.core.geometry import Array
from graphslam.graph.factors.batch import FactorBatch, FactorRecord, LazyRecords, batch_of, block_offsets, factor_kinds
from graphslam.graph.noise import robust_terms
from graphslam.graph.variables import Values, VariableLayout

Index = npt.NDArray[np.int64]


@dataclass(frozen=True)
class LinearSystem:
    """``A δ = -g`` at one point, with the objective there.

    Parameters
    ----------
    A : (n, n) dense or CSC
        ``Σ w Jᵀ Λ J`` (right tangents).
    g : (n,)
        ``Σ w Jᵀ Λ r``: half the gradient of the objective.
    chi2 : (f,)
        ``rᵀ Λ r`` per factor (``2 ρ`` with a robust kernel), in the order of the records.
    """

    A: Array | sp.csc_matrix
    g: Array
    chi2: Array

    @property
    def objective(self) -> float:
        """``Σ rᵀ Λ r`` (no ½)."""
        return float(self.chi2.sum())


@dataclass(frozen=True)
class FactorBlocks:
    """Every factor separately, linearised at one point, without robust kernels.

    Parameters
    ----------
    records : tuple of FactorRecord
        In the order of the blocks.
    columns : tuple of (k,) int
        Free and fixed columns of each factor; -1 = fixed.
    H : tuple of (k, k)
        ``Jᵀ Λ J``.
    d2 : (f,)
        ``rᵀ Λ r``.
    weight : (f,)
        Weight of the factor by its kernel in :attr:`LinearSystem.A`; 1 without a kernel.
    """

    records: tuple[FactorRecord, ...]
    columns: tuple[Index, ...]
    H: tuple[Array, ...]
    d2: Array
    weight: Array


class FactorArrays:
    """The least-squares problem: factor batches over the columns of a layout. Input of every solver.

    Parameters
    ----------
    records : sequence of FactorRecord
        One batch is made per kind.
    batches : sequence of FactorBatch, optional
        Factors given as arrays; they are numbered after the records.
    """

    def __init__(
        self, records: Sequence[FactorRecord], layout: VariableLayout, batches: Sequence[FactorBatch] = ()
    ) -> None:
        order: dict[type, list[int]] = {batch.record: [] for batch in factor_kinds()}
        for k, rec in enumerate(records):
            order[batch_of(type(rec)).record].append(k)
        made = [batch_of(t)([records[k] for k in ks], layout) for t, ks in order.items() if ks]
        first = block_offsets([len(records), *(len(f) for f in batches)])

        def record(k: int) -> FactorRecord:
            b = int(np.searchsorted(first, k, side="right")) - 1
            return cast(FactorRecord, (batches[b - 1].records if b else records)[k - int(first[b])])

        self.batches, self.layout = [*made, *batches], layout
        self.records: Sequence[FactorRecord] = LazyRecords(int(first[-1]), record) if batches else records
        ahead = np.array([k for ks in order.values() for k in ks], dtype=np.intp)
        self._position = np.concatenate([ahead, np.arange(first[1], first[-1])])
        empty = np.zeros(0, dtype=np.int64)
        arity, self._variable, width = (
            np.concatenate([empty, *(getattr(f, name) for f in self.batches)]) for name in ("arity", "first", "width")
        )
        self._first = block_offsets([len(f) for f in self.batches])
        self._arity, self._width = arity, width
        self._local = block_offsets(width)
        self._g_offset = self._local[block_offsets(arity)]
        self._H_offset = block_offsets(np.diff(self._g_offset) ** 2)

    def __len__(self) -> int:
        return len(self._position)

    @cached_property
    def _columns(self) -> Index:
        """Column of every local scalar of the factors, one factor after the other; -1 if it has none."""
        return np.concatenate([np.zeros(0, dtype=np.int64), *(f.columns for f in self.batches)])

    @property
    def has_kernels(self) -> bool:
        """Does any factor have a robust kernel?"""
        return any(bool(np.any(f.code != 0)) for f in self.batches)

    def classes(self) -> Iterator[tuple[str, Index, Index]]:
        """Name of each class of factors, indices of its factors in the order of the records, and their rows."""
        for f, first in zip(self.batches, self._first):
            for name, members in f.classes():
                yield name, self._position[first + members], f.rows[members]

    @property
    def measurements(self) -> int:
        """Number of measured scalars."""
        return int(sum(int(f.rows.sum()) for f in self.batches))

    @cached_property
    def links(self) -> tuple[Index, Index]:
        """Factor and variable (its first column; -1 fixed, -2 absent) for every place of every factor."""
        return np.repeat(np.arange(len(self._arity)), self._arity), self._variable

    @cached_property
    def _pattern(self) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp], npt.NDArray[np.intp]]:
        """Position of every entry of the factors' blocks in a CSC matrix (slot, row indices, indptr).

        Computed by pairs of variables; entries without a column get a slot after the last one.
        """
        n = self.layout.size
        of, places = self._pairs()
        var, width = self._variable[places], self._width[places]
        # one block for every two variables with a common factor, ordered by the column, then by the row
        _, at, block = np.unique(var[1] * (n + 1) + var[0], return_index=True, return_inverse=True)
        rows, columns, height, span = var[0][at], var[1][at], width[0][at], width[1][at]
        head = np.flatnonzero(np.diff(columns, prepend=-1))  # first block of every column of blocks
        above = np.cumsum(height) - height
        above -= np.repeat(above[head], np.diff(np.append(head, len(columns))))
        tall = np.add.reduceat(height, head) if len(head) else np.zeros(0, dtype=np.int64)
        lengths = np.zeros(n, dtype=np.int64)
        for b in range(int(span.max(initial=0))):
            wide = span[head] > b
            lengths[columns[head][wide] + b] = tall[wide]
        indptr = block_offsets(lengths)
        indices = np.zeros(indptr[-1], dtype=np.int64)
        slot = np.full(self._H_offset[-1], indptr[-1], dtype=np.intp)
        stride = np.diff(self._g_offset)[of]
        local = self._local[places] - self._g_offset[of]
        source = self._H_offset[of] + local[0] * stride + local[1]
        for h, w in sorted(set(zip(height.tolist(), span.tolist()))):
            here = np.flatnonzero((height == h) & (span == w))
            pairs = np.flatnonzero((width[0] == h) & (width[1] == w))
            which = np.searchsorted(here, block[pairs])
            target = indptr[columns[here, None] + np.arange(w)] + above[here, None]
            for row in range(h):
                indices[target + row] = rows[here, None] + row
                slot[(source + row * stride)[pairs, None] + np.arange(w)] = (target + row)[which]
        return slot, indices, indptr

    def _pairs(self) -> tuple[Index, Index]:
        """Factor ``(p,)`` and places ``(2, p)`` for every two free variables of every factor."""
        begin = block_offsets(self._arity)
        factors, places = [np.zeros(0, dtype=np.int64)], [np.zeros((2, 0), dtype=np.int64)]
        for a in np.unique(self._arity).tolist():
            f = np.flatnonzero(self._arity == a)
            one, other = np.divmod(np.arange(a * a), a)
            both = (begin[f, None] + np.stack([one, other])[:, None]).reshape(2, -1)
            free = (self._variable[both] >= 0).all(axis=0)
            factors.append(np.repeat(f, a * a)[free])
            places.append(both[:, free])
        return np.concatenate(factors), np.concatenate(places, axis=1)

    def _blocks(self, values: Values, hessian: bool, weights: Array | None = None) -> tuple[Array, Array, Array]:
        """Flat ``H`` and ``g`` (empty without ``hessian``) and losses ``(f,)`` in the order of the batches."""
        H = np.zeros(self._H_offset[-1] if hessian else 0)
        g = np.zeros(self._g_offset[-1] if hessian else 0)
        chi2 = np.zeros(len(self))
        with np.errstate(over="ignore", invalid="ignore"):  # an overflow gives inf or nan, which is refused by name
            for f, a, b in zip(self.batches, self._first, self._first[1:]):
                chi2[a:b] = f.blocks(values, hessian, H, self._H_offset[a : b + 1], g, self._g_offset[a : b + 1])
        if weights is not None:
            w = np.asarray(weights)[self._position]
            chi2 *= w
            if hessian:
                H *= np.repeat(w, np.diff(self._H_offset))
                g *= np.repeat(w, np.diff(self._g_offset))
        return H, g, chi2

    def squared(self, values: Values) -> Array:
        """``rᵀ Λ r`` ``(f,)`` of every factor in the order of the records, without robust kernels."""
        out = np.zeros(len(self))
        with np.errstate(over="ignore", invalid="ignore"):
            out[self._position] = np.concatenate([np.zeros(0), *(f.squared(values) for f in self.batches)])
        return out

    def objective(self, values: Values) -> float:
        """``Σ rᵀ Λ r`` (no ½)."""
        return self.evaluate(values, hessian=False).objective

    def evaluate(
        self, values: Values, *, hessian: bool = True, dense: bool | None = None, weights: Array | None = None
    ) -> LinearSystem:
        """Objective, gradient and Gauss-Newton matrix at ``values``.

        Parameters
        ----------
        hessian : bool
            False for the objective alone (``A`` and ``g`` are then empty).
        dense : bool, optional
            Dense ``A``; default: dense if that is faster.
        weights : (f,), optional
            Factor on the information of each factor, in the order of the records.
        """
        H, g, chi2 = self._blocks(values, hessian, weights)
        out = np.empty_like(chi2)
        out[self._position] = chi2
        if not hessian:
            return LinearSystem(np.zeros((0, 0)), np.zeros(0), out)
        n = self.layout.size
        free = self._columns >= 0
        gradient = np.bincount(self._columns[free], weights=g[free], minlength=n).astype(np.float64)
        if dense if dense is not None else n <= DENSE_LIMIT:
            from graphslam.graph.normal_kernels import scatter_dense  # numba takes a third of a second to load

            A = np.zeros((n, n))
            scatter_dense(self._columns, self._g_offset, H, self._H_offset, A)
            return LinearSystem(A, gradient, out)
        slot, indices, indptr = self._pattern
        data = np.bincount(slot, weights=H, minlength=len(indices) + 1)[:-1]
        return LinearSystem(sp.csc_matrix((data, indices, indptr), shape=(n, n)), gradient, out)

    def factor_blocks(self, values: Values) -> FactorBlocks:
        """Every factor separately at ``values``, for leverages and dof by class."""
        H, _, _ = self._blocks(values, True)
        d2 = self.squared(values)[self._position]
        weight = np.concatenate(
            [
                np.ones(0),
                *(robust_terms(d2[a:b], f.code, f.k)[1] for f, a, b in zip(self.batches, self._first, self._first[1:])),
            ]
        )
        columns = [self._columns[a:b] for a, b in zip(self._g_offset, self._g_offset[1:])]
        blocks = [H[a:b].reshape(len(c), len(c)) for a, b, c in zip(self._H_offset, self._H_offset[1:], columns)]
        return FactorBlocks(
            tuple(self.records[k] for k in self._position),
            tuple(columns),
            tuple(b / w for b, w in zip(blocks, weight)),
            d2,
            weight,
        )


# Above this number of columns a sparse factorisation is faster than a dense inverse factor (measured).
DENSE_LIMIT = 1600
