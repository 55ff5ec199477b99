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

from graphslam.core.geometry import Array, se2_adjoint, se2_between, se2_inverse, se2_log, se2_right_jacobian
from graphslam.graph.gps import gps_jacobians
from graphslam.graph.noise import robust_terms
from graphslam.graph.normal_kernels import scatter_dense, submap_blocks
from graphslam.graph.records import BetweenRecord, BiasPriorRecord, GpsRecord, Record, SubmapRecord
from graphslam.graph.state import Layout, Values

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


def _offsets(lengths: Sequence[int]) -> Index:
    return np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)


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
        order: dict[type, list[int]] = {SubmapRecord: [], BetweenRecord: [], GpsRecord: [], BiasPriorRecord: []}
        for k, rec in enumerate(records):
            order[type(rec)].append(k)
        self._position = np.array([k for ks in order.values() for k in ks], dtype=np.intp)
        self._submaps: list[SubmapRecord] = [records[k] for k in order[SubmapRecord]]  # type: ignore[misc]
        self._betweens: list[BetweenRecord] = [records[k] for k in order[BetweenRecord]]  # type: ignore[misc]
        self._fixes: list[GpsRecord] = [records[k] for k in order[GpsRecord]]  # type: ignore[misc]
        self._priors: list[BiasPriorRecord] = [records[k] for k in order[BiasPriorRecord]]  # type: ignore[misc]
        self._flatten_submaps()
        self._flatten_small()
        dims = [6 + 2 * len(r.landmark_ids) for r in self._submaps]
        dims += [6] * len(self._betweens) + [8] * len(self._fixes) + [2] * len(self._priors)
        self._g_offset = _offsets(dims)
        self._H_offset = _offsets([d * d for d in dims])
        self._columns = np.concatenate([np.zeros(0, dtype=np.int64), *self._column_parts()])

    def _flatten_submaps(self) -> None:
        subs, row = self._submaps, self.layout.row_of
        self._start = np.array([r.start for r in subs], dtype=np.int64)
        self._entry_offset = _offsets([len(r.landmark_ids) for r in subs])
        ids = np.concatenate([np.zeros(0, dtype=np.int64), *(r.landmark_ids for r in subs)])
        self._entry_row = np.array([row[i] for i in ids.tolist()], dtype=np.int64)
        self._z = np.concatenate([np.zeros(0), *(r.z for r in subs)])
        self._z_offset = _offsets([len(r.z) for r in subs])
        self._info = np.concatenate([np.zeros(0), *(r.information for r in subs)])
        self._info_offset = _offsets([len(r.z) ** 2 for r in subs])

    def _flatten_small(self) -> None:
        b, f, p = self._betweens, self._fixes, self._priors
        self._b_i = np.array([r.i for r in b], dtype=np.int64)
        self._b_j = np.array([r.j for r in b], dtype=np.int64)
        self._b_T = np.array([r.T_ij for r in b]).reshape(-1, 3)
        self._b_W = np.array([r.whitener for r in b]).reshape(-1, 3, 3)
        self._f_node = np.array([r.node for r in f], dtype=np.int64)
        self._f_arm = np.array([r.arm for r in f]).reshape(-1, 2)
        self._f_z = np.array([r.z for r in f]).reshape(-1, 2)
        self._f_W = np.array([r.whitener for r in f]).reshape(-1, 2, 2)
        self._f_bias = np.array([-1 if r.bias is None else r.bias for r in f], dtype=np.int64)
        kernels = [r.robust for r in b] + [r.robust for r in f]
        self._code = np.array([k.code for k in kernels], dtype=np.int64)
        self._k = np.array([k.k for k in kernels])
        self._p_bias = np.array([r.bias for r in p], dtype=np.int64)
        self._p_sigma = np.array([r.sigma for r in p])

    def _column_parts(self) -> list[Index]:
        lay = self.layout
        parts: list[Index] = []

        def pose(k: Index) -> Index:  # x_0 has no columns: -1
            c = 3 * (np.asarray(k)[..., None] - 1) + np.arange(3)
            return np.where(c < 0, -1, c)

        def bias(s: Index) -> Index:
            return np.where(s[:, None] < 0, -1, lay.bias_start + 2 * s[:, None] + np.arange(2))

        # every submap: two poses, then its entries; the heads are put in front of the entries' flat columns
        points = (lay.landmark_start + 2 * self._entry_row[:, None] + np.arange(2)).ravel()
        heads = np.concatenate([pose(self._start), pose(self._start + 1)], axis=1).ravel()
        parts.append(np.insert(points, np.repeat(2 * self._entry_offset[:-1], 6), heads))
        parts.append(np.concatenate([pose(self._b_i), pose(self._b_j)], axis=1).ravel())
        datum = np.broadcast_to(lay.datum_start + np.arange(3), (len(self._fixes), 3))
        parts.append(np.concatenate([pose(self._f_node), datum, bias(self._f_bias)], axis=1).ravel())
        parts.append(bias(self._p_bias).ravel())
        return [np.asarray(p, dtype=np.int64) for p in parts]

    @property
    def has_kernels(self) -> bool:
        """Does any factor carry a robust kernel?"""
        return bool(np.any(self._code != 0))

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

    def evaluate(self, values: Values, *, hessian: bool = True, dense: bool | None = None) -> System:
        """Objective, gradient and Gauss-Newton matrix at ``values``.

        Parameters
        ----------
        hessian : bool
            False for the objective alone (``A`` and ``g`` are then empty).
        dense : bool, optional
            Dense ``A``; by default where that is faster.
        """
        H = np.zeros(self._H_offset[-1] if hessian else 0)
        g = np.zeros(self._g_offset[-1])
        S = len(self._submaps)
        chi2 = np.zeros(len(self.records))
        submap_blocks(
            np.ascontiguousarray(values.poses), np.ascontiguousarray(values.landmarks), self._start,
            self._entry_offset, self._entry_row, self._z, self._z_offset, self._info, self._info_offset,
            hessian, H, self._H_offset, g, self._g_offset, chi2[:S],
        )  # fmt: skip
        with np.errstate(over="ignore", invalid="ignore"):  # what overflows shows as inf or nan and is refused by name
            self._small_blocks(values, hessian, H, g, chi2[S:])
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
        H, g, chi2 = np.zeros(self._H_offset[-1]), np.zeros(self._g_offset[-1]), np.zeros(len(self.records))
        S, B = len(self._submaps), len(self._betweens)
        submap_blocks(
            np.ascontiguousarray(values.poses), np.ascontiguousarray(values.landmarks), self._start,
            self._entry_offset, self._entry_row, self._z, self._z_offset, self._info, self._info_offset,
            True, H, self._H_offset, g, self._g_offset, chi2[:S],
        )  # fmt: skip
        self._small_blocks(values, True, H, g, chi2[S:])
        (r_b, _), (r_f, _) = self._whitened_terms(values)
        d2 = chi2.copy()
        d2[S : S + B + len(r_f)] = np.concatenate([np.sum(r_b**2, axis=1), np.sum(r_f**2, axis=1)])
        weight = np.ones(len(d2))
        weight[S : S + len(self._code)] = robust_terms(d2[S : S + len(self._code)], self._code, self._k)[1]
        columns = [self._columns[a:b] for a, b in zip(self._g_offset, self._g_offset[1:])]
        blocks = [H[a:b].reshape(len(c), len(c)) for a, b, c in zip(self._H_offset, self._H_offset[1:], columns)]
        return FactorBlocks(
            tuple(self.records[k] for k in self._position),
            tuple(columns),
            tuple(b / w for b, w in zip(blocks, weight)),
            d2,
            weight,
        )

    def _whitened_terms(self, values: Values) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """Whitened residuals and Jacobians of between factors and of GPS fixes."""
        r_b, J_b = self._between_terms(values)
        F = len(self._fixes)
        r_f, J_f = gps_jacobians(values, self._f_node, self._f_arm, self._f_z, self._f_bias) if F else (_R0, _J0)
        b = np.einsum("kij,kj->ki", self._b_W, r_b), self._b_W @ J_b
        return b, (np.einsum("kij,kj->ki", self._f_W, r_f), self._f_W @ J_f)

    def _small_blocks(self, values: Values, hessian: bool, H: Array, g: Array, chi2: Array) -> None:
        """Between factors, GPS fixes and bias priors, all of a kind at once."""
        S, B, F = len(self._submaps), len(self._betweens), len(self._fixes)
        (r_b, J_b), (r_f, J_f) = self._whitened_terms(values)
        d2 = np.concatenate([np.sum(r_b**2, axis=1), np.sum(r_f**2, axis=1)])
        chi2[: B + F], w = robust_terms(d2, self._code, self._k)
        bias = values.biases[self._p_bias] if len(self._p_bias) else np.zeros((0, 2))
        chi2[B + F :] = np.sum(bias**2, axis=1) / self._p_sigma**2
        if not hessian:
            return
        for first, r, J, weight in ((S, r_b, J_b, w[:B]), (S + B, r_f, J_f, w[B:])):
            k, d = len(r), J.shape[-1]
            Jt = np.swapaxes(J, 1, 2) * weight[:, None, None]
            H[self._H_offset[first] : self._H_offset[first] + k * d * d] = (Jt @ J).ravel()
            g[self._g_offset[first] : self._g_offset[first] + k * d] = (Jt @ r[..., None]).ravel()
        info = 1.0 / self._p_sigma**2
        H[self._H_offset[S + B + F] :] = (info[:, None, None] * np.eye(2)).ravel()
        g[self._g_offset[S + B + F] :] = (info[:, None] * bias).ravel()

    def _between_terms(self, values: Values) -> tuple[Array, Array]:
        """Residuals ``Log(T_ij⁻¹ h)``, ``h = x_i⁻¹ x_j``, and Jacobians on (x_i, x_j)."""
        h = se2_between(values.poses[self._b_i], values.poses[self._b_j])
        r = se2_log(se2_between(self._b_T, h))
        J_j = np.linalg.inv(se2_right_jacobian(r))  # Log(e Exp(δ)) ≈ Log(e) + J_r⁻¹ δ
        J_i = -J_j @ se2_adjoint(se2_inverse(h))  # x_i Exp(δ): h → Exp(-δ) h = h Exp(-Ad(h⁻¹) δ)
        return r, np.concatenate([J_i, J_j], axis=2)


_R0, _J0 = np.zeros((0, 2)), np.zeros((0, 2, 8))
# Above this many columns a sparse factorisation wins over a dense inverse factor (measured).
DENSE_LIMIT = 1600
