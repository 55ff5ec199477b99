"""Graphs in space: tangent order, Jacobians, GTSAM's own answer, removing, sessions, marginals against Monte Carlo."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from graphslam.core.errors import DataError, GeometryError, IndeterminateError
from graphslam.core.gaussian import chi2_mean_bounds
from graphslam.core.poses import SE3
from graphslam.core.records import Gps
from graphslam.core.submap import Match, Submap
from graphslam.graph.covariance import JointCovariance
from graphslam.graph.factor_arrays import FactorArrays
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.attitude import AttitudeRecord
from graphslam.graph.factors.batch import gtsam_factor, gtsam_pose, pose_array
from graphslam.graph.factors.between import BetweenRecord
from graphslam.graph.factors.gps import BiasPriorRecord, GpsRecord
from graphslam.graph.gtsam_values import from_gtsam
from graphslam.graph.network import to_network
from graphslam.graph.noise import NO_KERNEL, RobustKernel, robust_terms, whitener
from graphslam.graph.sensors.gps import GpsConfig
from graphslam.graph.variables import Values, gtsam_key, key_name
from graphslam.io.g2o import read_g2o, write_g2o
from graphslam.solve.batch import BatchSolver, linearisation_gap
from graphslam.solve.isam2 import Isam2Solver
from tests.reference.gtsam_optimum import optimise_with_gtsam
from tests.reference.gtsam_twin import to_gtsam
from tests.reference.space_chain import DenseChain, dense_chain

C = np.diag([1e-4, 2e-4, 4e-4, 1e-2, 2e-2, 3e-2])


def random_poses(rng: np.random.Generator, n: int) -> np.ndarray:
    return SE3.exp(rng.normal(size=(n, 6)) * [0.6, 0.6, 0.9, 3.0, 3.0, 1.0])


def loop_graph(chain: DenseChain, rng: np.random.Generator, robust: RobustKernel = NO_KERNEL, update=lambda g: None):
    g = FactorGraph(dim=3)
    for s in chain.submaps:
        g.add_submap(s)
        update(g)
    L = np.linalg.cholesky(C)
    for i, j in ((0, len(chain.poses) - 2), (1, len(chain.poses) - 1), (len(chain.poses) - 1, 0)):
        T = SE3.compose(SE3.between(chain.poses[i], chain.poses[j]), SE3.exp(L @ rng.standard_normal(6)))
        g.add_between(i, j, T, C, evidence="shared-scan", robust=robust)
        update(g)
    return g


def rich_records(rng: np.random.Generator) -> tuple[list, Values]:
    """Every kind of factor in space, both ends of the fixed base, kernels, values away from any optimum."""
    values = Values.empty(3)
    values.poses = np.vstack([values.poses, random_poses(rng, 4)])
    values.datum = np.array([3.0, -2.0, 1.0, 2.5])
    values.biases = rng.normal(size=(2, 3))
    values.tilt = np.array([0.08, -0.05])

    def W(n):
        return np.tril(rng.normal(size=(n, n))) + 2 * np.eye(n)

    near = SE3.compose(SE3.between(values.poses[1], values.poses[3]), SE3.exp(0.3 * rng.normal(size=6)))
    direction = rng.normal(size=(2, 3)) * 0.2 + [0, 0, -1.0]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    arm, z = rng.normal(size=(4, 3)), 5 * rng.normal(size=(4, 3))
    records = [
        BetweenRecord(0, 1, 3, near, W(6), RobustKernel("huber", 1.0)),
        BetweenRecord(1, 0, 2, SE3.between(values.poses[0], random_poses(rng, 1)[0]), W(6)),
        BetweenRecord(2, 4, 0, SE3.inverse(values.poses[4]) + 0.0, W(6)),
        GpsRecord(3, 0, 0.0, arm[0], z[0], W(3), bias=1, tilt=True),
        GpsRecord(4, 2, 1.0, arm[1], z[1], W(3), RobustKernel("cauchy", 1.0)),
        GpsRecord(5, 3, 2.0, arm[2], z[2], W(3), bias=0),
        GpsRecord(6, 4, 3.0, arm[3], z[3], W(3), tilt=True),
        BiasPriorRecord(7, 0, 0.5, dim=3),
        BiasPriorRecord(8, 1, 0.7, dim=3),
        AttitudeRecord(9, 0, direction[0], W(2)),
        AttitudeRecord(10, 3, direction[1], W(2), RobustKernel("huber", 0.5)),
    ]
    return records, values


def test_a_pose_tangent_is_gtsams_rotation_first(rng):
    """Exp, Local, adjoint and covariances of GTSAM's Pose3 are in the order of core/se3: rotation, translation."""
    xi = np.array([0.3, -0.2, 0.5, 1.0, 2.0, -3.0])
    np.testing.assert_allclose(pose_array(gtsam.Pose3.Expmap(xi)), SE3.exp(xi), atol=1e-14)
    T = random_poses(rng, 1)[0]
    np.testing.assert_allclose(gtsam_pose(T).retract(xi).matrix(), gtsam_pose(SE3.compose(T, SE3.exp(xi))).matrix())
    np.testing.assert_allclose(gtsam_pose(T).AdjointMap(), SE3.adjoint(T), atol=1e-12)
    # a covariance goes in and comes out by the same places
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    factors.push_back(gtsam_factor(BetweenRecord(0, 0, 1, T, whitener(C)), {"x0": SE3.identity}))
    values.insert(gtsam_key("x1"), gtsam_pose(T))
    np.testing.assert_allclose(
        gtsam.Marginals(factors, values).marginalCovariance(gtsam_key("x1")), C, rtol=1e-9, atol=1e-15
    )
    g = FactorGraph(dim=3)
    g.add_submap(Submap(key=0, interval=(0, 1), exit_pose=T, exit_covariance=C))
    np.testing.assert_allclose(g.covariance().marginal("x1"), C, rtol=1e-9, atol=1e-15)
    # and position and rotation are not alike: 1 m of σ_x is 10 mrad of roll here
    assert C[0, 0] != C[3, 3]


def test_gradient_and_matrix_against_finite_differences(rng):
    records, values = rich_records(rng)
    flat = FactorArrays(records, values.layout())
    n, h = flat.layout.size, 1e-6
    assert n == 4 * 6 + 4 + 2 * 3 + 2
    system = flat.evaluate(values, dense=True)
    np.testing.assert_allclose(flat.evaluate(values, dense=False).A.toarray(), system.A, rtol=1e-12, atol=1e-9)

    def residuals(v):
        rows = []
        for batch in flat.batches:
            if len(batch):
                rows.append((batch.whitened(v)[0], batch))
        return rows

    w = [np.sqrt(_weights(batch, r)) for r, batch in residuals(values)]
    J, gradient = [], []
    for c in range(n):
        step = np.zeros(n)
        step[c] = h
        plus, minus = values.retract(step), values.retract(-step)
        J.append(
            np.concatenate(
                [
                    (wk[:, None] * (a - b)).ravel()
                    for wk, (a, _), (b, _) in zip(w, residuals(plus), residuals(minus), strict=True)
                ]
            )
            / (2 * h)
        )
        up, down = (flat.evaluate(v, hessian=False).objective for v in (plus, minus))
        gradient.append((up - down) / (4 * h))
    J = np.array(J).T
    scale = np.sqrt(np.diag(system.A))
    np.testing.assert_allclose(system.A / np.outer(scale, scale), (J.T @ J) / np.outer(scale, scale), atol=1e-6)
    np.testing.assert_allclose(system.g / scale, np.array(gradient) / scale, atol=1e-4)


def _weights(batch, r):
    return robust_terms(np.sum(r**2, axis=1), batch.code, batch.k)[1]


def test_every_factor_is_gtsams(rng):
    """Residuals of the flat system and of the GTSAM factors, and their linearisation, factor by factor."""
    records, values = rich_records(rng)
    theirs, layout = to_gtsam(values), values.layout()
    for record in records:
        factor = gtsam_factor(record, {"x0": values.poses[0]})
        one = FactorArrays([record], layout).evaluate(values, dense=True)
        assert 2 * factor.error(theirs) == pytest.approx(one.objective, rel=1e-9), record.label()
        gaussian = factor.linearize(theirs)
        A, b = gaussian.jacobian()
        columns = np.concatenate([layout.columns(key_name(k)) for k in list(factor.keys())])
        np.testing.assert_allclose(
            A.T @ A, one.A[np.ix_(columns, columns)], rtol=1e-6, atol=1e-7, err_msg=record.label()
        )
        np.testing.assert_allclose(-A.T @ b, one.g[columns], rtol=1e-6, atol=1e-6, err_msg=record.label())


def test_values_go_to_gtsam_and_back(rng):
    _, values = rich_records(rng)
    back = from_gtsam(to_gtsam(values), values)
    for name in ("poses", "datum", "biases", "tilt"):
        np.testing.assert_allclose(getattr(back, name), getattr(values, name), atol=1e-14)
    names = values.layout().names()
    assert [key_name(gtsam_key(n)) for n in names] == names


@pytest.mark.parametrize("robust", [RobustKernel(), RobustKernel("cauchy", 1.0)], ids=lambda r: r.kind)
def test_isam2_batch_and_gtsam_agree(rng, robust):
    chain = dense_chain(rng, noise=2.0)
    seed = int(rng.integers(1 << 30))
    solvers: dict[int, Isam2Solver] = {}
    g = loop_graph(
        chain, np.random.default_rng(seed), robust, lambda g: solvers.setdefault(id(g), Isam2Solver(g)).update()
    )
    incremental = solvers[id(g)]
    assert linearisation_gap(incremental.graph) < 0.1 * g.objective().total
    incremental.solve_to_optimum()
    b = loop_graph(chain, np.random.default_rng(seed), robust)
    BatchSolver(b).solve_to_optimum()
    theirs, objective = optimise_with_gtsam(b)
    tolerance = 1e-9 if robust.kind == "none" else 2e-6
    assert g.objective().total == pytest.approx(b.objective().total, rel=1e-9)
    assert objective == pytest.approx(b.objective().total, rel=1e-9)
    np.testing.assert_allclose(g.values.poses, b.values.poses, atol=tolerance)
    np.testing.assert_allclose(theirs.poses, b.values.poses, atol=10 * tolerance)
    assert incremental.solution().converged
    assert b.objective()["dense-submap"].factors == 6
    assert b.objective().dof == 9 * 6 - 6 * 6


def test_marginals_are_gtsams_and_those_of_a_monte_carlo(rng):
    chain = dense_chain(rng, m=4, steps=16, noise=0.0)
    reference = loop_graph(chain, np.random.default_rng(0))
    for k in [r.factor_id for r in reference.records.values() if r.group == "between"][1:]:
        reference.remove(k)
    BatchSolver(reference).solve_to_optimum()
    factors = gtsam.NonlinearFactorGraph()
    for r in reference.records.values():
        factors.push_back(gtsam_factor(r, {"x0": reference.origin}))
    marginals = gtsam.Marginals(factors, to_gtsam(reference.values))
    for name in ("x1", "x3"):
        ours = reference.covariance().marginal(name)
        np.testing.assert_allclose(ours, marginals.marginalCovariance(gtsam_key(name)), rtol=1e-6, atol=1e-14)
    runs, d2 = 80, []
    for _ in range(runs):
        drawn = dense_chain(rng, m=4, steps=16)
        g = loop_graph(drawn, rng)
        BatchSolver(g).solve_to_optimum()
        e = SE3.log(SE3.between(g.values.poses[1:], drawn.poses[1:]))
        P = g.covariance().full()
        d2.append(float(e.ravel() @ np.linalg.solve(P, e.ravel())))
    low, high = chi2_mean_bounds(24, runs, 0.99)
    assert low < np.mean(d2) < high


def test_cross_covariances_dense_and_sparse(rng):
    chain = dense_chain(rng, m=14, steps=6)
    g = loop_graph(chain, rng)
    full = g.covariance().full()
    i, j = np.array([0, 1, 5, 13, 2]), np.array([1, 2, 6, 14, 9])
    for dense in (True, False):
        P = JointCovariance(g.flat().layout, g.flat().evaluate(g.values, dense=dense).A).cross(i, j)
        np.testing.assert_array_equal(P[0], 0.0)
        for k in range(1, 5):
            block = full[np.ix_(g.flat().layout.columns(f"x{i[k]}"), g.flat().layout.columns(f"x{j[k]}"))]
            np.testing.assert_allclose(P[k], block, rtol=1e-6, atol=1e-12)


def test_match_joins_the_bases(rng):
    chain = dense_chain(rng, m=4)
    g = FactorGraph(dim=3)
    for s in chain.submaps:
        g.add_submap(s)
    T = SE3.between(chain.poses[0], chain.poses[3])
    fid = g.add_match(3, Match(target=0, T_target_here=T, covariance=C, fitness=0.9, support=0.8))
    record = g.records[fid]
    assert (record.i, record.j, record.group) == (0, 3, "match")
    assert g.events[-1]["support"] == 0.8
    BatchSolver(g).solve_to_optimum()
    assert g.objective()["match"].rows == 6


def test_removing_gives_back_what_was_before(rng):
    chain = dense_chain(rng, m=6)
    g = FactorGraph(dim=3)
    solver = Isam2Solver(g)
    for s in chain.submaps[:5]:
        g.add_submap(s)
        solver.update()
    before = g.values.poses.copy(), len(g.ledger), len(g.records)
    fid = g.add_between(0, 4, SE3.exp([0.5, 0, 0, 9.0, 0, 0]), 1e-3 * C, evidence="shared-scan")
    solver.update()
    assert np.abs(g.values.poses - before[0]).max() > 0.01
    g.remove(fid)
    solver.solve_to_optimum()  # so far from where it linearised, one incremental step does not come back
    np.testing.assert_allclose(g.values.poses, before[0], atol=1e-8)
    last = g.add_submap(chain.submaps[5])
    g.remove(last)
    assert (len(g.values.poses), len(g.ledger), len(g.records)) == (len(before[0]), before[1], before[2])
    g.remove(g.submaps[2].factor_id)
    assert g.diagnose().unconstrained == ("x3", "x4", "x5")
    with pytest.raises(IndeterminateError, match="x3 is not connected to x2"):
        solver.update()


def test_another_session_is_tied_by_a_between_factor(rng):
    chain = dense_chain(rng, m=5)
    g = FactorGraph(dim=3)
    for s in chain.submaps[:3]:
        g.add_submap(s)
    start = g.start_session(SE3.compose(chain.poses[3], SE3.exp([0, 0, 0.2, 1.0, 0, 0])))
    for s in chain.submaps[3:]:
        g.add_submap(s)
    assert not g.diagnose().ok
    g.add_between(1, start, SE3.between(chain.poses[1], chain.poses[3]), C, evidence="shared-scan")
    BatchSolver(g).solve_to_optimum()
    assert g.diagnose().ok
    assert np.abs(SE3.log(SE3.between(g.values.poses[start], chain.poses[3]))).max() < 0.5


def test_what_a_graph_in_space_refuses(rng):
    g = FactorGraph(dim=3)
    with pytest.raises(GeometryError, match="wrong dimension"):
        g.add_submap(Submap(key=0, interval=(0, 1), exit_pose=np.zeros(3), exit_covariance=np.eye(3)))
    g.add_submap(Submap(key=0, interval=(0, 1), exit_pose=SE3.exp([0, 0, 0, 1.0, 0, 0]), exit_covariance=C))
    with pytest.raises(GeometryError, match="seven finite numbers"):
        g.add_between(0, 1, np.zeros(3), C, evidence="shared-scan")
    with pytest.raises(GeometryError, match="quaternion"):
        g.add_between(0, 1, np.zeros(7), C, evidence="shared-scan")
    with pytest.raises(DataError, match="wrong shape"):
        g.add_between(0, 1, SE3.identity, np.eye(3), evidence="shared-scan")
    with pytest.raises(GeometryError, match="dimension"):
        g.add_sensor(
            Gps(times=[0.0], positions=np.zeros((1, 2)), sigma=np.ones(1), lever=np.zeros(2)), config=GpsConfig()
        )


def test_network_in_space_is_the_same_problem(rng, tmp_path):
    chain = dense_chain(rng, m=4)
    g = loop_graph(chain, rng)
    BatchSolver(g).solve_to_optimum()
    write_g2o(tmp_path / "graph.g2o", to_network(g))
    back = read_g2o(tmp_path / "graph.g2o")
    e = SE3.log(SE3.between(back.measurements, SE3.between(back.poses[back.edges[:, 0]], back.poses[back.edges[:, 1]])))
    objective = np.einsum("ki,kij,kj->", e, back.information, e)
    assert objective == pytest.approx(g.objective().total, rel=1e-6)
    assert "VERTEX_SE3:QUAT" in (tmp_path / "graph.g2o").read_text()
