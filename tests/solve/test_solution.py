"""Solution: covariances, full-rate trajectory, GPS frame, independence of the graph."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.errors import MissingDataError, SolverError
from graphslam.core.geometry import se2_between, se2_compose, se2_exp, se2_log
from graphslam.graph.covariance import JointCovariance
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.variables import gtsam_key, key_name
from graphslam.solve.batch import BatchSolver
from tests.reference.graph_chain import dense_submap, make_chain, make_gps

DATUM = np.array([100.0, 20.0, -1.0])


@pytest.fixture
def solved(rng):
    chain = make_chain(rng, m=8, landmarks=20)
    g = FactorGraph()
    g.add_sensor(make_gps(chain, rng, DATUM, step=3.0))
    for s in chain.submaps:
        g.add_submap(s)
    solver = BatchSolver(g)
    solver.update()
    return chain, g, solver.solution()


def test_marginals_are_blocks_of_the_dense_inverse(solved):
    _, g, solution = solved
    lay = g.flat().layout
    P = np.linalg.inv(g.flat().evaluate(g.values, dense=True).A)
    landmark = f"l{g.values.landmark_ids[3]}"
    for names in (["x3"], [landmark], ["datum"], ["x8", landmark, "x1"]):
        c = lay.columns_of(names)
        np.testing.assert_allclose(solution.joint_marginal(names), P[np.ix_(c, c)], rtol=1e-7, atol=1e-12)
    np.testing.assert_array_equal(solution.joint_marginal([1, 2]), solution.joint_marginal(["x1", "x2"]))
    np.testing.assert_array_equal(
        solution.joint_marginal([gtsam_key("x2"), gtsam_key(landmark)]), solution.joint_marginal([2, landmark])
    )
    rows, columns = lay.columns(landmark), lay.columns("x3")
    np.testing.assert_allclose(solution.covariance(landmark, 3), P[np.ix_(rows, columns)], rtol=1e-7, atol=1e-12)
    np.testing.assert_array_equal(solution.covariance(3, landmark), solution.covariance(landmark, 3).T)
    np.testing.assert_array_equal(solution.covariance(landmark, 0), np.zeros((2, 3)))
    with pytest.raises(SolverError, match=r"no variable 1\.5"):
        solution.covariance(1.5)
    for k, C in enumerate(solution.node_covariances()[1:]):
        np.testing.assert_allclose(C, P[3 * k : 3 * k + 3, 3 * k : 3 * k + 3], rtol=1e-7, atol=1e-12)
    for r, C in enumerate(solution.landmark_covariances()):
        c = lay.landmark_start + 2 * r
        np.testing.assert_allclose(C, P[c : c + 2, c : c + 2], rtol=1e-7, atol=1e-12)
    np.testing.assert_array_equal(solution.covariance("x0"), np.zeros((3, 3)))
    with pytest.raises(SolverError, match="no variable 'x99'"):
        solution.covariance("x99")
    with pytest.raises(SolverError, match="no variable 'banana'"):
        solution.covariance("banana")


def test_sparse_covariances_are_the_dense_ones(solved):
    _, g, _ = solved
    flat = g.flat()
    dense = JointCovariance(flat.layout, flat.evaluate(g.values, dense=True).A)
    sparse = JointCovariance(flat.layout, flat.evaluate(g.values, dense=False).A)
    kw = {"rtol": 1e-7, "atol": 1e-12}
    np.testing.assert_allclose(sparse.full(), dense.full(), **kw)
    np.testing.assert_allclose(sparse.poses(), dense.poses(), **kw)
    np.testing.assert_allclose(sparse.landmarks(), dense.landmarks(), **kw)
    x, f = flat.layout.columns("x5"), flat.layout.landmark_start + 2 * np.arange(len(g.values.landmarks))
    for a, b in zip(sparse.pose_and_points(x, f), dense.pose_and_points(x, f)):
        np.testing.assert_allclose(a, b, **kw)


def test_joint_covariance_is_in_vector_form(solved):
    """A rotation of every pose block, checked on one pose by hand."""
    _, g, solution = solved
    P = solution.joint_covariance()
    n = 3 * 8 + 2 * len(g.values.landmarks)
    assert P.shape == (n, n)
    t = g.values.poses[4, 2]
    G = np.array([[np.cos(t), -np.sin(t), 0], [np.sin(t), np.cos(t), 0], [0, 0, 1]])
    np.testing.assert_allclose(P[9:12, 9:12], G @ solution.covariance("x4") @ G.T, rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(P[24:26, 24:26], solution.landmark_covariances()[0], rtol=1e-9)


def test_trajectory_is_node_after_local_path(solved):
    chain, g, solution = solved
    path = solution.trajectory()
    assert np.all(np.diff(path.times) > 0)
    assert len(path) == 8 * 10 + 1  # 11 samples each, a shared instant counted once
    s = chain.submaps[5]
    k = np.searchsorted(path.times, 54.0)
    np.testing.assert_allclose(path.poses[k], se2_compose(g.values.poses[5], s.trajectory.poses[4]), atol=1e-12)
    node = np.searchsorted(path.times, 50.0)  # on a boundary the later submap has it: the node itself
    np.testing.assert_allclose(path.poses[node], g.values.poses[5], atol=1e-12)
    np.testing.assert_allclose(
        path.covariances[node], solution.covariance("x5") + s.trajectory.covariances[0], rtol=1e-6
    )
    assert solution.trajectory(covariances=False).covariances is None


def test_trajectory_covariance_by_monte_carlo(solved, rng):
    chain, g, solution = solved
    local = chain.submaps[5].trajectory
    P, C, T = solution.covariance("x5"), local.covariances[6], local.poses[6]
    node = se2_compose(g.values.poses[5], se2_exp(rng.multivariate_normal(np.zeros(3), P, 100_000)))
    body = se2_compose(node, se2_compose(T, se2_exp(rng.multivariate_normal(np.zeros(3), C, 100_000))))
    xi = se2_log(se2_between(se2_compose(g.values.poses[5], T), body))
    path = solution.trajectory()
    claimed = path.covariances[np.searchsorted(path.times, 56.0)]
    scale = np.sqrt(np.diag(claimed))
    np.testing.assert_allclose(np.cov(xi.T) / np.outer(scale, scale), claimed / np.outer(scale, scale), atol=0.03)


def test_gps_frame_is_the_streams_own(solved):
    _, _, solution = solved
    np.testing.assert_allclose(solution.T_gps_world, DATUM, atol=0.5)


def test_a_solution_outlives_the_graph(solved):
    _, g, solution = solved
    P, poses = solution.covariance("x3").copy(), solution.poses.copy()
    g.merge_landmarks(*map(int, g.values.landmark_ids[:2]))
    g.add_between(0, 3, [50.0, 0, 0], 1e-4 * np.eye(3), evidence="shared-scan")
    BatchSolver(g).update()
    np.testing.assert_array_equal(solution.poses, poses)
    np.testing.assert_allclose(solution.covariance("x3"), P)
    assert "Solution" in solution._repr_html_()


def test_no_trajectory_is_reported():
    g = FactorGraph()
    g.add_submap(dense_submap(0, np.array([1.0, 0, 0]), np.eye(3)))
    solver = BatchSolver(g)
    solver.update()
    with pytest.raises(MissingDataError, match="trajectory"):
        solver.solution().trajectory()


def test_keys_round_trip():
    for name in ("x0", "x12345", "l0", "l987654321", "datum", "bias7"):
        assert key_name(gtsam_key(name)) == name
