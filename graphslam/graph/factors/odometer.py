"""Motion by wheels and gyro whose turn rate is off by a constant, and whose distances are off by a factor.

With the twist measured from node i to node j, ``ξ = [ω, v] Δt`` (rotation first), the bias β of the turn rate about z
and the scale error σ of distances::

    r = Log(Exp(ξ(β, σ))⁻¹ x_i⁻¹ x_j),   ξ(β, σ) = [ω - β e_z, (1 + σ) v] Δt
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.poses import SE3
from graphslam.graph.factors.batch import UniformBatch
from graphslam.graph.noise import NO_KERNEL, RobustKernel
from graphslam.graph.variables import VariableKind, register_variable

register_variable(
    VariableKind(
        "odometer", "o", {3: "rm"}, classes=("odometer",),
        remedy="bias and scale of an odometer need a prior, or positions from elsewhere.",
    )
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class OdometerRecord:
    """Motion between two nodes.

    Parameters
    ----------
    odometer : int
        Row of its bias of the turn rate [rad/s] and scale error.
    twist : (6,)
        Rotation [rad] and translation [m] from i to j, as measured.
    whitener : (6, 6)
        In the right tangent at j.
    """

    factor_id: int
    i: int
    j: int
    odometer: int
    twist: Array
    seconds: float
    whitener: Array
    robust: RobustKernel = NO_KERNEL
    group: str = "odometer"

    @property
    def rows(self) -> int:
        """Dimension of the residual."""
        return 6

    def variables(self) -> list[str]:
        """Names of the variables."""
        return [f"x{self.i}", f"x{self.j}", f"odometer{self.odometer}"]

    def label(self) -> str:
        """Name for messages."""
        return f"odometer x{self.i} → x{self.j} (factor {self.factor_id})"


class OdometerBatch(UniformBatch):
    """Motion by wheels and gyro."""

    record = OdometerRecord
    slots = ("x", "x", "odometer")

    def __init__(self, records: Sequence[OdometerRecord], layout: Any) -> None:
        super().__init__(records, layout)
        self._twist = np.array([r.twist for r in records]).reshape(-1, 6)
        self._seconds = np.array([r.seconds for r in records])

    @staticmethod
    def keys(record: OdometerRecord) -> Sequence[int | None]:
        """From, to, odometer."""
        return record.i, record.j, record.odometer

    def terms(self, *blocks: Array) -> tuple[Array, Array]:
        """See :meth:`~graphslam.graph.factors.batch.UniformBatch.terms`."""
        x_i, x_j, o = blocks
        D = np.zeros((len(o), 6, 2))  # of the twist by bias and scale
        D[:, 2, 0] = -self._seconds
        D[:, 3:, 1] = self._twist[:, 3:]
        xi = self._twist + (D @ o[..., None])[..., 0]
        h = SE3.between(x_i, x_j)
        r = SE3.log(SE3.between(SE3.exp(xi), h))
        J_j = np.linalg.inv(SE3.right_jacobian(r))
        J_i = -J_j @ SE3.adjoint(SE3.inverse(h))
        # Exp(ξ + δ)⁻¹ h = Exp(-J_r(ξ) δ) Exp(r): seen from the left
        J_o = -np.linalg.inv(SE3.right_jacobian(-r)) @ SE3.right_jacobian(xi) @ D
        return r, np.concatenate([J_i, J_j, J_o], axis=2)


@dataclass(frozen=True, slots=True, eq=False)
class OdometerPriorRecord:
    """How large bias and scale error may be: ``N(0, diag(sigmas²))``.

    Parameters
    ----------
    sigmas : (2,)
        [rad/s], and of the scale.
    """

    factor_id: int
    odometer: int
    sigmas: tuple[float, float]
    group: str = "odometer-prior"

    @property
    def rows(self) -> int:
        """Dimension of the residual."""
        return 2

    def variables(self) -> list[str]:
        """Names of the variables."""
        return [f"odometer{self.odometer}"]

    def label(self) -> str:
        """Name for messages."""
        return f"prior on odometer{self.odometer} (factor {self.factor_id})"


class OdometerPriorBatch(UniformBatch):
    """Priors on bias and scale."""

    record = OdometerPriorRecord
    slots = ("odometer",)
    prior = True

    @staticmethod
    def keys(record: OdometerPriorRecord) -> Sequence[int | None]:
        """The odometer."""
        return (record.odometer,)

    @staticmethod
    def whitener(record: OdometerPriorRecord) -> Array:
        """Of both σ."""
        return np.diag(1.0 / np.array(record.sigmas))

    def terms(self, *blocks: Array) -> tuple[Array, Array]:
        """See :meth:`~graphslam.graph.factors.batch.UniformBatch.terms`."""
        return blocks[0], np.broadcast_to(np.eye(2), (len(self), 2, 2))
