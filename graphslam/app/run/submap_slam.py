"""Front end and back end together: `run` uses it with a whole log, `gs.Slam` with records as they arrive."""

from __future__ import annotations

import copy
import logging
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from graphslam.app.run.audit import reference_identities
from graphslam.app.run.folder import RunFolder
from graphslam.app.run.options import RunOptions
from graphslam.app.run.run_bar import RunBar
from graphslam.app.run.run_inputs import RunInputs, collect_inputs
from graphslam.backend.back_end import BackEnd, Observer
from graphslam.backend.streams import GpsSource, ImuSource, OtherSources, optional_sensors
from graphslam.core.control import measured_places
from graphslam.core.geometry import Array
from graphslam.core.heap import trim_heap
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.random import SeedTree
from graphslam.core.record_source import RecordSource
from graphslam.core.submap import Submap
from graphslam.evaluate.stream_checks import StreamFinding
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.spilled_grid import load_spilled, spill_grid
from graphslam.loops.ledger import LoopDecision
from graphslam.refine.scans import Scans
from graphslam.solve.solution import Solution

logger = logging.getLogger(__name__)
PAUSE = 0.16
"""Time of the log between two slices of the search for loops [s]."""


@dataclass(frozen=True, slots=True)
class FrontEndTiming:
    """Timing of the front end in this session.

    Parameters
    ----------
    resumed : int
        Submaps that were already in the folder.
    per_scan : (k,)
        Seconds per scan for each submap except the first, which may include compilation.
    """

    seconds: float
    resumed: int
    per_scan: Array


class SubmapSlam:
    """A front end and a back end. Every submap is added to the graph and stored as soon as its records are complete.

    Parameters
    ----------
    feed : RecordSource
        Records of the log.
    observers : sequence of Observer
        Notified of the progress.
    folder : RunFolder, optional
        Folder for the submaps; those that it already has are not made again.
    """

    def __init__(
        self,
        options: RunOptions,
        feed: RecordSource,
        observers: Sequence[Observer] = (),
        folder: RunFolder | None = None,
    ) -> None:
        self.options, self.feed, self.folder = options, feed, folder
        self.control, self.check = options.table("control"), options.table("check")
        feed.places = measured_places(self.control, self.check)
        self.seed_choice = None if folder is None else folder.seed_choice()
        """Decision between earlier draws of the folder, if there was one."""
        self._begin(0 if self.seed_choice is None else self.seed_choice.draw, observers)

    def _begin(self, draw: int, observers: Sequence[Observer]) -> None:
        """Start with a random draw: submaps of it that are in the folder are added; the others follow."""
        self.draw, self.drops = draw, DropCounter()
        self.back = self._back_end(self.options, observers)
        self._seconds, self._since, self._cost = 0.0, 0.0, list[float]()
        self.store = None
        if self.folder is not None:
            load = load_spilled if self.options.with_grids else None
            chosen = 0 if self.seed_choice is None else self.seed_choice.draw
            self.store = self.folder.submaps_with(load, draw=None if draw == chosen else draw)
        self.submaps: list[Submap] = [] if self.store is None else self.store.complete_prefix()
        if self.store is not None and self.options.front is not None:
            self.store.truncate(len(self.submaps))
        self.waiting: list[Submap] = []
        """Finished submaps that are not yet in the graph, because it is searched for loops."""
        self._adding: Iterator[None] | None = None
        self._paused = -np.inf
        self._resumed = len(self.submaps)
        for s in self.submaps:
            self.back.add(s)
        self._stream: Iterator[Submap | None] = iter(()) if self.options.front is None else self._follow()

    def _follow(self) -> Iterator[Submap | None]:
        assert self.options.front is not None
        last = self.submaps[-1] if self.submaps else None
        if last is not None:
            logger.info("resumed after submap %d at %.2f s", last.key, last.interval[1])
        seed = SeedTree(self.options.named["seed"])
        drawn = seed.child("draw", self.draw, "frontend") if self.draw else seed.child("frontend")
        return self.options.front.follow(self.feed, seed=drawn, after=last, drops=self.drops, watch=self._watch)

    def _back_end(self, options: RunOptions, observers: Sequence[Observer]) -> BackEnd:
        """A back end with its IMUs, and the fixes to use."""
        feed, settings = self.feed, options.settings
        imu, fixes = ImuSource(feed, settings.imu), GpsSource(feed, settings.gps)
        others = OtherSources(feed)
        back = BackEnd(settings.backend, options.solver, imu=imu, observers=observers, fixes=fixes, others=others)
        back.control = self.control
        if feed.ended:  # compasses and beacons need the whole log
            for name, readings, config in optional_sensors(feed.log, settings.compass, settings.beacons):
                back.add_sensor(name, readings, config)
        return back

    def step(self) -> None:
        """Process the records so far; after the end of the log all of them."""
        while True:
            start = time.perf_counter()
            submap = next(self._stream, None)
            spent = time.perf_counter() - start
            self._seconds, self._since = self._seconds + spent, self._since + spent
            if submap is None:  # needs more records, or the log has ended
                self._add()
                return
            if isinstance(submap.grid, EvidenceGrid):
                submap.grid.pool.release_scratch()
                submap = replace(submap, grid=spill_grid(submap.grid))
            if self.store is not None:
                self.store.append(submap)
            self._cost.append(self._since / max(int(submap.report.get("scans", 1)), 1))
            self._since = 0.0
            self.waiting.append(submap)
            self._add()

    def _add(self) -> None:
        """Add the waiting submaps to the graph; while records come, one slice in :data:`PAUSE`."""
        while self.waiting or self._adding is not None:
            if not self.feed.ended:
                latest = max(map(self.feed.until, self.feed.names(object)))
                if latest < self._paused + PAUSE:
                    return
                self._paused = latest
            if self._adding is None:
                self.submaps.append(self.waiting.pop(0))
                self._adding = self.back.add_in_slices(self.submaps[-1])
            if next(self._adding, self) is self:
                self._adding = None

    def finish(self, undo: Sequence[int | LoopDecision] = ()) -> Solution:
        """Last factors, loops, and the optimum; without the loops in ``undo``."""
        tell_stage(self.back.observers, "graph")
        return self.back.finish(undo)

    def inputs(self, log: SensorLog, noticed: Sequence[StreamFinding]) -> RunInputs:
        """Inputs of the graph and its evaluation; frees the memory of the front end."""
        front = self.options.front
        assert front is not None
        steps = front.steps(log) if self.options.settings.refine.use else None
        scans = None if steps is None else Scans.of(steps)
        del steps
        self.release_memory()
        return collect_inputs(log, self.drops.counts, reference_identities(log, front), noticed, scans)

    def release_memory(self) -> None:
        """Free the memory that making the submaps needed."""
        if self.options.front is not None:
            self.options.front.forget()
        trim_heap()

    def next_draw(self) -> SubmapSlam:
        """The same log with the next random draw; all submaps are made anew."""
        bars = self._bars()
        tell_stage(bars, "front end")
        made = copy.copy(self)
        made.feed = RecordSource(self.feed.log)
        made.feed.places = self.feed.places
        made._begin(self.draw + 1, bars)
        made.step()
        made.release_memory()
        return made

    def searching_loops(self) -> SubmapSlam:
        """The same submaps in another graph, with loop search in the back end."""
        made = copy.copy(self)
        made.back = self._back_end(self.options.searching_loops(), self._bars())
        for s in self.submaps:
            made.back.add(s)
        return made

    @property
    def timing(self) -> FrontEndTiming:
        """Timing of the front end so far."""
        return FrontEndTiming(self._seconds, self._resumed, np.array(self._cost[1:]))

    def _bars(self) -> list[Observer]:
        return [o for o in self.back.observers if isinstance(o, RunBar)]

    def _watch(self, at: Any) -> None:
        for o in self.back.observers:
            o.front_end_at(at)


def tell_stage(observers: Sequence[Observer], name: str) -> None:
    """Notify the observers that a stage of the run begins."""
    for o in observers:
        o.stage(name)
