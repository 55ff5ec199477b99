"""One run of a world, from the SegMap to one graph: the effect of each step towards a consistent map.

Besides the metrics of the filters (``rbpf-N``; ``segslam-N``: the most likely map sample), graphs are built from the
settled segments. ``chain``: exits only; ``matches``: with the front end's matches to older maps; ``overlaps``: also
with constraints along the segments; ``loops``: also with loop closures searched between submaps; ``gps``: the same with
fixes; ``clearest``: of such graphs of the settled chain and of map samples, the one whose map has the least entropy.
Accepted loop closures are compared with ground truth.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter

import numpy as np

from graphslam.app.machine import one_blas_thread
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of, heading_of
from graphslam.core.random import SeedTree
from graphslam.core.records import Gps
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.graph.factor_graph import FactorGraph
from graphslam.loops.find_loops import FindConfig, find_loops
from graphslam.loops.loops import LoopCloser
from graphslam.loops.measure import Loop
from graphslam.maps.entropy import MapEntropy
from graphslam.solve.batch import BatchSolver
from graphslam.solve.solution import Solution
from graphslam_frontends.segslam.result import SegSlamResult
from graphslam_frontends.segslam.submaps import (
    common_ancestor_chain,
    drift_by_path,
    sampled_chain,
    segment_base,
    submaps_of_segments,
)
from graphslam_studies.evaluate import segslam_judge as judge
from graphslam_studies.montecarlo.trials import Measurement
from graphslam_studies.montecarlo.worlds_study import WorldsStudy
from graphslam_studies.segslam_trial import GridTrial, GridTrialConfig, Outcome

RIGHT_DISTANCE, RIGHT_ANGLE = 0.8, 0.1
"""Error limits of a right loop closure [m], [rad]: 3 σ of a good registration, half the width of a pillar."""


GRAPHS = ("chain", "matches", "overlaps", "loops", "gps", "clearest")


@dataclass(frozen=True, kw_only=True)
class FixConfig:
    """Simulated fixes of the graph ``gps``: true path with white noise, in their own frame."""

    period: float = 2.0
    """[s]"""
    sigma: float = 1.0
    """σ of every coordinate [m]."""
    lever: tuple[float, float, float] = (0.3, 0.0, 0.6)
    """Antenna in the base frame [m]."""
    heading: float = 0.7
    """Heading of the first base in the frame of the fixes [rad]."""
    start: tuple[float, float, float] = (250.0, -40.0, 12.0)
    """Position of the first antenna in that frame [m]."""


@dataclass(frozen=True, kw_only=True)
class GraphTrialConfig:
    """A world with its filters, and settings of the graph."""

    grid: GridTrialConfig
    """World, robot, steps, filters; each SegSLAM result becomes a graph."""
    spacing: float = 3.0
    """Distance between nodes [m]."""
    level_sigma: float = 0.006
    """σ of roll and pitch of a levelled base, as in the exits [rad]."""
    find: FindConfig = field(default_factory=lambda: FindConfig(front_end=True))
    """Search and selection of loop closures."""
    samples: int = 8
    """Number of map samples that become graphs besides the settled chain."""
    fixes: FixConfig = field(default_factory=FixConfig)


def run_graph_trial(config: GraphTrialConfig, seed: int) -> list[Measurement]:
    """All metrics of one run."""
    with one_blas_thread():
        return list(GraphTrial(config.grid, seed, graph=config).run())


@dataclass(frozen=True)
class BuiltGraph:
    """A graph, its solution, and its loop closer (None: no loops)."""

    graph: FactorGraph
    solution: Solution
    closer: LoopCloser | None
    seconds: float


@dataclass
class GraphTrial(GridTrial):
    """The filters of a run, and the graphs of the settled segments of SegSLAM."""

    graph: GraphTrialConfig = field(kw_only=True)

    def figures(self, name: str, outcome: Outcome) -> Iterator[Measurement]:
        """Metrics of an algorithm; for SegSLAM also those of its graphs."""
        yield from super().figures(name, outcome)
        result = outcome.result
        if not isinstance(result, SegSlamResult):
            return
        samples = [result.trajectory(k) for k in range(self.config.samples)]
        errors = [judge.path_errors(path, self.truth).aligned for path in samples]
        yield Measurement(name, "ate_best_sample", min(errors))
        yield Measurement(name, "ate_mean_sample", float(np.mean(errors)))
        submaps = self.submaps(result)
        made: dict[str, BuiltGraph] = {}
        for kind in GRAPHS:
            built = self.clearest(result, submaps, made["loops"]) if kind == "clearest" else self.build(submaps, kind)
            made[kind] = built
            yield from self.graph_figures(kind, result, built)
            yield Measurement(kind, "failed", 0.0)

    # ---------------------------------------------------------------- graphs

    def submaps(self, result: SegSlamResult) -> list[Submap]:
        """Submaps of the settled chain of the most likely particle, with maps."""
        segmap = result.segmap
        chain = common_ancestor_chain(segmap, int(result.closed[result.best]))
        return submaps_of_segments(segmap, chain, drift_by_path(segmap, chain, self.config.drift, result.steps))

    def build(self, submaps: Sequence[Submap], kind: str) -> BuiltGraph:
        """The graph of settled segments, one of :data:`GRAPHS`."""
        c, begin = self.graph, perf_counter()
        graph = FactorGraph(submaps[0].dim)
        for s in submaps:
            graph.add_submap(s, spacing=c.spacing, level_sigma=c.level_sigma if s.dim == 3 else None)
        solver = BatchSolver(graph)
        solver.solve_to_optimum()
        closer = None
        if kind == "gps":  # fixes are used before the search for loops
            graph.add_sensor(self.fixes(submaps[0].dim))
            graph.finish_sensors()
            solver.solve_to_optimum()
        if kind != "chain":
            few = replace(c.find, rounds=0, appearance=None)
            find = {"matches": replace(few, overlaps=None), "overlaps": few}.get(kind, c.find)
            closer = find_loops(graph, solver, submaps, find)
        return BuiltGraph(graph, solver.solution(), closer, perf_counter() - begin)

    def clearest(self, result: SegSlamResult, submaps: Sequence[Submap], loops: BuiltGraph) -> BuiltGraph:
        """The graph with the least entropy among those of the settled chain and of map samples, with all loops."""
        segmap = result.segmap
        found = [loops]
        chains = {tuple(int(s.report["segment"]) for s in submaps)}
        for number in range(self.graph.samples):
            chain = sampled_chain(segmap, result.sample(number))
            if tuple(chain.tolist()) not in chains:
                chains.add(tuple(chain.tolist()))
                found.append(
                    self.build(
                        submaps_of_segments(
                            segmap, chain, drift_by_path(segmap, chain, self.config.drift, result.steps)
                        ),
                        "loops",
                    )
                )
        seconds = sum(b.seconds for b in found)
        best = min(found, key=lambda b: self.clarity(b).entropy)
        return replace(best, seconds=seconds)

    def clarity(self, built: BuiltGraph) -> MapEntropy:
        """Entropy of the map of all scans along the path of a graph."""
        at = built.solution.trajectory().interpolate(self.steps.times)
        model = self.config.filter.beam_model()
        return judge.clarity(self.steps, at, voxel_size=0.2, model=model, count=self.config.placements)

    def fixes(self, dim: int) -> Gps:
        """Simulated fixes along the true path."""
        c, t = self.graph.fixes, self.steps.times
        times = np.arange(t[0] + c.period, t[-1], c.period)
        body = self._truth_at(times)
        lever, start = np.array(c.lever[:dim]), np.array(c.start[:dim])
        antenna = group_of(body).transform(body, np.broadcast_to(lever, (len(body), dim)))
        first = antenna[0].copy()
        cos, sin = np.cos(c.heading), np.sin(c.heading)
        z = antenna - first
        z[:, :2] = z[:, :2] @ np.array([[cos, sin], [-sin, cos]])
        noise = SeedTree(self.seed).child("fixes").generator().standard_normal(z.shape)
        return Gps(times=times, positions=start + z + c.sigma * noise, sigma=np.full(len(z), c.sigma), lever=lever)

    def graph_figures(self, kind: str, result: SegSlamResult, built: BuiltGraph) -> Iterator[Measurement]:
        """Errors and NEES of the full-rate path, entropy of the scans along it, correctness of loop closures."""
        path = built.solution.trajectory()
        e = judge.path_errors(path, self._truth_at(path.times))
        yield Measurement(kind, "final_error", e.final)
        yield Measurement(kind, "ate_anchored", e.anchored)
        yield Measurement(kind, "ate_aligned", e.aligned)
        yield Measurement(kind, "height_rmse", e.height)
        score = built.solution.score
        yield Measurement(kind, "chi2_per_dof", score.total / score.dof if score.dof else float("nan"))
        yield Measurement(kind, "nodes", len(built.solution.poses))
        yield Measurement(kind, "seconds_graph", built.seconds, timing=True)
        nees = self.node_nees(result, built)
        for block, values in nees.items():
            yield Measurement(kind, f"nees_{block}", float(values.mean()))
            yield Measurement(kind, f"nees_{block}_last", float(values[-1]))
        if "legs" in self.config.figures:
            yield Measurement(kind, "leg_angle", self.leg_angle(path.interpolate(self.steps.times)))
        if "entropy" in self.config.figures and kind in ("chain", "matches", "loops", "clearest"):
            found = self.clarity(built)
            yield Measurement(kind, "entropy_min", found.entropy)
            yield Measurement(kind, "known_volume", found.volume)
        if built.closer is not None:
            yield from self._decisions(kind, built.graph, built.closer)

    def node_nees(self, result: SegSlamResult, built: BuiltGraph) -> Mapping[str, Array]:
        """NEES per degree of freedom ``(m,)`` of the body poses at the nodes, with the covariance of the graph.

        Frame: the true first base, levelled and lowered as at the start of a map. ``pose``: position and heading;
        ``level``: roll and pitch.
        """
        path = built.solution.trajectory()
        node_times = np.unique(np.concatenate([np.asarray(s.times) for s in built.graph.submaps]))[1:]
        rows = np.clip(np.searchsorted(path.times, node_times), 0, len(path.times) - 1)
        g, truth = group_of(path.poses), self._truth_at(path.times[rows])
        base = segment_base(result.segmap, self.truth[0])
        true = g.between(np.broadcast_to(base, truth.shape), truth)
        e = g.log(g.between(path.poses[rows], true))
        assert path.covariances is not None
        P = path.covariances[rows]
        place = list(range(g.dof))[g.position]
        blocks = {"position": place, "heading": [g.heading], "pose": sorted([g.heading, *place])}
        if g.dim == 3:
            blocks["level"] = [0, 1]
        out = {}
        for name, k in blocks.items():
            S = P[:, k][:, :, k]
            out[name] = np.einsum("ni,ni->n", e[:, k], np.linalg.solve(S, e[:, k, None])[..., 0]) / len(k)
        return out

    def _decisions(self, kind: str, graph: FactorGraph, closer: LoopCloser) -> Iterator[Measurement]:
        times = np.zeros(len(graph.values.poses))
        for s in graph.submaps:
            times[list(s.nodes)] = s.times
        truth = self._truth_at(times)
        accepted = set(closer.accepted)
        measured = {n: x for n, x in closer.loops.items() if not x.why}
        right = {n for n, x in measured.items() if is_right(x, truth)}
        yield Measurement(kind, "loops_tried", len(closer.loops))
        yield Measurement(kind, "loops_measured", len(measured))
        yield Measurement(kind, "loops_measured_right", len(right))
        yield Measurement(kind, "loops_taken", len(accepted))
        yield Measurement(kind, "loops_taken_right", len(accepted & right))

    def _truth_at(self, times: Array) -> Array:
        truth = Trajectory(self.steps.times, self.truth)
        return truth.interpolate(np.clip(times, self.steps.times[0], self.steps.times[-1]))


def is_right(loop: Loop, truth: Array) -> bool:
    """Whether the relative pose of a loop is right, given true body poses ``(n, 7|3)``; roll and pitch are ignored."""
    g = group_of(truth)
    error = g.between(g.between(truth[loop.i], truth[loop.j]), loop.T_ij)
    turned = abs(float(heading_of(error)))
    return bool(np.linalg.norm(error[: g.dim]) < RIGHT_DISTANCE and turned < RIGHT_ANGLE)


class GraphStudy(WorldsStudy[GraphTrialConfig]):
    """Base of studies of graphs."""

    run_one = staticmethod(run_graph_trial)
