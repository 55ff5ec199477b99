"""Relative poses between two nodes: ``Log(T_ij⁻¹ x_i⁻¹ x_j)``, as GTSAM's BetweenFactor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt

from graphslam.core.geometry import Array
from graphslam.core.poses import SE2, SE3, group_of
from graphslam.graph.factors.batch import (
    Fixed,
    Index,
    UniformBatch,
    WhitenedRecord,
    custom_factor,
    gtsam_pose,
    with_kernel,
)
from graphslam.graph.noise import NO_KERNEL, RobustKernel
from graphslam.graph.variables import gtsam_key


def between_terms(T_ij: Array, x_i: Array, x_j: Array) -> tuple[Array, Array]:
    """Residuals ``(m, d)`` and Jacobians ``(m, d, 2 d)`` on (i, j) of relative poses ``(m, 3|7)``, not whitened."""
    G = group_of(T_ij)
    h = G.between(x_i, x_j)
    r = G.log(G.between(T_ij, h))
    J_j = G.right_jacobian_inverse(r)  # Log(e Exp(δ)) ≈ Log(e) + J_r⁻¹ δ
    J_i = -J_j @ G.adjoint(G.inverse(h))  # x_i Exp(δ): h → Exp(-δ) h = h Exp(-Ad(h⁻¹) δ)
    return r, np.concatenate([J_i, J_j], axis=2)


@dataclass(frozen=True, slots=True, eq=False)
class BetweenRecord(WhitenedRecord):
    """``T_ij`` between two nodes, right-tangent noise.

    Parameters
    ----------
    T_ij : (3,) or (7,)
    whitener : (3, 3) or (6, 6)
        Tangents in GTSAM's order: x, y, θ, or rotation before translation.
    """

    factor_id: int
    i: int
    j: int
    T_ij: Array
    whitener: Array
    robust: RobustKernel = NO_KERNEL
    group: str = "between"

    def variables(self) -> list[str]:
        """Names of the variables."""
        return [f"x{self.i}", f"x{self.j}"]

    def label(self) -> str:
        """Name for messages."""
        return f"{self.group} x{self.i} → x{self.j} (factor {self.factor_id})"


class BetweenBatch(UniformBatch):
    """Relative poses."""

    record = BetweenRecord
    relative = True
    slots = ("x", "x")

    def __init__(self, records: Sequence[BetweenRecord], layout: Any) -> None:
        super().__init__(records, layout)
        self._group = SE2 if layout.dim == 2 else SE3
        self._T = np.array([r.T_ij for r in records]).reshape(-1, self._group.size)

    @classmethod
    def of_arrays(
        cls,
        ends: Index,
        T_ij: Array,
        whiteners: Array,
        layout: Any,
        *,
        group: str = "between",
        ids: npt.NDArray[Any] | None = None,
    ) -> BetweenBatch:
        """A batch from arrays, without an object per factor.

        Parameters
        ----------
        ends : (m, 2) int
            Rows of the nodes.
        T_ij : (m, 3|7)
        whiteners : (m, d, d)
        group : str
            Class of all factors.
        ids : (m,) int, optional
            Ids of the factors; default: numbered from 0.
        """

        def record(k: int) -> BetweenRecord:
            i, j = ends[k].tolist()
            return BetweenRecord(k if ids is None else int(ids[k]), i, j, T_ij[k], whiteners[k], group=group)

        out = cls._bare(ends, whiteners, layout, group, record)
        out._group, out._T = (SE2 if layout.dim == 2 else SE3), T_ij
        return out

    @property
    def ends(self) -> Index:
        """Rows ``(m, 2)`` of the nodes."""
        return self._rows

    @property
    def measured(self) -> Array:
        """``T_ij`` ``(m, 3|7)``."""
        return self._T

    @staticmethod
    def keys(record: BetweenRecord) -> Sequence[int | None]:
        """From, to."""
        return record.i, record.j

    def residuals(self, *blocks: Array) -> Array:
        """See :meth:`UniformBatch.residuals`."""
        G = self._group
        return G.log(G.between(self._T, G.between(*blocks)))

    def terms(self, *blocks: Array) -> tuple[Array, Array]:
        """See :meth:`UniformBatch.terms`."""
        return between_terms(self._T, *blocks)

    @classmethod
    def gtsam(cls, record: BetweenRecord, fixed: Fixed) -> gtsam.NonlinearFactor:
        """GTSAM's own, or a prior if one node is the fixed first base."""
        # Not SqrtInformation(W): GTSAM expects an upper triangular one, and uses only the diagonal of a lower one.
        information = record.whitener.T @ record.whitener
        noise = with_kernel(gtsam.noiseModel.Gaussian.Information(information), record.robust)
        group = group_of(record.T_ij)
        plane = group.dim == 2
        origin = fixed.get("x0")
        if origin is None or (record.i and record.j):
            ki, kj = gtsam_key(f"x{record.i}"), gtsam_key(f"x{record.j}")
            between = gtsam.BetweenFactorPose2 if plane else gtsam.BetweenFactorPose3
            return between(ki, kj, gtsam_pose(record.T_ij), noise)
        if record.j:  # from the fixed base: Log(T⁻¹ x_0⁻¹ x_j) is the residual of a prior on x_j
            prior = gtsam.PriorFactorPose2 if plane else gtsam.PriorFactorPose3
            return prior(gtsam_key(f"x{record.j}"), gtsam_pose(group.compose(origin, record.T_ij)), noise)
        return custom_factor(cls, record, fixed)  # Log(T⁻¹ x_i⁻¹ x_0) is not the residual of a prior
