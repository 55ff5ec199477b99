"""SegSLAM: a particle filter on evidence grids that ends submaps, begins new ones, and re-enters old ones.

The state of a particle is its pose *in a submap* (A1–A6). While its map predicts the next beams the segment continues;
otherwise the segment ends for all particles, and each draws its next map: an older one that explains the look-ahead
window, or a new one. An older map can also be entered while the segment would continue; particles that do not draw it
then keep their map.

The filter at step k uses the seconds after it, so it lags behind the sensors by that time.
"""

from __future__ import annotations

import time
from collections.abc import Generator, Iterator, Sequence

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of, remove_roll_pitch
from graphslam.core.progress import Bar
from graphslam.core.random import SeedTree
from graphslam.registration.search import timed_slices
from graphslam_frontends.base import Watch
from graphslam_frontends.grid.config import GridFilterConfig
from graphslam_frontends.grid.filter import GridFilter
from graphslam_frontends.odometry.growing_steps import GrowingSteps
from graphslam_frontends.odometry.steps import Steps
from graphslam_frontends.segslam.config import SegSlamConfig
from graphslam_frontends.segslam.matching import MatchAttempt, Matcher
from graphslam_frontends.segslam.progress import SegSlamProgress
from graphslam_frontends.segslam.result import Boundary, ScoreLine, SegSlamResult
from graphslam_frontends.segslam.segmap import MATCH, NEW, SAME, SegMap, SegmentEntry
from graphslam_frontends.segslam.segmentation import (
    KNOWN_SCORE,
    SegmentDecision,
    Segmenter,
    predictive_score,
    representative_particles,
)
from graphslam_frontends.segslam.window import LookAheadScan, gather_look_ahead

Ints = npt.NDArray[np.int64]
SCORE_BEAMS = 600
"""Most beams of a look-ahead window that are ray-cast for the predictive score (evenly subsampled)."""
SCORE_PARTICLES = 8
"""Most particles for the predictive score, selected by weight, if the filter decides as a whole: its mean score is
used, and particles differ by less than 0.03 in it."""
RESERVED = 65_536, 262_144
"""Nodes and bricks of the maps from the beginning: unused ones take no physical memory, and growth copies all maps in
one step."""
KNOWN_RADIUS = 2.0
"""A place is known if the path of the map itself was within this distance [m] …"""
KNOWN_GAP = 20.0
"""… at least this long ago [s]."""


def run_segslam(
    steps: Steps,
    filter: GridFilterConfig,
    config: SegSlamConfig,
    seed: SeedTree,
    *,
    progress: bool = False,
    prune_every: int = 32,
    watch: Watch | None = None,
) -> SegSlamResult:
    """Run SegSLAM over all steps.

    Parameters
    ----------
    filter : GridFilterConfig
        Of the particle filter inside the segments.
    seed : SeedTree
        The same seed gives the same SegMap, with any number of threads.
    progress : bool
        Show a progress bar.
    prune_every : int
        See :class:`~graphslam_frontends.grid.ancestry.Ancestry`.
    watch : callable, optional
        Called with a :class:`~graphslam_frontends.segslam.progress.SegSlamProgress` after every step.
    """
    if len(steps) < 2:
        raise DataError("too few steps for a segment", where=steps.name, got=len(steps), wanted="at least 2")
    run = SegSlamFilter(steps, filter, config, seed, prune_every)
    for k in Bar(range(len(steps)), name=steps.name, unit="step", shown=progress):
        run.step(k, last=k == len(steps) - 1)
        if watch is not None:
            watch(run.progress(len(steps)))
    return run.result(steps)


def near_pose(path: Array, T: Array, radius: float) -> npt.NDArray[np.bool_]:
    """Which poses of a path ``(n, 7)`` or ``(n, 3)`` are within ``radius`` [m] of a pose, in 2-D or 3-D."""
    return np.asarray(np.linalg.norm((path - T)[:, : group_of(T).dim], axis=1) <= radius)


class SegSlamFilter:
    """State of a run, step by step; the steps may grow (:meth:`grow`)."""

    def __init__(
        self,
        steps: Steps | GrowingSteps,
        filter: GridFilterConfig,
        config: SegSlamConfig,
        seed: SeedTree,
        prune_every: int,
    ) -> None:
        self.steps, self.config, self.seed = steps, config, seed
        self.filter = GridFilter(steps, filter, seed.child("filter"), prune_every=prune_every)
        self.filter.pool.reserve(*RESERVED)
        n = filter.particles
        self.group = group_of(self.filter.particles.poses)
        self.at = -1
        """The last step; -1 before the first."""
        self.turned: list[float] = []  # accumulated absolute rotation until each step [rad]
        self.segmap = SegMap(
            steps.times, steps.path_length, n, dim=steps.dim, gravity=steps.tilt is not None, lift=self.filter.lift
        )
        self.grow()
        self.matcher = Matcher(self.segmap, config, steps.max_range, threads=filter.threads)
        self.segmenters = [self._segmenter(0) for _ in range(n)]
        self.segmap.open(0, [SegmentEntry(T_entry=p, kind=NEW) for p in self.filter.particles.poses])
        self.ids = np.zeros(n, dtype=np.int64)  # of the open segments, in order of start: tags of the ancestry
        self.begun = 1
        self.last_attempt = float(steps.times[0])
        self.effective: list[float] = []
        self.step_seconds: list[float] = []
        self.slice_seconds: list[float] = []
        self.resampled: list[bool] = []
        self.scores: list[ScoreLine] = []
        self.attempts: list[MatchAttempt] = []
        self.boundaries: list[Boundary] = []
        self.closed: Ints = np.full(n, -1, dtype=np.int64)
        self.seconds = {"score": 0.0, "match": 0.0, "segments": 0.0}  # wall time of parts not counted by the filter
        self.ahead: LookAheadScan | None = None

    # --- one step --------------------------------------------------------------------------------------------

    def grow(self) -> None:
        """Use the steps that were added."""
        steps, first = self.steps, len(self.turned)
        self.path_length = self.segmap.path_length = steps.path_length
        self.segmap.times = steps.times
        tangents = self.group.log(steps.odometry.increments[first:])
        turns = np.linalg.norm(tangents[:, [2]] if steps.dim == 2 else tangents[:, :3], axis=1)
        self.turned.extend(np.cumsum(np.append(self.turned[-1:], turns))[len(self.turned[-1:]) :].tolist())

    @property
    def boundary(self) -> bool:
        """Did segments end in the last step?"""
        return bool(self.boundaries) and self.boundaries[-1].step == self.at

    def step(self, k: int, *, last: bool) -> None:
        """Filter step k, and decide whether segments end there; ``last``: no step follows."""
        for _ in self.slices(k, last=last):
            pass

    def slices(self, k: int, *, last: bool) -> Iterator[None]:
        """:meth:`step` in slices of bounded work, so that a caller can look at its sensors in between."""
        work, spent = self._step(k, last), 0.0
        while True:
            begin = time.process_time()
            running = next(work, False) is None
            self.slice_seconds.append(time.process_time() - begin)
            spent += self.slice_seconds[-1]
            if not running:
                break
            yield
        self.step_seconds.append(spent)

    def _step(self, k: int, last: bool) -> Iterator[None]:
        f = self.filter
        f.predict(k)
        f.weigh(k)
        f.record(self.ids)
        self.effective.append(f.effective)
        ancestors = f.resample_if_needed(k)
        self.resampled.append(ancestors is not None)
        if ancestors is not None:
            self.segmap.resample(ancestors)
            self.ids = self.ids[ancestors]
            self.segmenters = [self.segmenters[a].copy() for a in ancestors]
        f.update(k)
        self.at = k
        if last:
            everybody = np.arange(len(f), dtype=np.int64)
            self.closed = self._close(k, everybody, "end-of-log")
        elif k:
            yield from self._decide(k)

    def _decide(self, k: int) -> Iterator[None]:
        now = float(self.steps.times[k])
        ends, why = self._ending(k, now)
        attempt = yield from self._match(k, now, ends)
        matched = np.array([e is not None for e in attempt.entries]) if attempt else np.zeros(len(ends), np.bool_)
        leaving = ends | matched
        if self.config.segmentation.decide == "filter" and leaving.any():
            leaving[:] = True
        if not leaving.any():
            return
        yield
        begin = time.perf_counter()
        chosen = np.flatnonzero(leaving).astype(np.int64)
        closed = self._close(k, chosen, why if ends.any() else "match")
        entries: list[SegmentEntry] = []
        for p, i in zip(chosen.tolist(), closed.tolist()):
            entry = attempt.entries[p] if attempt else None
            entries.append(entry if entry is not None else self._goes_on(p, i, bool(ends[p])))
        self._enter(k, chosen, entries)
        self.segmap.prune()
        self.matcher.forget()
        self.seconds["segments"] += time.perf_counter() - begin

    def _look(self, k: int) -> LookAheadScan:
        """The look-ahead window, gathered once per step for scores and matches."""
        if self.ahead is None or self.ahead.step != k:
            self.ahead = gather_look_ahead(self.steps, k, self.config.segmentation.window)
        return self.ahead

    # --- end of a segment ------------------------------------------------------------------------------------

    def _ending(self, k: int, now: float) -> tuple[npt.NDArray[np.bool_], str]:
        """Which particles' segments end here, and the reason of the first of them (A7, A8)."""
        f, c = self.filter, self.config.segmentation
        n = len(f)
        ends = np.zeros(n, dtype=np.bool_)
        due = [i for i in range(n) if self.segmenters[i].due(now)]
        if not due:
            return ends, ""
        together = c.decide == "filter"
        wants = any(self.segmenters[i].wants_score(now) for i in due)
        share, shares = np.nan, np.full(n, np.nan)
        if wants:
            begin = time.perf_counter()
            ahead, p = self._look(k), f.particles
            # a partial window at the end of the log is not comparable with full ones
            if ahead.full:
                rows, weights = representative_particles(p.weights, SCORE_PARTICLES if together else n)
                score = predictive_score(
                    [p.grids[i] for i in rows], p.poses[rows], ahead.window.thinned(SCORE_BEAMS),
                    self.steps.max_range, weights=weights, tolerance=c.tolerance,
                    threads=f.config.threads,
                )  # fmt: skip
                share, shares[rows] = score.share, score.shares
                self.scores.append(
                    ScoreLine(step=k, share=score.share, log_likelihood=score.log_likelihood, beams=score.beams)
                )
            self.seconds["score"] += time.perf_counter() - begin
        why = ""
        if together:
            decision = self._decision(0, k, now, share, f.particles.best)
            for s in self.segmenters[1:]:
                s.follow(self.segmenters[0])
            ends[:] = decision.ends
            why = decision.why if decision.ends else ""
        else:
            for i in due:
                decision = self._decision(i, k, now, float(shares[i]), i)
                ends[i] = decision.ends
                why = why or (decision.why if decision.ends else "")
        return ends, why

    def _decision(self, i: int, k: int, now: float, score: float, particle: int) -> SegmentDecision:
        again = score >= KNOWN_SCORE and self._been_here(k, particle)
        length, turned = float(self.path_length[k]), float(self.turned[k])
        return self.segmenters[i].decide(now, length, turned, score, again=again)

    def _been_here(self, k: int, particle: int) -> bool:
        """Was the path of the map of a particle here, long enough ago?"""
        f, segmap = self.filter, self.segmap
        entry, start, T = segmap.entries[particle], int(segmap.start[particle]), f.particles.poses[particle]
        assert entry is not None
        old = int(np.searchsorted(self.steps.times, self.steps.times[k] - KNOWN_GAP, side="right")) - 1
        own = f.ancestry.recent(k - start)[: max(old - start, 0), particle] if old > start else T[None][:0]
        paths, source = [own], -1 if entry.kind == NEW else entry.source
        while source >= 0:  # continue through the older segments of this map, in the same frame
            path, source = segmap.table.paths[source], int(segmap.table.source[source])
            if path is not None:
                paths.append(path)
        return any(bool(near_pose(path, T, KNOWN_RADIUS).any()) for path in paths)

    def _match(self, k: int, now: float, ends: npt.NDArray[np.bool_]) -> Generator[None, None, MatchAttempt | None]:
        """Try to enter older maps: at intervals, and whenever a segment ends."""
        c = self.config
        if not ends.any() and now - self.last_attempt < c.choice.every - 1e-6:
            return None
        if now - max(s.time for s in self.segmenters) < c.choice.every - 1e-6:
            return None  # the segment would be almost empty
        ahead = self._look(k)
        if not ahead.full:
            return None
        self.last_attempt = now
        attempt, spent = yield from timed_slices(
            self.matcher.attempt_in_slices(k, self.filter.particles.poses, ahead, self.seed.child("match", k))
        )
        self.seconds["match"] += spent
        if attempt.candidates:
            self.attempts.append(attempt)
        return attempt

    # --- boundaries ------------------------------------------------------------------------------------------

    def _close(self, k: int, chosen: Ints, why: str) -> Ints:
        f, segmap = self.filter, self.segmap
        first = int(segmap.start[chosen].min())
        recent = f.ancestry.recent(k - first)
        paths = []
        for p in chosen.tolist():
            entry = segmap.entries[p]
            assert entry is not None
            paths.append(np.concatenate([entry.T_entry[None], recent[int(segmap.start[p]) - first :, p]]))
        closed = segmap.close(k, [f.particles.grids[p] for p in chosen], paths, f.particles.weights, chosen.tolist())
        self.boundaries.append(Boundary(step=k, why=why, particles=len(chosen), segments=len(np.unique(closed))))
        return closed

    def _goes_on(self, p: int, segment: int, ended: bool) -> SegmentEntry:
        """Entry into a new map if the old one has ended; else with the current map."""
        pose = self.filter.particles.poses[p]
        if not ended:
            return SegmentEntry(T_entry=pose, kind=SAME, source=segment)
        if not self.segmap.gravity:
            return SegmentEntry(T_entry=self.group.identity, kind=NEW)
        T = self.group.between(remove_roll_pitch(pose), pose)
        T[2] += self.segmap.lift
        return SegmentEntry(T_entry=T, kind=NEW)

    def _enter(self, k: int, chosen: Ints, entries: Sequence[SegmentEntry]) -> None:
        p = self.filter.particles
        grids = self.segmap.open(k, entries, chosen.tolist())
        empty = p.grids[0].empty()
        known: dict[tuple[int, int], int] = {}
        for i, e, grid in zip(chosen.tolist(), entries, grids):
            p.grids[i] = empty.copy() if grid is None else grid
            p.poses[i] = e.T_entry
            if e.kind == NEW:
                p.ages[i] = 0
            elif e.kind == MATCH:
                p.ages[i] = max(int(p.ages[i]), self.filter.config.young)
            if e.kind != SAME:
                self.segmenters[i] = self._segmenter(k)
            key = (e.kind, e.source)
            if key not in known:
                known[key] = self.begun
                self.begun += 1
            self.ids[i] = known[key]

    def _segmenter(self, k: int) -> Segmenter:
        return Segmenter(
            self.config.segmentation, float(self.steps.times[k]), float(self.path_length[k]), float(self.turned[k])
        )

    def common(self) -> int:
        """The last closed segment from which all particles descend; -1 if there is none.

        It and those before it are in the result, whatever follows, if segments end for the whole filter.
        """
        t = self.segmap.table
        heads = np.unique(self.segmap.previous)
        while len(heads) > 1 and heads[0] >= 0:
            late = t.end[heads] == t.end[heads].max()
            heads = np.unique(np.append(heads[~late], t.previous[heads[late]]))
        return int(heads[0])

    def progress(self, steps: int) -> SegSlamProgress:
        """Progress after the last step, of this number of steps; 0: not known."""
        best, k = self.filter.particles.best, self.at
        last = int(self.closed[best]) if self.closed[best] >= 0 else int(self.segmap.previous[best])
        return SegSlamProgress(k + 1, steps, float(self.path_length[k]), self.segmap, last)

    # --- result ----------------------------------------------------------------------------------------------

    def result(self, steps: Steps) -> SegSlamResult:
        """Result of the run over all ``steps``; all segments are closed."""
        f = self.filter
        return SegSlamResult(
            steps=steps,
            segmap=self.segmap,
            closed=self.closed,
            weights=f.particles.weights,
            best=f.particles.best,
            effective=np.array(self.effective),
            resampled=np.array(self.resampled),
            ancestry=f.ancestry,
            scores=tuple(self.scores),
            attempts=tuple(self.attempts),
            boundaries=tuple(self.boundaries),
            winnowed=self.matcher.winnowed,
            tally=f.tally,
            seconds={**f.tally.seconds, **self.seconds},
            step_seconds=np.array(self.step_seconds),
            used_bytes=f.pool.used_bytes,
            seed=self.seed,
        )
