"""Errors of fixes that last: biases that follow from one another, as a Gauss–Markov process."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.errors import ConfigError
from graphslam.core.records import Gps
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.batch import gtsam_factor
from graphslam.graph.factors.gps import BiasPriorBatch, BiasPriorRecord, level_datum_pose
from graphslam.graph.sensors.gps import GpsConfig
from graphslam.solve.batch import BatchSolver
from graphslam.solve.isam2 import Isam2Solver
from tests.graph.factors.test_gps_space import DATUM, built, fixes_along
from tests.graph.factors.test_gps_uneven import TILTED, uneven
from tests.reference.gtsam_twin import to_gtsam
from tests.reference.space_chain import dense_chain

CORRELATED = GpsConfig(bias_sigma=0.5, bias_time=20.0, baseline=2.0)


def priors(graph: FactorGraph) -> list[BiasPriorRecord]:
    return [r for r in graph.records.values() if isinstance(r, BiasPriorRecord)]


def test_biases_follow_from_each_other(rng):
    """One in two seconds; what one leaves of the one before, and what is new, keep σ as it is at any time."""
    chain = dense_chain(rng, 3, m=6)
    gps = fixes_along(chain, rng, level_datum_pose(DATUM))
    g = built(chain, gps, CORRELATED)
    found = priors(g)
    assert len(found) == g.structure.count("bias") >= 3
    assert [r.before for r in found] == [None, *range(len(found) - 1)]
    for r in found[1:]:
        assert r.sigma**2 == pytest.approx(0.25 * (1.0 - r.keep**2))
        assert 0.0 < r.keep <= np.exp(-2.0 / 20.0) + 1e-12
    covariance = np.zeros((len(found), len(found)))
    A = np.eye(len(found)) - np.diag([r.keep for r in found[1:]], -1)
    covariance = np.linalg.inv(A) @ np.diag([r.sigma**2 for r in found]) @ np.linalg.inv(A).T
    np.testing.assert_allclose(np.diag(covariance), 0.25, rtol=1e-9)
    assert covariance[0, 1] == pytest.approx(0.25 * found[1].keep)


def test_jacobians_and_gtsam_agree(rng):
    chain = dense_chain(rng, 3, m=4)
    g = built(chain, uneven(fixes_along(chain, rng, level_datum_pose(DATUM)), TILTED), CORRELATED)
    (batch,) = [b for b in g.flat().batches if isinstance(b, BiasPriorBatch)]
    shape = batch.records[0].shape
    np.testing.assert_allclose(shape, TILTED / 0.17, rtol=1e-12)  # as large as sigma over east and north
    values = g.values.retract(0.05 * rng.standard_normal(g.flat().layout.size))
    J, columns, size = batch.whitened(values)[1], batch.columns.reshape(len(batch), -1), g.flat().layout.size
    for c in np.unique(columns[columns >= 0]):
        d = np.zeros(size)
        d[c] = 1e-5
        by_step = (batch.whitened(values.retract(d))[0] - batch.whitened(values.retract(-d))[0]) / 2e-5
        np.testing.assert_allclose(np.where((columns == c)[:, None], J, 0.0).sum(axis=2), by_step, atol=1e-5)
    theirs = to_gtsam(values)
    total = sum(2.0 * gtsam_factor(r, {"x0": g.origin}).error(theirs) for r in batch.records)
    assert total == pytest.approx(batch.squared(values).sum(), rel=1e-9)


def test_all_solvers_end_at_one_optimum(rng):
    chain = dense_chain(rng, 3, m=4)
    gps = uneven(fixes_along(chain, rng, level_datum_pose(DATUM)), TILTED)
    graphs = [built(chain, gps, CORRELATED) for _ in range(2)]
    BatchSolver(graphs[0]).solve_to_optimum()
    incremental = Isam2Solver(graphs[1])
    incremental.update()
    incremental.solve_to_optimum()
    np.testing.assert_allclose(graphs[1].values.biases, graphs[0].values.biases, atol=1e-5)
    np.testing.assert_allclose(graphs[1].values.poses, graphs[0].values.poses, atol=1e-5)


def test_what_is_claimed_of_the_datum_holds(rng):
    """Fixes off by one constant error: as if new every time they claim centimetres; with correlation they do not."""
    chi2 = {"white": [], "correlated": []}
    for _ in range(12):
        chain = dense_chain(rng, 3, m=4)
        gps = fixes_along(chain, rng, level_datum_pose(DATUM), sigma=0.05)
        gps = Gps(
            times=gps.times, positions=gps.positions + 0.5 * rng.standard_normal(3), sigma=gps.sigma, lever=gps.lever
        )
        for name, config in (
            ("white", GpsConfig(baseline=2.0)),
            ("correlated", GpsConfig(bias_sigma=0.5, bias_time=500.0, baseline=2.0)),
        ):
            g = built(chain, gps, config)
            BatchSolver(g).solve_to_optimum()
            e = g.values.datum[:3] + g.gps_origin - DATUM[:3]
            chi2[name].append(float(e @ np.linalg.solve(g.covariance().marginal("datum")[:3, :3], e)) / 3.0)
    assert np.mean(chi2["white"]) > 10.0
    assert 0.4 < np.mean(chi2["correlated"]) < 1.9


def test_what_lasts_needs_a_size():
    with pytest.raises(ConfigError, match="bias_sigma"):
        GpsConfig(bias_time=30.0)
    with pytest.raises(ConfigError, match="bias_time"):
        GpsConfig(bias_sigma=1.0, bias_time=-1.0)
