"""Every way of relaxing a skeleton network against plain Gauss-Newton over poses and landmarks together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.errors import ConfigError, CovarianceError, DataError, IndeterminateError, SolverError
from graphslam.skeleton.landmark_kernels import Poses
from graphslam.skeleton.preconditioner import PreconditionerLevels
from graphslam.skeleton.problem import SkeletonProblem
from graphslam.skeleton.reduced_network import ReducedNetwork, blocks_per_pose
from graphslam.skeleton.relax import RelaxConfig, relax_skeleton
from graphslam.skeleton.schur import Network, Workers, WorkRanges
from graphslam.skeleton.start import chain_start, forward_pass
from graphslam_studies.sim.laps import Laps, LapsConfig, draw_laps
from tests.reference import dense_skeleton as dense


@pytest.fixture(scope="module")
def optimum(problem: SkeletonProblem, laps: Laps) -> tuple[Poses, np.ndarray, float]:
    return dense.optimum(problem, laps.truth)


def farthest(a: Poses, b: Poses) -> float:
    return float(np.linalg.norm(a.position - b.position, axis=1).max())


def rms(a: Poses, b: Poses) -> float:
    return float(np.sqrt(np.mean(np.sum((a.position - b.position) ** 2, axis=1))))


@pytest.mark.parametrize(
    "config",
    [
        RelaxConfig(gain=1e-9, move=1e-8),
        RelaxConfig(gain=1e-9, move=1e-8, levels=PreconditionerLevels(4, 16), start="odometry", threads=2),
        RelaxConfig(gain=1e-9, move=1e-8, levels=PreconditionerLevels()),
        RelaxConfig(method="blocks", gain=1e-9, move=1e-8),
        RelaxConfig(method="cg", gain=1e-12, iterations=300),
        RelaxConfig(method="cg", gain=1e-12, iterations=3000, rebuild=0, levels=PreconditionerLevels(-1, 0)),
    ],
    ids=["gn", "gn-levels-odometry", "gn-jacobi", "blocks", "cg", "cg-plain"],
)
def test_the_optimum_is_that_of_poses_and_landmarks_together(
    problem: SkeletonProblem, optimum: tuple[Poses, np.ndarray, float], config: RelaxConfig
) -> None:
    poses, landmarks, objective = optimum
    found = relax_skeleton(problem, config)
    plain = config.method == "cg" and config.levels is not None
    assert found.objective == pytest.approx(objective, rel=1e-9 if not plain else 1e-5)
    assert farthest(found.poses, poses) < (0.01 if plain else 1e-5)
    if not plain:
        assert found.converged
        assert np.abs(found.landmarks - landmarks).max() < 1e-5
    assert found.split == 0
    assert found.chi2 == pytest.approx(1.0, abs=0.1)
    assert sum(h.products for h in found.history) == found.products


def test_keyframes_alone_are_named_approximate_and_end_above_the_optimum(
    problem: SkeletonProblem, optimum: tuple[Poses, np.ndarray, float]
) -> None:
    found = relax_skeleton(problem, RelaxConfig(method="levels", levels=PreconditionerLevels(0, 16)))
    assert found.approximate
    assert not relax_skeleton(problem, RelaxConfig(iterations=1)).approximate
    assert found.objective > 1.01 * optimum[2]
    assert farthest(found.poses, optimum[0]) < 0.5
    with pytest.raises(ConfigError, match="keyframes"):
        relax_skeleton(problem, RelaxConfig(method="levels", levels=PreconditionerLevels()))


def test_starts_come_nearer(laps: Laps, problem: SkeletonProblem) -> None:
    lay = WorkRanges(problem, Workers(1))
    reckoned, chain = problem.dead_reckoning(), chain_start(problem)
    walk = forward_pass(problem, chain, ago=20)
    cost = [Network(lay, p).objective for p in (reckoned, chain, walk.poses)]
    assert cost[0] > cost[1] > cost[2]
    assert rms(reckoned, laps.truth) > rms(chain, laps.truth)
    assert walk.aligned > problem.poses // 3


def test_chain_start_is_the_optimum_of_all_but_the_landmarks(problem: SkeletonProblem) -> None:
    """A network whose landmarks are seen once each has no more to say than its chain."""
    alone = problem.relabelled(np.arange(problem.measurements, dtype=np.int32))
    _, _, objective = dense.optimum(alone, problem.dead_reckoning())
    chain = chain_start(alone, iterations=30)
    assert Network(WorkRanges(alone, Workers(1)), chain).objective == pytest.approx(objective, rel=1e-3)
    assert relax_skeleton(alone, RelaxConfig(gain=1e-9)).objective == pytest.approx(objective, rel=1e-9)


def test_threads_change_no_byte_of_a_relaxation(problem: SkeletonProblem) -> None:
    a, b = (
        relax_skeleton(problem, RelaxConfig(threads=n, iterations=3, levels=PreconditionerLevels(4, 16)))
        for n in (1, 2)
    )
    assert a.poses.position.tobytes() == b.poses.position.tobytes()
    assert a.poses.rotation.tobytes() == b.poses.rotation.tobytes()
    assert [h.objective for h in a.history] == [h.objective for h in b.history]


def test_written_out_network_is_the_schur_complement(network: Network, written_out: dense.Rows) -> None:
    S, _ = dense.schur(written_out, len(network.poses.position))
    thinned = ReducedNetwork(network, 1e9)
    assert np.abs(thinned.matrix.toarray() - S).max() < 1e-10 * np.abs(S).max()
    full = [np.abs(S[6 * i : 6 * i + 6, 6 * j : 6 * j + 6]).max() > 0 for i in range(96) for j in range(i, 96)]
    assert thinned.blocks == sum(full)
    assert blocks_per_pose(network.layout.problem) == pytest.approx(sum(full) / 96, rel=0.02)


def test_a_network_too_large_to_write_out_is_refused_with_its_size(problem: SkeletonProblem) -> None:
    with pytest.raises(SolverError, match=r"blocks a pose: about .* GB; wanted at most"):
        relax_skeleton(problem, RelaxConfig(method="blocks", limit=1e5))


@pytest.mark.parametrize("start", ["odometry", "chain", "forward"])
def test_a_long_drift_is_undone_from_every_start(start: str) -> None:
    """GPS on the first lap only and turns ten times as noisy: the chain is metres off, landmarks pull laps together."""
    world = draw_laps(LapsConfig(poses=1200, laps=6, begin=4, reach=6, odometry=(5e-3, 0.01), gps_laps=1), seed=6)
    problem = world.problem()
    config = RelaxConfig(start=start, split=False, levels=PreconditionerLevels(10, 40))  # type: ignore[arg-type]
    best = relax_skeleton(problem, config, world.truth)
    assert rms(chain_start(problem), world.truth) > 1.0
    found = relax_skeleton(problem, config)
    assert found.converged == "poses"
    assert found.objective == pytest.approx(best.objective, abs=1e-3)
    assert farthest(found.poses, best.poses) < 1e-3


# ---- wrong unions ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def larger() -> Laps:
    return draw_laps(LapsConfig(poses=360, laps=6, begin=5, reach=6, gps_every=10, spacing=0.5), seed=1)


def merged(landmark: np.ndarray, share: float) -> tuple[np.ndarray, int]:
    """Some landmarks take the number of another one that is in view together with them."""
    rng = np.random.default_rng(8)
    several = np.flatnonzero(np.bincount(landmark) > 10)
    chosen = rng.choice(several, int(len(several) * share), replace=False)
    out = landmark.copy()
    for j in chosen:
        out[out == j] = several[(np.searchsorted(several, j) + 3) % len(several)]
    names, first, inverse = np.unique(out, return_index=True, return_inverse=True)
    rank = np.empty(len(names), np.int32)
    rank[np.argsort(first)] = np.arange(len(names))
    return rank[inverse].astype(np.int32), len(chosen)


def test_wrong_unions_are_found_split_and_counted(larger: Laps) -> None:
    landmark, _ = larger.collapsed()
    clean = relax_skeleton(larger.problem(landmark), RelaxConfig())
    assert clean.split == 0
    wrong, n = merged(landmark, 0.06)
    assert n >= 3
    bent = relax_skeleton(larger.problem(wrong), RelaxConfig(split=False))
    found = relax_skeleton(larger.problem(wrong), RelaxConfig())
    assert bent.chi2 > 5.0
    assert n - 1 <= found.split <= n + 2, (n, found.split)
    assert found.chi2 == pytest.approx(1.0, abs=0.05)
    assert found.refused > 0
    assert rms(found.poses, clean.poses) < 0.25 * rms(bent.poses, clean.poses)
    # measurements of a pass stay together, those of different passes do not
    assert len(np.unique(found.landmark)) > len(np.unique(wrong))


# ---- what cannot be ----------------------------------------------------------------------------------------------


def test_impossible_networks_are_refused(problem: SkeletonProblem) -> None:
    N = problem.poses
    bad = problem.points.copy()
    bad[7] = 0.0
    nan = problem.points.copy()
    nan[3, 1] = np.nan
    skewed = problem.odometry_covariance[0].copy()
    skewed[0, 0] = -1.0
    shuffled = problem.landmark.copy()
    shuffled[0] = 5
    for changed, error, words in (
        ({"points": bad}, DataError, "measurement 7"),
        ({"points": nan}, DataError, "not finite"),
        ({"odometry_covariance": skewed}, CovarianceError, "odometry_covariance"),
        ({"landmark": shuffled}, DataError, "first observation"),
        ({"first": problem.first + 1}, DataError, "rising"),
        ({"odometry_rotation": problem.odometry_rotation[1:]}, DataError, "odometry_rotation"),
        ({"gps_pose": np.array([N]), "gps_position": np.zeros((1, 3))}, DataError, "not there"),
        ({"range_sigma": 0.0}, DataError, "positive"),
    ):
        with pytest.raises(error, match=words):
            replace(problem, **changed)
    with pytest.raises(ConfigError, match="method"):
        RelaxConfig(method="newton")  # type: ignore[arg-type]


def test_a_pose_that_nothing_holds_is_named(problem: SkeletonProblem) -> None:
    loose = np.repeat(problem.odometry_covariance, problem.poses - 1, axis=0)
    loose[40:42] *= 1e30
    alone = replace(
        problem.relabelled(np.arange(problem.measurements, dtype=np.int32)),
        odometry_covariance=loose,
        up=None,
        gps_pose=np.empty(0, int),
        gps_position=np.empty((0, 3)),
    )
    with pytest.raises(IndeterminateError, match="pose 4"):
        relax_skeleton(alone, RelaxConfig(start="odometry", levels=PreconditionerLevels()))


def test_a_chain_whose_end_is_held_by_less_than_rounding_still_starts() -> None:
    # a metre of lateral drift behind the last fix, 1e-7 m of noise a step: shares of 1e-16 of the last pose's block
    config = LapsConfig(poses=2400, laps=2, gps_every=40, odometry=(0.01, 1e-7), up_sigma=1.0)
    laps = draw_laps(config, seed=1)
    problem = laps.problem()
    start, reckoned = chain_start(problem), problem.dead_reckoning()
    near, off = (np.linalg.norm(p.position - laps.truth.position, axis=1).max() for p in (start, reckoned))
    assert near <= off
