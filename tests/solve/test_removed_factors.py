"""Values that a wrong factor has bent return to the optimum when the factor is removed."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.poses import SE2, SE3
from graphslam.graph.factor_graph import FactorGraph
from graphslam.solve.batch import BatchSolver, chain_values, optimise_graph
from graphslam.solve.isam2 import Isam2Solver
from tests.reference.graph_chain import dense_submap, make_chain

SOLVERS = {"batch": BatchSolver, "isam2": Isam2Solver}


def ring(dim: int) -> FactorGraph:
    """A closed ring of 18 submaps with one correct loop."""
    graph, g, n = FactorGraph(dim), SE2 if dim == 2 else SE3, 18
    step = np.array([1.0, 0.2, 0.3]) if dim == 2 else np.array([0.02, 0.03, 0.35, 1.0, 0.2, 0.1])
    P = np.diag(np.square([0.02] * dim + [0.01]) if dim == 2 else np.square([0.01] * 3 + [0.02] * 3))
    for k in range(n):
        graph.add_submap(dense_submap(k, g.exp(step), P))
    T = g.between(graph.values.poses[0], graph.values.poses[n])
    graph.add_between(0, n, T, P, evidence="shared-scan", group="loop")
    return graph


def wound(graph: FactorGraph) -> np.ndarray:
    """Poses with one full turn more along the ring: near another minimum."""
    poses, g = graph.values.poses.copy(), graph.values.group
    turn = np.zeros((len(poses), g.dof))
    turn[:, g.heading] = np.linspace(0.0, 2.0 * np.pi, len(poses))
    return g.compose(poses, g.exp(turn))


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("name", list(SOLVERS))
def test_a_removed_loop_leaves_no_trace(name: str, dim: int) -> None:
    graph = ring(dim)
    solver = SOLVERS[name](graph)
    solver.solve_to_optimum()
    right = graph.values.poses.copy()
    P = np.diag(np.square([0.01] * (dim * (dim + 1) // 2)))
    wrong = graph.add_between(6, 12, graph.values.group.identity, P, evidence="shared-scan", group="loop")
    graph.remove(wrong)
    values = graph.values.copy()
    values.poses = wound(graph)
    graph.set_values(values)
    assert optimise_graph(graph).objective > 100.0  # the descent alone ends in another minimum
    assert graph.factor_removed
    solver.solve_to_optimum()
    np.testing.assert_allclose(graph.values.poses, right, atol=1e-6)
    assert not graph.factor_removed


def test_a_consistent_optimum_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    graph = ring(2)
    wrong = graph.add_between(0, 1, graph.values.poses[1], np.eye(3), evidence="shared-scan", group="loop")
    graph.remove(wrong)
    monkeypatch.setattr("graphslam.solve.batch.chain_values", lambda graph: pytest.fail("not needed"))
    BatchSolver(graph).solve_to_optimum()


def test_the_chain_has_landmarks_where_their_first_submap_has_them(rng: np.random.Generator) -> None:
    chain = make_chain(rng, m=6, landmarks=15)
    graph = FactorGraph()
    for s in chain.submaps:
        graph.add_submap(s)
    placed = graph.values.copy()
    np.testing.assert_allclose(chain_values(graph).poses, placed.poses, atol=1e-12)
    np.testing.assert_allclose(chain_values(graph).landmarks, placed.landmarks, atol=1e-12)
    best = optimise_graph(graph)
    graph.set_values(placed.retract(rng.normal(0.0, 0.5, graph.flat().layout.size)))
    spread = chain_values(graph)
    np.testing.assert_allclose(spread.poses, placed.poses, atol=1e-12)
    graph.set_values(spread)
    again = optimise_graph(graph)
    assert again.objective == pytest.approx(best.objective, rel=1e-9)
