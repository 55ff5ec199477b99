"""Batch Gauss–Newton over submaps: the published local maps, poor starts, and its own honesty."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from graphslam.app.run.front_ends import make_front_end, recommended_options
from graphslam.app.worlds import simulate
from graphslam.core.errors import SolverError
from graphslam.core.geometry import wrap_angle
from graphslam.core.random import SeedTree
from graphslam.core.submap import Submap
from graphslam.join.optimise import optimise_from_join
from graphslam.join.order import join_sequential
from graphslam.join.submap_blocks import SubmapProblem
from graphslam.join.submap_solver import minimise_submaps, solve_submaps
from graphslam_studies.io.slsjf import read_slsjf_local_maps
from tests.reference.submap_chain import submap_chain


@pytest.fixture(scope="module")
def local_maps(data_dir: Path) -> list[Submap]:
    return read_slsjf_local_maps(data_dir / "victoria_park_processed")


@pytest.mark.data
def test_published_local_maps(local_maps: list[Submap]) -> None:
    started = time.perf_counter()
    best = solve_submaps(local_maps)
    assert best.converged
    assert best.objective == pytest.approx(3643.43, rel=1e-5)
    assert best.states == 3 * 200 + 2 * 299
    assert len(best.landmark_ids) == 299
    assert best.seconds <= time.perf_counter() - started
    # The optimum is one: the gradient vanishes against the curvature.
    problem = SubmapProblem(local_maps)
    x = best.vector
    f, g, data = problem.linearise(x)
    step = problem.pattern.factor(data).solve(g)
    assert g @ step < 1e-8 * f


@pytest.mark.data
def test_published_local_maps_from_a_worse_start(local_maps: list[Submap], rng: np.random.Generator) -> None:
    best = solve_submaps(local_maps)
    start = best.poses[1:] + rng.normal(size=(200, 3)) * (3.0, 3.0, 0.1)
    again = solve_submaps(local_maps, initial_poses=start)
    assert again.converged
    np.testing.assert_allclose(again.poses[:, :2], best.poses[:, :2], atol=1e-5)
    assert again.objective == pytest.approx(best.objective, rel=1e-9)


@pytest.mark.parametrize("damping_alone", [False, True])
def test_poor_starts_reach_the_optimum_downhill(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, damping_alone: bool
) -> None:
    if damping_alone:  # neither shorter steps nor bent ones: what is left when they do not help
        monkeypatch.setattr("graphslam.join.submap_solver._SHORTEST", 1.0)
        monkeypatch.setattr(SubmapProblem, "bent", lambda self, x, step: x + step)
    submaps, _ = submap_chain(rng, submaps=15, landmarks=40)
    problem = SubmapProblem(submaps)
    best = minimise_submaps(problem, problem.initial())
    refused, reached, jumps = 0, 0, 0
    for _ in range(16):
        x = best.x.copy()
        x[2:45:3] = wrap_angle(x[2:45:3] + rng.normal(0.0, 1.1, 15))
        x[45:] += rng.normal(0.0, 15.0, len(x) - 45)
        found = minimise_submaps(problem, x, max_iterations=200)
        steps = np.diff(found.history)
        jumps += np.max(steps / np.maximum(found.history[:-1], 1.0)) > 1e-12  # never uphill, but for rounding
        if found.objective < best.objective * (1 + 1e-9):
            assert found.converged
            reached += 1
            refused += found.iterations - len(steps)
    # A descent may end where a residual of heading is π to the last bit: the objective jumps there, since what is
    # correlated with that residual sees it change its sign.
    assert jumps <= 1
    assert not damping_alone or refused >= 2  # damping was at work on the way to the optimum
    assert reached >= 10  # some starts are wound up by a turn, and a descent cannot unwind them


def test_a_kilometre_loop_joined_in_sequence_is_polished_in_a_few_steps() -> None:
    """Where headings are corrected by degrees, straight steps leave the valley and damped ones crawl along it."""
    log = simulate("landmark-field", preset="A", seed=3, layout_seed=1, laps=1.08, lap_length=2500.0, landmarks=260)
    options = {**recommended_options(log, "rbpf-ekf")["frontend"], "particles": 20}
    submaps = list(make_front_end("rbpf-ekf", options).submaps(log, seed=SeedTree(0)))
    joined, tree = join_sequential(submaps), solve_submaps(submaps)
    polished = optimise_from_join(submaps, joined)
    assert polished.converged
    assert polished.iterations <= 9  # 16 with straight and damped steps alone
    assert polished.objective_polished == pytest.approx(tree.objective, rel=1e-9)


def test_the_cap_on_iterations_is_reported(rng: np.random.Generator) -> None:
    submaps, _ = submap_chain(rng)
    hasty = solve_submaps(submaps, max_iterations=1)
    assert not hasty.converged
    assert hasty.iterations == 1
    assert hasty.objective > solve_submaps(submaps).objective


def test_a_start_that_is_not_a_number_is_an_error(rng: np.random.Generator) -> None:
    submaps, _ = submap_chain(rng, submaps=3)
    problem = SubmapProblem(submaps)
    with pytest.raises(SolverError, match="nan"):
        minimise_submaps(problem, np.full(problem.size, np.nan))


def test_covariance_blocks_by_sparse_solves_are_the_dense_inverse(rng: np.random.Generator) -> None:
    submaps, _ = submap_chain(rng)
    best = solve_submaps(submaps)
    P = np.linalg.inv(best.information.toarray())
    np.testing.assert_allclose(best.joint_covariance(), P, rtol=0, atol=1e-9 * np.abs(P).max())
    some = rng.choice(best.states, 30, replace=False)
    np.testing.assert_allclose(best.covariance_block(some), P[np.ix_(some, some)], rtol=0, atol=1e-9 * np.abs(P).max())


def test_global_heading_may_wrap(rng: np.random.Generator) -> None:
    """More than one turn: headings stay in (-π, π] and the objective knows the circle."""
    submaps, truth = submap_chain(rng, submaps=30, laps=2.6, sigma=0.01, sigma_heading=0.001)
    best = solve_submaps(submaps)
    assert np.all(np.abs(best.poses[:, 2]) <= np.pi)
    assert np.abs(wrap_angle(best.poses[1:, 2] - truth.exit_poses[:, 2])).max() < 0.02
    assert np.linalg.norm(best.poses[1:, :2] - truth.exit_poses[:, :2], axis=1).max() < 0.3
