"""Factors on the constant errors of a robot's wheels and sensor (:mod:`graphslam.core.sensor_biases`).

Rows ``R g - d`` of unit variance over ``g = [wheels, sensor, mount]``: their prior, and the information from each
submap's own motion and observations, with its end pose and landmarks marginalised out. The effect of constant errors on
a submap is in the submap's own factor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.sensor_biases import CONSTANTS
from graphslam.graph.factors.batch import Index, UniformBatch
from graphslam.graph.factors.landmark_submap import CONSTANT
from graphslam.graph.variables import Values

SIZE = len(CONSTANTS)


def sensor_biases_at(values: Values, robot: int) -> Array:
    """Constant errors ``(6,)`` of a robot, in the order of :data:`~graphslam.core.sensor_biases.CONSTANTS`."""
    return np.concatenate([values[w][robot] for w in CONSTANT])


def bias_variable_names(robot: int) -> list[str]:
    """Names of the variables of these errors."""
    return [f"{w}{robot}" for w in CONSTANT]


@dataclass(frozen=True, slots=True, eq=False)
class SensorBiasRecord:
    """One factor on the constant errors of a robot.

    Parameters
    ----------
    robot : int
        Row of its variables.
    root, offset : (6, 6), (6,)
        ``R`` and ``d``; rows of zeros have no information.
    what : str
        Its source, for messages.
    """

    factor_id: int
    robot: int
    root: Array
    offset: Array
    what: str = "beforehand"
    group: str = "biases"

    @property
    def rows(self) -> int:
        """Dimension of the residual."""
        return SIZE

    def variables(self) -> list[str]:
        """Names of the variables."""
        return bias_variable_names(self.robot)

    def label(self) -> str:
        """Name for messages."""
        return f"constant errors of wheels and sensor, {self.what} (factor {self.factor_id})"


class SensorBiasBatch(UniformBatch):
    """Factors on constant errors."""

    record = SensorBiasRecord
    relative = True
    slots = CONSTANT
    prior = True

    def __init__(self, records: Sequence[SensorBiasRecord], layout: object) -> None:
        super().__init__(records, layout)  # type: ignore[arg-type]
        self._root = np.array([r.root for r in records]).reshape(-1, SIZE, SIZE)
        self._offset = np.array([r.offset for r in records]).reshape(-1, SIZE)

    @cached_property
    def rows(self) -> Index:
        """Number of rows with information ``(k,)``; zero rows are no degrees of freedom."""
        return np.count_nonzero(np.any(self._root != 0.0, axis=2), axis=1).astype(np.int64)

    @staticmethod
    def keys(record: SensorBiasRecord) -> Sequence[int | None]:
        """The robot's wheels, its sensor, and the sensor position."""
        return (record.robot,) * len(CONSTANT)

    @staticmethod
    def whitener(record: SensorBiasRecord) -> Array:
        """Identity: rows have unit variance."""
        return np.eye(SIZE)

    def terms(self, *blocks: Array) -> tuple[Array, Array]:
        """See :meth:`~graphslam.graph.factors.batch.UniformBatch.terms`."""
        g = np.concatenate(blocks, axis=1)
        return np.einsum("kij,kj->ki", self._root, g) - self._offset, self._root
