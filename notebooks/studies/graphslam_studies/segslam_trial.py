"""One run of a world for grid front ends: the log, its steps, every algorithm on them, and all metrics.

Algorithms are ``dead-reckoning``, ``rbpf-N`` and ``segslam-N`` with N particles. All use the same steps; the two
filters have their own settings (:class:`GridTrialConfig`).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from time import perf_counter, process_time
from typing import Literal

import numpy as np
import numpy.typing as npt

from graphslam.app.machine import one_blas_thread
from graphslam.app.worlds import mesh_world
from graphslam.core.errors import ConfigError, GraphSlamError
from graphslam.core.geometry import Array
from graphslam.core.poses import heading_of
from graphslam.core.random import SeedTree
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.refined import heading_error
from graphslam.evaluate.trajectory_error import ate
from graphslam.sim.crawler import simulate_crawler
from graphslam.sim.crawler_config import CrawlerConfig
from graphslam.sim.ring_hall import ring_hall
from graphslam.sim.world import DRAWN, World
from graphslam_frontends.grid.config import GridFilterConfig
from graphslam_frontends.grid.filter_error_model import PASSED, FilterDrift
from graphslam_frontends.odometry.make_steps import make_steps
from graphslam_frontends.odometry.step_config import StepConfig
from graphslam_frontends.odometry.steps import Steps
from graphslam_frontends.segslam.config import (
    CandidateSearch,
    ChoiceConfig,
    SegmentationConfig,
    SegmentCandidateConfig,
    SegSlamConfig,
)
from graphslam_frontends.segslam.result import SegSlamResult
from graphslam_frontends.segslam.segslam import run_segslam
from graphslam_studies.evaluate import segslam_judge as judge
from graphslam_studies.frontends.drift import DriftModel
from graphslam_studies.frontends.rbpf_grid import RbpfResult, rbpf_submap, run_rbpf
from graphslam_studies.montecarlo.trials import Measurement
from graphslam_studies.montecarlo.worlds_study import WorldsStudy

Figure = Literal["matches", "exits", "entropy", "loops", "legs", "path", "climbs"]
DEAD_RECKONING = "dead-reckoning"
PATH_POINTS = 100
"""Number of path points that are stored for the plot."""


def family_of(algorithm: str) -> tuple[str, int]:
    """``rbpf`` or ``segslam``, and the number of particles; ``dead-reckoning`` and 0."""
    if algorithm == DEAD_RECKONING:
        return algorithm, 0
    found = re.fullmatch(r"(rbpf|segslam)-([1-9]\d*)", algorithm)
    if not found:
        raise ConfigError(f"unknown algorithm {algorithm!r}; known: {DEAD_RECKONING}, rbpf-N, segslam-N")
    return found[1], int(found[2])


def drawn_algorithm(names: Iterable[str]) -> str | None:
    """Algorithm whose path is stored for the plot: last SegSLAM with ≤ 20 particles, else last SegSLAM, or None."""
    found = [a for a in names if family_of(a)[0] == "segslam"]
    found = [a for a in found if family_of(a)[1] <= 20] or found
    return found[-1] if found else None


@dataclass(frozen=True, kw_only=True)
class GridTrialConfig:
    """A world, the algorithms compared in it, and the metrics."""

    world: str
    """``garage``, ``mine``, ``building``, or the small ``court``."""
    layout: str | None = None
    """Layout of the world; ``drawn``: random in each run."""
    algorithms: tuple[str, ...] = (DEAD_RECKONING,)
    """Algorithms in run order."""
    figures: tuple[Figure, ...] = ()
    """Metrics besides path errors and times."""
    samples: int = 1
    """Maximum number of map samples, or particles, whose entropy is computed."""
    placements: int = 1
    """Number of grid placements per entropy (see :func:`~graphslam_studies.evaluate.segslam_judge.clarity`)."""
    crawler: CrawlerConfig = field(default_factory=CrawlerConfig)
    """Settings of the robot."""
    speed: float = 1.0
    """Factor on the speed of the robot in the world."""
    steps: StepConfig = field(default_factory=lambda: StepConfig(max_range=25.0))
    """Conversion of its log to steps."""
    filter: GridFilterConfig = field(default_factory=GridFilterConfig)
    """Filter of the RBPF; the number of particles is that of the algorithm."""
    segslam_filter: GridFilterConfig = field(default_factory=lambda: GridFilterConfig(walk_scale=0.5))
    """Filter of SegSLAM; each family has its own tuned noise."""
    segslam: SegSlamConfig = field(default_factory=SegSlamConfig)
    """Further settings of SegSLAM."""
    drift: FilterDrift = field(default_factory=FilterDrift)
    """Drift in the exit covariance of SegSLAM."""
    rbpf_drift: DriftModel = field(default_factory=DriftModel)
    """Drift in the end-pose covariance of an RBPF."""

    def __post_init__(self) -> None:
        for name in self.algorithms:
            family_of(name)
        if len(set(self.algorithms)) != len(self.algorithms) or min(self.samples, self.placements) < 1:
            raise ConfigError("trial of grids: an algorithm is repeated, or no sample or placement is wanted")

    def make_world(self, seed: int) -> World:
        """World of a seed; the seed determines its random parts."""
        layout = self.layout
        if layout == "drawn":
            layout = f"{DRAWN}{1 + int(SeedTree(seed).child('layout').generator().integers(10**9))}"
        made = ring_hall(seed=seed) if self.world == "court" else mesh_world(self.world, layout=layout, seed=seed)
        return replace(made, speed=self.speed * made.speed)


def run_trial(config: GridTrialConfig, seed: int) -> list[Measurement]:
    """All metrics of one run."""
    with one_blas_thread():
        return list(GridTrial(config, seed).run())


@dataclass(frozen=True)
class Outcome:
    """Result of an algorithm."""

    path: Trajectory
    final_pose: Array
    seconds: dict[str, float]
    result: SegSlamResult | RbpfResult | None = None


@dataclass
class GridTrial:
    """Steps of one run, and all algorithms on them."""

    config: GridTrialConfig
    seed: int
    world: World = field(init=False)
    steps: Steps = field(init=False)
    truth: Array = field(init=False)
    """True poses at the steps ``(n, 7)``."""
    arc: Array = field(init=False)
    """Arc length of the true path at the steps ``(n,)`` [m]."""
    seconds_steps: float = field(init=False)

    def __post_init__(self) -> None:
        self.world = self.config.make_world(self.seed)
        log = simulate_crawler(self.world, self.seed, self.config.crawler)
        begin = perf_counter()
        self.steps = make_steps(log, self.config.steps)
        self.seconds_steps = perf_counter() - begin
        assert self.steps.truth is not None
        self.truth = self.steps.truth.interpolate(self.steps.times)
        self.arc = judge.steps_of_path(self.steps.truth, self.steps.times, self.world.route().length)

    def run(self) -> Iterator[Measurement]:
        """Metrics of every algorithm; if one fails with an error, only ``failed`` = 1."""
        yield Measurement("all", "seconds_steps", self.seconds_steps, timing=True)
        yield Measurement("all", "seconds_recorded", float(self.steps.times[-1] - self.steps.times[0]))
        yield Measurement("all", "path_length", float(self.steps.path_length[-1]))
        for name in self.config.algorithms:
            try:
                rows = list(self.figures(name, self.outcome(name)))
            except GraphSlamError:
                rows = [Measurement(name, "failed", 1.0)]
            else:
                rows.append(Measurement(name, "failed", 0.0))
            yield from rows

    # ---------------------------------------------------------------- algorithms

    def outcome(self, name: str) -> Outcome:
        """Run one algorithm on the steps. The filter seed depends on the run and the family only."""
        family, particles = family_of(name)
        if family == DEAD_RECKONING:
            path = judge.dead_reckoned(self.steps)
            return Outcome(path, path.poses[-1], {})
        settings = self.config.filter if family == "rbpf" else self.config.segslam_filter
        filter = replace(settings, particles=particles)
        seed = SeedTree(self.seed).child("filter", family)
        begin, spent = perf_counter(), process_time()
        if family == "rbpf":
            rbpf = run_rbpf(self.steps, filter, seed)
            whole = {"total": perf_counter() - begin, "cpu": process_time() - spent}
            return Outcome(rbpf.trajectory(), rbpf.final_pose, {**rbpf.tally.seconds, **whole}, rbpf)
        segslam = run_segslam(self.steps, filter, self.config.segslam, seed)
        whole = {"total": perf_counter() - begin, "cpu": process_time() - spent}
        seconds = {**segslam.seconds, **whole}
        seconds["step_first_quarter"], seconds["step_last_quarter"] = judge.quarters(segslam.step_seconds)
        return Outcome(segslam.trajectory(), segslam.final_pose, seconds, segslam)

    # ---------------------------------------------------------------- metrics

    def figures(self, name: str, outcome: Outcome) -> Iterator[Measurement]:
        """All metrics of one algorithm."""
        wanted, result = self.config.figures, outcome.result
        e = judge.path_errors(outcome.path, self.truth, outcome.final_pose)
        yield Measurement(name, "final_error", e.final)
        yield Measurement(name, "final_yaw", e.final_yaw)
        yield Measurement(name, "ate_anchored", e.anchored)
        yield Measurement(name, "ate_aligned", e.aligned)
        yield Measurement(name, "height_rmse", e.height)
        for part, seconds in outcome.seconds.items():
            yield Measurement(name, f"seconds_{part}", seconds, timing=True)
        if result is not None:
            effective = result.effective / result.report()["particles"]
            yield Measurement(name, "effective_median", float(np.median(effective)))
            yield Measurement(name, "maps_megabytes", result.used_bytes / 1e6)
            alternatives = survivors = float(result.ancestry.survivors().mean())
            if isinstance(result, SegSlamResult):
                t, alive = result.segmap.table, result.segmap.alive
                alternatives = float(np.sum(t.end[alive] - t.start[alive])) / len(self.steps)
            yield Measurement(name, "survivors", survivors)
            yield Measurement(name, "alternatives", alternatives)
        if "legs" in wanted:
            yield Measurement(name, "leg_angle", self.leg_angle(outcome.path.poses))
        if "climbs" in wanted:
            yield from self._climbs(name, outcome.path)
        if "entropy" in wanted:
            yield from self._entropy(name, outcome)
        if "loops" in wanted:
            yield from self._loops(name, outcome)
        if "path" in wanted and name == drawn_algorithm(self.config.algorithms):
            yield from self._path(name, outcome)
        if isinstance(result, SegSlamResult):
            yield Measurement(name, "segments", len(result.segmap))
            yield Measurement(name, "intervals", len(result.segmap.intervals()))
            if "matches" in wanted:
                yield from self._matches(name, result)
            if "exits" in wanted:
                yield from self._exits(name, result)
        elif isinstance(result, RbpfResult) and "exits" in wanted:
            yield from self._end(name, result)

    def leg_angle(self, poses: Array) -> float:
        """Error of the angles between straight path sections on different levels, for poses at the steps [rad]."""
        pieces = judge.legs(self.world.route(), self.arc, 10.0 if self.config.world != "court" else 4.0)
        return judge.leg_angle_error(poses, self.truth, pieces)

    def _matches(self, name: str, result: SegSlamResult) -> Iterator[Measurement]:
        m = judge.match_errors(result.segmap, self.truth)
        yield Measurement(name, "matches", len(m.segments))
        yield Measurement(name, "false_matches", int(m.false.sum()))
        yield Measurement(name, "false_match_weight", float(m.weights[m.false].max(initial=0.0)))
        if len(m.offsets):
            yield Measurement(name, "match_offset_median", float(np.median(m.offsets)))
            yield Measurement(name, "match_offset_max", float(m.offsets.max()))
        pairs = self.world.meta["parallel"]
        if pairs:
            yield Measurement(name, "merged_parallels", judge.merged_stretches(m, self.arc, pairs))

    def _exits(self, name: str, result: SegSlamResult) -> Iterator[Measurement]:
        e = judge.exit_errors(result, self.truth, self.config.drift)
        for k, length in enumerate(e.lengths):
            yield Measurement(name, "exit_length", float(length), k)
            yield Measurement(name, "exit_nees", float(e.default.values[k]), k)
            yield Measurement(name, "exit_nees_matched", float(e.matched.values[k]), k)
            yield Measurement(name, "exit_nees_stated", float(e.stated.values[k]), k)
            for axis, error in zip(("yaw", "x", "y", "z"), e.default.errors[k]):
                yield Measurement(name, f"exit_{axis}", float(error), k)
            for block, of in e.blocks.items():
                yield Measurement(name, f"exit_nees_{block}", float(of.values[k]) / of.dof, k)
        yield Measurement(name, "exit_dof", e.default.dof)

    def _end(self, name: str, result: RbpfResult) -> Iterator[Measurement]:
        """Metrics of the end pose of a filter over the whole path."""
        c = self.config
        submap = rbpf_submap(result, c.rbpf_drift, steps=self.steps, passed=PASSED)
        e = judge.end_errors(submap, self.truth)
        yield Measurement(name, "exit_length", float(result.path_length[-1]), 0)
        yield Measurement(name, "exit_nees", float(e[""].values[0]), 0)
        for block in ("heading", "plan", "height"):
            yield Measurement(name, f"exit_nees_{block}", float(e[block].values[0]) / e[block].dof, 0)
        yield Measurement(name, "exit_dof", e[""].dof)

    def _climbs(self, name: str, path: Trajectory) -> Iterator[Measurement]:
        """Mean errors of the climb of ramps, separately up and down; errors in height, in the plane and in heading."""
        found = judge.climbs(path.poses, self.truth)
        for direction, of in (("up", found.true > 0), ("down", found.true < 0)):
            if of.any():
                yield Measurement(name, f"climb_{direction}", float(found.error[of].mean()))
                yield Measurement(name, f"climb_{direction}_size", float(np.abs(found.error[of]).mean()))
        est, true = (judge.relative(poses) for poses in (path.poses, self.truth))
        yield Measurement(name, "height_std", float(np.std(est[:, 2] - true[:, 2])))
        flat = [Trajectory(path.times, np.column_stack([p[:, :2], heading_of(p)])) for p in (est, true)]
        yield Measurement(name, "ate_plan", ate(flat[0], flat[1], alignment="se").statistics.rmse)
        yield Measurement(name, "heading_rms", heading_error(path, Trajectory(path.times, self.truth)))

    def _entropy(self, name: str, outcome: Outcome) -> Iterator[Measurement]:
        """Entropy of the map of all scans along map samples, or along particles' paths, the best particle first."""
        found = []
        for poses in self._hypotheses(outcome):
            model = self.config.filter.beam_model()
            found.append(judge.clarity(self.steps, poses, voxel_size=0.2, model=model, count=self.config.placements))
        best = min(found, key=lambda c: c.entropy)
        yield Measurement(name, "entropy", found[0].entropy)
        yield Measurement(name, "entropy_min", best.entropy)
        yield Measurement(name, "known_volume", best.volume)
        yield Measurement(name, "entropy_samples", len(found))

    def _hypotheses(self, outcome: Outcome) -> Iterator[Array]:
        result, most = outcome.result, self.config.samples
        if isinstance(result, SegSlamResult):
            for number in range(most):
                yield result.trajectory(number).poses
        elif isinstance(result, RbpfResult):
            paths = np.swapaxes(result.ancestry.paths(), 0, 1)
            order = [result.best, *(k for k in range(len(paths)) if k != result.best)]
            for k in judge.distinct(paths[order], most):
                yield paths[order[k]]
        else:
            yield outcome.path.poses

    def _loops(self, name: str, outcome: Outcome) -> Iterator[Measurement]:
        """Errors between first and second visit of a place; a loop is closed if the error is small."""
        closed, wanted = [], []
        for k, r in enumerate(self.world.meta["revisits"]):
            first, again = (judge.nearest(self.arc, float(r[which][1])) for which in ("first", "again"))
            path = outcome.path
            if isinstance(outcome.result, SegSlamResult):
                path = judge.path_at(outcome.result, again)
            error = judge.visit_error(path.poses, self.truth, first, again)
            yield Measurement(name, "visit_error", error, k)
            if r["same_heading"]:
                closed.append(error <= judge.CLOSED_DISTANCE)
                wanted.append((first, again))
        yield Measurement(name, "loops", len(closed))
        yield Measurement(name, "loops_closed", int(np.sum(closed)))
        yield Measurement(name, "all_closed", float(all(closed)))
        if pairs := self.world.meta["parallel"]:
            count = judge.overlapping_stretches(outcome.path.poses, self.truth, self.arc, pairs)
            yield Measurement(name, "overlapping_parallels", count)
            yield Measurement(name, "parallels", len(pairs))
        if isinstance(outcome.result, RbpfResult):
            yield from self._every_particle(name, outcome.result, wanted)

    def _every_particle(self, name: str, result: RbpfResult, loops: list[tuple[int, int]]) -> Iterator[Measurement]:
        """The same of the maps of all particles: the fewest, the most; and the share of the path common to all."""
        paths = np.swapaxes(result.ancestry.paths(), 0, 1)
        paths = paths[judge.distinct(paths, len(paths))]
        error = np.array([[judge.visit_error(p, self.truth, *at) for at in loops] for p in paths])
        overlapping = [judge.overlapping_stretches(p, self.truth, self.arc, self.world.meta["parallel"]) for p in paths]
        closed = np.sum(error <= judge.CLOSED_DISTANCE, axis=1)
        yield Measurement(name, "particle_paths", len(paths))
        yield Measurement(name, "common_path", (result.ancestry.coalescence() + 1) / len(result.times))
        for quantity, values in (("loops_closed", closed), ("overlapping_parallels", overlapping)):
            yield Measurement(name, f"{quantity}_fewest", int(np.min(values)))
            yield Measurement(name, f"{quantity}_most", int(np.max(values)))
        for k in range(len(loops)):
            yield Measurement(name, "particle_visit_error_least", float(error[:, k].min()), k)
            yield Measurement(name, "particle_visit_error_greatest", float(error[:, k].max()), k)

    def _path(self, name: str, outcome: Outcome) -> Iterator[Measurement]:
        """Path points x, y with the number of their segment; and the true ones."""
        at = np.unique(np.linspace(0, len(self.steps) - 1, PATH_POINTS).astype(np.int64))
        segment: npt.NDArray[np.int64] = np.zeros(len(at), dtype=np.int64)
        if isinstance(outcome.result, SegSlamResult):
            starts = np.unique(outcome.result.segmap.intervals()[:, 0])
            segment = np.searchsorted(starts, at, side="right") - 1
        est = judge.relative(outcome.path.poses)[at]
        true = judge.relative(self.truth)[at]
        for k in range(len(at)):
            for axis, row in (("x", est[k, 0]), ("y", est[k, 1]), ("true_x", true[k, 0]), ("true_y", true[k, 1])):
                yield Measurement(name, f"path_{axis}", float(row), k)
            yield Measurement(name, "path_segment", float(segment[k]), k)


class GridStudy(WorldsStudy[GridTrialConfig]):
    """A study of grid front ends."""

    run_one = staticmethod(run_trial)


LEVEL = StepConfig(max_range=25.0, level_floors=True)
"""For garages and buildings: floors are level on average, so the median tilt shows the constant gravity error."""
QUICK = GridTrialConfig(
    world="court",
    crawler=CrawlerConfig(drift=0.08, max_range=8.0),
    steps=StepConfig(max_range=8.0, most_points=240),
    filter=GridFilterConfig(weight_beams=120),
    segslam_filter=GridFilterConfig(weight_beams=120, walk_scale=0.5),
    segslam=SegSlamConfig(
        segmentation=SegmentationConfig(window=2.0, min_seconds=6.0, min_length=5.0, max_length=14.0, excluded=3.0),
        winnowing=SegmentCandidateConfig(gap=15.0),
        search=CandidateSearch(source_radius=8.0),
        choice=ChoiceConfig(every=2.0),
    ),
)
"""The small world: segments of a few metres, and a loop of 37 m."""
