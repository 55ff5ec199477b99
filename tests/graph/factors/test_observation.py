"""Detections of landmarks from poses: Jacobians against differences, GTSAM's own factor, and the graph of a file."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.graph.factor_arrays import FactorArrays
from graphslam.graph.factors.batch import gtsam_factor
from graphslam.graph.factors.observation import ObservationRecord
from graphslam.graph.network import network_values, problem_of_network
from graphslam.graph.noise import RobustKernel
from graphslam.graph.variables import Values
from tests.reference.gtsam_twin import to_gtsam
from tests.solve.network.test_model import random_network


def records(rng, polar: bool) -> tuple[list[ObservationRecord], Values]:
    values = Values(2, {"x": rng.standard_normal((4, 3)), "l": 3.0 + rng.standard_normal((3, 2))}, np.array([7, 8, 20]))
    values.poses[0] = 0.0
    pairs = [(0, 7), (1, 7), (1, 20), (3, 8)]
    W = rng.standard_normal((4, 2, 2)) + 2.0 * np.eye(2)
    robust = [RobustKernel(), RobustKernel("huber", 1.0), RobustKernel("cauchy", 1.0), RobustKernel()]
    z = np.array([2.0, 4.0]) + rng.standard_normal((4, 2))
    return [ObservationRecord(k, i, l, z[k], polar, W[k], robust[k]) for k, (i, l) in enumerate(pairs)], values


@pytest.mark.parametrize("polar", [True, False])
def test_jacobians_are_those_of_differences(rng, polar):
    some, values = records(rng, polar)
    flat, h = FactorArrays(some, values.layout()), 1e-6
    batch = flat.batches[0]
    _, J = batch.whitened(values)
    columns = batch.columns.reshape(len(some), -1)
    for c in range(flat.layout.size):
        step = np.zeros(flat.layout.size)
        step[c] = h
        up, down = (batch.whitened(flat.layout.retract(values, s))[0] for s in (step, -step))
        mine = np.einsum("kdc,kc->kd", J, columns == c)
        np.testing.assert_allclose(mine, (up - down) / (2 * h), atol=1e-6 * np.abs(J).max())


@pytest.mark.parametrize("polar", [True, False])
def test_gtsam_says_the_same(rng, polar):
    some, values = records(rng, polar)
    blocks, theirs = FactorArrays(some, values.layout()).factor_blocks(values), to_gtsam(values)
    chi2 = FactorArrays(some, values.layout()).evaluate(values, hessian=False).chi2
    for k, record in enumerate(some):
        factor = gtsam_factor(record, {"x0": values.poses[0]})
        assert 2 * factor.error(theirs) == pytest.approx(chi2[k], rel=1e-9)
        free = blocks.columns[k] >= 0
        A, _ = factor.linearize(theirs).jacobian()
        np.testing.assert_allclose(A.T @ A, blocks.weight[k] * blocks.H[k][np.ix_(free, free)], atol=1e-9)
    assert ("BearingRange" in type(gtsam_factor(some[1], {"x0": values.poses[0]})).__name__) == polar


@pytest.mark.parametrize("kind", ["bearing-range", "cartesian"])
def test_records_and_arrays_are_one_kind(rng, kind):
    """What a file's arrays make is what a graph's records make."""
    net, poses, points = random_network(rng, 2, marks=kind)
    flat, values = problem_of_network(net, ordered=False), network_values(net, poses, points)
    again = FactorArrays(list(flat.records), flat.layout)
    a, b = flat.evaluate(values, dense=True), again.evaluate(values, dense=False)
    np.testing.assert_allclose(b.A.toarray(), a.A, rtol=1e-12, atol=1e-12 * np.abs(a.A).max())
    np.testing.assert_allclose(b.chi2, a.chi2, rtol=1e-12)
    assert flat.records[len(net.edges)].label() == "observation of l100 from x0 (factor 0)"
