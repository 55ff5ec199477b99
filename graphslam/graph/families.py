"""Kinds of factors, each all at once: columns, whitened residuals and Jacobians, Gauss-Newton blocks.

A new kind of factor is one record (:mod:`graphslam.graph.records`), one family here or in a file of its own, and one
conversion in :mod:`graphslam.graph.gtsam_factors`. :class:`~graphslam.graph.flat.FlatGraph` puts the families together.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from graphslam.core.geometry import Array
from graphslam.core.poses import SE2, SE3
from graphslam.graph.noise import NO_KERNEL, robust_terms
from graphslam.graph.normal_kernels import submap_blocks
from graphslam.graph.records import BetweenRecord, BiasPriorRecord, SubmapRecord
from graphslam.graph.state import Layout, Values

Index = npt.NDArray[np.int64]


def offsets(lengths: Sequence[int]) -> Index:
    """``[0, l_0, l_0 + l_1, …]``."""
    return np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)


class Family(ABC):
    """All factors of one kind.

    Parameters
    ----------
    records : sequence of records
        Of :attr:`record`, possibly none.
    layout : Layout

    Attributes
    ----------
    widths : (k,) int
        Columns of each factor, fixed ones included.
    columns : (Σ widths,) int
        Where they are in the layout; -1 = fixed.
    code, k : (k,)
        Robust kernel of each (:func:`~graphslam.graph.noise.robust_terms`).
    """

    record: ClassVar[type]

    def __init__(self, records: Sequence[Any], layout: Layout) -> None:
        self.records = list(records)
        self.layout = layout
        kernels = [getattr(r, "robust", NO_KERNEL) for r in records]
        self.code = np.array([r.code for r in kernels], dtype=np.int64)
        self.k = np.array([r.k for r in kernels])
        self.widths: Index = np.zeros(0, dtype=np.int64)
        self.columns: Index = np.zeros(0, dtype=np.int64)

    def __len__(self) -> int:
        return len(self.records)

    @abstractmethod
    def squared(self, values: Values) -> Array:
        """``rᵀ Λ r`` ``(k,)``, kernels left aside."""

    @abstractmethod
    def blocks(self, values: Values, hessian: bool, H: Array, H_offset: Index, g: Array, g_offset: Index) -> Array:
        """Fill this family's part of the flat blocks; return its losses ``(k,)`` (``2 ρ`` where a kernel acts).

        Parameters
        ----------
        H : flat
            Row-major ``w Jᵀ Λ J`` of the factors, one after the other; ``H_offset`` ``(k + 1,)`` says where.
        g : flat
            ``w Jᵀ Λ r``; ``g_offset`` ``(k + 1,)``.
        """


class SubmapFamily(Family):
    """Landmark submaps (Combined SLAM eq. 15), by a compiled kernel."""

    record = SubmapRecord

    def __init__(self, records: Sequence[SubmapRecord], layout: Layout) -> None:
        super().__init__(records, layout)
        row = layout.row_of
        self._start = np.array([r.start for r in records], dtype=np.int64)
        self._entry_offset = offsets([len(r.landmark_ids) for r in records])
        ids = np.concatenate([np.zeros(0, dtype=np.int64), *(r.landmark_ids for r in records)])
        self._entry_row = np.array([row[i] for i in ids.tolist()], dtype=np.int64)
        self._z = np.concatenate([np.zeros(0), *(r.z for r in records)])
        self._z_offset = offsets([len(r.z) for r in records])
        self._info = np.concatenate([np.zeros(0), *(r.information for r in records)])
        self._info_offset = offsets([len(r.z) ** 2 for r in records])
        self.widths = 6 + 2 * np.diff(self._entry_offset)
        # every submap: two poses, then its entries; the heads are put in front of the entries' flat columns
        points = (layout.landmark_start + 2 * self._entry_row[:, None] + np.arange(2)).ravel()
        heads = np.concatenate([layout.pose_columns(self._start), layout.pose_columns(self._start + 1)], axis=1).ravel()
        self.columns = np.insert(points, np.repeat(2 * self._entry_offset[:-1], 6), heads)

    def squared(self, values: Values) -> Array:
        """``rᵀ Λ r`` ``(k,)``."""
        none, no_offset = np.zeros(0), np.zeros(len(self) + 1, dtype=np.int64)
        return self.blocks(values, False, none, no_offset, none, no_offset)

    def blocks(self, values: Values, hessian: bool, H: Array, H_offset: Index, g: Array, g_offset: Index) -> Array:
        """See :meth:`Family.blocks`."""
        chi2 = np.zeros(len(self))
        if len(self) == 0:
            return chi2
        submap_blocks(
            np.ascontiguousarray(values.poses), np.ascontiguousarray(values.landmarks), self._start,
            self._entry_offset, self._entry_row, self._z, self._z_offset, self._info, self._info_offset,
            hessian, H, H_offset, g, g_offset, chi2,
        )  # fmt: skip
        return chi2


class UniformFamily(Family):
    """Factors that all have as many rows and columns: :meth:`terms` is all that a kind has to say."""

    @abstractmethod
    def terms(self, values: Values) -> tuple[Array, Array]:
        """Whitened residuals ``(k, d)`` and Jacobians ``(k, d, c)`` on :attr:`columns`."""

    def _set_columns(self, columns: Index) -> None:
        """Columns ``(k, c)``."""
        self.columns = np.asarray(columns, dtype=np.int64).ravel()
        self.widths = np.full(len(self), columns.shape[1], dtype=np.int64)

    def squared(self, values: Values) -> Array:
        """``rᵀ Λ r`` ``(k,)``."""
        return np.sum(self.terms(values)[0] ** 2, axis=1) if len(self) else np.zeros(0)

    def blocks(self, values: Values, hessian: bool, H: Array, H_offset: Index, g: Array, g_offset: Index) -> Array:
        """See :meth:`Family.blocks`."""
        if len(self) == 0:
            return np.zeros(0)
        r, J = self.terms(values)
        loss, w = robust_terms(np.sum(r**2, axis=1), self.code, self.k)
        if hessian:
            Jt = np.swapaxes(J, 1, 2) * w[:, None, None]
            H[H_offset[0] : H_offset[-1]] = (Jt @ J).ravel()
            g[g_offset[0] : g_offset[-1]] = (Jt @ r[..., None]).ravel()
        return loss


class BetweenFamily(UniformFamily):
    """Relative poses: residuals ``Log(T_ij⁻¹ h)``, ``h = x_i⁻¹ x_j``."""

    record = BetweenRecord

    def __init__(self, records: Sequence[BetweenRecord], layout: Layout) -> None:
        super().__init__(records, layout)
        self._group = SE2 if layout.dim == 2 else SE3
        d = self._group.dof
        self._i = np.array([r.i for r in records], dtype=np.int64)
        self._j = np.array([r.j for r in records], dtype=np.int64)
        self._T = np.array([r.T_ij for r in records]).reshape(-1, self._group.size)
        self._W = np.array([r.whitener for r in records]).reshape(-1, d, d)
        self._set_columns(np.concatenate([layout.pose_columns(self._i), layout.pose_columns(self._j)], axis=1))

    def terms(self, values: Values) -> tuple[Array, Array]:
        """See :meth:`UniformFamily.terms`."""
        G = self._group
        h = G.between(values.poses[self._i], values.poses[self._j])
        r = G.log(G.between(self._T, h))
        J_j = np.linalg.inv(G.right_jacobian(r))  # Log(e Exp(δ)) ≈ Log(e) + J_r⁻¹ δ
        J_i = -J_j @ G.adjoint(G.inverse(h))  # x_i Exp(δ): h → Exp(-δ) h = h Exp(-Ad(h⁻¹) δ)
        return np.einsum("kij,kj->ki", self._W, r), self._W @ np.concatenate([J_i, J_j], axis=2)


class BiasPriorFamily(UniformFamily):
    """Priors on the biases of GPS segments."""

    record = BiasPriorRecord

    def __init__(self, records: Sequence[BiasPriorRecord], layout: Layout) -> None:
        super().__init__(records, layout)
        self._bias = np.array([r.bias for r in records], dtype=np.int64)
        self._sigma = np.array([r.sigma for r in records])
        self._set_columns(layout.bias_start + layout.dim * self._bias[:, None] + np.arange(layout.dim))

    def terms(self, values: Values) -> tuple[Array, Array]:
        """See :meth:`UniformFamily.terms`."""
        sigma = self._sigma[:, None]
        return values.biases[self._bias] / sigma, np.eye(self.layout.dim) / sigma[..., None]

    def squared(self, values: Values) -> Array:
        """``rᵀ Λ r`` ``(k,)``."""
        return np.sum(values.biases[self._bias] ** 2, axis=1) / self._sigma**2

    def blocks(self, values: Values, hessian: bool, H: Array, H_offset: Index, g: Array, g_offset: Index) -> Array:
        """See :meth:`Family.blocks`; no need of a product of matrices."""
        if hessian and len(self):
            info = 1.0 / self._sigma**2
            H[H_offset[0] : H_offset[-1]] = (info[:, None, None] * np.eye(self.layout.dim)).ravel()
            g[g_offset[0] : g_offset[-1]] = (info[:, None] * values.biases[self._bias]).ravel()
        return self.squared(values)
