"""Compass headings in a graph."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from graphslam.core.config import check_options, flattened_field
from graphslam.core.geometry import Array, wrap_angle
from graphslam.core.records import Compass
from graphslam.core.se3 import quat_rotate
from graphslam.graph.factor_graph_state import FactorGraphState
from graphslam.graph.factors.compass import CompassRecord, DeclinationRecord, DeviationPriorRecord
from graphslam.graph.noise import NO_KERNEL, RobustKernel
from graphslam.graph.sensors.pending import PendingMeasurement, PendingMeasurements, thinned


@dataclass(frozen=True, slots=True, kw_only=True)
class CompassConfig:
    """Use of a compass in the graph.

    Magnetic disturbances are time-correlated, so readings are thinned. With a declination, and with GPS in the graph,
    the zero of the compass is linked to the GPS frame; otherwise it is estimated from the map alone.
    """

    sigma: float | None = None
    """Standard deviation of a reading [rad], replacing that of the stream."""
    every: float = 1.0
    """Minimum time between two readings, because magnetic disturbances are time-correlated [s]."""
    declination: float | None = None
    """Magnetic declination [rad], positive if magnetic north is east of true north; links the compass to GPS."""
    declination_sigma: float = 0.01
    """Its standard deviation [rad]."""
    hard_iron: float | None = None
    """Prior σ of the hard-iron deviation [rad], which is then estimated; none: no deviation."""
    robust: RobustKernel = flattened_field(NO_KERNEL, robust="kind", robust_width="k")
    """Robust kernel on each reading, and its width in standard deviations."""

    def __post_init__(self) -> None:
        ranges = {"> 0": "sigma declination_sigma hard_iron", "≥ 0": "every", "finite": "declination"}
        check_options(self, "compass.", ranges)


class CompassFactors(PendingMeasurements):
    """Compass headings; each is assigned to its submap.

    The zero of a compass (direction of magnetic east in the frame of the first base) is a variable, and also the
    hard-iron deviation if it is configured (:mod:`graphslam.graph.factors.compass`).
    """

    name: ClassVar[str] = "compass"
    title: ClassVar[str] = "compass"
    readings = Compass
    options = CompassConfig
    unit = "heading"
    holders: ClassVar = {
        "compass": (CompassRecord, DeclinationRecord),
        "deviation": (CompassRecord, DeviationPriorRecord),
    }

    def __init__(self, graph: FactorGraphState) -> None:
        super().__init__(graph)
        self.compasses: list[CompassConfig] = []
        self.rows: dict[str, dict[int, int]] = {"compass": {}, "deviation": {}}  # compass -> row

    def add(self, readings: Any, *, stream: str | None = None, config: Any = None) -> list[int]:
        """See :meth:`SensorFactors.add`; one id per reading that is used (:attr:`CompassConfig.every`)."""
        cfg = config or CompassConfig()
        kept = thinned(readings.times, cfg.every)
        sigma = readings.sigma if cfg.sigma is None else np.full(len(readings.times), cfg.sigma)
        rows = [(float(readings.times[k]), float(readings.headings[k]), float(sigma[k]), -1) for k in kept]
        ids = self.enter(stream or self.name, rows, len(self.compasses), len(readings.times) - len(kept))
        self.compasses.append(cfg)
        for s in self.graph.submaps:
            self.add_factors(s)
        return ids

    def finish(self) -> None:
        """See :meth:`SensorFactors.finish`."""
        super().finish()
        for k, cfg in enumerate(self.compasses):
            self._declare(k, cfg)

    def held(self) -> dict[str, set[int]]:
        """See :meth:`PendingMeasurements.held`."""
        g = self.graph
        if not g.structure.count("datum"):
            self.take_out(*(f for f, r in g.records.items() if isinstance(r, DeclinationRecord)))
        headings = [r for r in g.records.values() if isinstance(r, CompassRecord)]
        iron = {r.deviation for r in headings if r.deviation is not None}
        return {"compass": {r.compass for r in headings}, "deviation": iron}

    def moved(self, word: str, rows: dict[int, int]) -> None:
        """See :meth:`PendingMeasurements.moved`."""
        self.rows[word] = {k: rows[v] for k, v in self.rows[word].items() if v in rows}

    def attach(self, reading: PendingMeasurement, node: int, T_node_body: Array, covariance: Array | None) -> None:
        """See :meth:`PendingMeasurements.attach`."""
        r, T, P = reading, T_node_body, covariance
        g, cfg = self.graph, self.compasses[r.source]
        plane = g.dim == 2
        axis = g.structure.group.transform(T, np.eye(g.dim)[:1])[0] - T[0, : g.dim]
        lost = 0.0 if P is None else float(P[0, 2, 2])
        if r.source not in self.rows["compass"]:
            psi = g.pose(node)[2] + np.arctan2(axis[1], axis[0]) if plane else _level_heading(g.pose(node), axis)
            self.rows["compass"][r.source] = g.structure.append("compass", np.array([wrap_angle(r.value - psi)]))
            g.revision += 1
        if cfg.hard_iron is not None and r.source not in self.rows["deviation"]:
            row = self.rows["deviation"][r.source] = g.structure.append("deviation", np.zeros(2))
            prior = DeviationPriorRecord(g.next_factor(), row, cfg.hard_iron)
            g.ledger.spend(prior.factor_id, prior.label(), ["-"], (r.time, r.time), "prior")
            g.insert(prior)
        sigma, iron = float(np.hypot(r.sigma, np.sqrt(lost))), self.rows["deviation"].get(r.source)
        zero = self.rows["compass"][r.source]
        g.insert(CompassRecord(r.factor_id, node, r.time, axis, r.value, sigma, zero, iron, cfg.robust))
        self._declare(r.source, cfg)

    def _declare(self, compass: int, cfg: CompassConfig) -> None:
        """Add the factor between the zero of a compass and the GPS frame, once both are in the graph."""
        g = self.graph
        if cfg.declination is None or not g.structure.count("datum") or compass not in self.rows["compass"]:
            return
        if g.gps_origin is None:  # a datum of control points: the direction of north in their frame is unknown
            return
        zero = self.rows["compass"][compass]
        if any(isinstance(r, DeclinationRecord) and r.compass == zero for r in g.records.values()):
            return
        record = DeclinationRecord(g.next_factor(), zero, cfg.declination, cfg.declination_sigma)
        g.ledger.spend(record.factor_id, record.label(), ["-"], (0.0, 0.0), "prior")
        g.insert(record)


def _level_heading(pose: Array, axis: Array) -> float:
    u = quat_rotate(pose[3:], axis)
    return float(np.arctan2(u[1], u[0]))
