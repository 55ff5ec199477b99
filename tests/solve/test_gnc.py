"""Graduated non-convexity over whole graphs: wrong matches and wild fixes are named, right ones are kept."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.errors import ConfigError
from graphslam.core.poses import SE2, SE3
from graphslam.core.records import Gps
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.sensors.gps import GpsConfig
from graphslam.solve.gnc import GncConfig, GncSolver, find_outliers
from graphslam.solve.registry import SOLVERS, make_solver

SIGMA = {2: np.array([0.05, 0.05, 0.01]), 3: np.array([0.002, 0.002, 0.01, 0.05, 0.05, 0.05])}


def spoilt(rng: np.random.Generator, dim: int, wild: int, wrong: int) -> tuple[FactorGraph, np.ndarray, set[int]]:
    """Two rounds with right matches between them, fixes, and among both some that are far off: their factor ids."""
    G, n = (SE2 if dim == 2 else SE3), 40
    step = np.array([3.0, 0.0, np.pi / 10]) if dim == 2 else np.array([0, 0, np.pi / 10, 3.0, 0, 0.05])
    truth = [G.identity]
    for _ in range(n):
        truth.append(G.compose(truth[-1], G.exp(step)))
    poses, P = np.array(truth), np.diag(SIGMA[dim] ** 2)
    graph = FactorGraph(dim)
    t = np.arange(n) + 0.5
    fixes = poses[:-1, :dim] + 0.3 * rng.standard_normal((n, dim))
    far = rng.choice(n, wild, replace=False)
    fixes[far] += rng.uniform(5, 30, (wild, dim)) * rng.choice([-1, 1], (wild, dim))
    ids = graph.add_sensor(
        Gps(times=t, positions=fixes, sigma=np.full(n, 0.3), lever=np.zeros(dim)), config=GpsConfig(baseline=8.0)
    )
    bad = {ids[k] for k in far}
    for k in range(n):
        T = G.compose(G.between(poses[k], poses[k + 1]), G.exp(SIGMA[dim] * rng.standard_normal(G.dof)))
        path = Trajectory(np.array([k, k + 1.0]), np.stack([G.identity, T]), np.stack([0 * P, P]))
        graph.add_submap(Submap(key=k, interval=(float(k), k + 1.0), exit_pose=T, exit_covariance=P, trajectory=path))
    graph.finish_sensors()
    for i in range(0, 20, 2):
        T = G.compose(G.between(poses[i], poses[i + 20]), G.exp(SIGMA[dim] * rng.standard_normal(G.dof)))
        graph.add_between(i, i + 20, T, P, evidence="shared-scan", group="match")
    for _ in range(wrong):
        i, j = sorted(rng.choice(n, 2, replace=False))
        T = G.compose(G.between(poses[i], poses[j]), G.exp(np.r_[rng.normal(0, 2.0, G.dof)]))
        bad.add(graph.add_between(int(i), int(j), T, P, evidence="shared-scan", group="match"))
    return graph, poses, bad


@pytest.mark.parametrize("dim", [2, 3])
def test_wild_fixes_and_wrong_matches_are_named_and_no_others(rng, dim):
    graph, poses, bad = spoilt(rng, dim, wild=6, wrong=6)
    solver = GncSolver(graph)
    solver.update()
    solution = solver.solution()
    named = {e["factor_id"]: e for e in graph.events if e["event"] == "outlier"}
    assert bad <= set(named)
    assert len(set(named) - bad) <= 1  # one in a thousand of the right ones is beyond the limit
    assert {e["group"] for e in named.values()} == {"gps", "match"}
    assert all(e["chi2"] > e["limit"] for e in named.values())
    assert not set(named) & set(graph.records)
    assert solution.converged
    assert solution.score.total / solution.score.dof < 1.5
    error = np.linalg.norm(solution.poses[:, :2] - poses[:, :2], axis=1).max()
    assert error < 0.5


@pytest.mark.parametrize("dim", [2, 3])
def test_without_outliers_it_is_least_squares(rng, dim):
    graph, _, _ = spoilt(rng, dim, wild=0, wrong=0)
    other = make_solver("lm", graph)
    other.solve_to_optimum()
    before = graph.objective().total
    assert find_outliers(graph, GncConfig(confidence=0.9999)) == []
    make_solver("gnc", graph).solve_to_optimum()
    assert graph.objective().total == pytest.approx(before, rel=1e-9)


@pytest.mark.parametrize("dim", [2, 3])
def test_fixes_that_are_nearly_all_wrong_go_as_a_whole(rng, dim):
    """Two that agree by chance determine a frame, and one alone was an error of the solver."""
    graph, poses, bad = spoilt(rng, dim, wild=39, wrong=2)
    solver = GncSolver(graph)
    solver.update()
    solution = solver.solution()
    named = {e["factor_id"]: e["group"] for e in graph.events if e["event"] == "outlier"}
    assert list(named.values()).count("gps") == 40
    assert bad <= set(named)
    assert len(set(named) - bad) <= 2  # the last fix, and one in a thousand
    assert graph.values.datum is None
    assert solution.converged
    assert np.linalg.norm(solution.poses[:, :2] - poses[:, :2], axis=1).max() < 0.8


def test_settings_that_cannot_work_are_refused():
    with pytest.raises(ConfigError, match="growth"):
        GncConfig(growth=1.0)
    assert set(SOLVERS) == {"isam2", "batch", "lm", "gnc", "pcg"}
