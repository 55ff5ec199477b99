"""Distances to beacons of unknown position in a graph."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from graphslam.core.config import check_options, flattened_field
from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.records import LandmarkObservations
from graphslam.graph.factor_graph_state import FactorGraphState
from graphslam.graph.factors.range import BeaconRangeRecord
from graphslam.graph.noise import NO_KERNEL, RobustKernel
from graphslam.graph.sensors.gps import lever_arm
from graphslam.graph.sensors.pending import PendingMeasurement, PendingMeasurements, thinned


@dataclass(frozen=True, slots=True, kw_only=True)
class BeaconConfig:
    """Use of distances to beacons in the graph.

    A beacon is added only if the positions from which it was measured are not on one line.
    """

    sigma: float | None = None
    """Standard deviation of a distance [m], replacing that of the stream."""
    every: float = 0.0
    """Minimum time between two distances to the same beacon [s]."""
    least: int = 6
    """Minimum number of distances to a beacon before its position is initialised."""
    spread: float = 0.1
    """Minimum ratio of the smallest to the largest extent of the positions from which a beacon was measured."""
    robust: RobustKernel = flattened_field(NO_KERNEL, robust="kind", robust_width="k")
    """Robust kernel on each distance, and its width in standard deviations."""

    def __post_init__(self) -> None:
        ranges = {"> 0": "sigma", "≥ 0": "every", "in (0, 1)": "spread", "≥ 3": "least"}
        check_options(self, "beacons.", ranges)


@dataclass(slots=True, eq=False)
class _Beacon:
    """Row of a beacon in the graph, or its distances so far."""

    row: int | None = None
    heard: list[BeaconRangeRecord] = field(default_factory=list)


class BeaconFactors(PendingMeasurements):
    """Distances to beacons with known identities; each is assigned to its submap. Bearings are not used.

    A beacon is initialised after enough distances from positions that are not on one line; then its distances become
    factors (:mod:`graphslam.graph.factors.range`). The antenna is at the position of the stream's sensor; in 3-D at the
    height of the body.
    """

    name: ClassVar[str] = "beacons"
    title: ClassVar[str] = "landmark observations"
    readings = LandmarkObservations
    options = BeaconConfig
    unit = "distance"
    holders: ClassVar = {"beacon": (BeaconRangeRecord,)}

    def __init__(self, graph: FactorGraphState) -> None:
        super().__init__(graph)
        self.ranging: list[tuple[BeaconConfig, Array]] = []
        self.beacons: dict[int, _Beacon] = {}

    def add(self, readings: Any, *, stream: str | None = None, config: Any = None) -> list[int]:
        """See :meth:`SensorFactors.add`; one id per distance that is used."""
        cfg, name = config or BeaconConfig(), stream or self.name
        if readings.ids is None or np.any(readings.ids < 0):
            raise DataError("distances to beacons need to say which beacon", where=name, wanted="known identities")
        arm = np.append(readings.T_base_sensor[:2], np.zeros(self.graph.dim - 2))
        times = np.repeat(readings.times, np.diff(readings.offsets))
        kept: list[int] = []
        for b in np.unique(readings.ids).tolist():
            own = np.flatnonzero(readings.ids == b)
            kept += own[thinned(times[own], cfg.every)].tolist()
        kept.sort()
        sigma = readings.sigmas[:, 0] if cfg.sigma is None else np.full(len(times), cfg.sigma)
        rows = [(float(times[k]), float(readings.ranges[k]), float(sigma[k]), int(readings.ids[k])) for k in kept]
        ids = self.enter(name, rows, len(self.ranging), len(times) - len(kept))
        self.ranging.append((cfg, arm))
        for s in self.graph.submaps:
            self.add_factors(s)
        return ids

    def finish(self) -> None:
        """See :meth:`SensorFactors.finish`."""
        super().finish()
        for number, b in self.beacons.items():
            if b.row is None and b.heard:
                self._place(number, b, last=True)
            if b.row is None and b.heard:
                for r in b.heard:
                    self.graph.ledger.release(r.factor_id)
                why = "heard too seldom, or from places on one line"
                self.graph.log_event("beacon-not-placed", beacon=number, distances=len(b.heard), why=why)
                b.heard = []

    def held(self) -> dict[str, set[int]]:
        """See :meth:`PendingMeasurements.held`; a beacon needs at least as many distances as dimensions."""
        g = self.graph
        heard = Counter(r.beacon for r in g.records.values() if isinstance(r, BeaconRangeRecord))
        held = {k for k, n in heard.items() if n >= g.dim}
        self.take_out(*(f for f, r in g.records.items() if isinstance(r, BeaconRangeRecord) and r.beacon not in held))
        return {"beacon": held}

    def moved(self, word: str, rows: dict[int, int]) -> None:
        """See :meth:`PendingMeasurements.moved`."""
        for b in self.beacons.values():
            b.row = None if b.row is None else rows.get(b.row)

    def attach(self, reading: PendingMeasurement, node: int, T_node_body: Array, covariance: Array | None) -> None:
        """See :meth:`PendingMeasurements.attach`."""
        r = reading
        cfg, lever = self.ranging[r.source]
        arm, C = lever_arm(T_node_body, covariance, lever)
        lost = float(np.trace(C[0])) / self.graph.dim
        b = self.beacons.setdefault(r.part, _Beacon())
        sigma = float(np.hypot(r.sigma, np.sqrt(lost)))
        record = BeaconRangeRecord(
            r.factor_id, node, -1 if b.row is None else b.row, r.time, arm[0], r.value, sigma, cfg.robust
        )
        if b.row is not None:
            self.graph.insert(record)
            return
        b.heard.append(record)
        if len(b.heard) >= cfg.least and len(b.heard) % cfg.least == 0:
            self._place(r.part, b, cfg)

    def _place(self, number: int, b: _Beacon, cfg: BeaconConfig | None = None, *, last: bool = False) -> None:
        """Initialise a beacon and add its distances as factors, if they determine its position."""
        g, cfg = self.graph, cfg or self.ranging[-1][0]
        if len(b.heard) < max(cfg.least, g.dim + 1):
            return
        poses = np.array([g.pose(r.node) for r in b.heard])
        antenna = g.structure.group.transform(poses, np.array([r.arm for r in b.heard]))
        z, sigma = np.array([r.distance for r in b.heard]), np.array([r.sigma for r in b.heard])
        place = trilaterate(antenna, z, sigma, spread=cfg.spread)
        if place is None:
            return
        b.row = g.structure.append("beacon", place)
        g.revision += 1
        for r in b.heard:
            g.insert(replace(r, beacon=b.row))
        g.log_event("beacon", beacon=number, variable=f"beacon{b.row}", distances=len(b.heard), position=place.tolist())
        b.heard = []


def trilaterate(places: Array, distances: Array, sigma: Array, *, spread: float = 0.1) -> Array | None:
    """Position of a beacon ``(dim,)``, or None if the distances do not determine it.

    Differences of squared distances are linear in the position; a few Gauss–Newton steps with Cauchy weights of three
    sigma follow, which reduce the influence of outliers.

    Parameters
    ----------
    places : (k, dim)
        Positions of the antenna.
    distances, sigma : (k,)
    spread : float
        Minimum ratio of the smallest to the largest extent of the positions: if they are on one line (3-D: in one
        plane), the mirror image of the beacon has the same distances.
    """
    mean = places.mean(axis=0)
    c = places - mean
    extent = np.linalg.svd(c, compute_uv=False)
    if extent[-1] < spread * extent[0] or extent[0] == 0.0:
        return None
    q = distances**2 - np.sum(c**2, axis=1)
    A = np.column_stack([-2.0 * c, np.ones(len(c))])
    w = 1.0 / np.maximum(2.0 * distances * sigma, 1e-9)
    solution = np.linalg.lstsq(A * w[:, None], q * w, rcond=None)[0]
    p = solution[:-1] + mean
    width = 3.0 * sigma
    for _ in range(20):
        d = p - places
        length = np.maximum(np.linalg.norm(d, axis=1), 1e-9)
        r = length - distances
        weight = 1.0 / (sigma**2 * (1.0 + (r / width) ** 2))
        J = d / length[:, None]
        H = (J * weight[:, None]).T @ J
        step = np.linalg.lstsq(H, J.T @ (weight * r), rcond=None)[0]
        p = p - step
        if np.linalg.norm(step) < 1e-9:
            break
    return p if np.all(np.isfinite(p)) else None
