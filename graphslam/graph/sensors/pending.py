"""Scalar readings that wait for the submap of their time: one factor each, on the node nearest in time.

A reading at t inside a submap becomes a factor on the node of that submap that is nearest in time, with the pose of the
body relative to the node; the covariance that the submap's path accumulates between the two is added to the reading's.
"""

from __future__ import annotations

from abc import abstractmethod
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.graph.factor_graph_state import FactorGraphState
from graphslam.graph.ledger import EXCLUSIVE
from graphslam.graph.sensors.base import SensorFactors
from graphslam.graph.submap_node import SubmapNode


@dataclass(frozen=True, slots=True, eq=False)
class PendingMeasurement:
    """A reading that waits for its submap.

    Parameters
    ----------
    source : int
        Number of its sensor among those of the kind.
    part : int
        Which of several quantities at one instant, such as a beacon; -1: there is only one.
    """

    time: float
    factor_id: int
    value: float
    sigma: float
    source: int
    part: int = -1
    stream: str = ""


class PendingMeasurements(SensorFactors):
    """Sensors whose readings are scalars with a time.

    Attributes
    ----------
    unit : str
        Name of a reading in messages.
    holders : mapping of str to tuple of type
        By variable kind, the records that refer to its rows in a field of that name; removed with the readings.
    """

    unit: ClassVar[str]
    holders: ClassVar[dict[str, tuple[type[Any], ...]]]
    graph: FactorGraphState

    def __init__(self, graph: FactorGraphState) -> None:
        super().__init__(graph)
        self.waiting: list[PendingMeasurement] = []

    @abstractmethod
    def attach(self, reading: PendingMeasurement, node: int, T_node_body: Array, covariance: Array | None) -> None:
        """Make the factor of a reading; ``T_node_body`` ``(1, 3|7)`` with its ``covariance`` ``(1, d, d)``."""

    @abstractmethod
    def held(self) -> dict[str, set[int]]:
        """By variable kind, the rows that readings use."""

    def moved(self, word: str, rows: dict[int, int]) -> None:
        """Update row numbers of a variable kind: old → new; missing rows were removed."""

    def enter(
        self, stream: str, rows: Sequence[tuple[float, float, float, int]], source: int, left_out: int
    ) -> list[int]:
        """Add readings (time, value, σ, part) to the ledger, all or none, and to the queue; returns factor ids."""
        g, new = self.graph, []
        names = [f"{stream}/{part}" if part >= 0 else stream for *_, part in rows]
        for (t, *_), name in zip(rows, names):
            g.ledger.check(f"{self.unit} at {t:.3f} s", [name], (t, t), EXCLUSIVE)
        for (t, value, sigma, part), name in zip(rows, names):
            fid = g.next_factor()
            g.ledger.spend(fid, f"{self.unit} at {t:.3f} s", [name], (t, t))
            new.append(PendingMeasurement(t, fid, value, sigma, source, part, stream))
        self.waiting = sorted([*self.waiting, *new], key=lambda r: r.time)
        if left_out:
            g.log_event("readings-thinned", stream=stream, count=left_out)
        return [r.factor_id for r in new]

    def add_factors(self, submap: SubmapNode, *, closed: bool = False) -> None:
        """Add the readings of a submap; one exactly between two submaps belongs to the later one."""
        t0, t1 = submap.interval
        first = bisect_left(self.waiting, t0, key=lambda r: r.time)
        last = (bisect_right if closed else bisect_left)(self.waiting, t1, key=lambda r: r.time)
        mine = self.waiting[first:last]
        if not mine:
            return
        del self.waiting[first:last]
        if submap.trajectory is None:
            self.drop(mine, "submap has no trajectory")
            return
        outside, spent = [], []
        for r in mine:
            # with parts, ledger names contain the part; the stream itself is in the ledger if the front end used it
            if r.part >= 0 and self.graph.ledger.conflict(r.stream, (r.time, r.time)) is not None:
                spent.append(r)
                continue
            try:
                at = submap.nearest(np.array([r.time]))
                T, P = submap.local(np.array([r.time]), at)
            except DataError:
                outside.append(r)
                continue
            self.attach(r, submap.nodes[int(at[0])], T, P)
        self.drop(outside, "outside the submap's trajectory")
        self.drop(spent, "its submap uses the stream already")

    def finish(self) -> None:
        """See :meth:`SensorFactors.finish`."""
        if self.graph.submaps:
            self.add_factors(self.graph.submaps[-1], closed=True)
        self.drop(self.waiting, "no submap covers it")
        self.waiting = []

    def remove(self, submap: SubmapNode) -> None:
        """See :meth:`SensorFactors.remove`."""
        inside, kinds = set(submap.nodes[:-1]), tuple({t for types in self.holders.values() for t in types})
        self.take_out(
            *(f for f, r in self.graph.records.items() if isinstance(r, kinds) and getattr(r, "node", -1) in inside)
        )

    def remove_unused(self, removed: Any) -> None:
        """Remove variables without readings, and other factors on them; renumber the others."""
        g = self.graph
        if not any(g.structure.count(word) for word in self.holders):
            return
        for word, rows in self.held().items():
            self.moved(word, self._keep(word, rows))

    def _keep(self, word: str, rows: set[int]) -> dict[int, int]:
        """Keep these rows of a kind of variable; returns old row → new row."""
        g = self.graph
        new = {old: k for k, old in enumerate(sorted(rows))}
        if len(new) == g.structure.count(word):
            return new
        for fid, r in list(g.records.items()):
            old = getattr(r, word) if isinstance(r, self.holders[word]) else None
            if old is None:
                continue
            if old not in new:
                self.take_out(fid)
            elif new[old] != old:
                g.insert(replace(r, **{word: new[old]}))  # type: ignore[type-var]
        g.values[word] = g.values[word][sorted(rows)]
        g.revision += 1
        return new

    def take_out(self, *factor_ids: int) -> None:
        """Remove factors and release their ledger entries."""
        for fid in list(factor_ids):
            del self.graph.records[fid]
            self.graph.ledger.release(fid)
            self.graph.revision += 1

    def drop(self, readings: Iterable[PendingMeasurement], why: str) -> None:
        """Count readings that get no factor, and release their ledger entries."""
        count = 0
        for r in readings:
            self.graph.ledger.release(r.factor_id)
            count += 1
        if count:
            self.graph.log_event("readings-dropped", what=self.unit, count=count, why=why)


def thinned(times: Array, every: float) -> list[int]:
    """Indices of records that are at least ``every`` seconds apart."""
    kept: list[int] = []
    for k, t in enumerate(times.tolist()):
        if not kept or t - times[kept[-1]] >= every:
            kept.append(k)
    return kept
