"""The front end ``segslam``: submaps with evidence grids and matches from a log of beams and motion."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass, field, replace
from typing import ClassVar, cast

import numpy as np

from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.random import SeedTree
from graphslam.core.record_source import RecordSource
from graphslam.core.submap import Submap
from graphslam.registration.search import last_value
from graphslam_frontends.base import PoseEstimate, Watch
from graphslam_frontends.grid.config import GridFilterConfig
from graphslam_frontends.grid.filter_error_model import FilterDrift
from graphslam_frontends.odometry.growing_steps import GrowingSteps, needs_whole_log
from graphslam_frontends.odometry.scan_use import with_findings
from graphslam_frontends.odometry.step_config import StepConfig
from graphslam_frontends.scan_window.config import ScanWindowConfig
from graphslam_frontends.scan_window.scan_odometry_steps import odometry_from_scans, refuse_fused_steps
from graphslam_frontends.segslam.config import SegSlamConfig
from graphslam_frontends.segslam.estimate import PoseEstimator
from graphslam_frontends.segslam.result import SegSlamResult
from graphslam_frontends.segslam.segslam import SegSlamFilter, run_segslam
from graphslam_frontends.segslam.submaps import common_ancestor_chain, drift_by_path, submaps_in_slices
from graphslam_frontends.stepwise import StepwiseFrontEnd


@dataclass(frozen=True, slots=True, kw_only=True)
class SegSlamFrontEndConfig:
    """The front end ``segslam``."""

    steps: StepConfig = field(default_factory=StepConfig)
    """Conversion of the log to steps."""
    filter: GridFilterConfig = field(default_factory=GridFilterConfig)
    """Particles, motion, weights."""
    segslam: SegSlamConfig = field(default_factory=SegSlamConfig)
    """Segmentation, matching, and output."""
    drift: FilterDrift = field(default_factory=FilterDrift)
    """Errors common to all particles, if the filter samples the motion."""
    window: ScanWindowConfig = field(default_factory=ScanWindowConfig)
    """Scan-to-window odometry inside the segments (``segslam.inside = "scan-window"``)."""

    def __post_init__(self) -> None:
        if self.segslam.inside == "scan-window":
            refuse_fused_steps(self.steps)


DELAY = 2.0
"""A step is filtered this long after its look-ahead window, so that steps that are made together are filtered evenly
[s]."""

PAUSE = 0.04
"""Between records there is one slice of work per this time of the log [s]."""


@dataclass(frozen=True, slots=True)
class SegSlam(StepwiseFrontEnd):
    """The front end ``segslam``.

    Needs a stream of beams (a spinning scanner, point clouds, planar scans) and one of motion. A segment becomes a
    submap as soon as all particles descend from it, because it is then in the result whatever follows. The filter lags
    behind the records by the look-ahead window and :data:`DELAY`; :meth:`estimate` adds dead reckoning. A resumed run
    filters from the start; the same seed gives the same submaps.
    """

    config: SegSlamFrontEndConfig = field(default_factory=SegSlamFrontEndConfig)
    _live: list[PoseEstimator] = field(default_factory=list, init=False, repr=False, compare=False)
    name: ClassVar[str] = "segslam"
    draws: ClassVar[bool] = True

    def waits_for(self) -> str:
        """See :class:`~graphslam_frontends.base.FrontEnd`."""
        c = self.config
        reasons = {
            "segslam.inside = 'scan-window'": c.segslam.inside == "scan-window",
            "segslam.segmentation.decide = 'particle'": c.segslam.segmentation.decide == "particle",
            "filter.likelihood = 'upright'": c.filter.likelihood == "upright",
        }
        found = next((what for what, so in reasons.items() if so), needs_whole_log(c.steps))
        return f"frontend.{found} needs the whole log" if found else ""

    def follow(
        self,
        feed: RecordSource,
        *,
        seed: SeedTree,
        after: Submap | None = None,
        drops: DropCounter | None = None,
        watch: Watch | None = None,
    ) -> Iterator[Submap | None]:
        """See :class:`~graphslam_frontends.base.FrontEnd`: the chain of the best particle, segment by segment."""
        first, key = 0 if after is None else after.key + 1, -1
        found: SegSlamFilter | SegSlamResult | None = None
        for found in self._filtered(feed, seed, drops, watch):
            new: list[Submap] = []
            if isinstance(found, SegSlamFilter) and found.closed[0] < 0 and (found.boundary or found.resampled[-1]):
                yield from _pause(feed)
                work = _submaps_until(found, found.common(), self.config.drift, self.config.segslam, key)
                new = yield from _with_records(feed, work)
            elif isinstance(found, SegSlamResult):
                new = submaps_of_best_particle(found, self.config.drift, self.config.segslam, after=key)
                new[-1] = with_findings(new[-1], found.steps)
            for submap in new:
                yield from _pause(feed)
                key = submap.key
                for estimator in self._live:
                    estimator.committed = key + 1
                if key >= first:
                    yield submap
                    yield from _pause(feed)
            if found is None:
                yield None

    def result(
        self, log: SensorLog, *, seed: SeedTree, drops: DropCounter | None = None, watch: Watch | None = None
    ) -> SegSlamResult:
        """The SegMap with all particles; :meth:`submaps` outputs the chain of the best one."""
        *_, found = self._filtered(RecordSource(log), seed, drops, watch)
        return cast(SegSlamResult, found)

    def estimate(self) -> PoseEstimate | None:
        """See :class:`~graphslam_frontends.base.FrontEnd`: the step *Estimate* of the paper."""
        return self._live[0].now() if self._live else None

    def forget(self) -> None:
        """Free the steps and the filter of the last log."""
        self._made.clear()
        self._live.clear()

    def _filtered(
        self, feed: RecordSource, seed: SeedTree, drops: DropCounter | None, watch: Watch | None
    ) -> Iterator[SegSlamFilter | SegSlamResult | None]:
        """The filter after each step, None where it waits for records, and the result at the end."""
        self._live.clear()
        c, filter, growing = self.config, self.config.filter, GrowingSteps(feed, self.config.steps)
        number = len(self.steps(feed.log, drops=drops)) if feed.ended else 0  # errors of the log, before the work
        run: SegSlamFilter | None = None
        window, k, seen, busy = c.segslam.segmentation.window, 0, -np.inf, -np.inf
        while not (self.waits_for() or growing.whole_log):
            while not growing.cover(k, window) and growing.more():
                pass
            due = growing.latest >= growing.times[k] + window + DELAY if growing.cover(k, window) else growing.complete
            if not (feed.ended or (due and growing.latest >= busy)):
                seen = growing.latest
                yield None
                continue
            if growing.complete and (k >= growing.made or growing.made < 2):
                break
            if growing.whole_log or not growing.cover(k, window):
                continue
            if run is None:
                run = SegSlamFilter(growing, filter, c.segslam, seed.child(0), 32)
            run.grow()
            for _ in run.slices(k, last=growing.complete and k == growing.made - 1):
                busy = max(busy, seen) + PAUSE
                while not feed.ended and growing.latest < busy:  # the rest of the step with the next records
                    seen = growing.latest
                    yield None
                    growing.more()
            busy = max(busy, seen) + PAUSE
            growing.forget_before(k + 1)
            if not self._live:
                self._live.append(PoseEstimator(run, growing, c.drift, c.segslam.handover.drift_scale))
            k += 1
            if watch is not None:
                watch(run.progress(number))
            yield run
            seen = growing.latest  # more records came if submaps were made meanwhile: the filter goes on one by one
        while not feed.ended:
            yield None
        steps = self.steps(feed.log, drops=drops)
        if drops is not None:
            drops.counts.update(growing.drops.counts)
        if run is not None:
            yield run.result(steps)
            return
        if c.segslam.inside == "scan-window":
            # one path for all: its uncertainty is too small for maps to resolve
            steps, filter = odometry_from_scans(steps, c.window), replace(filter, walk_scale=0.0, motion_scale=0.0)
        yield run_segslam(steps, filter, c.segslam, seed.child(0), watch=watch)


def _pause(feed: RecordSource, seconds: float = 3.0 * PAUSE) -> Iterator[None]:
    """Wait for the records of the next scan: the parts of the work for a submap are not done together."""
    begin = max((feed.until(n) for n in feed.names(object)), default=0.0)
    while not feed.ended and max(feed.until(n) for n in feed.names(object)) < begin + seconds:
        yield None


def _with_records(feed: RecordSource, work: Generator[None, None, list[Submap]]) -> Generator[None, None, list[Submap]]:
    """Do the slices of some work one by one between the records."""
    while True:
        try:
            next(work)
        except StopIteration as end:
            found: list[Submap] = end.value
            return found
        yield from _pause(feed, PAUSE)


def submaps_of_best_particle(
    result: SegSlamResult, drift: FilterDrift, config: SegSlamConfig, *, after: int = -1
) -> list[Submap]:
    """Submaps of the best particle's chain.

    Parameters
    ----------
    drift : FilterDrift
        Errors common to all particles.
    after : int
        Only the submaps after this key.
    """
    return last_value(_submaps_until(result, int(result.closed[result.best]), drift, config, after))


def _submaps_until(
    found: SegSlamFilter | SegSlamResult, last: int, drift: FilterDrift, config: SegSlamConfig, after: int
) -> Generator[None, None, list[Submap]]:
    """In slices, the submaps after a key of the chain that ends with the segment ``last``; -1: there is none."""
    segmap = found.segmap
    chain = common_ancestor_chain(segmap, last) if last >= 0 else np.zeros(0, dtype=np.int64)
    if len(chain) <= after + 1:
        return []
    return (
        yield from submaps_in_slices(
            segmap,
            chain,
            drift_by_path(segmap, chain, drift, found.steps),
            config.handover,
            uses=found.steps.uses,
            reasons={b.step: b.why for b in found.boundaries},
            after=after,
        )
    )
