"""Loops in a pose graph: its marginals, chain and factors are those of the chain by itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.app.run.residual_consistency import ResidualConsistency
from graphslam.app.verdict.figures import RunMetrics, whole_chi2
from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.metrics import Metrics, solution_metrics
from graphslam.evaluate.residual_consistency import class_consistency
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.between import BetweenRecord
from graphslam.graph.noise import RobustKernel
from graphslam.loops.graph_loops import GROUP, GraphLoops, chain_of_graph, places_of_graph
from graphslam.loops.ledger import LoopLedger
from graphslam.loops.loops import LoopCloser
from graphslam.solve.batch import BatchSolver
from tests.reference.loop_chain import STEP, chain_of, loop_of, right_loops, square_poses
from tests.reference.loop_network import LoopNetwork
from tests.reference.loop_places import loop_places


def submaps_of(poses: Array, rng: np.random.Generator, length: int = 12) -> list[Submap]:
    """Submaps of a noisy chain, a pose every metre, covariances as the steps make them."""
    g = group_of(poses)
    T, _ = chain_of(poses, rng)
    out = []
    for key, a in enumerate(range(0, len(T), length)):
        local, P = [g.identity], [np.zeros((g.dof, g.dof))]
        for step in T[a : a + length]:
            local.append(g.compose(local[-1], step))
            A = g.adjoint(g.inverse(step))
            P.append(A @ P[-1] @ A.T + STEP[g.dim])
        n = len(local)
        out.append(
            Submap(
                key=key, interval=(float(a), float(a + n - 1)), exit_pose=local[-1], exit_covariance=P[-1],
                trajectory=Trajectory(a + np.arange(float(n)), np.stack(local), np.stack(P)),
                uses=frozenset({"odometry"}),
            )
        )  # fmt: skip
    return out


def graph_of(submaps: list[Submap]) -> GraphLoops:
    graph = FactorGraph(submaps[0].dim)
    for s in submaps:
        graph.add_submap(s, spacing=3.0)
    return GraphLoops(graph, BatchSolver(graph))


@pytest.mark.parametrize("dim", [2, 3])
def test_it_is_the_chain_by_itself(dim: int) -> None:
    """Marginals, decisions and poses of the graph, and of a network of its chain."""
    poses = square_poses(dim, nodes=73)
    rng = np.random.default_rng(0)
    ours = graph_of(submaps_of(poses, rng))
    T, P = chain_of_graph(ours.graph)
    plain = LoopNetwork(T, P)
    i, j = np.array([0, 3, 20, 5]), np.array([20, 17, 2, 5 + 1])
    for got, wanted in zip(ours.relative(i, j), plain.relative(i, j)):
        np.testing.assert_allclose(got, wanted, atol=1e-6)
    every = poses[::3]  # nodes stand every 3 m
    assert len(ours.places) == 24
    loops = [
        *right_loops(every, rng, 0),
        *(loop_of(every, a, a + 16, np.random.default_rng(a)) for a in (0, 2, 4, 6)),
        loop_of(every, 1, 9, rng, np.concatenate([np.zeros(group_of(poses).dof - 2), [3.0, 2.0]])),
    ]
    decisions = []
    for graph in (ours, plain):
        closer = LoopCloser(graph, T, P)
        closer.propose(loops)
        decisions.append([(d.verdict, f"{d.chi2:.2f}", f"{d.effect:.1f}") for d in closer.ledger.current()])
    assert decisions[0] == decisions[1]
    assert [v for v, *_ in decisions[0]] == ["accepted"] * 4 + ["rejected"]
    np.testing.assert_allclose(ours.graph.values.poses, plain.poses, atol=1e-4)
    assert ours.graph.objective()[GROUP].factors == 4
    # with loops in, too
    for got, wanted in zip(ours.relative(i, j), plain.relative(i, j)):
        np.testing.assert_allclose(got, wanted, atol=2e-6)


def test_undo_gives_the_evidence_back() -> None:
    poses = square_poses(3, nodes=73)
    ours = graph_of(submaps_of(poses, np.random.default_rng(2)))
    before = ours.graph.values.poses.copy()
    closer = LoopCloser(ours, *chain_of_graph(ours.graph), ledger=LoopLedger())
    (d,) = closer.propose([loop_of(poses[::3], 2, 18, np.random.default_rng(1))])
    assert d.verdict == "accepted"
    assert d.factor_id in ours.graph.records
    closer.undo(d.loop)
    assert d.factor_id not in ours.graph.records
    np.testing.assert_allclose(ours.graph.values.poses, before, atol=1e-6)
    ours.add_loop(loop_of(poses[::3], 2, 18, np.random.default_rng(1)), RobustKernel("huber", 3.0))


def test_overlap_constraints_are_a_class_of_their_own_that_tests_nothing() -> None:
    """They were made of the poses of the chain: their small residuals must not pass for a sign of small errors."""
    poses = square_poses(3, nodes=73)
    rng = np.random.default_rng(2)
    ours = graph_of(submaps_of(poses, rng))
    x = ours.graph.values.poses
    ours.add_loop(loop_of(poses[::3], 2, 18, rng), RobustKernel())
    ours.solve()
    alone = class_consistency(ours.graph)
    for i in range(3, 13):
        j = i + 10
        T = group_of(x).between(x[i], x[j])
        ours.add_loop(replace(loop_of(poses[::3], i, j, rng), T_ij=T, source="overlap"), RobustKernel())
    classes = class_consistency(ours.graph)
    assert set(classes) == {"dense-submap", "loop", "overlap"}
    assert classes["overlap"].as_row()["verdict"] == "not tested"
    assert classes["overlap"].factors == 10
    out = Metrics()
    solution_metrics(out, ours.solver.solution(), 0)
    keys = {r["key"] for r in out.rows}
    assert {"overlap_chi2", "loop_chi2_per_dof"} <= keys
    assert "overlap_chi2_per_dof" not in keys
    # of the whole graph as many degrees of freedom are tested as without them
    whole = whole_chi2(RunMetrics({"graph": {"classes": [c.as_row() for c in classes.values()]}}, {}))
    assert whole is not None
    assert whole[1] == pytest.approx(sum(c.dof for c in alone.values()), abs=1e-6)
    # no test of covariances is made of them; of the same residuals of a class that measures, one is
    for name, tested in (("overlap", False), ("loop", True)):
        found = ResidualConsistency({name: replace(classes["overlap"], name=name)}, None, None).evidence([])
        assert any(t.name == f"χ² of {name}" for t in found) == tested


def test_places_of_a_graph_are_those_of_its_submaps() -> None:
    poses = square_poses(3, nodes=73)
    submaps = submaps_of(poses, np.random.default_rng(2))
    ours, plain = graph_of(submaps).places, loop_places(submaps, 3.0)
    np.testing.assert_allclose(ours.T_base_node, plain.T_base_node, atol=1e-9)
    np.testing.assert_array_equal(ours.submap, plain.submap)
    np.testing.assert_allclose(ours.time, plain.time)
    np.testing.assert_allclose(ours.arc, plain.arc, rtol=0.02)


def test_what_is_no_chain_is_refused() -> None:
    with pytest.raises(DataError):
        places_of_graph(FactorGraph(3))
    submaps = submaps_of(square_poses(2, nodes=37), np.random.default_rng(0))
    graph = FactorGraph(2)
    for s in submaps[:2]:
        graph.add_submap(s, spacing=3.0)
    graph.start_session(np.array([3.0, 1.0, 0.0]))
    graph.add_submap(submaps[2], spacing=3.0)
    with pytest.raises(DataError, match="one chain"):
        places_of_graph(graph)


def test_the_chain_of_levelled_submaps_is_what_they_stated() -> None:
    """A levelled exit gave its relative roll and pitch to an attitude: the chain by itself still has them."""
    submaps = submaps_of(square_poses(3, nodes=37), np.random.default_rng(1))
    plain, level = FactorGraph(3), FactorGraph(3)
    for s in submaps:
        plain.add_submap(s, spacing=3.0)
        level.add_submap(s, spacing=3.0, level_sigma=0.006)
    for a, b in zip(chain_of_graph(plain), chain_of_graph(level)):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)
    r = level.records[level.submaps[0].factor_ids[len(level.submaps[0].nodes) - 2]]
    assert isinstance(r, BetweenRecord)
    given_up = np.linalg.inv(r.whitener.T @ r.whitener)
    assert given_up[0, 0] > 100 * chain_of_graph(level)[1][len(level.submaps[0].nodes) - 2][0, 0]
