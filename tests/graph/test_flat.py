"""The flat Gauss-Newton system against its obvious twin and against finite differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.geometry import se2_between, se2_log
from graphslam.graph.factor_arrays import FactorArrays
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.between import BetweenRecord
from graphslam.graph.factors.gps import BiasPriorRecord, GpsRecord
from graphslam.graph.factors.landmark_submap import SubmapRecord
from graphslam.graph.ledger import EvidenceUse
from graphslam.graph.noise import RobustKernel
from graphslam.graph.sensors.gps import GpsConfig
from tests.reference.graph_chain import dense_submap, make_chain, make_gps
from tests.reference.plain_gps import gps_residual
from tests.reference.submap_model import submap_jacobians, submap_residual


def rich_graph(rng) -> FactorGraph:
    """Every class of factor, both ends of the fixed base, kernels, a repeated id, values away from the optimum."""
    chain = make_chain(rng, m=6, landmarks=10)
    g = FactorGraph()
    gps = make_gps(chain, rng, np.array([5.0, -3.0, 1.1]), step=2.0)
    g.add_sensor(
        gps, config=GpsConfig(robust=RobustKernel("cauchy", 1.0), bias_sigma=0.5, segment_gap=9.0, baseline=15.0)
    )
    for s in chain.submaps:
        g.add_submap(s)
    C = np.diag([1e-2, 2e-2, 1e-3])
    rel = se2_between(chain.poses[0], chain.poses[4])
    g.add_between(0, 4, rel + [0.3, 0, 0], C, evidence="shared-scan", robust=RobustKernel("huber", 1.0))
    g.add_between(5, 0, se2_between(chain.poses[5], chain.poses[0]), C, evidence=EvidenceUse(["wheel"], (0, 50)))
    g.add_between(2, 5, se2_between(chain.poses[2], chain.poses[5]), C, evidence="shared-scan")
    first = g.detections(int(g.values.landmark_ids[0]))
    shared = [i for i in g.values.landmark_ids if len(g.detections(int(i)) & first)]
    g.merge_landmarks(int(shared[0]), int(shared[1]))  # the id now stands twice in a submap
    step = 0.02 * rng.standard_normal(g.flat().layout.size)
    g.set_values(g.values.retract(step))
    return g


def slow_residuals(g: FactorGraph, values) -> list[np.ndarray]:
    """Whitened residual of every record, one by one, no kernel."""
    out, row = [], g.flat().layout.row_of
    for r in g.records.values():
        if isinstance(r, SubmapRecord):
            points = values.landmarks[[row[int(i)] for i in r.landmark_ids]]
            e = submap_residual(values.poses[r.start], values.poses[r.start + 1], points, r.z, r.chart)
            out.append(r.whitener @ e)
        elif isinstance(r, BetweenRecord):
            h = se2_between(values.poses[r.i], values.poses[r.j])
            out.append(r.whitener @ se2_log(se2_between(r.T_ij, h)))
        elif isinstance(r, GpsRecord):
            bias = np.zeros(2) if r.bias is None else values.biases[r.bias]
            out.append(r.whitener @ gps_residual(values.poses[r.node], values.datum, bias, r.arm, r.z))
        else:
            assert isinstance(r, BiasPriorRecord)
            out.append(values.biases[r.bias] / r.sigma)
    return out


def test_graph_has_every_kind(rng):
    g = rich_graph(rng)
    assert {r.group for r in g.records.values()} == {"submap", "between", "gps", "gps-bias"}
    assert any(len(set(i.landmark_ids.tolist())) < len(i.landmark_ids) for i in _submaps(g))


def _submaps(g: FactorGraph) -> list[SubmapRecord]:
    return [r for r in g.records.values() if isinstance(r, SubmapRecord)]


def test_objective_is_that_of_the_slow_twin(rng):
    g = rich_graph(rng)
    chi2 = g.flat().evaluate(g.values, hessian=False).chi2
    for record, e, value in zip(g.records.values(), slow_residuals(g, g.values), chi2):
        kernel = getattr(record, "robust", RobustKernel())
        assert value == pytest.approx(float(kernel.loss(np.array([e @ e]))[0]), rel=1e-10), record.label()


def test_gradient_and_matrix_against_finite_differences(rng):
    g = rich_graph(rng)
    flat, n, h = g.flat(), g.flat().layout.size, 1e-6
    system = flat.evaluate(g.values, dense=True)
    weights = [
        float(np.sqrt(getattr(r, "robust", RobustKernel()).weight(np.array([e @ e]))[0]))
        for r, e in zip(g.records.values(), slow_residuals(g, g.values))
    ]
    J, gradient = [], []
    for c in range(n):
        step = np.zeros(n)
        step[c] = h
        plus, minus = g.values.retract(step), g.values.retract(-step)
        J.append(
            np.concatenate([w * (a - b) for w, a, b in zip(weights, slow_residuals(g, plus), slow_residuals(g, minus))])
            / (2 * h)
        )
        up, down = (flat.evaluate(v, hessian=False).objective for v in (plus, minus))
        gradient.append((up - down) / (4 * h))  # g is half the gradient
    J = np.array(J).T
    scale = np.sqrt(np.diag(system.A))
    np.testing.assert_allclose(system.A / np.outer(scale, scale), (J.T @ J) / np.outer(scale, scale), atol=1e-6)
    np.testing.assert_allclose(system.g / scale, np.array(gradient) / scale, atol=1e-4)


def test_dense_and_sparse_agree(rng):
    g = rich_graph(rng)
    dense, sparse = (g.flat().evaluate(g.values, dense=d) for d in (True, False))
    np.testing.assert_allclose(sparse.A.toarray(), dense.A, rtol=1e-12, atol=1e-9)
    np.testing.assert_array_equal(sparse.g, dense.g)


@pytest.mark.parametrize("chart", ["cartesian", "group"])
def test_vector_and_tangent_blocks_share_one_model(rng, chart):
    """The kernel's block of one submap is Jᵀ Λ J of the published model, away from the optimum too."""
    chain = make_chain(rng, m=2)
    g = FactorGraph()
    for s in chain.submaps:
        g.add_submap(replace(s, landmarks=replace(s.landmarks, chart=chart)))
    g.set_values(g.values.retract(0.4 * rng.standard_normal(g.flat().layout.size)))
    r = _submaps(g)[1]
    only = FactorArrays([r], g.flat().layout)
    A = only.evaluate(g.values, dense=True).A
    points = g.values.landmarks[[g.flat().layout.row_of[int(i)] for i in r.landmark_ids]]
    J_s, J_e, J_l = submap_jacobians(g.values.poses[1], g.values.poses[2], points, r.z, r.chart, tangent=True)
    J = np.zeros((len(r.z), g.flat().layout.size))
    J[:, 0:3], J[:, 3:6] = J_s, J_e
    for e, i in enumerate(r.landmark_ids):
        c = g.flat().layout.columns(f"l{i}")
        J[3 + 2 * e : 5 + 2 * e, c] = J_l
    W = r.whitener
    np.testing.assert_allclose(A, J.T @ W.T @ W @ J, rtol=1e-9, atol=1e-7)


def test_empty_and_landmark_free_graphs():
    g = FactorGraph()
    assert g.flat().evaluate(g.values).objective == 0.0
    g.add_submap(dense_submap(0, np.array([1.0, 0, 0]), np.eye(3)))
    np.testing.assert_allclose(g.covariance().marginal("x1"), np.eye(3))
