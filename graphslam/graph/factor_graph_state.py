"""State of a graph: factor records, values, landmark table, ledger, events; with all queries."""

from __future__ import annotations

from collections.abc import ItemsView, Iterator, Mapping, MutableMapping, Sequence, ValuesView
from dataclasses import dataclass, replace
from typing import Any, Protocol, Self, cast

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import ConfigError, DataError, GraphSlamError
from graphslam.core.geometry import Array
from graphslam.graph.covariance import JointCovariance
from graphslam.graph.diagnose import Diagnosis, diagnose
from graphslam.graph.factor_arrays import FactorArrays
from graphslam.graph.factors.attitude import AttitudeRecord
from graphslam.graph.factors.batch import FactorRecord, batch_of
from graphslam.graph.factors.between import BetweenBatch, BetweenRecord
from graphslam.graph.factors.function import FunctionRecord
from graphslam.graph.factors.landmark_submap import PathRecord, SubmapRecord
from graphslam.graph.factors.space_submap import SpaceSubmapRecord
from graphslam.graph.ledger import Ledger
from graphslam.graph.score import GraphScore, score_graph
from graphslam.graph.sensors.base import SensorFactors
from graphslam.graph.submap_node import SubmapNode
from graphslam.graph.variables import Values, VariableLayout

LANDMARK_SUBMAPS = (SubmapRecord, SpaceSubmapRecord)
"""Records of submaps with landmarks, 2-D and 3-D."""


@dataclass(frozen=True, slots=True, eq=False)
class BetweenBlock:
    """Relative poses that were added together, as arrays, with consecutive ids.

    Parameters
    ----------
    ends, T_ij, whiteners : (m, 2), (m, 3|7), (m, d, d)
    kept : (m,) bool
        False for removed ones.
    """

    first_id: int
    ends: npt.NDArray[np.int64]
    T_ij: Array
    whiteners: Array
    group: str
    kept: npt.NDArray[np.bool_]

    def batch(self, layout: VariableLayout) -> BetweenBatch:
        """The remaining factors as a batch."""
        k = np.flatnonzero(self.kept)
        rows = slice(None) if len(k) == len(self.kept) else k
        return BetweenBatch.of_arrays(
            self.ends[rows], self.T_ij[rows], self.whiteners[rows], layout, group=self.group, ids=self.first_id + k
        )

    def record(self, factor_id: int) -> BetweenRecord:
        """Record of one factor."""
        k = factor_id - self.first_id
        i, j = self.ends[k].tolist()
        return BetweenRecord(factor_id, i, j, self.T_ij[k], self.whiteners[k], group=self.group)


class FactorTable(MutableMapping[int, "FactorRecord"]):
    """Factors by id, with a journal of all changes, so that a solver finds new factors without a search.

    Factors added as arrays stay arrays; a record of one is made on request. Records of unregistered kinds are refused.
    """

    def __init__(self) -> None:
        self.single: dict[int, FactorRecord] = {}
        self.blocks: list[BetweenBlock] = []
        self.journal: list[int] = []

    def block_of(self, factor_id: int) -> BetweenBlock | None:
        """The array block of a factor."""
        for b in self.blocks:
            if 0 <= factor_id - b.first_id < len(b.kept) and b.kept[factor_id - b.first_id]:
                return b
        return None

    def add_block(self, block: BetweenBlock) -> None:
        """Add factors as arrays."""
        self.blocks.append(block)
        self.journal.extend(range(block.first_id, block.first_id + len(block.kept)))

    def flat(self, layout: VariableLayout) -> FactorArrays:
        """All factors as a least-squares problem."""
        return FactorArrays(list(self.single.values()), layout, [b.batch(layout) for b in self.blocks])

    def __getitem__(self, factor_id: int) -> FactorRecord:
        if factor_id not in self.single:
            block = self.block_of(factor_id)
            if block is not None:
                return block.record(factor_id)
        return self.single[factor_id]

    def __setitem__(self, factor_id: int, record: FactorRecord) -> None:
        batch_of(type(record))
        if self.block_of(factor_id) is not None:
            del self[factor_id]
        self.single[factor_id] = record
        self.journal.append(factor_id)

    def __delitem__(self, factor_id: int) -> None:
        block = None if factor_id in self.single else self.block_of(factor_id)
        if block is None:
            del self.single[factor_id]
        else:
            block.kept[factor_id - block.first_id] = False
        self.journal.append(factor_id)

    def __contains__(self, factor_id: object) -> bool:
        return factor_id in self.single or (isinstance(factor_id, int) and self.block_of(factor_id) is not None)

    def __iter__(self) -> Iterator[int]:
        yield from self.single
        for b in self.blocks:
            yield from (b.first_id + np.flatnonzero(b.kept)).tolist()

    def __len__(self) -> int:
        return len(self.single) + sum(int(b.kept.sum()) for b in self.blocks)

    def values(self) -> ValuesView[FactorRecord]:
        """Records; those of arrays are created during the iteration."""
        return super().values() if self.blocks else self.single.values()

    def items(self) -> ItemsView[int, FactorRecord]:
        """Ids and records; those of arrays are created during the iteration."""
        return super().items() if self.blocks else self.single.items()


class ValueSource(Protocol):
    """An incremental solver whose values are newer than the graph's."""

    def holds(self, name: str) -> bool:
        """Does it have this variable?"""
        ...

    def value(self, name: str) -> Array:
        """Its current value."""
        ...

    def pull(self, structure: Values) -> Values:
        """All values; variables that it does not have are copied from ``structure``."""
        ...


class FactorGraphState:
    """The passive part of a :class:`~graphslam.graph.factor_graph.FactorGraph`.

    Parameters
    ----------
    dim : int
        2 or 3.

    Attributes
    ----------
    structure : Values
        Variables with possibly outdated values, for uses that need only the set of variables.
    records : dict of int to FactorRecord
        Every factor by id.
    ledger : Ledger
    events : list of dict
        Changes and decisions in order; JSON-serialisable.
    revision : int
        Increases with every change of factors or variables.
    """

    def __init__(self, dim: int = 2) -> None:
        if dim not in (2, 3):
            raise ConfigError(f"a graph is in two or in three dimensions, got dim={dim}")
        self.dim = dim
        self.structure = Values.empty(dim)
        self._source: ValueSource | None = None
        self.origin = self.structure.poses[0].copy()
        self.records = FactorTable()
        self.ledger = Ledger()
        self.events: list[dict[str, Any]] = []
        self.revision = 0
        self.factor_removed = False
        """A factor was removed after the values were last optimised: they may still be near *its* optimum."""
        self.submaps: list[SubmapNode] = []
        self._place: dict[int, int] = {}  # submap key -> index in submaps
        self.sensors: dict[str, SensorFactors] = {}
        """By the name of their kind; created at first use."""
        self.gps_origin: Array | None = None
        self._row: dict[int, int] = {}
        self._seen_in: dict[int, set[int]] = {}  # landmark id -> factor ids
        self._attitude_of: dict[int, int] = {}  # node -> number of its attitude factors
        self._robots: dict[frozenset[str], int] = {}  # streams -> robot, whose submaps share constant errors
        self._user: set[int] = set()  # ids of the factors of a user
        self._retired: set[int] = set()  # ids of merged or removed landmarks, never reused
        self._next_factor = 0
        self._next_landmark = 0
        self._flat: tuple[int, FactorArrays] | None = None
        self._covariance: tuple[int, Values, JointCovariance] | None = None

    @classmethod
    def with_values(cls, values: Values) -> Self:
        """A graph with variables and without factors: factors can be inserted one by one."""
        new = cls(values.dim)
        new.structure, new.origin = values, values.poses[0].copy()
        new._row = {int(i): k for k, i in enumerate(values.landmark_ids)}
        new._seen_in = {i: set() for i in new._row}
        return new

    # ---------------------------------------------------------------- values

    @property
    def values(self) -> Values:
        """Current values; if an incremental solver has newer ones, all are read from it first."""
        if self._source is not None:
            source, self._source = self._source, None
            self.structure = source.pull(self.structure)
        return self.structure

    @values.setter
    def values(self, values: Values) -> None:
        self._source, self.structure = None, values

    def expect(self, source: ValueSource | None) -> None:
        """Set the source of newer values, which is read at the next use (None: no source)."""
        self._source = source

    def pose(self, node: int) -> Array:
        """Current pose ``(3|7,)`` of one node."""
        name = f"x{node}"
        if self._source is not None and node and self._source.holds(name):
            return self._source.value(name)
        return self.structure.poses[node].copy()

    @property
    def landmark_rows(self) -> Mapping[int, int]:
        """Landmark id → row of :attr:`Values.landmarks`."""
        return self._row

    # ---------------------------------------------------------------- changing

    def remove(self, factor_id: int, *, reason: str = "asked for") -> None:
        """Remove a factor and release its evidence; variables without a factor are removed too.

        Removing a submap also removes the GPS, IMU and other sensor factors attached to its path and, if it is the last
        submap, its nodes. The factors of a chain are removed together.
        """
        if factor_id not in self.records:
            raise DataError(f"factor {factor_id} is not in the graph", wanted="the id of a factor")
        removed = self.records[factor_id]
        owner = next((s for s in self.submaps if factor_id in s.factor_ids), None)
        if owner is not None:
            for sensor in self.sensors.values():
                sensor.remove(owner)
        for fid in (factor_id,) if owner is None else owner.factor_ids:
            if fid in self.records:
                self.take_out(fid, reason)
        if owner is not None:
            used = {n for r in self.records.values() for n in r.variables()}
            if owner.key == self.submaps[-1].key and not any(f"x{n}" in used for n in owner.nodes[1:]):
                self.values.poses = self.values.poses[: owner.node + 1].copy()
                self._place.pop(self.submaps.pop().key)
        for sensor in self.sensors.values():
            sensor.remove_unused(removed)
        known = {"x0", *self.structure.layout().names()} if self._user else set()
        for fid in [i for i in self._user if not known.issuperset(self.records[i].variables())]:
            self.take_out(fid, "one of its variables was removed")
        if self.structure.count("tilt") and not any("tilt" in r.variables() for r in self.records.values()):
            self.values.tilt = None
            self.revision += 1

    def take_out(self, factor_id: int, reason: str) -> None:
        """Remove one factor, its evidence, and landmarks that have no factor left."""
        block = self.records.block_of(factor_id)
        record = self.records.pop(factor_id)
        self._user.discard(factor_id)
        if isinstance(record, AttitudeRecord):
            self._attitude_of[record.node] -= 1
        if block is None or not block.kept.any():  # the factors of a block have one ledger entry
            self.ledger.release(factor_id if block is None else block.first_id)
        self.revision += 1
        self.factor_removed = True
        if isinstance(record, LANDMARK_SUBMAPS):
            for i in set(record.landmark_ids.tolist()):
                self._seen_in[i].discard(factor_id)
            self.drop_landmarks([i for i in set(record.landmark_ids.tolist()) if not self._seen_in[i]])
        self._event("removed", factor_id=factor_id, factor=record.label(), reason=reason)

    def merge_landmarks(self, keep: int, drop: int) -> None:
        """Merge two landmarks: factors on ``drop`` become factors on ``keep``."""
        if keep == drop or keep not in self._row or drop not in self._row:
            raise DataError("landmarks to merge are not two of the graph", got=(keep, drop), wanted="two known ids")
        distance = float(np.linalg.norm(self.landmark(keep) - self.landmark(drop)))
        for fid in self._seen_in[drop]:
            record = self.records[fid]
            assert isinstance(record, LANDMARK_SUBMAPS)
            ids = np.where(record.landmark_ids == drop, keep, record.landmark_ids)
            self.records[fid] = replace(record, landmark_ids=ids)  # a new object, so that solvers detect the change
            self._seen_in[keep].add(fid)
            self._path_follows(record.submap_key, ids)
        for fid in list(self._user):
            own = cast(FunctionRecord, self.records[fid])
            if f"l{drop}" in own.names:
                self.records[fid] = replace(own, names=tuple(f"l{keep}" if n == f"l{drop}" else n for n in own.names))
                if len(set(self.records[fid].variables())) < len(own.names):
                    self.take_out(fid, "two of its landmarks are one")
        for fid, r in list(self.records.single.items()) if "control" in self.sensors else ():
            moved = {n: keep for n in ("landmark", "landmark_to") if getattr(r, n, None) == drop}
            if moved:
                self.records[fid] = replace(cast(Any, r), **moved)
                if len(set(self.records[fid].variables())) < len(self.records[fid].variables()):
                    self.take_out(fid, "both of its landmarks are one")
        self._seen_in[drop] = set()
        self.drop_landmarks([drop])
        self.revision += 1
        self._event("merged", keep=keep, drop=drop, distance=distance)

    def split_landmark(self, factor_id: int, entry: int) -> int:
        """Undo a false association: entry ``entry`` of a submap factor gets a new landmark.

        Returns
        -------
        int
            Id of the new landmark, initialised at the observed position.
        """
        record = self.records.get(factor_id)
        if not isinstance(record, LANDMARK_SUBMAPS) or not 0 <= entry < len(record.landmark_ids):
            raise DataError(
                "no such observation to split off", got=(factor_id, entry), wanted="a submap factor's entry"
            )
        old, new = int(record.landmark_ids[entry]), self._next_landmark
        ids = record.landmark_ids.copy()
        ids[entry] = new
        if old not in ids and len(self._seen_in[old]) < 2:
            raise DataError(f"landmark {old} is seen nowhere else", got=(factor_id, entry), wanted="two observations")
        self._next_landmark += 1
        seen = self.values.group.transform(self.values.poses[record.start], record.landmark_positions()[entry])
        self.start_landmarks(ids[entry : entry + 1], seen[None])
        if old not in ids:
            self._seen_in[old].discard(factor_id)
        self.insert(replace(record, landmark_ids=ids))  # a new object, so that solvers detect the change
        self._path_follows(record.submap_key, ids)
        self._event("split", factor_id=factor_id, submap=record.submap_key, landmark=old, new=new)
        return new

    def _path_follows(self, submap_key: int, ids: npt.NDArray[np.int64]) -> None:
        """Update the landmark ids of the path factor of a submap."""
        inner = self.submap(submap_key).inner_points
        if inner is not None and inner.factor_id is not None:
            path = self.records[inner.factor_id]
            assert isinstance(path, PathRecord)
            self.records[inner.factor_id] = replace(path, landmark_ids=ids)

    def set_values(self, values: Values) -> None:
        """Use a solver's values (same variables)."""
        if not values.is_finite():
            raise DataError("values of the graph are not finite", wanted="finite numbers")
        if values.layout() != self.structure.layout():
            raise DataError("values are of other variables than the graph's", wanted="the same layout")
        self.values = values

    def log_event(self, kind: str, **facts: Any) -> None:
        """Add a decision on this graph to :attr:`events`; facts must be JSON-serialisable."""
        self._event(kind, **facts)

    # ---------------------------------------------------------------- asking

    def node_of(self, submap_key: int) -> int:
        """Node at the base of a submap."""
        return self.submap(submap_key).node

    def submap(self, submap_key: int) -> SubmapNode:
        """Nodes of a submap, by its key."""
        if submap_key in self._place:
            return self.submaps[self._place[submap_key]]
        raise DataError(f"submap {submap_key} is not in the graph", wanted="the key of a submap")

    def landmark(self, landmark_id: int) -> Array:
        """World position of a landmark."""
        return self.values.landmarks[self._row[landmark_id]]

    def detections(self, landmark_id: int) -> frozenset[int]:
        """Ids of the factors that observe a landmark."""
        return frozenset(self._seen_in[landmark_id])

    def landmark_ids_of(self, submap_key: int) -> npt.NDArray[np.int64]:
        """Current graph landmark of every entry of a submap."""
        record = self.records.get(self.submap(submap_key).factor_id) if submap_key in self._place else None
        return record.landmark_ids.copy() if isinstance(record, LANDMARK_SUBMAPS) else np.zeros(0, dtype=np.int64)

    def flat(self) -> FactorArrays:
        """Flat arrays of the factors, computed once per revision."""
        if self._flat is None or self._flat[0] != self.revision:
            self._flat = (self.revision, self.records.flat(self.structure.layout()))
        return self._flat[1]

    def covariance(self) -> JointCovariance:
        """Joint covariance at the current values, computed once per revision and values."""
        c = self._covariance
        if c is None or c[0] != self.revision or c[1] is not self.values:
            system = self.flat().evaluate(self.values)
            try:
                cov = JointCovariance(self.flat().layout, system.A)
            except GraphSlamError:
                self.diagnose().raise_if_bad()
                raise
            self._covariance = c = (self.revision, self.values, cov)
        return c[2]

    def objective(self, values: Values | None = None) -> GraphScore:
        """χ² and dof per factor class at ``values`` (default: the graph's)."""
        flat = self.flat()
        return score_graph(flat, flat.evaluate(values or self.values, hessian=False).chi2)

    def diagnose(self, values: Values | None = None) -> Diagnosis:
        """Unconstrained variables and remedies; ``.raise_if_bad()`` raises an error."""
        waiting = sum(sensor.waiting_readings() for sensor in self.sensors.values())
        return diagnose(self.flat(), values or self.values, waiting_fixes=waiting)

    # ---------------------------------------------------------------- inside

    def insert(self, record: FactorRecord) -> None:
        """Add a factor whose evidence is already in the ledger; one with the same id is replaced."""
        self.records[record.factor_id] = record
        self._next_factor = max(self._next_factor, record.factor_id + 1)
        self.revision += 1
        if isinstance(record, FunctionRecord):
            self._user.add(record.factor_id)
        if isinstance(record, AttitudeRecord):
            self._attitude_of[record.node] = self._attitude_of.get(record.node, 0) + 1
        if isinstance(record, LANDMARK_SUBMAPS):
            for i in record.landmark_ids.tolist():
                self._seen_in[i].add(record.factor_id)

    def next_factor(self) -> int:
        """An unused factor id."""
        self._next_factor += 1
        return self._next_factor - 1

    def _event(self, kind: str, **facts: Any) -> None:
        self.events.append({"event": kind, **facts})

    def append_node(self, pose: Array) -> int:
        """Append a node ``(3|7,)`` without factors; returns its number."""
        self.revision += 1
        return self.structure.append("x", pose)

    def start_landmarks(self, ids: npt.NDArray[np.int64], world: Array) -> None:
        """Add new landmarks ``(k,)`` at ``(k, dim)``; existing ones are unchanged."""
        new: dict[int, Array] = {}
        for i, p in zip(ids.tolist(), world):
            if i not in self._row and i not in new:
                new[i] = p
        for i in new:
            self._row[i] = len(self._row)
            self._seen_in[i] = set()
        self.structure.append_landmarks(
            np.array(list(new), dtype=np.int64), np.array(list(new.values())).reshape(-1, self.dim)
        )

    def drop_landmarks(self, ids: Sequence[int]) -> None:
        """Remove landmarks without factors; their ids are not used again."""
        if not ids:
            return
        keep = ~np.isin(self.values.landmark_ids, np.asarray(ids))
        self.values.landmark_ids = self.values.landmark_ids[keep]
        self.values.landmarks = self.values.landmarks[keep]
        self._row = {int(i): r for r, i in enumerate(self.values.landmark_ids)}
        for i in ids:
            self._seen_in.pop(i, None)
            self._retired.add(i)

    def start_tilt(self) -> None:
        """Add the variable ``tilt``; factors that assumed the z axis of the first base as up are then rotated by it."""
        if not self.structure.count("tilt"):
            self.structure.append("tilt", np.zeros(2))
            for fid, r in self.records.items():
                if getattr(r, "tilt", None) is False and self.dim == 3:
                    self.records[fid] = replace(cast(Any, r), tilt=True)  # a new object, so that solvers detect it
            self.revision += 1
