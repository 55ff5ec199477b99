"""Sound data must not end the default solver: long open chains, and pose graphs whose descent is slow."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from scipy.spatial import cKDTree

import graphslam.solve.network.multistart as multistart
from graphslam.app.solve_file import solution_json
from graphslam.core.network import PoseNetwork
from graphslam.core.poses import SE2, SE3, group_of
from graphslam.graph.factor_graph import FactorGraph
from graphslam.solve.batch import optimise_graph
from graphslam.solve.descent import descend_to_minimum, limits_of
from graphslam.solve.isam2 import Isam2Solver
from graphslam.solve.network.solve import solve_network
from tests.reference.graph_chain import dense_submap


def chain(n: int, dim: int, covariance: np.ndarray, every: int) -> tuple[FactorGraph, Isam2Solver]:
    """One metre forward and 0.01 rad to the left, ``n`` times, with an update after every few."""
    graph = FactorGraph(dim)
    solver = Isam2Solver(graph)
    step = np.array([1.0, 0.0, 0.01]) if dim == 2 else SE3.exp(np.array([0.0, 0.0, 0.01, 1.0, 0.0, 0.0]))
    for k in range(n):
        graph.add_submap(dense_submap(k, step, covariance))
        if (k + 1) % every == 0:
            solver.update()
    solver.update()
    return graph, solver


def same_as_batch(graph: FactorGraph, solver: Isam2Solver) -> None:
    assert not [e for e in graph.events if e["event"] == "removed"]
    assert set(solver._held) == set(graph.records)
    own = graph.values.poses.copy()
    np.testing.assert_allclose(own, optimise_graph(graph).values.poses, atol=1e-6)
    solver.solve_to_optimum()
    assert solver.solution().converged


@pytest.mark.parametrize(("n", "every"), [(900, 9), (5000, 100)])
def test_an_open_chain_in_space_is_carried_through(n: int, every: int) -> None:
    """Cholesky calls this chain indeterminate at pose 889, and threw its factor out."""
    graph, solver = chain(n, 3, 1e-4 * np.eye(6), every)
    assert len(graph.records) == n
    same_as_batch(graph, solver)


def test_a_loop_at_the_end_of_a_long_chain_is_shared_out_as_by_the_batch_solver() -> None:
    graph, solver = chain(3000, 3, 1e-4 * np.eye(6), 100)
    g, poses = group_of(graph.values.poses), graph.values.poses
    measured = g.compose(g.between(poses[2500], poses[2990]), SE3.exp(np.array([0, 0, 0.05, 2.0, -1.0, 0.5])))
    graph.add_between(2500, 2990, measured, 1e-4 * np.eye(6), evidence="shared-scan")
    solver.update()
    solver.solve_to_optimum()
    assert graph.objective().total > 0.1
    same_as_batch(graph, solver)


def test_a_chain_of_unequal_noise_is_carried_through() -> None:
    """Variances of 4 mm, 7 cm and 0.14 rad: such a recorded log ended at pose 348."""
    graph, solver = chain(2000, 2, np.diag([0.004, 0.07, 0.14]) ** 2, 20)
    same_as_batch(graph, solver)


def noisy_streets(n: int, seed: int) -> PoseNetwork:
    """A drive of ``n`` metres on a grid of streets: 0.1 m and 0.3 rad of noise a step, few loops, a bad start."""
    rng = np.random.default_rng(seed)
    poses = [np.zeros(3)]
    for k in range(n - 1):
        turn = rng.choice([-np.pi / 2, 0.0, np.pi / 2]) if k % 5 == 4 else 0.0
        ahead = SE2.compose(poses[-1], np.array([1.0, 0.0, turn]))
        if np.abs(ahead[:2]).max() > 60:
            ahead = SE2.compose(SE2.compose(poses[-1], np.array([0.0, 0.0, np.pi / 2])), np.array([1.0, 0.0, 0.0]))
        poses.append(ahead)
    true = np.array(poses)
    near = cKDTree(true[:, :2]).query_pairs(2.0, output_type="ndarray")
    near = np.sort(near[np.abs(near[:, 0] - near[:, 1]) > 10], axis=1)
    near = near[rng.choice(len(near), int(0.3 * n), replace=False)]
    edges = np.concatenate([np.stack([np.arange(n - 1), np.arange(1, n)], 1), near]).astype(np.intp)
    sigma = np.array([0.1, 0.1, 0.3])
    noise = SE2.exp(sigma * rng.standard_normal((len(edges), 3)))
    measured = SE2.compose(SE2.between(true[edges[:, 0]], true[edges[:, 1]]), noise)
    start = [np.zeros(3)]
    for z in measured[: n - 1]:
        start.append(SE2.compose(start[-1], z))
    return PoseNetwork(
        dim=2,
        ids=np.arange(n),
        poses=np.array(start),
        has_initial=np.ones(n, dtype=np.bool_),
        edges=edges,
        measurements=measured,
        information=np.broadcast_to(np.diag(sigma**-2), (len(edges), 3, 3)),
        source=f"streets of {n} poses, seed {seed}",
    )


@pytest.mark.parametrize("starts", [None, ("file",)])
def test_a_slow_descent_gets_to_a_minimum(starts: tuple[str, ...] | None) -> None:
    """With damped steps of one kind only both ended in a curved valley, up to 2.7 above where they go now."""
    network = noisy_streets(1500, 6)
    solution = solve_network(network, "lm", starts=starts)
    assert solution.converged
    assert limits_of(network.residuals).reached(solution.objective, solution.decrement)
    assert solution.gap <= 1e-9 * solution.objective
    assert solution.objective < 0.5 * solution.objective_initial


def test_no_gap_is_reported_where_no_optimum_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(multistart, "descend_to_minimum", partial(descend_to_minimum, max_iterations=3))
    solution = solve_network(noisy_streets(300, 1), "lm", starts=("file",))
    assert not solution.converged
    assert np.isnan(solution.gap)
    assert solution.decrement > 0
    assert solution_json(solution)["gap"] is None
    assert "above a minimum" in repr(solution)


@pytest.mark.parametrize("dim", [2, 3])
def test_noise_from_a_ten_thousandth_to_one_in_one_chain(rng: np.random.Generator, dim: int) -> None:
    """Factors 10⁸ apart in information, and a loop over most of them: nothing is removed, one optimum."""
    graph = FactorGraph(dim)
    solver, G = Isam2Solver(graph), SE2 if dim == 2 else SE3
    step = np.array([1.0, 0.0, 0.01]) if dim == 2 else SE3.exp(np.array([0.0, 0.0, 0.01, 1.0, 0.0, 0.0]))
    for k in range(2000):
        sigma = 10.0 ** rng.uniform(-4, 0)
        exit_pose = G.compose(step, G.exp(0.1 * sigma * rng.standard_normal(G.dof)))
        graph.add_submap(dense_submap(k, exit_pose, sigma**2 * np.eye(G.dof)))
        if k % 40 == 0:
            solver.update()
    solver.update()
    same_as_batch(graph, solver)
    poses = graph.values.poses
    apart = G.compose(G.between(poses[100], poses[1900]), G.exp(0.05 * rng.standard_normal(G.dof)))
    graph.add_between(100, 1900, apart, 1e-4 * np.eye(G.dof), evidence="shared-scan")
    solver.update()
    solver.solve_to_optimum()
    assert solver.solution().converged
    assert not [e for e in graph.events if e["event"] == "removed"]
