"""What must hold for any graph: consistent covariances, indifference to order and to the place of the frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from graphslam.core.gaussian import chi2_mean_bounds
from graphslam.core.geometry import rotation2, se2_between, se2_log, wrap_angle
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.sensors.gps import GpsConfig
from graphslam.solve.batch import BatchSolver
from tests.reference.graph_chain import make_chain, make_gps


def solve(chain, **scale) -> FactorGraph:
    g = FactorGraph()
    for s in chain.submaps:
        g.add_submap(s, **scale)
    BatchSolver(g).update()
    return g


@pytest.mark.parametrize(("scale", "consistent"), [(1.0, True), (0.6, False), (1.7, False)])
def test_nees_and_chi2_of_the_graph_are_consistent(rng, scale, consistent):
    """Monte Carlo, two-sided: the joint NEES and the χ² of the join see a covariance wrong by 1.7 either way."""
    runs, nees, chi2, dof, n = 25, [], [], 0, 0
    for _ in range(runs):
        chain = make_chain(rng, m=8, landmarks=15, laps=1.5, sigma=0.02)
        g = solve(chain, covariance_scale=scale)
        e = [se2_log(se2_between(a, b)) for a, b in zip(g.values.poses[1:], chain.poses[1:])]
        e = np.concatenate([np.ravel(e), (chain.landmarks[g.values.landmark_ids] - g.values.landmarks).ravel()])
        A = g.flat().evaluate(g.values, dense=True).A
        nees.append(e @ A @ e / len(e))
        s = g.objective()["submap"]
        chi2.append(s.chi2)
        dof += s.dof
        n += len(e)
    low, high = (b * runs for b in chi2_mean_bounds(n / runs, runs, 0.999))
    mean = np.average(nees) * n
    inside = low < mean < high
    assert inside == consistent, (low, mean, high)
    p = stats.chi2.cdf(np.sum(chi2), dof)
    assert (0.0005 < p < 0.9995) == consistent


def test_order_of_factors_does_not_matter(rng):
    """GPS before or after, a between-factor early or late: the optimum is the same."""
    chain = make_chain(rng, m=8, landmarks=15)
    gps = make_gps(chain, rng, np.array([5.0, 5.0, 1.0]), step=4.0)
    T, C = se2_between(chain.poses[1], chain.poses[4]), np.diag([1e-3, 1e-3, 1e-4])
    results = []
    for late in (False, True):
        g = FactorGraph()
        if not late:
            g.add_sensor(gps, config=GpsConfig(baseline=10.0))
        for s in chain.submaps:
            g.add_submap(s)
            if s.key == 5 and not late:
                g.add_between(1, 4, T, C, evidence="shared-scan")
        if late:
            g.add_between(1, 4, T, C, evidence="shared-scan")
            g.add_sensor(gps, config=GpsConfig(baseline=10.0))
        BatchSolver(g).update()
        results.append(g)
    assert results[0].objective().total == pytest.approx(results[1].objective().total, rel=1e-10)
    np.testing.assert_allclose(results[0].values.poses, results[1].values.poses, atol=1e-9)


def test_moving_the_gps_frame_moves_the_datum_alone(rng):
    chain = make_chain(rng, m=8, landmarks=15)
    gps = make_gps(chain, rng, np.array([5.0, 5.0, 1.0]), step=4.0)
    R = rotation2(0.8)
    moved = replace(gps, positions=gps.positions @ R.T + [1000.0, -5000.0])
    graphs = []
    for stream in (gps, moved):
        g = FactorGraph()
        g.add_sensor(stream)
        for s in chain.submaps:
            g.add_submap(s)
        BatchSolver(g).update()
        graphs.append(g)
    np.testing.assert_allclose(graphs[0].values.poses, graphs[1].values.poses, atol=1e-8)
    turn = wrap_angle(graphs[1].values.datum[2] - graphs[0].values.datum[2] - 0.8)
    assert abs(turn) < 1e-9


def test_a_repeated_landmark_is_its_fusion(rng):
    """Two entries of one id in a submap weigh as much as the single entry that fuses them."""
    from graphslam.join.submap_blocks import fuse_repeated

    chain = make_chain(rng, m=6, landmarks=12, laps=1.2)
    twice, fused = FactorGraph(), FactorGraph()
    for s in chain.submaps:
        ids = s.landmarks.ids.copy()
        if s.key == 2:
            assert len(ids) >= 2
            ids[1] = ids[0]
        twice.add_submap(s, landmark_ids=ids)
        fused.add_submap(replace(s, landmarks=fuse_repeated(replace(s.landmarks, ids=ids))))
    for g in (twice, fused):
        BatchSolver(g).update()
    np.testing.assert_allclose(twice.values.poses, fused.values.poses, atol=1e-8)
    np.testing.assert_allclose(twice.covariance().marginal("x6"), fused.covariance().marginal("x6"), rtol=1e-6)
    assert twice.objective().total > fused.objective().total
