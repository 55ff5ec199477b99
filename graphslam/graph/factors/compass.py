"""Compass headings, with the variables zero and hard-iron deviation, and the magnetic declination.

A reading z is the heading of the body's x axis, counter-clockwise from magnetic east. With the node's heading ψ in
the frame of the first base, the *zero* c of the compass in that frame, and the hard-iron deviation d (the classical
coefficients of a single turn)::

    r = wrap(ψ + c + d_1 sin z + d_2 cos z - z)

In 3-D, ψ is the heading of the body's x axis, projected on the level plane of the first base. If the graph has a GPS
datum and the declination D (positive if magnetic north is east of true north) is known, it constrains the zero::

    r = wrap(c - (ψ_datum + D))
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphslam.core.geometry import Array, wrap_angle
from graphslam.core.se3 import quat_to_matrix, skew
from graphslam.graph.factors.batch import UniformBatch
from graphslam.graph.noise import NO_KERNEL, RobustKernel
from graphslam.graph.variables import VariableKind, register_variable

register_variable(
    VariableKind(
        "compass", "c", {2: "r", 3: "r"}, classes=("compass",),
        remedy="the zero of a compass is unconstrained: add readings at nodes that are connected to x0.",
    )
)  # fmt: skip
register_variable(VariableKind("deviation", "d", {2: "rr", 3: "rr"}, classes=("deviation",)))


@dataclass(frozen=True, slots=True, eq=False)
class CompassRecord:
    """One reading at a node.

    Parameters
    ----------
    axis : (dim,)
        The body's x axis in the node's frame, a unit vector.
    heading : float
        z [rad].
    sigma : float
        Of the reading and of the body's heading in the node's frame combined [rad].
    compass : int
        Number of its zero.
    deviation : int or None
        Number of its deviation, if that is estimated.
    """

    factor_id: int
    node: int
    time: float
    axis: Array
    heading: float
    sigma: float
    compass: int = 0
    deviation: int | None = None
    robust: RobustKernel = NO_KERNEL
    group: str = "compass"

    @property
    def rows(self) -> int:
        """Dimension of the residual."""
        return 1

    def variables(self) -> list[str]:
        """Names of the variables."""
        names = [f"x{self.node}", f"compass{self.compass}"]
        return names if self.deviation is None else [*names, f"deviation{self.deviation}"]

    def label(self) -> str:
        """Name for messages."""
        return f"compass at {self.time:.3f} s on x{self.node} (factor {self.factor_id})"


class CompassBatch(UniformBatch):
    """Compass readings, 2-D or 3-D."""

    record = CompassRecord
    slots = ("x", "compass", "deviation")

    def __init__(self, records: Sequence[CompassRecord], layout: Any) -> None:
        super().__init__(records, layout)
        self._axis = np.array([r.axis for r in records]).reshape(-1, layout.dim)
        self._z = np.array([r.heading for r in records])

    @staticmethod
    def keys(record: CompassRecord) -> Sequence[int | None]:
        """Node, zero, and deviation if it is estimated."""
        return record.node, record.compass, record.deviation

    def terms(self, *blocks: Array) -> tuple[Array, Array]:
        """See :meth:`~graphslam.graph.factors.batch.UniformBatch.terms`."""
        x, zero, deviation = blocks
        k, a = len(x), self._axis
        iron = np.column_stack([np.sin(self._z), np.cos(self._z)])
        if self.dim == 2:
            psi = x[:, 2] + np.arctan2(a[:, 1], a[:, 0])
            by_pose = np.broadcast_to(np.array([0.0, 0.0, 1.0]), (k, 3))
        else:
            R = quat_to_matrix(x[:, 3:])
            u = (R @ a[..., None])[..., 0]
            psi = np.arctan2(u[:, 1], u[:, 0])
            du = -R @ skew(a)  # R Exp(δ) a = u + R (δ × a)
            level = np.maximum(u[:, 0] ** 2 + u[:, 1] ** 2, 1e-12)
            turn = (u[:, :1] * du[:, 1] - u[:, 1:2] * du[:, 0]) / level[:, None]
            by_pose = np.concatenate([turn, np.zeros((k, 3))], axis=1)
        known = np.where(self._rows[:, 2:] < 0, 0.0, iron)
        r = wrap_angle(psi + zero[:, 0] + np.sum(known * deviation, axis=1) - self._z)
        return r[:, None], np.concatenate([by_pose, np.ones((k, 1)), known], axis=1)[:, None]


@dataclass(frozen=True, slots=True, eq=False)
class DeclinationRecord:
    """The zero of a compass relative to the GPS frame.

    Parameters
    ----------
    declination, sigma : float
        [rad]
    """

    factor_id: int
    compass: int
    declination: float
    sigma: float
    group: str = "declination"

    @property
    def rows(self) -> int:
        """Dimension of the residual."""
        return 1

    def variables(self) -> list[str]:
        """Names of the variables."""
        return [f"compass{self.compass}", "datum"]

    def label(self) -> str:
        """Name for messages."""
        return f"declination of compass {self.compass} (factor {self.factor_id})"


class DeclinationBatch(UniformBatch):
    """Zeros of compasses relative to the GPS frame."""

    record = DeclinationRecord
    slots = ("compass", "datum")

    def __init__(self, records: Sequence[DeclinationRecord], layout: Any) -> None:
        super().__init__(records, layout)
        self._declination = np.array([r.declination for r in records])

    @staticmethod
    def keys(record: DeclinationRecord) -> Sequence[int | None]:
        """Zero, datum."""
        return record.compass, 0

    def terms(self, *blocks: Array) -> tuple[Array, Array]:
        """See :meth:`~graphslam.graph.factors.batch.UniformBatch.terms`; the datum's heading is last."""
        zero, datum = blocks
        r = wrap_angle(zero[:, 0] - datum[:, -1] - self._declination)
        J = np.zeros((len(r), 1, 1 + (3 if self.dim == 2 else 4)))
        J[:, :, 0], J[:, :, -1] = 1.0, -1.0
        return r[:, None], J


@dataclass(frozen=True, slots=True, eq=False)
class DeviationPriorRecord:
    """Prior on a hard-iron deviation: ``N(0, sigma² I)``."""

    factor_id: int
    deviation: int
    sigma: float
    group: str = "deviation"

    @property
    def rows(self) -> int:
        """Dimension of the residual."""
        return 2

    def variables(self) -> list[str]:
        """Names of the variables."""
        return [f"deviation{self.deviation}"]

    def label(self) -> str:
        """Name for messages."""
        return f"prior on deviation{self.deviation} (factor {self.factor_id})"


class DeviationPriorBatch(UniformBatch):
    """Priors on deviations."""

    record = DeviationPriorRecord
    slots = ("deviation",)
    prior = True

    @staticmethod
    def keys(record: DeviationPriorRecord) -> Sequence[int | None]:
        """The deviation."""
        return (record.deviation,)

    def terms(self, *blocks: Array) -> tuple[Array, Array]:
        """See :meth:`~graphslam.graph.factors.batch.UniformBatch.terms`."""
        return blocks[0], np.broadcast_to(np.eye(2), (len(self), 2, 2))
