"""Heights of nodes by air pressure: ``r = u(τ) · (p + R a) + h_0 - z``.

p and R are position and attitude of the node, a is the position of the body in its frame, u the vertical in the frame
of the first base (:mod:`graphslam.graph.factors.attitude`; its z axis if the graph has no tilt), and the variable h_0
is the height of the first base above the reference level of the barometer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.se3 import quat_to_matrix, skew
from graphslam.graph.factors.attitude import up_turn
from graphslam.graph.factors.batch import UniformBatch, register_factor
from graphslam.graph.variables import VariableKind, VariableLayout, register_variable

register_variable(
    VariableKind(
        "baselevel", "h", {3: "m"}, classes=("barometer",),
        remedy="the level of a barometer has no reading: remove it.",
    )
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class BarometerRecord:
    """One height.

    Parameters
    ----------
    arm : (3,)
        Position of the body in the frame of the node [m].
    height, sigma : float
        [m]
    baselevel : int
        Row of the level.
    tilt : bool
        The graph has the variable ``tilt``.
    """

    factor_id: int
    node: int
    time: float
    arm: Array
    height: float
    sigma: float
    baselevel: int
    tilt: bool = False
    group: str = "barometer"

    @property
    def rows(self) -> int:
        """Dimension of the residual."""
        return 1

    def variables(self) -> list[str]:
        """Names of the variables."""
        return [f"x{self.node}", f"baselevel{self.baselevel}", *(["tilt"] if self.tilt else [])]

    def label(self) -> str:
        """Name for messages."""
        return f"height at {self.time:.3f} s (factor {self.factor_id})"


class BarometerBatch(UniformBatch):
    """Heights."""

    record = BarometerRecord
    slots = ("x", "baselevel", "tilt")

    def __init__(self, records: Sequence[BarometerRecord], layout: VariableLayout) -> None:
        super().__init__(records, layout)
        self._arm = np.array([r.arm for r in records]).reshape(-1, 3)
        self._z = np.array([r.height for r in records])

    @staticmethod
    def keys(record: BarometerRecord) -> Sequence[int | None]:
        """Node, level, tilt."""
        return record.node, record.baselevel, 0 if record.tilt else None

    def terms(self, *blocks: Array) -> tuple[Array, Array]:
        """See :meth:`~graphslam.graph.factors.batch.UniformBatch.terms`."""
        x, level, tilt = blocks
        turn, J_r = up_turn(tilt[0] if len(tilt) else np.zeros(2))
        up, R = turn[:, 2], quat_to_matrix(x[:, 3:])
        at = x[:, :3] + (R @ self._arm[..., None])[..., 0]
        J = np.zeros((len(x), 1, 9))
        J[:, 0, :3] = -np.einsum("i,kij,kjl->kl", up, R, skew(self._arm))
        J[:, 0, 3:6] = up @ R
        J[:, 0, 6] = 1.0
        J[:, 0, 7:] = at @ (-turn @ skew([0.0, 0.0, 1.0]) @ J_r)
        return (at @ up + level[:, 0] - self._z)[:, None], J


register_factor(BarometerBatch)
