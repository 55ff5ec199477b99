"""Back end: association, factors, solver, merging of landmarks, loops. One call per finished submap."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.association.identity import find_association_outliers
from graphslam.association.landmarks import AssociationConfig, associate_landmarks
from graphslam.association.merging import euclidean_merges, mahalanobis_merges
from graphslam.backend.ambiguous_maps import AmbiguousMaps, ambiguous_maps
from graphslam.backend.config import MATCH_KERNEL, BackEndConfig, GpsOptions
from graphslam.backend.fix_errors import fit_fix_errors
from graphslam.backend.streams import GpsSource, ImuSource, OtherSources, repreintegrate_until_converged
from graphslam.core.control import ControlTable
from graphslam.core.errors import DataError
from graphslam.core.log import SensorLog
from graphslam.core.records import Gps
from graphslam.core.submap import Submap
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.between import BetweenRecord
from graphslam.graph.sensors.control import ControlFactors
from graphslam.graph.sensors.gps import GpsFactors
from graphslam.loops.candidates import FRONT_END, CandidateConfig
from graphslam.loops.find_loops import FindConfig, LoopSearch
from graphslam.loops.ledger import DECIDED, LoopDecision, LoopLedger, ledger_of_events, same_loop
from graphslam.loops.overlap_constraints import overlap_entries
from graphslam.registration.search import last_value, timed_slices
from graphslam.solve.registry import make_solver
from graphslam.solve.solution import Solution
from graphslam_frontends.base import PoseEstimate

logger = logging.getLogger(__name__)
Ints = npt.NDArray[np.int64]
MERGE_REACH = 5.0
"""Landmarks that are farther apart are not tested for merging by covariance [m]."""
LOOP_OVERLAP = 8.0
"""Maps of two places are matched if their distance may be smaller than this [m] …"""
LOOP_HEIGHT = 1.0
"""… and their height difference not larger than this [m]."""


def find_config(c: BackEndConfig) -> FindConfig:
    """Configuration of the loop search; front-end matches are included."""
    return FindConfig(
        candidates=CandidateConfig(overlap=LOOP_OVERLAP, height=LOOP_HEIGHT, least_support=c.match_support),
        front_end=True,
        rounds=FindConfig().rounds if c.looks else 0,
    )


class Observer:
    """Notified during a run, for example a progress bar or a live view. Subclasses override the methods they need.

    An observer cannot change the run; an exception in it ends the run.
    """

    def stage(self, name: str) -> None:
        """A stage of the run begins, such as ``"front end"`` (:data:`graphslam.app.run.run_bar.STAGES`)."""

    def log_read(self, log: SensorLog) -> None:
        """The log was read; before any other work."""

    def front_end_at(self, progress: Any) -> None:
        """A front end has made a step; the type of ``progress`` depends on the front end."""

    def pose_estimated(self, estimate: PoseEstimate) -> None:
        """Online (`gs.Slam`), after every scan: the current pose in the map, with its covariance and lag."""

    def submap_added(self, submap: Submap, graph: FactorGraph) -> None:
        """A submap was added to the graph, and the graph was solved."""

    def loop_decided(self, decision: LoopDecision, graph: FactorGraph) -> None:
        """A loop was accepted or rejected; ``decision.why`` has the reason."""

    def solved(self, solution: Solution) -> None:
        """All submaps were added, and the graph was solved."""


@dataclass
class BackEnd:
    """A pose graph to which submaps are added; it is solved after each of them.

    Parameters
    ----------
    solver : str
        Name in the solver registry.
    """

    config: BackEndConfig
    solver_name: str
    graph: FactorGraph = field(default_factory=FactorGraph)
    """2-D until the first submap is added; replaced if that is 3-D."""
    seconds: dict[str, float] = field(default_factory=lambda: {"associate": 0.0, "solve": 0.0, "merge": 0.0})
    per_submap_s: list[float] = field(default_factory=list)
    submaps: list[Submap] = field(default_factory=list)
    """With their maps; kept only if loops are searched."""
    imu: ImuSource | None = None
    """IMUs of the log; None without a log."""
    fixes: GpsSource | None = None
    """Fixes of the log that are added during the run."""
    others: OtherSources | None = None
    """Sensors of the log without options."""
    observers: Sequence[Observer] = ()
    control: ControlTable | None = None
    """Control points and distances, which are added in :meth:`finish`."""
    two_maps: AmbiguousMaps | None = None
    """After :meth:`finish`: the graph with each of two contradictory groups of loops, if undecided."""

    def __post_init__(self) -> None:
        self.solver = make_solver(self.solver_name, self.graph)
        self._waiting: list[tuple[Gps, GpsOptions]] = []
        self._later: list[Callable[[FactorGraph], object]] = []  # until the first submap, which sets the dimension
        self._loops: LoopSearch | None = None
        self._noted = 0  # number of loop decisions that are already in the events
        self._association = AssociationConfig(
            method=self.config.method, gate=self.config.gate, covariance_scale=self.config.covariance_scale
        )

    def add_gps(self, gps: Gps, config: GpsOptions) -> None:
        """Add fixes to the graph; they become factors when the submaps of their times are added.

        Before the first submap the fixes are stored. In a planar graph they lose their height.
        """
        if not self.graph.submaps:
            self._waiting.append((gps, config))
            return
        have, want = gps.positions.shape[1], self.graph.dim
        if have > want:
            gps = replace(gps, positions=gps.positions[:, :want], lever=gps.lever[:want])
        self.graph.add_sensor(gps, config=config)

    def add_sensor(self, name: str, readings: Any, config: Any) -> None:
        """Add the readings of a sensor to the graph; they become factors when the submaps of their times are added."""
        self._later.append(lambda graph: graph.add_sensor(readings, stream=name, config=config))

    def add(self, submap: Submap) -> None:
        """Associate, add and solve; landmarks are merged and loops are searched after every n-th submap."""
        last_value(self.add_in_slices(submap))

    def add_in_slices(self, submap: Submap) -> Generator[None, None, None]:
        """:meth:`add`, with the search for loops in slices of bounded work; nothing else may be added in between."""
        _, spent = yield from timed_slices(self._add(submap))
        self.per_submap_s.append(spent)
        for o in self.observers:
            o.submap_added(submap, self.graph)

    def _add(self, submap: Submap) -> Generator[None, None, None]:
        start = time.perf_counter()
        associated = self.append(submap)
        self.solver.update()
        solved = time.perf_counter()
        self.seconds["associate"] += associated - start
        self.seconds["solve"] += solved - associated
        n = len(self.graph.submaps)
        if self.config.merge_every and n % self.config.merge_every == 0:
            self.merge()
        if self.config.look_every and n % self.config.look_every == 0:
            yield from self._look()

    def _look(self) -> Generator[None, None, None]:
        """During the run: add IMU factors of the submaps so far, and search for loops."""
        if self.imu is not None and self.imu.attach(self.graph, more=True):
            self.solver.update()
        if self.config.looks:
            yield
            yield from self._find_loops(last=False)

    def append(self, submap: Submap) -> float:
        """Associate and add without solving; returns the time after the association (``perf_counter``) [s]."""
        if submap.dim != self.graph.dim and not self.graph.submaps:
            self.graph = FactorGraph(submap.dim)
            self.solver = make_solver(self.solver_name, self.graph)
        c = self.config
        ids = None
        if c.associate and submap.landmarks is not None:
            ids = associate_landmarks(self.graph, self.graph.as_known(submap), self._association)
        associated = time.perf_counter()
        dense = submap.landmarks is None
        self.graph.add_submap(
            submap,
            landmark_ids=ids,
            covariance_scale=c.covariance_scale,
            spacing=c.node_spacing if dense and c.node_spacing > 0 else None,
            level_sigma=c.level_sigma if dense and submap.dim == 3 and c.level_sigma > 0 else None,
        )
        self._add_matches(submap)
        if c.looks:
            self.submaps.append(submap)
        if self.imu is not None:
            self.imu.look(self.graph)
        waiting, self._waiting = self._waiting, []
        for gps, config in waiting:
            self.add_gps(gps, config)
        self._give_fixes(submap.interval[1])
        later, self._later = self._later, []
        for add in later:
            add(self.graph)
        return associated

    def _give_fixes(self, until: float) -> None:
        gps = None if self.fixes is None else self.fixes.next(until)
        if gps is not None and self.fixes is not None:
            self.add_gps(gps, self.fixes.config)
        if self.others is not None:
            self.others.give(self.graph, until)

    def _add_matches(self, submap: Submap) -> None:
        """Add front-end matches with enough support as factors; the others are logged as events."""
        for m in submap.matches:
            if m.support >= self.config.match_support:
                self.graph.add_match(submap.key, m, robust=MATCH_KERNEL)
            else:
                self.graph.log_event(
                    "match-not-used", submap=submap.key, target=m.target, fitness=m.fitness, support=m.support
                )

    def merge(self) -> int:
        """Merge landmarks by joint covariance, then by distance, and solve; returns the number of merges."""
        start = time.perf_counter()
        merged = 0
        if self.config.associate and len(self.graph.values.landmarks) > 1:
            for keep, drop in mahalanobis_merges(self.graph, self.config.gate, distance=MERGE_REACH):
                self.graph.merge_landmarks(keep, drop)
                merged += 1
            if merged:
                self.solver.update()
            if self.config.merge_distance > 0:
                for keep, drop in euclidean_merges(self.graph, self.config.merge_distance):
                    self.graph.merge_landmarks(keep, drop)
                    merged += 1
                self.solver.update()
        self.seconds["merge"] += time.perf_counter() - start
        return merged

    def finish(self, undo: Sequence[int | LoopDecision] = ()) -> Solution:
        """Add the last factors, solve to the optimum, merge landmarks, decide on loops, and return the solution.

        Parameters
        ----------
        undo : sequence of int or LoopDecision
            Loops to remove: by their numbers in the loop ledger, or as decisions from an earlier ledger of the same
            submaps. If such a loop is not in this graph, this is logged and it stays undone.
        """
        self._give_fixes(np.inf)
        if self.control is not None:
            ControlFactors.of(self.graph).add(self.control)
        self.graph.finish_sensors()
        if self.imu is not None:
            self.imu.attach(self.graph)
        repreintegrate_until_converged(self.graph, self.solver)
        if GpsFactors.of(self.graph).config.errors == "fitted" and fit_fix_errors(self.graph) is not None:
            self.solver.solve_to_optimum()
        for _ in range(10):
            if not self.merge():
                break
            self.solver.solve_to_optimum()
        if self.config.looks:
            self.find_loops()
        for loop in undo:
            if isinstance(loop, LoopDecision):
                self._stay_undone(loop)
            else:
                self.undo_loop(loop)
        start = time.perf_counter()
        if self._loops is not None and self._loops.closer is not None:
            self.two_maps = ambiguous_maps(self.graph, self.solver, self._loops.closer)
        repreintegrate_until_converged(self.graph, self.solver)
        self.split_wrong_identities()
        solution = self.solver.solution()
        self.seconds["solve"] += time.perf_counter() - start
        for o in self.observers:
            o.solved(solution)
        return solution

    def find_loops(self, *, last: bool = True) -> LoopLedger:
        """Search for loops between the submaps, add the accepted ones, and log every decision.

        The front end's matches are decided on as well; until now each was a factor because of its support alone.

        Parameters
        ----------
        last : bool
            No more submaps follow (:class:`~graphslam.loops.find_loops.LoopSearch`).
        """
        return last_value(self._find_loops(last=last))

    def _find_loops(self, *, last: bool) -> Generator[None, None, LoopLedger]:
        ledger, spent = yield from timed_slices(self._decide_on_loops(last))
        self.seconds["loops"] = self.seconds.get("loops", 0.0) + spent
        return ledger

    def _decide_on_loops(self, last: bool) -> Generator[None, None, LoopLedger]:
        for fid in [f for f, r in self.graph.records.items() if isinstance(r, BetweenRecord) and r.group == "match"]:
            self.graph.remove(fid, reason=DECIDED)
        self.solver.solve_to_optimum()
        self._loops = self._loops or LoopSearch(find_config(self.config))
        yield
        ledger = (yield from self._loops.look_in_slices(self.graph, self.solver, self.submaps, last=last)).ledger
        new = ledger.decisions[self._noted :]
        self._noted = len(ledger.decisions)
        for decision in new:
            event = decision.event()
            self.graph.log_event(event.pop("event"), **event)
        for n in dict.fromkeys(d.loop for d in new):
            for o in self.observers:
                o.loop_decided(ledger.of(n), self.graph)
        return ledger

    def undo_loop(self, loop: int) -> None:
        """Remove a loop, or a match with its overlap constraints; other loops found with it stay in the graph."""
        ledger = ledger_of_events(self.graph.events)
        d = ledger.of(loop)
        if d.verdict != "accepted" or d.factor_id not in self.graph.records:
            raise DataError(f"loop {loop} is not in the graph", got=d.verdict, wanted="an accepted loop")
        why = {d.loop: "asked for"}
        if d.source == FRONT_END:
            entry = (d.submap_i, d.submap_j)
            dependent = (x for x in ledger.current() if x.verdict == "accepted" and entry in overlap_entries(x.gates))
            why |= {x.loop: f"by loop {loop}, which was undone" for x in dependent}
        for number, reason in why.items():
            x = ledger.of(number)
            matched = self.graph.records[x.factor_id]
            self.graph.remove(x.factor_id, reason="undone")
            if isinstance(matched, BetweenRecord) and matched.group != "match":  # for a match the removal is the event
                event = replace(x, verdict="undone", why=reason, weight=0.0, factor_id=-1).event()
                self.graph.log_event(event.pop("event"), **event)
        self.solver.solve_to_optimum()

    def _stay_undone(self, before: LoopDecision) -> None:
        """Remove a loop that was undone in an earlier run of the same submaps."""
        ledger = ledger_of_events(self.graph.events)
        d = same_loop(before, ledger)
        if d is not None:
            self.undo_loop(d.loop)
            return
        what = f"loop {before.loop} of submaps {before.submap_i} and {before.submap_j}"
        logger.warning("%s was undone before and was not found this time", what)
        number = 1 + max((x.loop for x in ledger.decisions), default=-1)
        event = replace(before, loop=number, why="undone before; not found this time").event()  # for the next run
        self.graph.log_event(event.pop("event"), **event)

    def split_wrong_identities(self) -> int:
        """Split off observations that contradict the map, the worst first, until none does; returns their number."""
        split = 0
        while self.config.identity_gate > 0 and split < 10 * len(self.graph.submaps):
            doubts = find_association_outliers(self.graph, self.config.identity_gate)
            if not doubts:
                break
            self.graph.split_landmark(doubts[0].factor_id, doubts[0].entry)
            self.solver.solve_to_optimum()
            split += 1
        return split

    def landmark_hits(self, submaps: list[Submap]) -> dict[int, int]:
        """Observations of every landmark over all submaps (1 per submap that does not count them)."""
        hits: dict[int, int] = {int(i): 0 for i in self.graph.values.landmark_ids}
        for s in submaps:
            if s.landmarks is None:
                continue
            ids = self.graph.landmark_ids_of(s.key)
            rows = s.landmarks.detections
            counts = np.ones(len(ids), dtype=int) if rows is None else np.bincount(rows[:, 1], minlength=len(ids))
            for i, n in zip(ids.tolist(), counts.tolist()):
                hits[i] = hits.get(i, 0) + n
        return hits

    def observation_labels(self, submaps: list[Submap]) -> tuple[Ints, Ints]:
        """(observation index in the log, landmark id) of every observation, for audits of the association."""
        rows: list[Any] = [np.zeros((0, 2), dtype=np.int64)]
        for s in submaps:
            if s.landmarks is not None and s.landmarks.detections is not None:
                ids = self.graph.landmark_ids_of(s.key)
                q = s.landmarks.detections
                rows.append(np.column_stack([q[:, 0], ids[q[:, 1]]]))
        table = np.concatenate(rows)
        return table[:, 0], table[:, 1]
