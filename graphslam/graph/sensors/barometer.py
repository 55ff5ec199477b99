"""Barometric heights in a 3-D graph."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from graphslam.core.errors import GeometryError
from graphslam.core.geometry import Array
from graphslam.core.records import Barometer
from graphslam.graph.factor_graph_state import FactorGraphState
from graphslam.graph.factors.barometer import BarometerRecord
from graphslam.graph.sensors.gps import lever_arm
from graphslam.graph.sensors.pending import PendingMeasurement, PendingMeasurements


class BarometerFactors(PendingMeasurements):
    """Heights, one factor each; the reference level of each barometer is a variable (``baselevel0``)."""

    name: ClassVar[str] = "barometer"
    title: ClassVar[str] = "barometer"
    readings = Barometer
    dims = (3,)
    unit = "height"
    holders: ClassVar = {"baselevel": (BarometerRecord,)}

    def __init__(self, graph: FactorGraphState) -> None:
        super().__init__(graph)
        self.streams: dict[str, int] = {}
        self.rows: dict[int, int] = {}  # stream -> row

    def add(self, readings: Any, *, stream: str | None = None, config: Any = None) -> list[int]:
        """See :meth:`SensorFactors.add`."""
        name = stream or self.name
        if self.graph.dim != 3:
            raise GeometryError("heights say nothing of poses in the plane", where=name, wanted="a graph in space")
        source = self.streams.setdefault(name, len(self.streams))
        columns = (readings.times.tolist(), readings.heights.tolist(), readings.sigma.tolist())
        ids = self.enter(name, [(t, z, s, -1) for t, z, s in zip(*columns)], source, 0)
        for s in self.graph.submaps:
            self.add_factors(s)
        return ids

    def attach(self, reading: PendingMeasurement, node: int, T_node_body: Array, covariance: Array | None) -> None:
        """See :meth:`PendingMeasurements.attach`."""
        g, r = self.graph, reading
        arm, C = lever_arm(T_node_body, covariance, np.zeros(3))
        if r.source not in self.rows:
            self.rows[r.source] = g.structure.append("baselevel", np.array([r.value - g.pose(node)[2]]))
            g.revision += 1
        sigma = float(np.sqrt(r.sigma**2 + C[0, 2, 2]))
        tilt = g.structure.count("tilt") > 0
        g.insert(BarometerRecord(r.factor_id, node, r.time, arm[0], r.value, sigma, self.rows[r.source], tilt))

    def held(self) -> dict[str, set[int]]:
        """See :meth:`PendingMeasurements.held`."""
        return {"baselevel": {r.baselevel for r in self.graph.records.values() if isinstance(r, BarometerRecord)}}

    def moved(self, word: str, rows: dict[int, int]) -> None:
        """See :meth:`PendingMeasurements.moved`."""
        self.rows = {k: rows[v] for k, v in self.rows.items() if v in rows}
