"""Five methods on one graph, in the plane and in space: one optimum, consistent covariances, clear refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graphslam.app.compare import compare_methods, default_methods
from graphslam.app.join_verdict import compare_verdict
from graphslam.app.submap_sources import submap_source
from graphslam.core.atomic import write_npz
from graphslam.core.errors import ConfigError, DataError, FormatError, MissingDataError, UnknownNameError
from graphslam.core.gaussian import chi2_mean_bounds
from graphslam.core.geometry import Array
from graphslam.core.map_truth import MapTruth
from graphslam.core.submap import Match, Submap
from graphslam.evaluate.consistency import joint_nees, pose_error
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.noise import RobustKernel
from graphslam.io.network_file import read_network
from graphslam.join.graph_file import PARTS, graph_arrays
from graphslam.join.graph_join import (
    GRAPH_JOINERS,
    MOST_STATES,
    GraphEstimate,
    join_graph_sequential,
    join_graph_tree,
    optimise_estimate,
)
from graphslam.join.graph_problem import JoinProblem
from graphslam.join.registry import join_by_method
from graphslam.solve.batch import BatchSolver, optimise_graph
from tests.reference.best_known import BEST_KNOWN
from tests.reference.pose_ramp import pose_ramp

CASES = [{"dim": 2}, {"dim": 3}, {"dim": 3, "level_sigma": 0.01}]
METHODS = ("isam2", "batch", "eif-tree", "eif-sequential", "ekf")


def truth_of(problem: JoinProblem, poses: Array) -> MapTruth:
    exits = poses[problem.bases[1:]]
    none = np.zeros(0, dtype=np.int64)
    return MapTruth(keys=problem.keys, exit_poses=exits, landmark_ids=none, landmarks=np.zeros((0, problem.dim)))


@pytest.mark.parametrize("case", CASES)
def test_five_methods_one_optimum_and_the_price_of_filtering_before_it(case: dict) -> None:
    problem, truth = pose_ramp(2, submaps=7, radians=0.03, **case)  # an odd one goes up the tree by itself
    table = compare_methods(problem, truth=truth_of(problem, truth), memory=False).set_index("method")
    assert list(table.index) == list(METHODS)
    best = table["objective_polished"]["batch"]
    np.testing.assert_allclose(table["objective_polished"], best, rtol=1e-9)
    assert (table["objective"].drop("batch") > best * (1 + 1e-7)).all()
    assert table["converged"].all()
    np.testing.assert_allclose(table["nees"], table["nees"]["batch"], rtol=1e-4)
    assert table["nees_unpolished"]["eif-tree"] != pytest.approx(table["nees"]["batch"], rel=1e-6)
    d, n = problem.group.dof, len(problem.times)
    levels = problem.factor_counts().get("levelled", 0)
    assert set(table["states"]) == {d * (n - 1) + 2 * (levels > 0)}
    assert set(table["nees_dof"]) == {d * len(problem.keys)}
    assert set(table["dof"]) == {d * problem.factor_counts()["between"] + 2 * levels - problem.states}
    assert set(table["factors"]) == {", ".join(f"{k} {v}" for k, v in problem.factor_counts().items())}


@pytest.mark.parametrize("case", CASES)
def test_the_filter_in_sequence_is_the_dense_filter(case: dict) -> None:
    problem, _ = pose_ramp(6, submaps=5, radians=0.05, **case)
    sparse, dense = join_graph_sequential(problem, passes=1), join_by_method(problem, "ekf")
    np.testing.assert_allclose(dense.poses, sparse.poses, atol=1e-9)
    assert sparse.information.shape == (problem.states, problem.states) == (sparse.states, dense.states)
    if "levelled" in problem.factor_counts():
        np.testing.assert_allclose(dense.values.tilt, sparse.values.tilt, atol=1e-9)
        assert np.abs(sparse.values.tilt).max() > 1e-4
    P = dense.covariance
    np.testing.assert_allclose(P, P.T, atol=1e-12 * np.abs(P).max())
    np.testing.assert_allclose(P, np.linalg.inv(sparse.information.toarray()), atol=1e-8 * np.abs(P).max())
    k = len(problem.times) - 1
    np.testing.assert_allclose(sparse.pose_covariance(k), dense.pose_covariance(k), atol=1e-8 * np.abs(P).max())


def test_more_passes_come_nearer_to_the_optimum() -> None:
    problem, _ = pose_ramp(3, submaps=8, loops=40, radians=0.03)
    for join in (join_graph_tree, join_graph_sequential):
        once, thrice = join(problem), join(problem, passes=3)
        best = optimise_estimate(problem, once).objective_polished
        assert once.objective - best > 3 * (thrice.objective - best) > 0


def test_where_loops_bend_each_submap_only_the_refinement_helps() -> None:
    problem, _ = pose_ramp(7, submaps=10, loops=60, radians=0.1)
    tree = join_graph_tree(problem, passes=1)
    best = optimise_estimate(problem, tree)
    assert tree.objective > 1.2 * best.objective_polished
    assert best.objective_polished == pytest.approx(join_by_method(problem, "batch").objective, rel=1e-8)


@pytest.mark.parametrize("case", CASES)
def test_covariances_are_consistent(case: dict) -> None:
    """Joint NEES of all nodes over 16 draws, two-sided; and a covariance a third too small fails."""
    values: dict[str, list[float]] = {m: [] for m in METHODS}
    dof = 0
    for seed in range(16):
        problem, truth = pose_ramp(
            100 + seed, submaps=4, steps=4, around=8, loops=8, radians=0.005, metres=0.03, **case
        )
        dof = problem.group.dof * (len(truth) - 1)
        for method in METHODS:
            found = join_by_method(problem, method, polish=method == "isam2")
            error = pose_error(found.poses[1:], truth[1:]).ravel()
            P = found.covariance_block(np.arange(dof))
            values[method].append(joint_nees(error, covariance=P))
    low, high = chi2_mean_bounds(
        dof, 16, confidence=0.999
    )  # five methods, three cases: one test in 67 would be unlucky
    for method, nees in values.items():
        assert low < np.mean(nees) < high, method
        assert not low < np.mean(nees) * 1.5 < high


def test_relative_poses_enter_whatever_their_direction_and_order() -> None:
    problem, _ = pose_ramp(9, submaps=6, loops=20)
    rng = np.random.default_rng(0)
    g, order = problem.group, rng.permutation(len(problem.factors))
    graph = FactorGraph.with_values(problem.graph.values.copy())
    for number, k in enumerate(order.tolist()):
        r = problem.factors[k]
        if rng.random() < 0.5:  # the residual of the inverse is -Ad(T) that of the measurement
            W = r.whitener @ g.adjoint(g.inverse(r.T_ij))
            r = replace(r, i=r.j, j=r.i, T_ij=g.inverse(r.T_ij), whitener=np.linalg.cholesky(W.T @ W).T)
        graph.insert(replace(r, factor_id=number))
    other = replace(problem, graph=graph)
    a, b = join_by_method(problem, "batch"), join_by_method(other, "batch")
    np.testing.assert_allclose(a.poses, b.poses, atol=1e-7)
    for method in ("eif-tree", "eif-sequential"):
        there, here = join_by_method(other, method), join_by_method(problem, method)
        assert there.objective == pytest.approx(here.objective, rel=1e-7)
        np.testing.assert_allclose(there.poses, here.poses, atol=1e-6)


def dense_submaps(dim: int = 3) -> tuple[list[Submap], JoinProblem]:
    """The ramp as submaps: exits with covariances, and its loops between bases as matches."""
    problem, _ = pose_ramp(12, dim=dim, submaps=10, steps=1, around=4, loops=6)
    g = problem.group
    matches: dict[int, list[Match]] = {}
    exits = {}
    for r in problem.factors:
        i, j, T, C = r.i, r.j, r.T_ij, np.linalg.inv(r.whitener.T @ r.whitener)
        if i > j:
            Ad = g.adjoint(T)
            i, j, T, C = j, i, g.inverse(T), Ad @ C @ Ad.T
        if j - i == 1 and i not in exits:
            exits[i] = T, C
        elif j - i > 1 and j < 10:
            matches.setdefault(j, []).append(Match(target=i, T_target_here=T, covariance=C, fitness=0.9, support=0.9))
    submaps = [
        Submap(
            key=k, interval=(float(k), k + 1.0), exit_pose=exits[k][0], exit_covariance=exits[k][1],
            matches=tuple(matches.get(k, ())),
        )
        for k in range(10)
    ]  # fmt: skip
    return submaps, problem


@pytest.mark.parametrize("dim", [2, 3])
def test_submaps_are_joined_by_their_exits_and_matches(dim: int) -> None:
    submaps, problem = dense_submaps(dim)
    assert any(s.matches for s in submaps)
    found = join_by_method(submaps, "eif-tree", polish=True)
    assert isinstance(found, GraphEstimate)
    assert found.states == problem.group.dof * 10
    graph = FactorGraph(dim)
    for s in submaps:
        graph.add_submap(s)
        for m in s.matches:
            graph.add_match(s.key, m)
    best = optimise_graph(graph)
    assert found.objective_polished == pytest.approx(best.objective, rel=1e-9)
    np.testing.assert_allclose(found.poses, best.values.poses, atol=1e-6)
    wide = join_by_method(submaps, "eif-tree", polish=True, covariance_scale=4.0)
    assert wide.objective_polished < found.objective_polished
    doubted = [replace(s, matches=tuple(replace(m, support=0.1) for m in s.matches)) for s in submaps]
    assert join_by_method(doubted, "batch").problem.dof == 0


def test_robust_kernels_stay_robust() -> None:
    """Wrong loops keep their kernels in every method: the optimum is that of the graph."""
    submaps, problem = dense_submaps()
    graph = FactorGraph(3)
    for s in submaps:
        graph.add_submap(s)
    far = problem.group.exp(np.array([0, 0, 1.0, 3, 3, 0]))
    for i, j in ((0, 6), (1, 9)):
        graph.add_between(i, j, far, 1e-2 * np.eye(6), evidence="shared-scan", robust=RobustKernel("cauchy", 1.0))
    BatchSolver(graph).solve_to_optimum()
    table = compare_methods(JoinProblem.of_graph(graph), memory=False)
    np.testing.assert_allclose(table["objective_polished"], graph.objective().total, rtol=1e-9)


def test_what_cannot_be_joined_is_refused_in_one_line() -> None:
    submaps, problem = dense_submaps()
    refused = [
        (lambda: join_by_method(problem, "eif-tree-classical"), UnknownNameError, "classical"),
        (lambda: compare_methods(problem, ["magic"], memory=False), UnknownNameError, "magic"),
        (lambda: join_by_method(problem, "eif-tree", associate="joint"), ConfigError, "only landmark submaps"),
        (lambda: join_by_method(problem, "eif-tree", workers=2), ConfigError, "one process"),
        (lambda: join_by_method(problem, "eif-tree", covariance_scale=2.0), ConfigError, "scale 1"),
        (lambda: JoinProblem.of_graph(FactorGraph(3)), DataError, "no submaps"),
        (lambda: two_sessions(submaps), DataError, "one chain"),
    ]
    for call, kind, message in refused:
        with pytest.raises(kind, match=message) as error:
            call()
        assert "\n" not in str(error.value)
    large, _ = pose_ramp(1, dim=3, submaps=2, steps=MOST_STATES // 12 + 1, loops=0)
    with pytest.raises(DataError, match="no room"):
        join_by_method(large, "ekf")
    assert default_methods(large) == tuple(m for m in METHODS if m != "ekf")
    assert default_methods(problem) == METHODS


def two_sessions(submaps: list[Submap]) -> JoinProblem:
    graph = FactorGraph(3)
    for s in submaps[:3]:
        graph.add_submap(replace(s, matches=()))
    graph.start_session(graph.values.poses[0])
    for s in submaps[3:6]:
        graph.add_submap(replace(s, matches=()))
    return JoinProblem.of_graph(graph)


def test_a_problem_on_disk_is_the_same_problem(tmp_path: Path) -> None:
    problem, _ = pose_ramp(5, level_sigma=0.01)
    problem.save(tmp_path / "p.npz")
    again = JoinProblem.load(tmp_path / "p.npz")
    assert again.factor_counts() == problem.factor_counts()
    assert join_by_method(again, "eif-tree").objective == join_by_method(problem, "eif-tree").objective
    part = problem.first_submaps(3)
    assert part.keys.tolist() == [0, 1, 2]
    assert len(part.graph.values.poses) == part.bases[-1] + 1


@pytest.mark.parametrize("name", ["dim", "values.x", "order", "columns", "BetweenRecord.T_ij", "BetweenRecord.i"])
def test_a_damaged_graph_file_is_refused(tmp_path: Path, name: str) -> None:
    problem, _ = pose_ramp(5, submaps=2)
    arrays = graph_arrays(problem.graph, {p: getattr(problem, p) for p in PARTS})
    assert name in arrays
    write_npz(tmp_path / "missing.npz", {k: v for k, v in arrays.items() if k != name})
    with pytest.raises(FormatError, match="graph cannot be read"):
        JoinProblem.load(tmp_path / "missing.npz")


def test_a_graph_file_of_variables_that_are_not_there_is_refused(tmp_path: Path) -> None:
    problem, _ = pose_ramp(5, submaps=2)
    arrays = graph_arrays(problem.graph, {p: getattr(problem, p) for p in PARTS})
    write_npz(tmp_path / "short.npz", arrays | {"values.x": arrays["values.x"][:-1]})
    with pytest.raises(FormatError, match="has no value"):
        JoinProblem.load(tmp_path / "short.npz")


@pytest.mark.parametrize(
    ("name", "submaps", "tree", "sequence"), [("parking-garage", 34, 1.664, 1.493), ("sphere2500", 50, 1771, 1436)]
)
def test_published_graphs_cut_into_submaps(
    data_dir: Path, name: str, submaps: int, tree: float, sequence: float
) -> None:
    file = f"posegraphs/{name}.g2o.xz"
    problem = JoinProblem.of_network(read_network(data_dir / file), 50)
    assert len(problem.keys) == submaps
    own = GRAPH_JOINERS["eif-tree"](problem)
    assert own.objective < tree
    assert join_graph_sequential(problem).objective < sequence
    best = optimise_estimate(problem, own)
    assert best.converged
    assert best.objective_polished == pytest.approx(BEST_KNOWN[file], rel=1e-6)


def test_a_pose_graph_file_is_cut_where_it_is_named(data_dir: Path) -> None:
    found = submap_source(data_dir / "posegraphs/intel.g2o.xz", submap_poses=100)
    assert len(found.material.keys) == 18
    table = compare_methods(found.material, ["eif-tree", "batch"], memory=False)
    np.testing.assert_allclose(table["objective_polished"], BEST_KNOWN["posegraphs/intel.g2o.xz"], rtol=1e-6)
    assert found.times == list(range(1728))
    with pytest.raises(MissingDataError, match="cut into some by --submap-poses"):
        submap_source(data_dir / "posegraphs/intel.g2o.xz")


def test_methods_that_end_apart_are_reported() -> None:
    def rows(*ends: float | None) -> list[dict]:
        return [{"method": m, "objective_polished": e} for m, e in zip(METHODS, ends)]

    assert compare_verdict(rows(3.0, None)) == []
    (same,), (apart,) = compare_verdict(rows(3.0, 3.0 + 1e-7)), compare_verdict(rows(4.0, 3.0, 3.0))
    assert "the same for all 2 methods" in same.text
    assert "χ² 3 (batch, eif-tree) to 4" in apart.text
    assert apart.level == "look"


def test_pose_graph_files_that_cannot_be_cut(data_dir: Path) -> None:
    network = read_network(data_dir / "posegraphs/intel.g2o.xz")
    with pytest.raises(DataError, match="no step"):
        JoinProblem.of_network(network, 0)
    with pytest.raises(DataError, match="one vertex"):
        JoinProblem.of_network(replace(network, fixed=np.arange(len(network)) < 2), 50)
    chain = np.abs(np.diff(network.edges, axis=1).ravel()) == 1
    keep = ~(chain & (network.edges.min(axis=1) == 41))
    cut = replace(
        network, edges=network.edges[keep], measurements=network.measurements[keep],
        information=network.information[keep],
    )  # fmt: skip
    with pytest.raises(DataError, match="nodes 41 and 42 are not tied to each other"):
        JoinProblem.of_network(cut, 50)
