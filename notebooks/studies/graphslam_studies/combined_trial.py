"""One run of the Combined SLAM study: every algorithm on exactly the same simulated data.

The log is simulated once. All front ends cut it at the same scans, and all map-joining methods get the same submaps.
Data association is known, as in the paper.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from graphslam.app.machine import one_blas_thread
from graphslam.app.run.front_ends import make_front_end, recommended_options
from graphslam.app.worlds import simulate
from graphslam.core.config import merge_options
from graphslam.core.errors import GraphSlamError
from graphslam.core.geometry import se2_compose
from graphslam.core.log import DropCounter
from graphslam.core.random import SeedTree
from graphslam.core.submap import Submap
from graphslam.join.ekf import join_ekf
from graphslam.join.joined_map import JoinResult
from graphslam.join.optimise import optimise_from_join
from graphslam.join.order import join_sequential, join_tree
from graphslam.join.submap_isam2 import solve_submaps_isam2
from graphslam.join.submap_solver import SubmapEstimate, solve_submaps
from graphslam_frontends.landmarks.prepare import prepare_log
from graphslam_studies.baselines.full_batch import full_batch
from graphslam_studies.baselines.online import RelinearisationPolicy, join_online
from graphslam_studies.frontends.ekf_slam import ekf_snapshots
from graphslam_studies.frontends.rbpf_slam import rbpf_snapshots
from graphslam_studies.frontends.snapshot import Snapshot
from graphslam_studies.montecarlo.trials import Measurement
from graphslam_studies.scoring import Judge, Watch, clock, timed, watch_snapshots

CLASSICAL: dict[str, Callable[..., JoinResult]] = {
    "eif": partial(join_sequential, classical=True),
    "eif-tree": partial(join_tree, classical=True),
}
"""Map-joining methods of the paper: Cartesian, each join linearised once."""


@dataclass(frozen=True)
class TrialConfig:
    """World and settings of a trial.

    Parameters
    ----------
    world : str
        Preset of the landmark field.
    scans : int
        Scans per submap, the same for all algorithms.
    layout_seed : int, optional
        Fixes the features for all runs. By default they are random in every run.
    particles, default_particles : int
        Number of particles of the filters of the paper, and of the default front end.
    """

    world: str
    scans: int
    layout_seed: int | None = None
    particles: int = 40
    default_particles: int = 100


def run_trial(config: TrialConfig, seed: int) -> list[Measurement]:
    """All metrics of one run (see :mod:`graphslam_studies.combined_slam` for their names)."""
    with one_blas_thread():
        return list(_Trial(config, seed).run())


class _Trial:
    def __init__(self, config: TrialConfig, seed: int) -> None:
        self.config, self.seed = config, SeedTree(seed)
        self.log = simulate("landmark-field", seed=seed, preset=config.world, layout_seed=config.layout_seed)
        assert self.log.truth is not None
        scans = self.log["landmarks"].times
        ends = np.append(np.arange(config.scans, len(scans), config.scans), len(scans))
        self.cuts = [int(k) for k in ends]
        world = self.log.meta["config"]
        self.judge = Judge(self.log.truth, scans[ends - 1], world["laps"] * world["lap_length"])

    def run(self) -> Iterator[Measurement]:
        """Metrics of single-map filters, local maps, and joined maps."""
        yield from self._single_map("ekf", ekf_snapshots, "ekf-slam")
        yield from self._single_map("rbpf", rbpf_snapshots, "rbpf-slam", particles=self.config.particles)
        paper = {"handover": "moments", "particles": self.config.particles}
        default = {"particles": self.config.default_particles}
        for name, front_end, options in (
            ("local-paper-1.0", "rbpf-ekf", {**paper, "proposal": "1.0"}),
            ("local-paper-inflated", "rbpf-ekf", {**paper, "moment_inflation": True}),
        ):
            yield from self.judge.local(name, self._submaps(front_end, options))
        ekf, seconds = clock("local-ekf", partial(self._submaps, "ekf", {"handover": "filter"}))
        yield seconds
        yield from self._joined("ekf", ekf, CLASSICAL)
        rbpf, seconds = clock("local-paper", partial(self._submaps, "rbpf-ekf", paper))
        yield seconds
        yield from self._joined("rbpf", rbpf, {"ekf": join_ekf, **CLASSICAL})
        smooth, seconds = clock("local-default", partial(self._submaps, "rbpf-ekf", default))
        yield seconds
        own: dict[str, Callable[..., JoinResult]] = {"ekf": join_ekf, "eif": join_sequential, "eif-tree": join_tree}
        own |= {f"{name}-classical": join for name, join in CLASSICAL.items()}
        yield from self._joined("default", smooth, own)
        for name, maps in (("local-ekf", ekf), ("local-paper", rbpf), ("local-default", smooth)):
            yield from self.judge.local(name, maps)
        yield from self._least_squares(smooth)

    # ---------------------------------------------------------------- front ends

    def _options(self, front_end: str, options: dict[str, Any]) -> dict[str, Any]:
        """Options of the preset, overridden by those of the study (known association, equal cuts)."""
        own = {"association": "known", "stopping": {"scans": self.config.scans}}
        merged: dict[str, Any] = merge_options(
            recommended_options(self.log, front_end), {"frontend": merge_options(own, options)}
        )
        return dict(merged["frontend"])

    def _submaps(self, front_end: str, options: dict[str, Any]) -> list[Submap]:
        made = make_front_end(front_end, self._options(front_end, options))
        submaps = list(made.submaps(self.log, seed=self.seed.child("frontend")))
        if len(submaps) != len(self.cuts):
            raise GraphSlamError(f"{front_end} made {len(submaps)} submaps; wanted {len(self.cuts)}, cut as the others")
        return submaps

    def _single_map(
        self, name: str, snapshots: Callable[..., Iterator[Snapshot]], front_end: str, **options: Any
    ) -> Iterator[Measurement]:
        own = {k: v for k, v in self._options(front_end, options).items() if k != "stopping"}
        config = make_front_end(front_end, own).config
        watched = snapshots(self.log, config, seed=self.seed.child("single-map"), cuts=self.cuts, joint="last")
        try:
            rows, kept = watch_snapshots(self.judge, name, watched)
        except GraphSlamError:  # numerical failure of the filter: a result, not a failed trial
            yield Measurement(name, "diverged", 1.0)
            return
        yield from rows
        end = kept[-1]
        assert end.gaussian is not None
        yield from self.judge.final(
            name,
            end.landmark_ids,
            end.landmarks,
            end.gaussian.covariance[3:, 3:],
            poses=np.array([s.pose for s in kept]),
            pose_covariance=end.pose_covariance,
        )

    # ---------------------------------------------------------------- joining

    def _joined(
        self, family: str, submaps: list[Submap], joiners: dict[str, Callable[..., JoinResult]]
    ) -> Iterator[Measurement]:
        """Joined maps, and the optimum started from the tree."""
        done: dict[str, JoinResult] = {}
        for kind, join in joiners.items():
            name = f"{family}-{kind}"
            try:
                if kind.startswith("eif-tree"):
                    joined = join(submaps)
                else:
                    watch = Watch(self.judge, name)
                    joined = join(submaps, on_join=watch)
                    yield from watch.rows
                yield from self.judge.estimate(name, joined)
            except GraphSlamError:  # a collapsed particle set has a singular covariance
                yield Measurement(name, "diverged", 1.0)
                continue
            yield from timed(name, dict(joined.times))
            yield Measurement(name, "objective", joined.objective)
            done[kind] = joined
        classical = "eif-classical" if "eif-classical" in joiners else "eif"
        if {"ekf", classical} <= set(done):
            difference = np.abs(done["ekf"].vector - done[classical].vector)
            yield Measurement(f"{family}-ekf", "difference_to_eif", float(difference.max()))
        polished = optimise_from_join(submaps, done["eif-tree"])
        name = f"{family}-eif+polish"
        yield from self.judge.estimate(name, polished)
        yield from timed(name, {"polish": polished.times["polish"]})
        yield Measurement(name, "objective_optimum", _optimum(polished))
        yield Measurement(name, "polish_iterations", float(polished.iterations))

    def _least_squares(self, submaps: list[Submap]) -> Iterator[Measurement]:
        """Optimum of the default submaps by every method, online methods, and the full batch."""
        best = solve_submaps(submaps)
        yield Measurement("default-batch", "objective_optimum", best.objective)
        yield Measurement("default-batch", "objective_dof", float(_degrees_of_freedom(submaps, best)))
        for kind, join in (("sequence", join_sequential), ("ekf", join_ekf)):
            polished = optimise_from_join(submaps, join(submaps))
            yield Measurement(f"default-{kind}+polish", "objective_optimum", _optimum(polished))
            yield Measurement(f"default-{kind}+polish", "polish_iterations", float(polished.iterations))
        isam = solve_submaps_isam2(submaps)
        yield from self.judge.estimate("default-isam2", isam)
        yield Measurement("default-isam2", "objective", isam.objective)
        yield Measurement("default-isam2", "objective_optimum", _optimum(isam))
        yield Measurement("default-isam2", "seconds_total", isam.seconds, timing=True)
        for name, policy in (
            ("default-online", RelinearisationPolicy()),
            ("default-optimum", RelinearisationPolicy(every=1)),
        ):
            watch = Watch(self.judge, name)
            joined = join_online(submaps, policy=policy, on_join=watch)
            yield from watch.rows
            yield from self.judge.estimate(name, joined)
            yield from timed(name, dict(joined.times))
            yield Measurement(name, "objective", joined.objective)
        yield from self._full_batch(submaps, best)

    def _full_batch(self, submaps: list[Submap], best: SubmapEstimate) -> Iterator[Measurement]:
        """Batch over all scan poses, started from the optimum of the submaps."""
        front_end = make_front_end("rbpf-ekf", self._options("rbpf-ekf", {}))
        data = prepare_log(self.log, front_end.config, DropCounter())
        start = np.concatenate(
            [
                se2_compose(base, s.trajectory.poses[-n:])
                for base, s, n in zip(best.poses, submaps, np.diff([0, *self.cuts]), strict=False)
                if s.trajectory is not None
            ]
        )
        marks = dict(zip(best.landmark_ids.tolist(), best.landmarks, strict=True))
        whole = full_batch(
            data.odometry.increments,
            data.odometry.covariances,
            data.observations,
            initial_poses=start,
            initial_landmarks=marks,
        )
        yield from self.judge.final(
            "full-batch",
            whole.landmark_ids,
            whole.landmarks,
            whole.landmark_covariance(),
            poses=whole.poses[self.cuts],
            pose_covariance=whole.pose_covariances([self.cuts[-1]])[0],
        )
        yield Measurement("full-batch", "objective", whole.objective)
        yield Measurement("full-batch", "objective_dof", float(whole.dof))
        yield Measurement("full-batch", "seconds_total", whole.seconds, timing=True)


def _optimum(estimate: SubmapEstimate) -> float:
    value = estimate.objective_polished
    return float("nan") if value is None else value


def _degrees_of_freedom(submaps: list[Submap], estimate: SubmapEstimate) -> int:
    measured = sum(3 + 2 * len(s.landmarks) for s in submaps if s.landmarks is not None)
    return measured - estimate.states
