"""Errors of fixes that last: fitted to the log, gated, and then honest."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.backend.fix_errors import GATE, LEAST, _Innovations, fit_fix_errors, spread_fixes
from graphslam.core.geometry import se2_between, se2_compose, se2_exp, se2_transform
from graphslam.core.records import Gps
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.gps_innovation import gps_innovations
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.gps import BiasPriorRecord, GpsRecord
from graphslam.graph.noise import RobustKernel
from graphslam.graph.sensors.gps import GpsConfig
from graphslam.solve.batch import BatchSolver
from graphslam_studies.trust_worlds import correlated

STEP = np.array([0.06, 0.04, np.deg2rad(0.15)])
"""σ of the odometry in a second."""
CAUCHY = RobustKernel("cauchy", 2.385)


def drive(rng: np.random.Generator, errors: np.ndarray, *, every: int = 5) -> tuple[FactorGraph, np.ndarray, Gps]:
    """Dead reckoning with a fix each second whose σ is stated as 1 m: graph, true nodes, fixes."""
    n = len(errors)
    rate = 0.05 * correlated(rng, n, 1.0, 20.0, 1)[:, 0]
    true = np.zeros((n + 1, 3))
    for k in range(n):
        true[k + 1] = se2_compose(true[k], np.array([2.0, 0.0, rate[k]]))
    steps = se2_compose(se2_between(true[:-1], true[1:]), se2_exp(STEP * rng.standard_normal((n, 3))))
    times = np.arange(n) + 0.5
    inside = se2_compose(true[:-1], se2_exp(0.5 * np.array([2.0, 0.0, 0.0])))[:, :2]
    fixes = Gps(
        times=times, positions=se2_transform(np.array([30.0, 5.0, 0.4]), inside) + errors, sigma=np.ones(n),
        lever=np.zeros(2),
    )  # fmt: skip
    graph, P = FactorGraph(), np.diag(STEP**2)
    for k in range(n):
        path = Trajectory(np.array([k, k + 1.0]), np.stack([np.zeros(3), steps[k]]), np.stack([1e-9 * np.eye(3), P]))
        graph.add_submap(
            Submap(key=k, interval=(float(k), k + 1.0), exit_pose=steps[k], exit_covariance=P, trajectory=path)
        )
    return graph, true, fixes


def solved(graph: FactorGraph, fixes: Gps, robust: RobustKernel = CAUCHY) -> FactorGraph:
    graph.add_sensor(fixes, config=GpsConfig(robust=robust))
    graph.finish_sensors()
    BatchSolver(graph).solve_to_optimum()
    return graph


def node_nees(graph: FactorGraph, true: np.ndarray) -> float:
    """Mean NEES/2 of the positions of the nodes in the frame of the fixes."""
    lay, cov = graph.flat().layout, graph.covariance()
    D = graph.values.datum.copy()
    D[:2] += graph.gps_origin
    out = []
    for k in range(5, len(true), 10):
        x = graph.values.poses[k]
        c, s = np.cos(D[2]), np.sin(D[2])
        R = np.array([[c, -s], [s, c]])
        cx, sx = np.cos(x[2]), np.sin(x[2])
        J = np.zeros((2, 6))
        J[:, :2], J[:, 3:5] = R @ np.array([[cx, -sx], [sx, cx]]), R
        J[:, 5] = R @ np.array([-x[1], x[0]])
        columns = np.concatenate([lay.pose_columns(np.array([k]))[0], lay.columns("datum")])
        e = se2_transform(D, x[:2]) - se2_transform(np.array([30.0, 5.0, 0.4]), true[k, :2])
        out.append(e @ np.linalg.solve(J @ cov.columns(columns) @ J.T, e) / 2.0)
    return float(np.mean(out))


def multipath(rng: np.random.Generator, n: int) -> np.ndarray:
    e, k = rng.standard_normal((n, 2)), 0
    while k < n:
        k += int(rng.integers(15, 40))
        long = int(rng.integers(5, 15))
        e[k : k + long] += 8.0 * rng.standard_normal(2)
        k += long
    return e


KINDS = {
    "white": lambda rng, n: rng.standard_normal((n, 2)),
    "correlated": lambda rng, n: correlated(rng, n, 1.0, 60.0, 2),
    "correlated-white": lambda rng, n: correlated(rng, n, 1.0, 60.0, 2) + 0.3 * rng.standard_normal((n, 2)),
    "multipath": multipath,
    "optimistic": lambda rng, n: 5.0 * rng.standard_normal((n, 2)),
}


@pytest.mark.parametrize(
    ("kind", "low", "high", "before"),
    [
        ("white", 0.4, 1.4, None),
        ("correlated", 0.1, 1.3, 3.0),
        ("correlated-white", 0.1, 1.3, 3.0),
        ("multipath", 0.3, 1.5, None),
        ("optimistic", 0.4, 1.4, None),
    ],
)
def test_nodes_are_consistent_whatever_the_receiver(rng, kind, low, high, before):
    plain, fitted, found = [], [], []
    for _ in range(4):
        graph, true, fixes = drive(rng, KINDS[kind](rng, 240))
        solved(graph, fixes)
        plain.append(node_nees(graph, true))
        found.append(fit_fix_errors(graph))
        BatchSolver(graph).solve_to_optimum()
        fitted.append(node_nees(graph, true))
    assert low < np.mean(fitted) < high, (fitted, plain)
    if before:
        assert np.mean(plain) > before
        assert all(f is not None and f.bias_sigma > 0 and f.gain > GATE for f in found)
        assert 15.0 < np.median([f.bias_time for f in found]) <= 480.0
    if kind == "white":
        assert sum(f is not None and f.bias_sigma > 0 for f in found) <= 1
    if kind == "optimistic":
        assert all(f is not None and f.wild < 8 and (f.bias_sigma > 0 or 4.0 < f.white < 6.0) for f in found), found
    if kind == "multipath":
        assert all(f is not None and 5 < f.wild < 120 for f in found)


def test_the_likelihood_equals_the_dense_one(rng):
    n = 30
    times, y = np.sort(rng.uniform(0.0, 60.0, n)), rng.standard_normal(2 * n)
    M = rng.standard_normal((2 * n, 4))
    stated = np.tile(np.diag([1.0, 4.0]), (n, 1, 1))
    seen = _Innovations(times, y, M @ M.T, stated, 60.0)
    C = M @ M.T
    for i in range(n):
        C[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] += 0.7**2 * stated[i]
        for j in range(n):
            alike = 1.3**2 * np.exp(-abs(times[i] - times[j]) / 9.0)
            C[2 * i : 2 * i + 2, 2 * j : 2 * j + 2] += alike * np.diag([1.0, 4.0]) / 2.5
    slow = -0.5 * y @ np.linalg.solve(C, y) - 0.5 * np.linalg.slogdet(C)[1]
    assert seen.likelihood(1.3, 9.0, 0.7) == pytest.approx(slow, rel=1e-10)


def test_innovations_are_those_of_a_map_without_fixes(rng):
    """The slow twin: the fixes against a graph that holds them with no weight."""
    graph, _, fixes = drive(rng, 0.05 * rng.standard_normal((40, 2)))
    solved(graph, fixes, RobustKernel())
    seen = _Innovations.of(graph, sorted((r for r in graph.records.values() if isinstance(r, GpsRecord)),
                                         key=lambda r: r.time))  # fmt: skip
    D = graph.values.datum
    # dead reckoning alone, in the datum of the other: first order in the errors of the way
    poses = np.zeros((41, 3))
    for k, s in enumerate(graph.submaps):
        poses[k + 1] = se2_compose(poses[k], s.T_base_node[-1])
    where = [se2_transform(se2_compose(D, poses[k]), graph.records[r.factor_id].arm)
             for k, r in enumerate(sorted((r for r in graph.records.values() if isinstance(r, GpsRecord)),
                                          key=lambda r: r.time))]  # fmt: skip
    z = fixes.positions - graph.gps_origin
    slow = (np.array(where) - z).ravel()
    # the datum is free too, and loose: compare what it cannot take up
    turned = np.array([[-p[1], p[0]] for p in where]).reshape(-1, 1)
    B = np.concatenate([np.tile(np.eye(2), (40, 1)), turned], 1)
    left = lambda v: v - B @ np.linalg.lstsq(B, v, rcond=None)[0]  # noqa: E731
    assert np.allclose(left(seen.y), left(slow), atol=0.05 * np.abs(slow).max() + 0.02)


def test_few_fixes_or_biases_that_are_stated_are_left_alone(rng):
    graph, _, fixes = drive(rng, correlated(rng, 60, 1.0, 30.0, 2))
    few = solved(graph, fixes.take(slice(0, LEAST - 1)))
    assert fit_fix_errors(few) is None
    graph, _, fixes = drive(rng, correlated(rng, 60, 1.0, 30.0, 2))
    graph.add_sensor(fixes, config=GpsConfig(bias_sigma=1.0, bias_time=20.0))
    graph.finish_sensors()
    BatchSolver(graph).solve_to_optimum()
    assert fit_fix_errors(graph) is None


def test_withheld_fixes_are_predicted_with_the_bias_between_the_used_ones(rng):
    """Every second fix is used; NIS of the others is honest in size and together."""
    each, joint = [], []
    for _ in range(4):
        graph, _, fixes = drive(rng, correlated(rng, 200, 1.0, 40.0, 2) + 0.2 * rng.standard_normal((200, 2)))
        solved(graph, fixes.take(slice(0, None, 2)))
        found = fit_fix_errors(graph)
        assert found is not None
        assert found.bias_sigma > 0
        BatchSolver(graph).solve_to_optimum()
        assert sum(isinstance(r, BiasPriorRecord) for r in graph.records.values()) == 100 - found.wild
        of_each, of_all = gps_innovations(graph, fixes.take(slice(1, None, 2))).tests()
        each.append(of_each["value"])
        joint.append(of_all["value"])
    assert 0.6 < np.mean(each) < 1.5
    assert 0.6 < np.mean(joint) < 1.5


def test_stretches_are_spread_over_the_log():
    k = spread_fixes(3000, 200)
    assert 190 <= len(k) <= 200
    assert k[0] == 0
    assert k[-1] >= 2990
    assert np.sum(np.diff(k) == 3) > 180  # stretches of two minutes, and long times between them
    assert np.array_equal(spread_fixes(20, 200), np.arange(20))
    assert np.array_equal(spread_fixes(600, 200), np.arange(0, 600, 3))
