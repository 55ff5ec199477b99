"""GPS: residual, arm, datum, queue, boundaries, biases, robust kernels."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from graphslam.core.errors import ConfigError, EvidenceReusedError, GeometryError
from graphslam.core.geometry import se2_compose, se2_exp, se2_transform, wrap_angle
from graphslam.core.records import Gps
from graphslam.core.trajectory import Trajectory
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.batch import gtsam_factor
from graphslam.graph.factors.gps import GpsRecord
from graphslam.graph.noise import RobustKernel
from graphslam.graph.sensors.gps import GpsConfig, GpsFactors
from graphslam.graph.variables import gtsam_key
from graphslam.solve.batch import BatchSolver
from tests.reference.antenna import antenna_in_base
from tests.reference.graph_chain import make_chain, make_gps
from tests.reference.plain_gps import gps_residual

DATUM = np.array([120.0, -40.0, 2.3])


def fixes(g: FactorGraph) -> list[GpsRecord]:
    return [r for r in g.records.values() if isinstance(r, GpsRecord)]


@pytest.mark.parametrize("node", [0, 4])
@pytest.mark.parametrize("bias", [None, 1])
def test_factor_jacobians_by_finite_differences(rng, node, bias):
    W = np.tril(rng.normal(size=(2, 2))) + 2 * np.eye(2)
    record = GpsRecord(0, node, 1.0, np.array([3.0, -1.0]), np.array([8.0, 5.0]), W, bias=bias)
    pose = np.array([4.0, 2.0, 2.0]) if node else np.zeros(3)
    datum, b = np.array([1.0, 2.0, -0.6]), np.array([0.3, -0.7])
    factor = gtsam_factor(record, {"x0": np.zeros(3)})
    values = gtsam.Values()
    state = {"datum": datum}
    if node:
        state[f"x{node}"] = pose
    if bias is not None:
        state[f"bias{bias}"] = b
    for name, v in state.items():
        values.insert(gtsam_key(name), gtsam.Pose2(*v) if len(v) == 3 else v)

    def residual(s):
        return W @ gps_residual(s.get(f"x{node}", pose), s["datum"], s.get(f"bias{bias}", 0 * b), record.arm, record.z)

    np.testing.assert_allclose(factor.unwhitenedError(values), residual(state), atol=1e-12)
    J, columns, h = factor.linearize(values).jacobian()[0], [], 1e-6
    for key in list(factor.keys()):
        name = next(n for n in state if gtsam_key(n) == key)
        for axis in range(len(state[name])):
            e = np.zeros(len(state[name]))
            e[axis] = h
            sides = []
            for sign in (1, -1):
                move = se2_compose(state[name], se2_exp(sign * e)) if len(e) == 3 else state[name] + sign * e
                sides.append(residual({**state, name: move}))
            columns.append((sides[0] - sides[1]) / (2 * h))
    np.testing.assert_allclose(J, np.array(columns).T, atol=1e-7)


def test_residual_is_the_plain_one_rotated(rng):
    """Same norm as T_gps_world x arm + bias - z: the frame of the residual does not matter to a round fix."""
    x, D, b, arm, z = rng.normal(size=3), rng.normal(size=3), rng.normal(size=2), rng.normal(size=2), rng.normal(size=2)
    plain = se2_transform(D, se2_transform(x, arm)) + b - z
    assert np.linalg.norm(gps_residual(x, D, b, arm, z)) == pytest.approx(np.linalg.norm(plain))


def test_arm_covariance_by_monte_carlo(rng):
    T, lever = np.array([2.0, 1.0, 0.8]), np.array([3.0, 1.0])
    C = np.diag([0.04, 0.01, 0.0004])
    path = Trajectory(np.array([0.0, 1.0]), np.array([T, T]), np.array([C, C]))
    arm, cov = antenna_in_base(path, np.array([0.5]), lever)
    np.testing.assert_allclose(arm[0], se2_transform(T, lever))
    draws = se2_transform(se2_compose(T, se2_exp(rng.multivariate_normal(np.zeros(3), C, 200_000))), lever)
    np.testing.assert_allclose(np.cov(draws.T), cov[0], atol=6e-4)


def test_datum_heading_is_recovered(rng):
    chain = make_chain(rng, m=12, landmarks=30)
    g = FactorGraph()
    solver = BatchSolver(g)
    g.add_sensor(make_gps(chain, rng, DATUM, sigma=0.05))
    for s in chain.submaps:
        g.add_submap(s)
        solver.update()
    T = solver.solution().T_gps_world
    sigma = np.sqrt(np.diag(solver.solution().covariance("datum")))
    assert abs(wrap_angle(T[2] - DATUM[2])) < 4 * sigma[2]
    assert sigma[2] < 0.01
    assert np.linalg.norm(T[:2] - DATUM[:2]) < 0.3
    assert 0.7 < g.objective()["gps"].chi2_per_dof < 1.35


def test_fixes_wait_for_the_baseline(rng):
    chain = make_chain(rng, m=10, landmarks=20)
    gps = make_gps(chain, rng, DATUM)
    g = FactorGraph()
    g.add_sensor(gps, config=GpsConfig(baseline=20.0))
    started = None
    for s in chain.submaps:
        g.add_submap(s)
        if g.values.datum is not None and started is None:
            started = s.key
            assert len(fixes(g)) == 10 * (s.key + 1)  # the ones that waited came in together
        if g.values.datum is None:
            assert not fixes(g)
            assert g.covariance() is not None  # and the graph is sound without them
    assert started is not None
    assert started >= 2
    assert any(e["event"] == "datum" for e in g.events)


def test_boundary_fix_belongs_to_one_submap_only(rng):
    chain = make_chain(rng, m=4)
    times = np.array([0.0, 10.0, 20.0, 25.0, 30.0, 40.0])
    gps = Gps(times=times, positions=rng.uniform(0, 50, (6, 2)), sigma=np.full(6, 1.0), lever=np.zeros(2))
    g = FactorGraph()
    g.add_sensor(gps, config=GpsConfig(baseline=0.1))
    for s in chain.submaps:
        g.add_submap(s)
    assert [f.time for f in GpsFactors.of(g).waiting] == [40.0]
    g.finish_sensors()
    assert {r.time: r.node for r in fixes(g)} == {0.0: 0, 10.0: 1, 20.0: 2, 25.0: 2, 30.0: 3, 40.0: 3}


def test_given_late_or_in_portions_it_is_the_same(rng):
    chain = make_chain(rng, m=5)
    gps = make_gps(chain, rng, DATUM)
    results = []
    for mode in range(3):
        g = FactorGraph()
        if mode == 0:
            g.add_sensor(gps)
        for s in chain.submaps:
            g.add_submap(s)
            if mode == 1:
                t0, t1 = s.interval
                g.add_sensor(gps.take((gps.times >= t0) & (gps.times < t1)))
        if mode == 2:
            g.add_sensor(gps)
        solver = BatchSolver(g)
        solver.update()
        results.append((len(fixes(g)), g.values.poses, g.objective().total))
    for other in results[1:]:
        assert other[0] == results[0][0] == 50
        np.testing.assert_allclose(other[1], results[0][1], atol=1e-7)


def test_uncovered_fixes_are_dropped_and_counted(rng):
    chain = make_chain(rng, m=2)
    gps = Gps(times=[-3.0, 5.0, 33.0], positions=np.zeros((3, 2)), sigma=np.ones(3), lever=np.zeros(2))
    g = FactorGraph()
    g.add_sensor(gps)
    for s in chain.submaps:
        g.add_submap(s)
    g.finish_sensors()
    dropped = [e["reason"] for e in g.events if e["event"] == "gps-dropped"]
    assert dropped == ["no submap covers it", "after the last submap"]
    assert not [e for e in g.ledger.entries() if e.stream == "gps" and e.t_start != 5.0]


def test_gps_inside_a_submap_that_used_it_is_refused(rng):
    from dataclasses import replace

    chain = make_chain(rng, m=2)
    greedy = replace(chain.submaps[1], uses=frozenset({"gps", "laser"}))
    gps = make_gps(chain, rng, DATUM)
    g = FactorGraph()
    g.add_submap(chain.submaps[0])
    g.add_submap(greedy)
    revision = g.revision
    with pytest.raises(EvidenceReusedError, match="gps"):
        g.add_sensor(gps)
    assert g.revision == revision
    assert not GpsFactors.of(g).attached
    g.add_sensor(gps.take(gps.times < 10.0))
    with pytest.raises(EvidenceReusedError, match="second time"):
        g.add_sensor(gps.take(gps.times < 10.0))
    h = FactorGraph()  # and the other way round: the submap comes second
    h.add_sensor(gps)
    h.add_submap(chain.submaps[0])
    with pytest.raises(EvidenceReusedError, match="submap 1"):
        h.add_submap(greedy)
    assert len(h.values.poses) == 2


def test_robust_kernel_against_outliers(rng):
    chain = make_chain(rng, m=12, landmarks=30)
    gps = make_gps(chain, rng, DATUM, sigma=0.3)
    wild = gps.positions.copy()
    bad = rng.choice(len(wild), 12, replace=False)
    wild[bad] += rng.uniform(10, 40, (12, 2))
    spoilt = Gps(times=gps.times, positions=wild, sigma=gps.sigma, lever=gps.lever)
    error = {}
    for kind in ("none", "cauchy", "huber"):
        g = FactorGraph()
        g.add_sensor(spoilt, config=GpsConfig(robust=RobustKernel(kind, 1.0)))
        for s in chain.submaps:
            g.add_submap(s)
        BatchSolver(g).update()
        error[kind] = np.sqrt(np.mean(np.sum((g.values.poses - chain.poses)[:, :2] ** 2, axis=1)))
    assert error["cauchy"] < 0.15
    assert error["huber"] < error["none"]
    assert error["none"] > 1.3 * error["cauchy"]


def test_segment_bias_is_estimated_where_revisits_show_it(rng):
    chain = make_chain(rng, m=24, landmarks=40, laps=2.0)
    gps = make_gps(chain, rng, DATUM, sigma=0.1)
    half = gps.times > 120.0
    shifted = gps.positions + np.where(half[:, None], [2.0, -1.0], 0.0)
    keep = (gps.times < 110) | (gps.times > 125)
    gps = Gps(times=gps.times[keep], positions=shifted[keep], sigma=gps.sigma[keep], lever=gps.lever)
    g = FactorGraph()
    g.add_sensor(gps, config=GpsConfig(bias_sigma=2.0, segment_gap=5.0))
    for s in chain.submaps:
        g.add_submap(s)
    BatchSolver(g).update()
    assert g.values.biases.shape == (2, 2)
    np.testing.assert_allclose(g.values.biases[1] - g.values.biases[0], [2.0, -1.0], atol=0.15)
    assert g.objective().dof == sum(r.rows for r in g.records.values()) - g.flat().layout.size


def test_arm_uncertainty_is_added(rng):
    chain = make_chain(rng, m=3)
    g = FactorGraph()
    g.add_sensor(make_gps(chain, rng, DATUM, sigma=0.3), config=GpsConfig(baseline=5.0, sigma=0.2))
    for s in chain.submaps:
        g.add_submap(s)
    first, last = fixes(g)[0], fixes(g)[9]
    for record in (first, last):
        P = np.linalg.inv(record.whitener.T @ record.whitener)
        assert np.all(np.linalg.eigvalsh(P) > 0.04)
    grown = [np.trace(np.linalg.inv(r.whitener.T @ r.whitener)) for r in (first, last)]
    assert grown[1] > grown[0]


def test_bad_input_is_refused(rng):
    g = FactorGraph()
    with pytest.raises(GeometryError, match="dimension"):
        g.add_sensor(Gps(times=[0.0], positions=np.zeros((1, 3)), sigma=np.ones(1), lever=np.zeros(3)))
    with pytest.raises(ConfigError, match=r"gps.baseline"):
        GpsConfig(baseline=-1.0)
