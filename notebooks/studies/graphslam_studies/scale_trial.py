"""One trial of the study ``scale``: one laps world, relaxed by every method, or approximated, or from a bad start."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from graphslam.core.geometry import Array
from graphslam.core.network import PoseNetwork
from graphslam.core.se3 import matrix_to_quat, quat_to_matrix
from graphslam.skeleton.collapse import Collapse, number_by_first_observation
from graphslam.skeleton.landmark_kernels import Poses
from graphslam.skeleton.preconditioner import PreconditionerLevels
from graphslam.skeleton.problem import SkeletonProblem
from graphslam.skeleton.relax import RelaxationResult, RelaxConfig, relax_skeleton
from graphslam.skeleton.schur import Network, Workers, WorkRanges
from graphslam.solve.network.solve import solve_network
from graphslam_studies.baselines.links import relative_links
from graphslam_studies.montecarlo.trials import Measurement
from graphslam_studies.sim.laps import Laps, LapsConfig, draw_laps

Labels = npt.NDArray[np.int32]
Rows = Iterator[Measurement]


@dataclass(frozen=True)
class ScaleTrialConfig:
    """A world of the study.

    Parameters
    ----------
    what : {"methods", "approximations", "stability"}
    wrong : tuple of float
        Shares of the landmarks with several traversals that are wrongly merged with another one.
    kept : tuple of float
        Shares of the landmarks with several traversals that are kept; others are split, one per traversal.
    turns : tuple of float
        Stability: σ of the odometry heading per step [rad].
    """

    what: Literal["methods", "approximations", "stability"] = "methods"
    world: LapsConfig = field(default_factory=LapsConfig)
    wrong: tuple[float, ...] = (1e-3, 1e-2)
    kept: tuple[float, ...] = (1 / 3, 0.1, 1 / 30, 0.0)
    turns: tuple[float, ...] = (5e-4, 5e-3, 2e-2)


TIGHT = RelaxConfig(gain=1e-6, move=1e-5, soft=0)
METHODS: dict[str, RelaxConfig] = {
    "direct": replace(TIGHT, method="levels", levels=PreconditionerLevels(0, 1)),
    "gn": TIGHT,
    "gn, block Jacobi": replace(TIGHT, levels=PreconditionerLevels(), inner=2000),
    "cg, two levels": replace(TIGHT, method="cg", iterations=300),
    "cg, two levels kept": replace(TIGHT, method="cg", iterations=300, rebuild=0),
    "cg, block Jacobi": replace(TIGHT, method="cg", iterations=300, rebuild=50, levels=PreconditionerLevels()),
    "cg, none": replace(TIGHT, method="cg", iterations=300, rebuild=0, levels=PreconditionerLevels(-1, 0)),
    "blocks": replace(TIGHT, method="blocks"),
    "keyframes alone": replace(TIGHT, method="levels"),
}
"""``direct``: keyframes at every pose, so the whole Schur complement is factored."""


def run_scale_trial(config: ScaleTrialConfig, seed: int) -> Rows:
    """One trial."""
    run: dict[str, Callable[[ScaleTrialConfig, int], Rows]] = {
        "methods": _methods,
        "approximations": _approximations,
        "stability": _stability,
    }
    yield from run[config.what](config, seed)


def rms(a: Poses, b: Poses) -> float:
    """Root mean square distance of positions [m]."""
    return float(np.sqrt(np.mean(np.sum((a.position - b.position) ** 2, axis=1))))


def _rows(name: str, found: RelaxationResult, best: RelaxationResult, truth: Poses, first: float) -> Rows:
    yield Measurement(name, "gap", found.objective - best.objective)
    yield Measurement(name, "chi2", found.chi2)
    yield Measurement(name, "iterations", found.iterations)
    yield Measurement(name, "products", found.products)
    yield Measurement(name, "residual", found.gradient / first)
    yield Measurement(name, "to_optimum", rms(found.poses, best.poses))
    yield Measurement(name, "to_truth", rms(found.poses, truth))
    yield Measurement(name, "seconds", sum(found.seconds.values()), timing=True)


def _methods(config: ScaleTrialConfig, seed: int) -> Rows:
    """Every method, started from dead reckoning."""
    world = draw_laps(config.world, seed)
    problem = world.problem()
    start = problem.dead_reckoning()
    first = float(np.linalg.norm(Network(WorkRanges(problem, Workers(1)), start).gradient))
    best = relax_skeleton(problem, TIGHT)
    for name, how in METHODS.items():
        yield from _rows(name, relax_skeleton(problem, how, start), best, world.truth, first)
    yield from _rows("gn, forward pass", best, best, world.truth, first)


def _approximations(config: ScaleTrialConfig, seed: int) -> Rows:
    """Optimum of the exact network, and of approximate ones."""
    world = draw_laps(config.world, seed)
    landmark, _ = world.collapsed()
    points = world.points()
    exact = relax_skeleton(world.problem(landmark, points), TIGHT)
    rng = np.random.default_rng(seed)
    for name, labels, split in _labels(config, world, landmark, rng):
        found = relax_skeleton(world.problem(labels, points), replace(TIGHT, split=split))
        yield Measurement(name, "landmarks", int(found.landmark.max()) + 1)
        yield Measurement(name, "split", found.split)
        yield Measurement(name, "chi2", found.chi2)
        yield Measurement(name, "to_optimum", rms(found.poses, exact.poses))
        yield Measurement(name, "to_truth", rms(found.poses, world.truth))
    averaged = relax_skeleton(averaged_passes(world.problem(landmark, points)), TIGHT)
    yield Measurement("passes averaged", "chi2", averaged.chi2)
    yield Measurement("passes averaged", "to_optimum", rms(averaged.poses, exact.poses))
    yield Measurement("passes averaged", "to_truth", rms(averaged.poses, world.truth))


def _labels(
    config: ScaleTrialConfig, world: Laps, landmark: Labels, rng: np.random.Generator
) -> Iterator[tuple[str, Labels, bool]]:
    """Names and landmarks of the variants, and whether wrong unions are searched and split."""
    yield "exact", landmark, True
    passes, _ = pass_labels(landmark, world.first)
    # a landmark with several traversals has several traversal labels
    pairs = np.unique(np.column_stack([landmark, passes]), axis=0)
    several = np.flatnonzero(np.bincount(pairs[:, 0]) > 1)
    for share in config.wrong:
        n = max(1, round(share * len(several)))
        chosen = rng.choice(several, n, replace=False)
        merged = landmark.copy()
        other = several[(np.searchsorted(several, chosen) + 1) % len(several)]
        table = np.arange(int(landmark.max()) + 1, dtype=np.int32)
        table[chosen] = other
        labels, _ = number_by_first_observation(table[merged])
        yield f"{share:.2%} wrong unions", labels, False
        yield f"{share:.2%} wrong unions, split", labels, True
    for share in config.kept:
        falls = np.zeros(int(landmark.max()) + 1, dtype=bool)
        falls[several] = rng.random(len(several)) >= share
        labels = np.where(falls[landmark], int(landmark.max()) + 1 + passes, landmark)
        yield f"{share:.1%} of the links kept", number_by_first_observation(labels)[0], True


def pass_labels(landmark: Labels, first: npt.NDArray[np.int64], gap: int = 20) -> tuple[Labels, int]:
    """Labels ``(M,)``, one per traversal of each landmark, and their number."""
    pose = np.repeat(np.arange(len(first) - 1), np.diff(first))
    collapse = Collapse(len(landmark))
    order = np.lexsort((pose, landmark))
    same = (np.diff(landmark[order]) == 0) & (np.diff(pose[order]) <= gap)
    collapse.add(order[:-1][same], order[1:][same])
    return collapse.landmarks()


def averaged_passes(problem: SkeletonProblem) -> SkeletonProblem:
    """Replace every traversal of a landmark by one observation from its middle pose, with the noise of the mean.

    Observations are transformed to the middle pose by the odometry. Shorter traversals than the longest are omitted,
    because all observations have one noise.
    """
    passes, n = pass_labels(problem.landmark, problem.first)
    pose = np.repeat(np.arange(problem.poses), np.diff(problem.first))
    counts = np.bincount(passes, minlength=n)
    middle = np.zeros(n, np.int64)
    np.add.at(middle, passes, pose)
    middle //= counts
    at = problem.dead_reckoning()
    z = problem.points.astype(np.float64)
    world = at.position[pose] + np.einsum("nij,nj->ni", at.rotation[pose], z) - at.position[middle[passes]]
    local = np.einsum("nji,nj->ni", at.rotation[middle[passes]], world)
    mean = np.zeros((n, 3))
    np.add.at(mean, passes, local)
    mean /= counts[:, None]
    landmark = np.zeros(n, np.int64)
    landmark[passes] = problem.landmark
    full = np.flatnonzero(counts == counts.max())
    order = full[np.argsort(middle[full], kind="stable")]
    first = np.concatenate([[0], np.cumsum(np.bincount(middle[order], minlength=problem.poses))])
    fewer = float(np.sqrt(counts.max()))
    return replace(
        problem,
        points=mean[order].astype(np.float32),
        landmark=number_by_first_observation(landmark[order])[0],
        first=first.astype(np.int64),
        range_sigma=problem.range_sigma / fewer,
        bearing_sigma=problem.bearing_sigma / fewer,
    )


def _stability(config: ScaleTrialConfig, seed: int) -> Rows:
    """From dead reckoning, without GPS and tilt: relinearised, linearised once, and links computed once."""
    for turn in config.turns:
        world = draw_laps(replace(config.world, odometry=(turn, config.world.odometry[1])), seed)
        nothing: Array = np.empty((0, 3))
        problem = replace(world.problem(), up=None, gps_pose=np.empty(0, np.int64), gps_position=nothing)
        start = problem.dead_reckoning()
        best = relax_skeleton(problem, replace(TIGHT, split=False), world.truth)
        once = RelaxConfig(
            method="levels", levels=PreconditionerLevels(0, 1), iterations=1, soft=0, split=False, halve=False
        )
        variants: dict[str, Poses] = {
            "dead reckoning": start,
            "relinearised": relax_skeleton(problem, replace(TIGHT, split=False, start="odometry")).poses,
            "relinearised, forward pass": relax_skeleton(problem, replace(TIGHT, split=False)).poses,
            "information form, linearised once": relax_skeleton(problem, once, start).poses,
            "links fixed once": linked(problem, start),
        }
        layout = WorkRanges(problem, Workers(1))
        for variant, poses in variants.items():
            name = f"{variant}; {1e3 * turn:g} mrad"
            network = Network(layout, poses)
            yield Measurement(name, "chi2", network.objective / problem.freedom)
            yield Measurement(name, "gap", network.objective - best.objective)
            yield Measurement(name, "to_optimum", rms(poses, best.poses))
            yield Measurement(name, "to_truth", rms(poses, world.truth))


def linked(problem: SkeletonProblem, start: Poses) -> Poses:
    """Poses from odometry and links between pairs of poses, each link computed once."""
    links = relative_links(problem)
    N = problem.poses
    chain = np.column_stack([np.arange(N - 1), np.arange(1, N)])
    steps = np.column_stack([problem.odometry_translation, matrix_to_quat(problem.odometry_rotation)])
    information = np.broadcast_to(problem.odometry_information, (N - 1, 6, 6))
    network = PoseNetwork(
        3,
        np.arange(N),
        np.column_stack([start.position, matrix_to_quat(start.rotation)]),
        np.ones(N, dtype=bool),
        np.concatenate([chain, links.edges]).astype(np.intp),
        np.concatenate([steps, links.measurements]),
        np.concatenate([information, links.information]),
        source="links",
    )
    poses = solve_network(network, "lm").poses
    return Poses(np.ascontiguousarray(quat_to_matrix(poses[:, 3:])), np.ascontiguousarray(poses[:, :3]))
