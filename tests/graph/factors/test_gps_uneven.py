"""Fixes whose coordinates are not equally sure, in the plane and in space; withheld ones predicted in space."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.poses import SE3
from graphslam.core.records import Gps
from graphslam.evaluate.gps_innovation import gps_innovations
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.batch import gtsam_factor
from graphslam.graph.factors.gps import GpsBatch, GpsRecord, antenna_terms, level_datum_pose
from graphslam.graph.sensors.gps import GpsConfig
from graphslam.solve.batch import BatchSolver
from graphslam.solve.isam2 import Isam2Solver
from graphslam_studies.graph.gnss import add_odometer, add_pseudoranges
from graphslam_studies.graph.pseudorange import PseudorangeRecord
from graphslam_studies.sim.satellites import PLANE, SatelliteConfig, simulate_satellites
from tests.graph.factors.test_gps_space import DATUM, LEVER, built, fixes_along
from tests.reference.gtsam_twin import to_gtsam
from tests.reference.space_chain import dense_chain

TILTED = np.array([[0.09, 0.05, 0.0], [0.05, 0.25, 0.1], [0.0, 0.1, 4.0]])
"""Less sure of heights, and not along the axes [m²]."""
SOON = GpsConfig(baseline=2.0)


def uneven(gps: Gps, P: np.ndarray) -> Gps:
    return replace(gps, covariances=np.tile(P, (len(gps.times), 1, 1)))


@pytest.mark.parametrize("bias", [None, 0.5])
def test_jacobians_are_those_of_small_steps(rng, bias):
    chain = dense_chain(rng, 3, m=3)
    g = built(
        chain,
        uneven(fixes_along(chain, rng, level_datum_pose(DATUM)), TILTED),
        GpsConfig(bias_sigma=bias, baseline=2.0),
    )
    g.start_tilt()
    values = g.values.retract(0.05 * rng.standard_normal(g.flat().layout.size))
    (batch,) = [b for b in g.flat().batches if isinstance(b, GpsBatch)]
    assert all(r.uneven and r.tilt for r in batch.records)
    J, columns, size = batch.whitened(values)[1], batch.columns.reshape(len(batch), -1), g.flat().layout.size
    for c in range(size):
        d = np.zeros(size)
        d[c] = 1e-5
        by_step = (batch.whitened(values.retract(d))[0] - batch.whitened(values.retract(-d))[0]) / 2e-5
        np.testing.assert_allclose(np.where((columns == c)[:, None], J, 0.0).sum(axis=2), by_step, atol=1e-5)
    theirs = to_gtsam(values)
    total = sum(2.0 * gtsam_factor(r, {"x0": g.origin}).error(theirs) for r in batch.records)
    assert total == pytest.approx(batch.squared(values).sum(), rel=1e-9)


def test_equal_in_all_directions_it_is_the_plain_factor(rng):
    """In both frames the same χ²: a round covariance may be turned."""
    chain = dense_chain(rng, 3, m=4)
    gps = fixes_along(chain, rng, level_datum_pose(DATUM))
    plain, round_ = built(chain, gps, SOON), built(chain, uneven(gps, 0.09 * np.eye(3)), SOON)
    assert plain.values.datum is not None
    assert round_.objective().total == pytest.approx(plain.objective().total, rel=1e-6)


def test_heights_pull_less_than_the_plane(rng):
    """Heights that are off by metres, and said to be: the path keeps to the fixes in the plane alone."""
    chain = dense_chain(rng, 3, m=6)
    gps = fixes_along(chain, rng, level_datum_pose(DATUM), sigma=0.05)
    wrong = gps.positions + np.column_stack([np.zeros((len(gps.times), 2)), 3.0 * rng.standard_normal(len(gps.times))])
    even = replace(gps, positions=wrong, sigma=np.full(len(wrong), 0.05))
    weighted = Gps.upright(times=gps.times, positions=wrong, horizontal=0.05, vertical=3.0, lever=LEVER)
    graphs = [built(chain, z, SOON) for z in (even, weighted)]
    for g in graphs:
        BatchSolver(g).solve_to_optimum()
    heights = [np.std((g.values.poses[[s.exit_node for s in g.submaps]] - chain.poses[1:])[:, 2]) for g in graphs]
    assert heights[1] < 0.5 * heights[0]
    assert graphs[0].objective()["gps"].chi2_per_dof > 50.0
    assert graphs[1].objective()["gps"].chi2_per_dof == pytest.approx(1.0, abs=0.3)


def test_both_solvers_end_at_the_same_place(rng):
    chain = dense_chain(rng, 3, m=4)
    gps = uneven(fixes_along(chain, rng, level_datum_pose(DATUM)), TILTED)
    a, b = built(chain, gps, SOON), built(chain, gps, SOON)
    assert any(isinstance(r, GpsRecord) for r in a.records.values())
    BatchSolver(a).solve_to_optimum()
    solver = Isam2Solver(b)
    solver.update()
    solver.solve_to_optimum()
    assert b.objective().total == pytest.approx(a.objective().total, rel=1e-7)


def test_one_sigma_for_all_takes_their_place(rng):
    chain = dense_chain(rng, 3, m=3)
    gps = uneven(fixes_along(chain, rng, level_datum_pose(DATUM)), TILTED)
    g = built(chain, gps, GpsConfig(sigma=0.4, baseline=2.0))
    assert any(isinstance(r, GpsRecord) for r in g.records.values())
    assert not any(r.uneven for r in g.records.values() if isinstance(r, GpsRecord))


@pytest.mark.parametrize("dim", [2, 3])
def test_antennas_in_the_gps_frame(rng, dim):
    datum = np.array([3.0, -2.0, 0.7]) if dim == 2 else DATUM
    poses = rng.standard_normal((4, 3)) if dim == 2 else SE3.exp(rng.standard_normal((4, 6)))
    arm = rng.standard_normal((4, dim))
    y, _ = antenna_terms(poses, datum, None, arm)
    if dim == 3:
        np.testing.assert_allclose(y, SE3.transform(level_datum_pose(datum), SE3.transform(poses, arm)), atol=1e-9)
    else:
        from graphslam.core.geometry import se2_transform

        np.testing.assert_allclose(y, se2_transform(datum, se2_transform(poses, arm)), atol=1e-12)


def test_withheld_fixes_are_predicted_in_space(rng):
    """Every second fix withheld: innovations as large as their covariance says, heights by their own σ."""
    found = []
    for _ in range(4):
        chain = dense_chain(rng, 3, m=8)
        gps = fixes_along(chain, rng, level_datum_pose(DATUM), sigma=0.3)
        P = np.diag([0.09, 0.09, 0.81])
        high = gps.positions + np.sqrt(0.81 - 0.09) * rng.standard_normal((len(gps.times), 1)) * [0.0, 0.0, 1.0]
        gps = replace(gps, positions=high, covariances=np.tile(P, (len(gps.times), 1, 1)))
        even = np.arange(len(gps.times)) % 2 == 0
        g = built(chain, gps.take(even))
        BatchSolver(g).solve_to_optimum()
        got = gps_innovations(g, gps.take(~even))
        assert got.innovations.shape == (len(got.times), 3)
        found.append(got)
    nis = np.concatenate([f.nis for f in found]) / 3.0
    assert 0.75 < nis.mean() < 1.3
    up = np.concatenate([f.normalised[:, 2] for f in found])
    assert 0.6 < np.mean(up**2) < 1.5


def test_the_datum_stays_with_its_pseudoranges():
    """A graph of pseudoranges keeps its datum when one of them goes, and learns where up is when it is told later."""
    log = simulate_satellites(1, SatelliteConfig(seconds=8.0, satellites=7))
    g = FactorGraph(3)
    nodes = add_odometer(g, log["odometry"])
    ids = add_pseudoranges(g, log["pseudoranges"], PLANE, nodes)
    g.remove(ids[3])
    assert g.values.datum is not None
    assert not any(r.tilt for r in g.records.values() if isinstance(r, PseudorangeRecord))
    g.add_attitude(0, [0.0, 0.0, -1.0], 0.02, evidence="prior")
    assert all(r.tilt for r in g.records.values() if isinstance(r, PseudorangeRecord))
    BatchSolver(g).solve_to_optimum()
