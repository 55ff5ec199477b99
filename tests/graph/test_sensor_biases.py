"""Constant errors of wheels and sensor as variables of a graph of submaps."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from graphslam.core.errors import DataError
from graphslam.core.path_points import PathPoints
from graphslam.core.sensor_biases import SensorBiases
from graphslam.core.submap import Submap
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.batch import gtsam_factor, gtsam_value
from graphslam.graph.factors.landmark_submap import PathRecord, SubmapRecord
from graphslam.graph.sensors.gps import GpsConfig
from graphslam.graph.variables import gtsam_key
from graphslam.io.submap_store import read_submaps, write_submaps
from graphslam.solve.registry import make_solver
from tests.reference.graph_chain import make_chain, make_gps
from tests.reference.hat_matrix import numeric_jacobian, whitened_residual

NAMES = ("yaw_bias", "distance_scale", "range_offset", "sensor_yaw", "mount_x", "mount_y")


def with_errors(rng, s: Submap, *, points: int = 0) -> Submap:
    """A submap with made-up responses, and points of its path."""
    lm = s.landmarks
    n = 3 + 2 * len(lm)
    B = rng.standard_normal((8, 6))
    t0, t1 = s.interval
    path = None
    if points:
        times = np.linspace(t0, t1, points + 2)[1:-1]
        P = lm.dense_covariance()
        gain = 0.3 * rng.standard_normal((2 * points, n)) / np.sqrt(n)
        own = gain @ P @ gain.T + 0.01 * np.eye(2 * points)
        poses = s.trajectory.interpolate(times)
        path = PathPoints(times=times, lever=np.zeros(2), positions=poses[:, :2], covariance=own, cross=gain @ P)
    biases = SensorBiases(
        names=NAMES, sigmas=np.array([0.02, 0.05, 0.3, 0.1, 0.2, 0.2]), response=0.05 * rng.standard_normal((n, 6)),
        score=B.T @ rng.standard_normal(8), information=B.T @ B,
        path=0.1 * rng.standard_normal((len(s.trajectory), 3, 6)), points=0.05 * rng.standard_normal((2 * points, 6)),
    )  # fmt: skip
    return replace(s, landmarks=replace(lm, biases=biases, path=path, chart="group"))


@pytest.fixture
def graph(rng) -> FactorGraph:
    chain = make_chain(rng, m=5, landmarks=8)
    g = FactorGraph()
    gps = make_gps(chain, rng, np.array([5.0, -3.0, 1.1]), step=2.0)
    submaps = [with_errors(rng, s, points=2) for s in chain.submaps]
    times = np.concatenate([s.landmarks.path.times for s in submaps])
    places = np.concatenate([s.landmarks.path.positions for s in submaps])
    g.add_sensor(
        replace(gps, times=times, positions=places + 1.0, sigma=np.ones(len(places)), lever=np.zeros(2)),
        config=GpsConfig(baseline=0.1),
    )
    for s in submaps:
        g.add_submap(s)
    return g


def test_kernel_equals_the_slow_twin_and_finite_differences(graph, rng):
    flat = graph.flat()
    assert any(isinstance(r, PathRecord) for r in graph.records.values())
    values = graph.values.retract(0.02 * rng.standard_normal(flat.layout.size))
    graph.set_values(values)
    flat = graph.flat()
    records = [r for r in graph.records.values() if r.group in ("submap", "biases")]
    everything = flat.evaluate(values, hessian=False).chi2
    for r, chi2 in zip(graph.records.values(), everything):
        if r in records:
            e = whitened_residual(r, values)
            assert chi2 == pytest.approx(float(e @ e), rel=1e-10), r.label()
    objective = lambda v: np.array([flat.evaluate(v, hessian=False).chi2.sum()])  # noqa: E731
    slope = numeric_jacobian(objective, values)[0] / 2.0
    made = flat.evaluate(values)
    np.testing.assert_allclose(made.g, slope, rtol=1e-5, atol=1e-5 * np.abs(slope).max())
    J = np.vstack([numeric_jacobian(lambda v, r=r: whitened_residual(r, v), values) for r in records])
    biases = flat.layout.columns_of(["wheels0", "sensor0", "mount0"])
    assert np.linalg.matrix_rank(J[:, biases]) == 6


@pytest.mark.parametrize("group", ["submap", "path", "biases"])
def test_factor_of_gtsam_has_the_same_residual_and_jacobians(graph, rng, group):
    values = graph.values.retract(0.02 * rng.standard_normal(graph.flat().layout.size))
    records = [r for r in graph.records.values() if r.group == group]
    row = graph.flat().layout
    for r in (records[0], records[-1]):
        factor = gtsam_factor(r, {"x0": values.poses[0]})
        held = gtsam.Values()
        names = [n for n in r.variables() if n != "x0"]
        for n in names:
            kind = n.rstrip("0123456789")
            k = int(n[len(kind) :])
            value = values["l"][row.row_of[k]] if kind == "l" else values[kind][k]
            held.insert(gtsam_key(n), gtsam_value(value, n, 2))
        one = graph.flat().evaluate(values, hessian=False).chi2[list(graph.records).index(r.factor_id)]
        assert 2.0 * factor.error(held) == pytest.approx(one, rel=1e-9)
        linear = factor.linearize(held)
        step = 1e-6 * rng.standard_normal(row.size)
        delta = gtsam.VectorValues()
        for n in names:
            delta.insert(gtsam_key(n), step[row.columns(n)])
        moved = values.retract(step)
        after = graph.flat().evaluate(moved, hessian=False).chi2[list(graph.records).index(r.factor_id)]
        assert linear.error(delta) - linear.error(_zeros(delta, names, row)) == pytest.approx(
            (after - one) / 2.0, rel=1e-3, abs=1e-9 * max(one, 1.0)
        )


def _zeros(delta, names, row):
    out = gtsam.VectorValues()
    for n in names:
        out.insert(gtsam_key(n), np.zeros(len(row.columns(n))))
    return out


@pytest.mark.parametrize("solver", ["batch", "lm", "isam2"])
def test_solvers_come_to_one_optimum(rng, solver):
    chain = make_chain(rng, m=6, landmarks=8)
    g = FactorGraph()
    s = make_solver(solver, g)
    made = np.random.default_rng(4)
    for submap in chain.submaps:
        g.add_submap(with_errors(made, submap))
        s.update()
    s.solve_to_optimum()
    solution = s.solution()
    found, P = g.sensor_biases()
    twin = FactorGraph()
    made = np.random.default_rng(4)
    for submap in chain.submaps:
        twin.add_submap(with_errors(made, submap))
    plain = make_solver("batch", twin)
    plain.update()
    plain.solve_to_optimum()
    best = plain.solution()
    assert solution.objective == pytest.approx(best.objective, rel=1e-8)
    np.testing.assert_allclose(found, twin.sensor_biases()[0], atol=1e-5)
    np.testing.assert_allclose(P, twin.sensor_biases()[1], rtol=1e-3, atol=1e-8)
    path = solution.trajectory()
    assert np.all(np.isfinite(path.covariances))


def test_a_submap_that_is_removed_takes_its_word_along(rng):
    chain = make_chain(rng, m=4, landmarks=8)
    g = FactorGraph()
    ids = [g.add_submap(with_errors(rng, s)) for s in chain.submaps]
    words = lambda: sum(r.group == "biases" for r in g.records.values())  # noqa: E731
    assert words() == 1 + len(ids)
    assert set(g.ledger.table()["kind"]) >= {"measurement", "biases", "prior"}
    g.remove(ids[-1])
    assert words() == len(ids)
    with pytest.raises(DataError, match="no constant errors"):
        g.sensor_biases(1)


def test_what_is_known_of_the_errors_moves_and_widens_a_map(rng):
    chain = make_chain(rng, m=2, landmarks=6)
    s = with_errors(rng, chain.submaps[0])
    g = np.array([0.01, 0.02, -0.1, 0.03, 0.1, -0.1])
    moved = s.landmarks.with_biases(g, np.eye(6))
    S = s.landmarks.biases.response
    np.testing.assert_allclose(moved.mean, s.landmarks.mean + S @ g)
    np.testing.assert_allclose(moved.covariance, s.landmarks.dense_covariance() + S @ S.T)
    plain = chain.submaps[1]
    assert plain.landmarks.with_biases(g, np.eye(6)) is plain.landmarks


def test_a_store_keeps_them(rng, tmp_path):
    s = with_errors(rng, make_chain(rng, m=2, landmarks=6).submaps[0], points=2)
    write_submaps(tmp_path, [s])
    back = read_submaps(tmp_path)[0]
    for name in ("names", "sigmas", "response", "score", "information", "path", "points"):
        np.testing.assert_array_equal(getattr(back.landmarks.biases, name), getattr(s.landmarks.biases, name))
    part = s.landmarks.subset([1])
    np.testing.assert_array_equal(part.biases.response, s.landmarks.biases.response[[0, 1, 2, 5, 6]])


def test_records_of_submaps_keep_their_own_part(rng):
    g = FactorGraph()
    s = with_errors(rng, make_chain(rng, m=2, landmarks=6).submaps[0])
    g.add_submap(s)
    r = next(r for r in g.records.values() if isinstance(r, SubmapRecord))
    z, W = r.own
    np.testing.assert_allclose(z, s.landmarks.mean)
    np.testing.assert_allclose(W.T @ W, np.linalg.inv(s.landmarks.dense_covariance()), rtol=1e-6)
