"""Readings that wait for the submap that holds their instant: headings of a compass, distances to beacons.

A reading at t inside a submap becomes a factor on the node of that submap that is nearest in time, by the pose of the
body seen from the node; what the submap's own path has lost between the two is added to the reading's variance.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from graphslam.core.config import flattened_field
from graphslam.core.errors import ConfigError, DataError
from graphslam.core.geometry import Array, wrap_angle
from graphslam.core.records import Compass, LandmarkObservations
from graphslam.core.se3 import quat_rotate
from graphslam.graph.factors.compass import CompassRecord, DeclinationRecord, DeviationPriorRecord
from graphslam.graph.factors.range import BeaconRangeRecord
from graphslam.graph.gps import lever_arm
from graphslam.graph.ledger import EXCLUSIVE
from graphslam.graph.noise import NO_KERNEL, RobustKernel
from graphslam.graph.submap_node import SubmapNode

if TYPE_CHECKING:
    from graphslam.graph.factor_graph_state import FactorGraphState


@dataclass(frozen=True, slots=True, kw_only=True)
class CompassConfig:
    """How a compass enters the graph.

    Parameters
    ----------
    sigma : float or None
        Standard deviation of a reading [rad] in place of the stream's own.
    every : float
        At most one reading in so many seconds: what disturbs a compass lasts, so that readings close to each other are
        wrong together.
    declination : float or None
        Magnetic declination [rad], positive where magnetic north is east of true north. With it, and with GPS in the
        graph, the zero of the compass is tied to the GPS frame; else it is found from the map alone.
    declination_sigma : float
        [rad]
    hard_iron : float or None
        Standard deviation [rad] of the deviation by iron on the robot, which is then estimated; None: there is none.
    robust : RobustKernel
        Kernel on each reading.
    """

    sigma: float | None = None
    """Standard deviation of a reading [rad] in place of the stream's own."""
    every: float = 1.0
    """At most one reading in so many seconds: what disturbs a compass lasts [s]."""
    declination: float | None = None
    """Magnetic declination [rad], positive where magnetic north is east of true north; ties the compass to GPS."""
    declination_sigma: float = 0.01
    """Its standard deviation [rad]."""
    hard_iron: float | None = None
    """Standard deviation of the deviation by iron on the robot [rad], which is then estimated; none: there is none."""
    robust: RobustKernel = flattened_field(NO_KERNEL, robust="kind", robust_width="k")
    """Robust kernel on each reading, and its width in standard deviations."""

    def __post_init__(self) -> None:
        for name in ("sigma", "declination_sigma", "hard_iron"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise ConfigError(f"compass.{name} must be positive, got {value}")
        if not (np.isfinite(self.every) and self.every >= 0):
            raise ConfigError(f"compass.every must not be negative, got {self.every}")
        if self.declination is not None and not np.isfinite(self.declination):
            raise ConfigError(f"compass.declination must be a number, got {self.declination}")


@dataclass(frozen=True, slots=True, kw_only=True)
class BeaconConfig:
    """How distances to beacons enter the graph.

    Parameters
    ----------
    sigma : float or None
        Standard deviation of a distance [m] in place of the stream's own.
    every : float
        At most one distance to each beacon in so many seconds.
    least : int
        Distances to a beacon before it gets a place.
    spread : float
        Places from which it was heard must not lie on one line: the smaller extent of them is at least this share of
        the larger one, or else the beacon waits.
    robust : RobustKernel
        Kernel on each distance.
    """

    sigma: float | None = None
    """Standard deviation of a distance [m] in place of the stream's own."""
    every: float = 0.0
    """At most one distance to each beacon in so many seconds [s]."""
    least: int = 6
    """Distances to a beacon before it gets a place."""
    spread: float = 0.1
    """Least ratio of the smallest to the largest extent of the places from which a beacon was heard."""
    robust: RobustKernel = flattened_field(NO_KERNEL, robust="kind", robust_width="k")
    """Robust kernel on each distance, and its width in standard deviations."""

    def __post_init__(self) -> None:
        if self.sigma is not None and not (np.isfinite(self.sigma) and self.sigma > 0):
            raise ConfigError(f"beacons.sigma must be positive, got {self.sigma}")
        if not (np.isfinite(self.every) and self.every >= 0 and 0 < self.spread < 1 and self.least >= 3):
            raise ConfigError(f"beacons.every ≥ 0, 0 < beacons.spread < 1 and beacons.least ≥ 3 are wanted, got {self}")


@dataclass(frozen=True, slots=True, eq=False)
class PendingMeasurement:
    """One reading that waits."""

    time: float
    factor_id: int
    value: float
    sigma: float
    source: int
    beacon: int = -1
    stream: str = ""


@dataclass(slots=True, eq=False)
class _Beacon:
    """A beacon that is not placed yet: its distances so far."""

    row: int | None = None
    heard: list[BeaconRangeRecord] = field(default_factory=list)


class PendingMeasurements:
    """Compasses and beacons of a graph."""

    def __init__(self, graph: FactorGraphState) -> None:
        self.graph = graph
        self.compasses: list[CompassConfig] = []
        self.ranging: list[tuple[BeaconConfig, Array]] = []
        self.zeros: dict[int, int] = {}  # compass -> row
        self.deviations: dict[int, int] = {}  # compass -> row
        self.beacons: dict[int, _Beacon] = {}
        self.waiting: list[PendingMeasurement] = []

    # ---------------------------------------------------------------- taking readings

    def add_compass(self, compass: Compass, stream: str, config: CompassConfig | None) -> list[int]:
        """See :meth:`~graphslam.graph.factor_graph.FactorGraph.add_compass`."""
        cfg = config or CompassConfig()
        kept = _thinned(compass.times, cfg.every)
        source = len(self.compasses)
        sigma = compass.sigma if cfg.sigma is None else np.full(len(compass.times), cfg.sigma)
        rows = [(float(compass.times[k]), float(compass.headings[k]), float(sigma[k]), -1) for k in kept]
        readings = self._spend("compass", stream, rows, source)
        self.compasses.append(cfg)
        return self._queue(readings, stream, len(compass.times) - len(kept))

    def add_beacons(
        self, ranges: LandmarkObservations, stream: str, config: BeaconConfig | None, lever: Array | None
    ) -> list[int]:
        """See :meth:`~graphslam.graph.factor_graph.FactorGraph.add_beacons`."""
        cfg = config or BeaconConfig()
        if ranges.ids is None or np.any(ranges.ids < 0):
            raise DataError("distances to beacons need to say which beacon", where=stream, wanted="known identities")
        dim = self.graph.dim
        arm = np.append(ranges.T_base_sensor[:2], np.zeros(dim - 2)) if lever is None else np.asarray(lever, np.float64)
        if arm.shape != (dim,):
            raise DataError("the place of the antenna does not fit", where=stream, got=arm.shape, wanted=f"({dim},)")
        times = np.repeat(ranges.times, np.diff(ranges.offsets))
        kept: list[int] = []
        for b in np.unique(ranges.ids).tolist():
            own = np.flatnonzero(ranges.ids == b)
            kept += own[_thinned(times[own], cfg.every)].tolist()
        kept.sort()
        sigma = ranges.sigmas[:, 0] if cfg.sigma is None else np.full(len(times), cfg.sigma)
        rows = [(float(times[k]), float(ranges.ranges[k]), float(sigma[k]), int(ranges.ids[k])) for k in kept]
        readings = self._spend("distance", stream, rows, len(self.ranging))
        self.ranging.append((cfg, arm))
        return self._queue(readings, stream, len(times) - len(kept))

    def _spend(
        self, what: str, stream: str, rows: list[tuple[float, float, float, int]], source: int
    ) -> list[PendingMeasurement]:
        """Enter all readings in the ledger, or none."""
        g = self.graph
        names = [f"{stream}/{b}" if b >= 0 else stream for *_, b in rows]
        for (t, *_), name in zip(rows, names):
            g.ledger.check(f"{what} at {t:.3f} s", [name], (t, t), EXCLUSIVE)
        out = []
        for (t, value, sigma, beacon), name in zip(rows, names):
            fid = g.next_factor()
            g.ledger.spend(fid, f"{what} at {t:.3f} s", [name], (t, t))
            out.append(PendingMeasurement(t, fid, value, sigma, source, beacon, stream))
        return out

    def _queue(self, readings: Iterable[PendingMeasurement], stream: str, left_out: int) -> list[int]:
        new = list(readings)
        self.waiting = sorted([*self.waiting, *new], key=lambda r: r.time)
        if left_out:
            self.graph.log_event("readings-thinned", stream=stream, count=left_out)
        for s in self.graph.submaps:
            self.attach(s)
        return [r.factor_id for r in new]

    # ---------------------------------------------------------------- tying them to nodes

    def attach(self, s: SubmapNode, *, closed: bool = False) -> None:
        """Give a submap its readings; one at an instant that two submaps share belongs to the later."""
        t0, t1 = s.interval
        first = bisect_left(self.waiting, t0, key=lambda r: r.time)
        last = (bisect_right if closed else bisect_left)(self.waiting, t1, key=lambda r: r.time)
        mine = self.waiting[first:last]
        if not mine:
            return
        del self.waiting[first:last]
        if s.trajectory is None:
            self._drop(mine, "submap has no trajectory")
            return
        outside, spent = [], []
        for r in mine:
            # distances are entered by beacon, since several come at one instant: the stream itself is the front end's
            if r.beacon >= 0 and self.graph.ledger.conflict(r.stream, (r.time, r.time)) is not None:
                spent.append(r)
                continue
            try:
                at = s.nearest(np.array([r.time]))
                T, P = s.local(np.array([r.time]), at)
            except DataError:
                outside.append(r)
                continue
            (self._tie_range if r.beacon >= 0 else self._tie_heading)(r, s.nodes[int(at[0])], T, P)
        self._drop(outside, "outside the submap's trajectory")
        self._drop(spent, "its submap uses the stream already")

    def finish(self) -> None:
        """No more submaps will come: what still waits is dropped, and counted."""
        if self.graph.submaps:
            self.attach(self.graph.submaps[-1], closed=True)
        self._drop(self.waiting, "no submap covers it")
        self.waiting = []
        for k, cfg in enumerate(self.compasses):
            self._declare(k, cfg)
        for number, b in self.beacons.items():
            if b.row is None and b.heard:
                self._place(number, b, last=True)
            if b.row is None and b.heard:
                for r in b.heard:
                    self.graph.ledger.release(r.factor_id)
                why = "heard too seldom, or from places on one line"
                self.graph.log_event("beacon-not-placed", beacon=number, distances=len(b.heard), why=why)
                b.heard = []

    # ---------------------------------------------------------------- taking out

    def detach(self, s: SubmapNode) -> None:
        """Take out what hangs on a submap that goes."""
        inside = set(s.nodes[:-1])
        for fid, r in list(self.graph.records.items()):
            if isinstance(r, (CompassRecord, BeaconRangeRecord)) and r.node in inside:
                self._take_out(fid)

    def remove_unused(self) -> None:
        """Variables that no reading holds any more go, and what was said of them; the others move up."""
        g = self.graph
        if not any(g.structure.count(word) for word in ("compass", "deviation", "beacon")):
            return
        readings = [r for r in g.records.values() if isinstance(r, CompassRecord)]
        if not g.structure.count("datum"):
            self._take_out(*(f for f, r in g.records.items() if isinstance(r, DeclinationRecord)))
        heard = Counter(r.beacon for r in g.records.values() if isinstance(r, BeaconRangeRecord))
        held = {k for k, n in heard.items() if n >= g.dim}  # fewer distances do not hold a place
        self._take_out(*(f for f, r in g.records.items() if isinstance(r, BeaconRangeRecord) and r.beacon not in held))
        rows = self._keep("compass", {r.compass for r in readings})
        self.zeros = {k: rows[v] for k, v in self.zeros.items() if v in rows}
        iron = self._keep("deviation", {r.deviation for r in readings if r.deviation is not None})
        self.deviations = {k: iron[v] for k, v in self.deviations.items() if v in iron}
        posts = self._keep("beacon", held)
        for b in self.beacons.values():
            b.row = None if b.row is None else posts.get(b.row)

    def _keep(self, word: str, rows: set[int]) -> dict[int, int]:
        """Keep these rows of a kind of variable; old row → new row."""
        g = self.graph
        new = {old: k for k, old in enumerate(sorted(rows))}
        if len(new) == g.structure.count(word):
            return new
        for fid, r in list(g.records.items()):
            old = getattr(r, word) if isinstance(r, _HOLDERS[word]) else None
            if old is None:
                continue
            if old not in new:
                self._take_out(fid)
            elif new[old] != old:
                g.insert(replace(r, **{word: new[old]}))  # type: ignore[type-var]
        g.values[word] = g.values[word][sorted(rows)]
        g.revision += 1
        return new

    def _take_out(self, *factor_ids: int) -> None:
        for fid in list(factor_ids):
            del self.graph.records[fid]
            self.graph.ledger.release(fid)
            self.graph.revision += 1

    def _drop(self, readings: Iterable[PendingMeasurement], why: str) -> None:
        count: Counter[str] = Counter()
        for r in readings:
            self.graph.ledger.release(r.factor_id)
            count["distance" if r.beacon >= 0 else "heading"] += 1
        for what, n in count.items():
            self.graph.log_event("readings-dropped", what=what, count=n, why=why)

    def _tie_heading(self, r: PendingMeasurement, node: int, T: Array, P: Array | None) -> None:
        g, cfg = self.graph, self.compasses[r.source]
        plane = g.dim == 2
        axis = g.structure.group.transform(T, np.eye(g.dim)[:1])[0] - T[0, : g.dim]
        lost = 0.0 if P is None else float(P[0, 2, 2])
        if r.source not in self.zeros:
            psi = g.pose(node)[2] + np.arctan2(axis[1], axis[0]) if plane else _level_heading(g.pose(node), axis)
            self.zeros[r.source] = g.structure.append("compass", np.array([wrap_angle(r.value - psi)]))
            g.revision += 1
        if cfg.hard_iron is not None and r.source not in self.deviations:
            row = self.deviations[r.source] = g.structure.append("deviation", np.zeros(2))
            prior = DeviationPriorRecord(g.next_factor(), row, cfg.hard_iron)
            g.ledger.spend(prior.factor_id, prior.label(), ["-"], (r.time, r.time), "prior")
            g.insert(prior)
        sigma, iron = float(np.hypot(r.sigma, np.sqrt(lost))), self.deviations.get(r.source)
        zero = self.zeros[r.source]
        g.insert(CompassRecord(r.factor_id, node, r.time, axis, r.value, sigma, zero, iron, cfg.robust))
        self._declare(r.source, cfg)

    def _declare(self, compass: int, cfg: CompassConfig) -> None:
        """Tie the zero of a compass to the GPS frame, once both are there."""
        g = self.graph
        if cfg.declination is None or not g.structure.count("datum") or compass not in self.zeros:
            return
        zero = self.zeros[compass]
        if any(isinstance(r, DeclinationRecord) and r.compass == zero for r in g.records.values()):
            return
        record = DeclinationRecord(g.next_factor(), zero, cfg.declination, cfg.declination_sigma)
        g.ledger.spend(record.factor_id, record.label(), ["-"], (0.0, 0.0), "prior")
        g.insert(record)

    def _tie_range(self, r: PendingMeasurement, node: int, T: Array, P: Array | None) -> None:
        cfg, lever = self.ranging[r.source]
        arm, C = lever_arm(T, P, lever)
        lost = float(np.trace(C[0])) / self.graph.dim
        b = self.beacons.setdefault(r.beacon, _Beacon())
        sigma = float(np.hypot(r.sigma, np.sqrt(lost)))
        record = BeaconRangeRecord(
            r.factor_id, node, -1 if b.row is None else b.row, r.time, arm[0], r.value, sigma, cfg.robust
        )
        if b.row is not None:
            self.graph.insert(record)
            return
        b.heard.append(record)
        if len(b.heard) >= cfg.least and len(b.heard) % cfg.least == 0:
            self._place(r.beacon, b, cfg)

    def _place(self, number: int, b: _Beacon, cfg: BeaconConfig | None = None, *, last: bool = False) -> None:
        """Give a beacon a place, and its distances factors, once they say where it is."""
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


_HOLDERS: dict[str, tuple[type[Any], ...]] = {
    "compass": (CompassRecord, DeclinationRecord),
    "deviation": (CompassRecord, DeviationPriorRecord),
    "beacon": (BeaconRangeRecord,),
}
"""Kinds of factors that hold variables of a kind, in a field of that name."""


def _thinned(times: Array, every: float) -> list[int]:
    """Records that are at least ``every`` seconds apart."""
    kept: list[int] = []
    for k, t in enumerate(times.tolist()):
        if not kept or t - times[kept[-1]] >= every:
            kept.append(k)
    return kept


def _level_heading(pose: Array, axis: Array) -> float:
    u = quat_rotate(pose[3:], axis)
    return float(np.arctan2(u[1], u[0]))


def trilaterate(places: Array, distances: Array, sigma: Array, *, spread: float = 0.1) -> Array | None:
    """Where a beacon is ``(dim,)``, or None where the distances do not say.

    Differences of squared distances are linear in the position; a few Gauss–Newton steps with Cauchy weights of three
    sigma follow, so that one wild distance does not move it.

    Parameters
    ----------
    places : (k, dim)
        From which it was heard.
    distances, sigma : (k,)
    spread : float
        Least ratio of the smallest to the largest extent of the places: those on one line (in space: in one plane) are
        as far from the beacon's mirror image.
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
