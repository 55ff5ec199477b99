"""One run of refinement by scans: the path of the graph, the refined path, and refinements from wrong starts.

Besides the metrics of SegSLAM: ``loops``: initial graph; ``refined``; ``wrong-N``: refinement started from the graph
with N wrong loop closures between distant places, each with a small covariance; ``mount``: scanner rotated by 1°;
``clock``: motion stamps late by 50 ms; ``moving``: 10 % of the returns from moving people.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter, process_time
from typing import Any

import numpy as np

from graphslam.app.machine import one_blas_thread
from graphslam.core.geometry import Array
from graphslam.core.poses import SE3, group_of
from graphslam.core.random import SeedTree
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.refined import heading_error
from graphslam.graph.factor_graph import FactorGraph
from graphslam.refine.config import RefineConfig
from graphslam.refine.refine import refine_by_scans
from graphslam.refine.result import Refinement
from graphslam.refine.scans import Scans
from graphslam.sim.crawler import simulate_crawler
from graphslam.sim.crawler_config import crawler_preset
from graphslam.solve.batch import BatchSolver
from graphslam_frontends.odometry.make_steps import make_steps
from graphslam_frontends.segslam.result import SegSlamResult
from graphslam_frontends.segslam.submaps import segment_base
from graphslam_studies.evaluate import segslam_judge as judge
from graphslam_studies.montecarlo.trials import Measurement
from graphslam_studies.segmap_trial import GraphTrial, GraphTrialConfig
from graphslam_studies.segslam_trial import GridTrialConfig, Outcome

ROBOTS = {
    "range_sigma": (0.01, 0.05),
    "wheel_sigma": (0.01, 0.06),
    "wheel_scale": (0.002, 0.015),
    "gyro": (5e-5, 5e-4),
    "gyro_walk": (1e-6, 1e-5),
    "attitude_sigma": (0.002, 0.009),
    "drift": (0.01, 0.05),
}
"""Ranges of the parameters of a random robot; log-uniform."""
FAULTS = ("mount", "clock", "moving")
WRONG_SIGMA = (0.005, 0.005, 0.005, 0.02, 0.02, 0.02)
"""σ of a wrong loop closure in the graph [rad], [m]."""
UNSCORED = 10
"""Number of first steps that are not scored, because the anchored path has almost no error there."""
APART = 30.0
"""Time between poses whose relative error is scored [s]."""


@dataclass(frozen=True, kw_only=True)
class RefinementTrialConfig:
    """A world, and the variants of its refinement."""

    graph: GraphTrialConfig
    """World, and settings of its graph."""
    drawn: bool = False
    """Random robot and layout of the garage."""
    wrong: tuple[int, ...] = ()
    """Numbers of wrong loop closures."""
    faults: tuple[str, ...] = ()
    """Faults to test, of :data:`FAULTS`."""
    refine: RefineConfig = field(default_factory=RefineConfig)


def run_refinement_trial(config: RefinementTrialConfig, seed: int) -> list[Measurement]:
    """All metrics of one run."""
    with one_blas_thread():
        grid = config.graph.grid
        if config.drawn:
            grid = drawn_garage(grid, seed)
        return list(RefinementTrial(grid, seed, graph=replace(config.graph, grid=grid), study=config).run())


def drawn_garage(config: GridTrialConfig, seed: int) -> GridTrialConfig:
    """The config with a random robot and layout."""
    rng = SeedTree(seed).child("robot").generator()
    found = {k: float(np.exp(rng.uniform(np.log(a), np.log(b)))) for k, (a, b) in ROBOTS.items()}
    return replace(config, crawler=crawler_preset("light", **found), layout=str(rng.choice(list("ABCD"))))


@dataclass
class RefinementTrial(GraphTrial):
    """SegSLAM of a run, its graph, and refinements."""

    study: RefinementTrialConfig = field(kw_only=True)

    def figures(self, name: str, outcome: Outcome) -> Iterator[Measurement]:
        """Metrics of SegSLAM, of its graph, and of the refinements."""
        yield from super(GraphTrial, self).figures(name, outcome)
        result = outcome.result
        if not isinstance(result, SegSlamResult):
            return
        submaps = self.submaps(result)
        built = self.build(submaps, "loops")
        yield from self.graph_figures("loops", result, built)
        yield Measurement("loops", "failed", 0.0)
        start = built.solution.trajectory().interpolate(self.steps.times)
        base = segment_base(result.segmap, self.truth[0])
        scans = Scans.of(self.steps)
        yield from self.refined("refined", scans, start, base, entropy="entropy" in self.config.figures)
        for count in self.study.wrong:
            bent = self.bent(submaps, count)
            yield from self.refined(f"wrong-{count}", scans, bent, base)
        for fault in self.study.faults:
            yield from self.refined(fault, self.faulty(fault, scans), start, base)

    def refined(
        self, kind: str, scans: Scans, start: Array, base: Array, *, entropy: bool = False
    ) -> Iterator[Measurement]:
        """Metrics of a refinement from an initial path."""
        true = self.true_at(scans.times, base)
        start = Trajectory(self.steps.times, start).interpolate(
            np.clip(scans.times, self.steps.times[0], self.steps.times[-1])
        )
        wall, cpu = perf_counter(), process_time()
        found = refine_by_scans(scans, start, self.study.refine)
        yield Measurement(kind, "seconds_refine", perf_counter() - wall, timing=True)
        yield Measurement(kind, "cpu_share", (process_time() - cpu) / float(scans.times[-1]), timing=True)
        before = judge.path_errors(Trajectory(scans.times, start), true)
        e = judge.path_errors(Trajectory(scans.times, found.poses), true)
        yield Measurement(kind, "ate_start", before.aligned)
        yield Measurement(kind, "ate_aligned", e.aligned)
        yield Measurement(kind, "ate_anchored", e.anchored)
        yield Measurement(kind, "final_error", e.final)
        yield Measurement(kind, "height_rmse", e.height)
        path, truth = Trajectory(scans.times, found.poses), Trajectory(scans.times, true)
        yield Measurement(kind, "heading_rms", heading_error(path, truth))
        yield Measurement(kind, "rounds", len(found.rounds))
        yield Measurement(kind, "agreement", found.agreement[1])
        yield Measurement(kind, "agreement_start", found.agreement[0])
        yield Measurement(kind, "left_apart", len(found.refused))
        yield Measurement(kind, "odometry_widened", float(found.scales.max()))
        yield Measurement(kind, "worse", float(found.better and e.aligned > before.aligned))
        for name, value in nees_of(found, true).items():
            yield Measurement(kind, name, value)
        if "legs" in self.config.figures and len(scans) == len(self.steps):
            yield Measurement(kind, "leg_angle", self.leg_angle(found.poses))
        if entropy:
            clear = judge.clarity(
                self.steps,
                found.poses,
                voxel_size=0.2,
                model=self.config.filter.beam_model(),
                count=self.config.placements,
            )
            yield Measurement(kind, "entropy_min", clear.entropy)
            yield Measurement(kind, "known_volume", clear.volume)
        yield Measurement(kind, "failed", 0.0)

    def true_at(self, times: Array, base: Array) -> Array:
        """True poses in the level frame of the map ``(n, 7)``."""
        truth = self._truth_at(times)
        return SE3.between(np.broadcast_to(base, truth.shape), truth)

    def bent(self, submaps: Sequence[Submap], count: int) -> Array:
        """Path of the graph with wrong loop closures between places 8 to 40 m and more than 30 s apart."""
        c = self.graph
        graph = FactorGraph(3)
        for s in submaps:
            graph.add_submap(s, spacing=c.spacing, level_sigma=c.level_sigma)
        solver = BatchSolver(graph)
        solver.solve_to_optimum()
        rng = SeedTree(self.seed).child("wrong", str(count)).generator()
        poses = graph.values.poses
        times = np.zeros(len(poses))
        for g in graph.submaps:
            times[list(g.nodes)] = g.times
        far = np.linalg.norm(poses[:, None, :3] - poses[None, :, :3], axis=2)
        level = np.abs(poses[:, None, 2] - poses[None, :, 2]) < 1.0
        i, j = np.nonzero((far > 8.0) & (far < 40.0) & level & (times[None] - times[:, None] > 30.0))
        for k in rng.choice(len(i), min(count, len(i)), replace=False).tolist():
            turn = np.zeros(6)
            turn[2] = rng.choice([0.0, np.pi])
            T = SE3.compose(SE3.exp(turn), SE3.exp(rng.standard_normal(6) * [0, 0, 0.1, 0.5, 0.5, 0.05]))
            graph.add_between(
                int(i[k]), int(j[k]), T, np.diag(np.square(WRONG_SIGMA)), evidence="shared-scan", group="match"
            )
        solver = BatchSolver(graph)
        solver.solve_to_optimum()
        return solver.solution().trajectory().interpolate(self.steps.times)

    def faulty(self, fault: str, scans: Scans) -> Scans:
        """Scans with one of :data:`FAULTS`."""
        if fault == "mount":
            a = np.deg2rad(1.0)
            R = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
            turned = (np.asarray(x @ R.T, np.float32) for x in (scans.points, scans.origins))
            return replace(scans, points=next(turned), origins=next(turned))
        if fault == "clock":
            log = simulate_crawler(self.world, self.seed, self.config.crawler)
            late: dict[str, Any] = {k: log.streams[k] for k in ("imu", "wheels")}
            late = {k: replace(s, times=s.times + 0.05) for k, s in late.items()}
            return Scans.of(make_steps(replace(log, streams={**log.streams, **late}), self.config.steps))
        rng = SeedTree(self.seed).child("moving").generator()
        points = scans.points.copy()
        t = scans.times[np.repeat(np.arange(len(scans)), np.diff(scans.offsets))]
        rows = np.flatnonzero(scans.returns)
        rows = rows[rng.random(len(rows)) < 0.1]
        who = rng.integers(0, 5, len(rows))  # five people walk around the robot at 1 m/s, on circles of 2 to 6 m
        angle = t[rows] / (2.0 + who) * (1 - 2 * (who % 2)) + 1.3 * who
        skin = rng.uniform(0, 2 * np.pi, len(rows))
        points[rows, 0] = (2.0 + who) * np.cos(angle) + 0.25 * np.cos(skin)
        points[rows, 1] = (2.0 + who) * np.sin(angle) + 0.25 * np.sin(skin)
        points[rows, 2] = rng.uniform(0.0, 1.8, len(rows))
        return replace(scans, points=points)


def nees_of(found: Refinement, true: Array) -> dict[str, float]:
    """NEES per degree of freedom, mean over the steps: anchored, by block, and relative over 30 s."""
    g = group_of(found.poses)
    e = g.log(g.between(found.poses, true))[UNSCORED:]
    C = found.covariances[UNSCORED:]
    blocks = {"nees": slice(0, 6), "nees_level": slice(0, 2), "nees_heading": slice(2, 3), "nees_plan": slice(3, 5)}
    blocks["nees_height"] = slice(5, 6)
    out = {}
    for name, block in blocks.items():
        S = C[:, block, block]
        x = np.einsum("ki,ki->k", e[:, block], np.linalg.solve(S, e[:, block, None])[..., 0])
        out[name] = float(np.mean(x)) / S.shape[1]
    ends = np.searchsorted(found.times, np.arange(found.times[0], found.times[-1] - APART, APART))
    later = np.clip(np.searchsorted(found.times, found.times[ends] + APART), 0, len(true) - 1)
    relative = []
    for a, b in zip(ends.tolist(), later.tolist()):
        if a == b:
            continue
        P = found.joint([a, b])
        step = g.between(found.poses[a], found.poses[b])
        J = np.concatenate([-g.adjoint(g.inverse(step)), np.eye(6)], axis=1)
        d = g.log(g.between(step, g.between(true[a], true[b])))
        relative.append(float(d @ np.linalg.solve(J @ P @ J.T, d)) / 6.0)
    out["nees_relative"] = float(np.mean(relative))
    return out
