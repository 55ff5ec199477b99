"""Control points and measured distances in a graph: the node, landmark or path point that each row is attached to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from graphslam.core.control import ControlRow, ControlTable, MeasuredPlace
from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.records import Gps
from graphslam.graph.factor_graph_state import FactorGraphState
from graphslam.graph.factors.batch import FactorRecord
from graphslam.graph.factors.control import ControlRecord, DistanceRecord, survey_terms
from graphslam.graph.factors.range import TOUCHING
from graphslam.graph.noise import RobustKernel, whitener
from graphslam.graph.sensors.base import SensorFactors
from graphslam.graph.sensors.gps import GpsFactors, greatest_distance, level_datum, lever_arm
from graphslam.graph.submap_node import SubmapNode

ROBUST = RobustKernel("cauchy", 2.385)
"""As for GPS fixes."""
CONTROL_ROWS = "control rows"
"""Name in the ledger, followed by the line number, because several rows may have the same time."""
SPANNED = 10.0
"""The datum is initialised when control points span this multiple of their median σ."""


@dataclass(frozen=True, slots=True, eq=False)
class _Site:
    """A place in the graph.

    Parameters
    ----------
    position : (dim,)
        In the frame of the first base.
    covariance : (dim, dim)
        In that frame: uncertainty of the submap's path that is not in a variable of the graph.
    inner : (SubmapNode, int) or None
        Submap and number of a point of its path; its variable is created when needed.
    """

    position: Array
    covariance: Array
    arm: Array
    node: int | None = None
    landmark: int | None = None
    inner: tuple[SubmapNode, int] | None = None

    def key(self) -> tuple[Any, ...]:
        """Equal for places that are at the same point of the graph."""
        return self.node, self.landmark, None if self.inner is None else (self.inner[0].key, self.inner[1])


class ControlFactors(SensorFactors):
    """Rows of a control table, which become factors when no more submaps follow.

    If the graph has GPS fixes, the datum is theirs, and rows need the frame ``gps``. Otherwise the datum is that of the
    first frame in the rows with at least two places that are far enough apart. Unusable rows are refused one by one
    (event ``control-refused``).
    """

    name: ClassVar[str] = "control"
    title: ClassVar[str] = "control points"
    readings = ControlTable
    graph: FactorGraphState

    def __init__(self, graph: FactorGraphState) -> None:
        super().__init__(graph)
        self.gps = GpsFactors.of(graph)
        self.waiting: list[tuple[int, ControlRow]] = []
        self.used: list[ControlRow] = []
        self.frame, self.origin = "", np.zeros(graph.dim)

    def add(self, readings: Any, *, stream: str | None = None, config: Any = None) -> list[int]:
        """See :meth:`SensorFactors.add`; one id per row."""
        new = [(self.graph.next_factor(), r) for r in readings.rows]
        for fid, r in new:
            time = r.place.time or 0.0
            self.graph.ledger.spend(fid, f"control row at {r.label()}", [f"{CONTROL_ROWS}/{r.line}"], (time, time))
        self.waiting += new
        return [fid for fid, _ in new]

    def waiting_readings(self) -> int:
        """See :meth:`SensorFactors.waiting_readings`."""
        return len(self.waiting)

    def finish(self) -> None:
        """See :meth:`SensorFactors.finish`."""
        waiting, self.waiting = self.waiting, []
        placed = []
        for fid, row in waiting:
            try:
                ends = [self.site(p) for p in (row.place, row.to) if p is not None]
                if len(ends) == 2 and ends[0].key() == ends[1].key():
                    raise DataError("both places are at one node of the graph", wanted="places that are farther apart")
                if row.to is None:
                    row.coordinates(self.graph.dim)
                placed.append((fid, row, ends))
            except DataError as error:
                self._refuse(fid, row, error)
        self._start([(row, ends[0]) for _, row, ends in placed if row.to is None])
        for fid, row, ends in placed:
            if row.to is None and row.frame != self.frame:
                held = "GPS fixes hold the datum" if self.frame == "gps" else "rows of one frame hold the datum"
                if not self.frame:
                    held = "the rows do not span enough of the map to place their frame"
                wanted = f"coordinates in the frame {self.frame}" if self.frame else "two places that are far apart"
                self._refuse(fid, row, DataError(held, got=row.frame, wanted=wanted))
            else:
                self._insert(fid, row, ends)
                self.used.append(row)
        for s in list(self.graph.submaps):
            self.gps.attach_points(s)

    def _refuse(self, fid: int, row: ControlRow, why: DataError) -> None:
        self.graph.ledger.release(fid)
        self.graph.log_event("control-refused", line=row.line, name=row.name, why=str(why))

    def site(self, place: MeasuredPlace) -> _Site:
        """Find a place in the graph; a DataError has the reason if there is none."""
        g, d = self.graph, self.graph.dim
        none, zero = np.zeros((d, d)), np.zeros(d)
        if place.time is None:
            assert place.landmark is not None
            if place.landmark not in g.landmark_rows:
                raise DataError("no landmark has this id", got=place, wanted="an id of landmarks.csv")
            return _Site(g.landmark(place.landmark), none, zero, landmark=place.landmark)
        t = place.time
        inside = [s for s in g.submaps if s.interval[0] <= t < s.interval[1]]
        inside += [s for s in g.submaps[-1:] if t == s.interval[1]]
        if not inside:
            span = f"{g.submaps[0].interval[0]:.3f} to {g.submaps[-1].interval[1]:.3f} s" if g.submaps else "a submap"
            raise DataError("the time is outside the map", got=place, wanted=span)
        s, group, lever = inside[0], g.structure.group, place.arm(d)
        if s.trajectory is None:
            raise DataError("the submap has no trajectory", got=place)
        inner = s.inner_points
        k = None if inner is None else inner.path.at(t, lever)
        if inner is not None and k is not None:
            return _Site(group.transform(g.pose(s.node), inner.path.positions[k]), none, zero, inner=(s, k))
        at = s.nearest(np.array([t]))
        arm, C = lever_arm(*s.local(np.array([t]), at), lever)
        node = s.nodes[int(at[0])]
        pose = g.pose(node)
        turn = group.transform(np.tile(pose, (d, 1)), np.eye(d)).T - group.transform(pose, zero)[:, None]
        return _Site(group.transform(pose, arm[0]), turn @ C[0] @ turn.T, arm[0], node=node)

    def _start(self, rows: list[tuple[ControlRow, _Site]]) -> None:
        """Choose the frame of the datum, and initialise the datum."""
        g = self.graph
        if g.structure.count("datum"):
            if g.gps_origin is not None:
                self.frame, self.origin = "gps", g.gps_origin
            return
        for frame in dict.fromkeys(row.frame for row, _ in rows):
            mine = [(row, site) for row, site in rows if row.frame == frame]
            z = np.array([row.coordinates(g.dim)[0] for row, _ in mine])
            P = np.array([row.coordinates(g.dim)[1] + site.covariance for row, site in mine])
            world = np.array([site.position for _, site in mine])
            sigma = np.sqrt(np.trace(P[:, :2, :2], axis1=1, axis2=2) / 2.0)
            spans = greatest_distance(world[:, :2]), greatest_distance(z[:, :2])
            if min(spans) > SPANNED * np.median(sigma):
                self.frame, self.origin = frame, z[0].copy()
                if frame == "gps":
                    g.gps_origin = self.origin
                g.values.datum = level_datum(world, z - self.origin, sigma)
                g.log_event("datum", control=len(mine), frame=frame)
                return

    def _insert(self, fid: int, row: ControlRow, ends: list[_Site]) -> None:
        g, d = self.graph, self.graph.dim
        points = [None if e.inner is None else self.gps.row_of_point(*e.inner) for e in ends]
        first, time, tilt = ends[0], row.place.time or 0.0, g.structure.count("tilt") > 0
        if row.to is not None:
            last = ends[1]
            apart = first.position - last.position
            n = apart / max(float(np.linalg.norm(apart)), TOUCHING)
            sigma = float(np.sqrt(row.sigma[0] ** 2 + n @ (first.covariance + last.covariance) @ n))
            g.insert(
                DistanceRecord(
                    fid, time, row.distance, sigma, first.arm, last.arm, first.node, first.landmark, points[0],
                    last.node, last.landmark, points[1], ROBUST,
                )
            )  # fmt: skip
            return
        z, P = row.coordinates(d)
        values = g.values
        assert values.datum is not None
        turn = survey_terms(first.position[None], values.datum, values.tilt)[1][0]
        W = whitener(P + turn @ first.covariance @ turn.T, what=f"control row at {row.label()}")
        g.insert(
            ControlRecord(
                fid, time, z - self.origin, W, first.arm, first.node, first.landmark, points[0], ROBUST, tilt,
            )
        )  # fmt: skip

    def as_fixes(self) -> tuple[Gps, list[str]] | None:
        """Coordinates with times and the most frequent lever arm, as fixes of a path, and their names in the ledger;
        None if there are none."""
        rows = [r for r in self.used if r.to is None and r.place.time is not None]
        levers = [r.place.lever for r in rows]
        lever = max(levers, key=levers.count, default=())
        by_time = {r.place.time or 0.0: r for r in rows if r.place.lever == lever}
        if not by_time:
            return None
        d = self.graph.dim
        parts = [by_time[t].coordinates(d) for t in sorted(by_time)]
        P = np.array([c for _, c in parts])
        names = [f"{CONTROL_ROWS}/{by_time[t].line}" for t in sorted(by_time)]
        fixes = Gps(
            times=np.array(sorted(by_time)), positions=np.array([z for z, _ in parts]),
            sigma=np.sqrt(np.trace(P, axis1=1, axis2=2) / d), lever=np.array([*lever, 0.0, 0.0, 0.0][:d]),
            covariances=P,
        )  # fmt: skip
        return fixes, names

    def remove(self, submap: SubmapNode) -> None:
        """See :meth:`SensorFactors.remove`; points of its path were removed before."""
        own = set(submap.nodes[:-1])
        self._take_out(lambda r: bool({r.node, getattr(r, "node_to", None)} & own or -1 in _rows(r, "point")))

    def remove_unused(self, removed: FactorRecord) -> None:
        """See :meth:`SensorFactors.remove_unused`."""
        known = self.graph.landmark_rows
        self._take_out(lambda r: any(k is not None and k not in known for k in _rows(r, "landmark")))
        self.gps.remove_unused(removed)

    def _take_out(self, removed: Any) -> None:
        g = self.graph
        for fid, r in list(g.records.single.items()):
            if isinstance(r, (ControlRecord, DistanceRecord)) and removed(r):
                g.take_out(fid, "its place was removed")


def _rows(record: ControlRecord | DistanceRecord, word: str) -> tuple[int | None, int | None]:
    return getattr(record, word), getattr(record, f"{word}_to", None)
