"""A graph's factors as flat arrays, and their Gauss-Newton system at given values.

This is the vectorised path that batch solving, covariances, diagnosis and the linearisation-gap report use. It is
independent of GTSAM, so that each can check the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from graphslam.core.geometry import Array
from graphslam.graph.factors.batch import FactorBatch, Record, batch_of, factor_kinds, offsets
from graphslam.graph.noise import robust_terms
from graphslam.graph.normal_kernels import scatter_dense
from graphslam.graph.variables import Layout, Values

Index = npt.NDArray[np.int64]


@dataclass(frozen=True)
class System:
    """``A δ = -g`` at one point, with the objective there.

    Parameters
    ----------
    A : (n, n) dense or CSC
        ``Σ w Jᵀ Λ J`` (right tangents).
    g : (n,)
        ``Σ w Jᵀ Λ r``: half the gradient of the objective.
    chi2 : (f,)
        ``rᵀ Λ r`` per factor (``2 ρ`` where a kernel acts), in the order of the records.
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
    """Every factor by itself, linearised at one point, robust kernels left aside.

    Parameters
    ----------
    records : tuple of Record
        In the order of the blocks.
    columns : tuple of (k,) int
        Free and fixed columns of each factor; -1 = fixed.
    H : tuple of (k, k)
        ``Jᵀ Λ J``.
    d2 : (f,)
        ``rᵀ Λ r``.
    weight : (f,)
        Weight that the factor's kernel gives it in :attr:`System.A`; 1 without one.
    """

    records: tuple[Record, ...]
    columns: tuple[Index, ...]
    H: tuple[Array, ...]
    d2: Array
    weight: Array


class FlatGraph:
    """Flat arrays of the factors of one graph revision.

    Parameters
    ----------
    records : sequence of Record
    layout : Layout
    """

    def __init__(self, records: Sequence[Record], layout: Layout) -> None:
        self.layout = layout
        self.records = tuple(records)
        order: dict[type, list[int]] = {batch.record: [] for batch in factor_kinds()}
        for k, rec in enumerate(records):
            order[batch_of(type(rec)).record].append(k)
        self._position = np.array([k for ks in order.values() for k in ks], dtype=np.intp)
        self.batches: list[FactorBatch] = [
            batch_of(t)([records[k] for k in ks], layout) for t, ks in order.items() if ks
        ]
        widths = [int(w) for f in self.batches for w in f.widths]
        self._first = offsets([len(f) for f in self.batches])
        self._g_offset = offsets(widths)
        self._H_offset = offsets([d * d for d in widths])
        self._columns = np.concatenate([np.zeros(0, dtype=np.int64), *(f.columns for f in self.batches)])

    @property
    def has_kernels(self) -> bool:
        """Does any factor carry a robust kernel?"""
        return any(bool(np.any(f.code != 0)) for f in self.batches)

    @cached_property
    def _pattern(self) -> tuple[npt.NDArray[np.intp], ...]:
        """Where every block entry lands in a CSC matrix: (kept entries, slot, row indices, indptr)."""
        n = self.layout.size
        rows, cols = [], []
        for k in range(len(self._g_offset) - 1):
            c = self._columns[self._g_offset[k] : self._g_offset[k + 1]]
            rows.append(np.repeat(c, len(c)))
            cols.append(np.tile(c, len(c)))
        r = np.concatenate([np.zeros(0, dtype=np.int64), *rows])
        c = np.concatenate([np.zeros(0, dtype=np.int64), *cols])
        keep = np.flatnonzero((r >= 0) & (c >= 0))
        unique, slot = np.unique(c[keep] * n + r[keep], return_inverse=True)
        indptr = np.searchsorted(unique, np.arange(n + 1) * n)
        return keep, slot, unique % max(n, 1), indptr

    def _blocks(self, values: Values, hessian: bool, weights: Array | None = None) -> tuple[Array, Array, Array]:
        """Flat ``H`` and ``g`` (empty without ``hessian``) and losses ``(f,)`` in the order of the batches."""
        H = np.zeros(self._H_offset[-1] if hessian else 0)
        g = np.zeros(self._g_offset[-1])
        chi2 = np.zeros(len(self.records))
        with np.errstate(over="ignore", invalid="ignore"):  # what overflows shows as inf or nan and is refused by name
            for f, a, b in zip(self.batches, self._first, self._first[1:]):
                chi2[a:b] = f.blocks(values, hessian, H, self._H_offset[a : b + 1], g, self._g_offset[a : b + 1])
        if weights is not None:
            w = np.asarray(weights)[self._position]
            chi2 *= w
            if hessian:
                H *= np.repeat(w, np.diff(self._H_offset))
                g *= np.repeat(w, np.diff(self._g_offset))
        return H, g, chi2

    def evaluate(
        self, values: Values, *, hessian: bool = True, dense: bool | None = None, weights: Array | None = None
    ) -> System:
        """Objective, gradient and Gauss-Newton matrix at ``values``.

        Parameters
        ----------
        hessian : bool
            False for the objective alone (``A`` and ``g`` are then empty).
        dense : bool, optional
            Dense ``A``; by default where that is faster.
        weights : (f,), optional
            Factor on the information of each factor, in the order of the records.
        """
        H, g, chi2 = self._blocks(values, hessian, weights)
        out = np.empty_like(chi2)
        out[self._position] = chi2
        if not hessian:
            return System(np.zeros((0, 0)), np.zeros(0), out)
        n = self.layout.size
        free = self._columns >= 0
        gradient = np.bincount(self._columns[free], weights=g[free], minlength=n).astype(np.float64)
        if dense if dense is not None else n <= DENSE_LIMIT:
            A = np.zeros((n, n))
            scatter_dense(self._columns, self._g_offset, H, self._H_offset, A)
            return System(A, gradient, out)
        keep, slot, indices, indptr = self._pattern
        data = np.bincount(slot, weights=H[keep], minlength=len(indices))
        return System(sp.csc_matrix((data, indices, indptr), shape=(n, n)), gradient, out)

    def factor_blocks(self, values: Values) -> FactorBlocks:
        """Every factor by itself at ``values``: what leverages and class-wise dof are made of."""
        H, _, _ = self._blocks(values, True)
        d2 = np.concatenate([np.zeros(0), *(f.squared(values) for f in self.batches)])
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


# Above this many columns a sparse factorisation wins over a dense inverse factor (measured).
DENSE_LIMIT = 1600
