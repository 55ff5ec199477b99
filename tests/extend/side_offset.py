"""A new kind of sensor, as CONTRIBUTING.md describes it: a record, a factor and a sensor.

A laser plane beside the path measures how far the body is to the left of the line of the first pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.records import check_times, plain_record
from graphslam.graph.factors.batch import UniformBatch, register_factor
from graphslam.graph.factors.range import antennas
from graphslam.graph.sensors.gps import lever_arm
from graphslam.graph.sensors.pending import PendingMeasurement, PendingMeasurements


@plain_record("side-offset")
@dataclass(frozen=True, slots=True, kw_only=True)
class SideOffset:
    """Offsets of the body to the left of the line ``(n,)`` [m], their stamps and standard deviations."""

    times: Array
    offsets: Array
    sigma: Array

    def __post_init__(self) -> None:
        check_times(self.times)

    def take(self, index: Any) -> SideOffset:
        """See :class:`~graphslam.core.records.Stream`."""
        return replace(self, times=self.times[index], offsets=self.offsets[index], sigma=self.sigma[index])


@dataclass(frozen=True, slots=True, eq=False)
class SideOffsetRecord:
    """One offset at a node; ``arm`` ``(2,)`` is the body seen from the node [m]."""

    factor_id: int
    node: int
    arm: Array
    offset: float
    sigma: float
    group: str = "side-offset"
    rows: ClassVar[int] = 1

    def variables(self) -> list[str]:
        """Names of the variables."""
        return [f"x{self.node}"]

    def label(self) -> str:
        """Name for messages."""
        return f"side offset at x{self.node}"


class SideOffsetBatch(UniformBatch):
    """``r = (p + R a)_y - z``."""

    record = SideOffsetRecord
    slots = ("x",)

    def __init__(self, records: Sequence[SideOffsetRecord], layout: Any) -> None:
        super().__init__(records, layout)
        self._arm = np.array([r.arm for r in records])
        self._z = np.array([r.offset for r in records])

    @staticmethod
    def keys(record: SideOffsetRecord) -> Sequence[int | None]:
        """Its node."""
        return (record.node,)

    @staticmethod
    def whitener(record: SideOffsetRecord) -> Array:
        """Of σ."""
        return np.array([[1.0 / record.sigma]])

    def terms(self, *blocks: Array) -> tuple[Array, Array]:
        """See :meth:`UniformBatch.terms`."""
        a, J = antennas(blocks[0], self._arm)
        return (a[:, 1] - self._z)[:, None], J[:, 1:2]


register_factor(SideOffsetBatch)


class SideOffsetFactors(PendingMeasurements):
    """Offsets, one factor each."""

    name = "side-offset"
    title = "side offset"
    readings = SideOffset
    dims = (2,)
    unit = "side offset"
    holders: ClassVar = {}

    def add(self, readings: Any, *, stream: str | None = None, config: Any = None) -> list[int]:
        """See :meth:`SensorFactors.add`."""
        columns = (readings.times.tolist(), readings.offsets.tolist(), readings.sigma.tolist())
        ids = self.enter(stream or self.name, [(t, y, s, -1) for t, y, s in zip(*columns)], 0, 0)
        for s in self.graph.submaps:
            self.add_factors(s)
        return ids

    def attach(self, reading: PendingMeasurement, node: int, T_node_body: Array, covariance: Array | None) -> None:
        """See :meth:`PendingMeasurements.attach`."""
        arm, C = lever_arm(T_node_body, covariance, np.zeros(2))
        sigma = float(np.sqrt(reading.sigma**2 + C[0, 1, 1]))
        self.graph.insert(SideOffsetRecord(reading.factor_id, node, arm[0], reading.value, sigma))

    def held(self) -> dict[str, set[int]]:
        """It has no variables."""
        return {}
