"""A graph as a plain network: unique vertices, marginal informations, readable by the g2o writer."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.geometry import se2_between, se2_log
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.network import to_network
from graphslam.solve.batch import BatchSolver
from tests.reference.graph_chain import dense_submap, make_chain

C = np.diag([1e-2, 2e-2, 1e-3])


def test_vertices_edges_and_observations(rng):
    chain = make_chain(rng, m=5, landmarks=10, noise=0.0)
    g = FactorGraph()
    for s in chain.submaps:
        g.add_submap(s, landmark_ids=s.landmarks.ids)
    g.add_between(0, 4, se2_between(chain.poses[0], chain.poses[4]), C, evidence="shared-scan")
    net = to_network(g)
    assert len(set(net.ids) | set(net.landmark_ids)) == 6 + len(g.values.landmarks)
    assert len(net.edges) == 6
    assert len(net.observations) == sum(len(s.landmarks) for s in chain.submaps)
    np.testing.assert_allclose(net.information[-1], np.linalg.inv(C), rtol=1e-9)
    s = chain.submaps[2]
    np.testing.assert_allclose(net.information[2], np.linalg.inv(s.exit_covariance), rtol=1e-6)
    for (i, j), z in zip(net.edges, net.measurements):  # without noise everything fits exactly
        np.testing.assert_allclose(se2_log(se2_between(z, se2_between(net.poses[i], net.poses[j]))), 0, atol=1e-9)


def test_a_chain_of_dense_submaps_survives_as_it_is(rng):
    g = FactorGraph()
    for k in range(4):
        g.add_submap(dense_submap(k, rng.normal(size=3), C))
    BatchSolver(g).update()
    net = to_network(g)
    np.testing.assert_allclose(net.information, np.broadcast_to(np.linalg.inv(C), (4, 3, 3)), rtol=1e-9)
    assert net.edges.tolist() == [[0, 1], [1, 2], [2, 3], [3, 4]]
    assert len(net.landmark_ids) == 0
    assert net.fixed.tolist() == [True] + 4 * [False]
    assert net.poses[4] == pytest.approx(g.values.poses[4])
