"""Pseudoranges, clocks, biases, odometers: Jacobians, GTSAM's own factor, every solver, consistency, refusals."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2

from graphslam.core.errors import ConfigError, DataError, EvidenceReusedError, GeometryError
from graphslam.core.gnss import SPEED_OF_LIGHT, Pseudoranges, TangentPlane
from graphslam.core.poses import SE3
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.attitude import DOWN
from graphslam.graph.factors.batch import gtsam_factor, gtsam_pose
from graphslam.graph.factors.gps import level_datum_pose
from graphslam.solve.batch import BatchSolver
from graphslam.solve.isam2 import Isam2Solver
from graphslam_studies.graph.gnss import PseudorangeConfig, add_odometer, add_pseudoranges, antenna_positions
from graphslam_studies.graph.odometer import OdometerPriorRecord, OdometerRecord
from graphslam_studies.graph.pseudorange import ClockRecord, PseudorangeRecord, SatelliteBiasRecord
from graphslam_studies.sim.satellites import PLANE, SatelliteConfig, simulate_satellites
from graphslam_studies.smartloc import errors, score_of, solve_street
from tests.graph.factors.test_gps_space import LEVER, built, fixes_along
from tests.reference.gtsam_twin import to_gtsam
from tests.reference.space_chain import dense_chain

SHORT = SatelliteConfig(seconds=12.0, satellites=7)
TRUE = PseudorangeConfig(density_scale=10.0, bias_sigma=5.0)
"""What the simulation draws from."""


def street(
    seed: int = 1, config: SatelliteConfig = SHORT, *, level: bool = True, lever=(0.3, -0.2, 1.5)
) -> FactorGraph:
    """A short drive before it is solved, moved away from where it starts."""
    log = simulate_satellites(seed, config)
    graph = FactorGraph(3)
    nodes = add_odometer(graph, log["odometry"])
    if level:
        for n in nodes[::3].tolist():
            graph.add_attitude(n, DOWN, 0.02, evidence="prior")
    ranges = replace(log["pseudoranges"], lever=np.array(lever))
    add_pseudoranges(graph, ranges, PLANE, nodes, config=TRUE)
    return graph


@pytest.mark.parametrize("level", [True, False])
def test_jacobians_are_those_of_small_steps(rng, level):
    graph = street(level=level)
    step = 0.02 * rng.standard_normal(graph.flat().layout.size)
    graph.set_values(graph.values.retract(step))
    kinds = {PseudorangeRecord, ClockRecord, SatelliteBiasRecord, OdometerRecord, OdometerPriorRecord}
    seen = set()
    for batch in graph.flat().batches:
        if batch.record not in kinds or not len(batch):
            continue
        seen.add(batch.record)
        J, columns, h = batch.whitened(graph.values)[1], batch.columns.reshape(len(batch), -1), 1e-4
        for c in rng.choice(graph.flat().layout.size, 60, replace=False).tolist() + list(range(66, 90)):
            d = np.zeros(graph.flat().layout.size)
            d[c] = h
            up, down = (batch.whitened(graph.values.retract(s * d))[0] for s in (1.0, -1.0))
            by_step = (up - down) / (2.0 * h)
            by_hand = np.where((columns == c)[:, None], J, 0.0).sum(axis=2)
            scale = max(float(np.abs(by_step).max()), 1.0)
            np.testing.assert_allclose(by_hand, by_step, atol=2e-5 * scale)
    assert seen == kinds


def test_the_residual_is_that_of_gtsam(rng):
    """With the datum as GTSAM's pose of the navigation frame, and a clock in seconds."""
    graph = street(level=False)
    datum = graph.values.datum
    c, s = np.cos(datum[3] / 2.0), np.sin(datum[3] / 2.0)
    frame = gtsam_pose(np.array([*datum[:3], 0.0, 0.0, s, c]))
    records = [r for r in graph.records.values() if isinstance(r, PseudorangeRecord)][::9]
    for r in records:
        theirs = gtsam.PseudorangeFactorArm(
            1, 2, r.distance, r.satellite, r.arm, frame, 0.0, gtsam.noiseModel.Isotropic.Sigma(1, r.sigma)
        )
        pose, clock = graph.values.poses[r.node], graph.values["clock"][r.clock, 0]
        values = gtsam.Values()
        values.insert(1, gtsam_pose(pose))
        values.insert(2, clock / SPEED_OF_LIGHT)
        (batch,) = [b for b in graph.flat().batches if b.record is PseudorangeRecord]
        k = [q.factor_id for q in batch.records].index(r.factor_id)
        ours, J = (a[k] for a in batch.whitened(graph.values))
        J_pose, by = theirs.linearize(values).jacobian()
        assert ours[0] == pytest.approx(-by[0], abs=1e-3)  # theirs is rounded to a millimetre
        np.testing.assert_allclose(J[0, :6], J_pose[0, :6], atol=1e-5)


def test_every_solver_ends_at_the_same_place():
    batch, step_by_step = street(), street()
    BatchSolver(batch).solve_to_optimum()
    solver = Isam2Solver(step_by_step)
    solver.update()
    solver.solve_to_optimum()
    ours, theirs = batch.objective().total, step_by_step.objective().total
    assert theirs == pytest.approx(ours, rel=1e-6)
    np.testing.assert_allclose(step_by_step.values.poses[:, :3], batch.values.poses[:, :3], atol=1e-2)
    values = to_gtsam(batch.values)
    total = sum(2.0 * gtsam_factor(r, {"x0": batch.origin}).error(values) for r in batch.records.values())
    assert total == pytest.approx(ours, rel=1e-6)


def test_positions_are_consistent_where_the_noise_is_as_stated():
    """Squared errors of the last epoch over their covariance, 16 drives."""
    config, found = SatelliteConfig(seconds=40.0, step=2.0), []
    for seed in range(16):
        log = simulate_satellites(seed, config)
        graph = solve_street(log, TRUE)
        y, P = antenna_positions(graph, [len(log["odometry"].times) - 1], np.zeros(3))
        e = (y - log["reference"].poses[-1:, :3])[0, :2]
        found.append(float(e @ np.linalg.solve(P[0, :2, :2], e)))
    low, high = chi2.ppf([0.005, 0.995], 32) / 32.0
    assert low < np.mean(found) / 2.0 < high


def test_what_is_stated_matters():
    """The stated σ alone, for signals that come round corners: far off, and sure of it."""
    log = simulate_satellites(3, SatelliteConfig(seconds=60.0, step=2.0))
    naive, consistent = (score_of([errors(log, solve_street(log, c), 1)]) for c in (PseudorangeConfig(), TRUE))
    assert naive.nees > 50.0 > 5.0 > consistent.nees
    assert consistent.rmse < naive.rmse


def test_the_turn_of_the_earth_is_not_left_out():
    """Satellites as they stand in the file put the car twenty metres to the east."""
    config = SatelliteConfig(seconds=30.0, step=2.0, sigma=0.5, bias_sigma=0.5, density=(50.0, 52.0))
    log = simulate_satellites(5, config)
    here = score_of([errors(log, solve_street(log, PseudorangeConfig()), 1)])
    assert here.rmse < 3.0

    class Still(TangentPlane):
        def satellites(self, sent):
            return self.from_ecef(sent)

    graph = FactorGraph(3)
    nodes = add_odometer(graph, log["odometry"])
    for n in nodes[::5].tolist():
        graph.add_attitude(n, DOWN, 0.02, evidence="prior")
    add_pseudoranges(graph, log["pseudoranges"], Still(*log.meta["plane"]), nodes)
    BatchSolver(graph).update()
    assert score_of([errors(log, graph, 1)]).mean[0] > 10.0


def test_a_receiver_alone_on_its_antenna():
    """The antenna is where its lever puts it, and not at the base."""
    graph = street(lever=(0.0, 0.0, 40.0))
    plain = street(lever=(0.0, 0.0, 0.0))
    for g in (graph, plain):
        BatchSolver(g).solve_to_optimum()
    high = antenna_positions(graph, [4], np.array([0.0, 0.0, 40.0]))[0]
    np.testing.assert_allclose(high, antenna_positions(plain, [4], np.zeros(3))[0], atol=2.0)
    base = antenna_positions(graph, [4], np.zeros(3))[0]
    assert high[0, 2] - base[0, 2] == pytest.approx(40.0, abs=0.5)


def test_what_cannot_be_used_is_refused_and_changes_nothing():
    log = simulate_satellites(1, SHORT)
    with pytest.raises(GeometryError, match="in space"):
        add_odometer(FactorGraph(2), log["odometry"])
    graph = FactorGraph(3)
    nodes = add_odometer(graph, log["odometry"])
    with pytest.raises(DataError, match="empty graph"):
        add_odometer(graph, log["odometry"], stream="another")
    few = log["pseudoranges"].take([])
    before = graph.revision, len(graph.records)
    for ranges, at in ((few, nodes[:0]), (log["pseudoranges"], nodes + 1), (log["pseudoranges"], np.full(12, -1))):
        with pytest.raises(DataError):
            add_pseudoranges(graph, ranges, PLANE, at)
    assert (graph.revision, len(graph.records)) == before
    ids = add_pseudoranges(graph, log["pseudoranges"], PLANE, nodes)
    assert len(ids) == len(log["pseudoranges"].ranges)
    with pytest.raises(EvidenceReusedError):
        add_pseudoranges(graph, log["pseudoranges"], PLANE, nodes)
    for bad in ({"bias_sigma": -1.0}, {"density_scale": 0.0}, {"bias_every": np.nan}):
        with pytest.raises(ConfigError, match="pseudoranges"):
            PseudorangeConfig(**bad)


def test_the_stream_stays_spent_whichever_factor_goes():
    log = simulate_satellites(1, SHORT)
    graph = FactorGraph(3)
    nodes = add_odometer(graph, log["odometry"])
    ids = add_pseudoranges(graph, log["pseudoranges"], PLANE, nodes)
    for fid in (0, 1, ids[0], ids[-1]):
        if fid in graph.records:
            graph.remove(fid)
    with pytest.raises(EvidenceReusedError):
        add_pseudoranges(graph, log["pseudoranges"], PLANE, nodes)


def test_fixes_and_pseudoranges_share_their_frame(rng):
    """Fixes a kilometre from the plane's origin, and exact distances to satellites: one datum holds both."""

    class Flat(TangentPlane):
        def satellites(self, sent):
            return sent

    chain = dense_chain(rng, 3, m=8)
    away = np.array([800.0, -600.0, 50.0, 0.7])
    gps = fixes_along(chain, rng, level_datum_pose(away), sigma=0.01)
    graph = built(chain, gps)
    BatchSolver(graph).solve_to_optimum()
    nodes = np.array([s.node for s in graph.submaps])
    there = antenna_positions(graph, nodes, LEVER)[0] + graph.gps_origin
    up = np.array([[1, 0, 1], [-1, 0.3, 1], [0, 1, 1], [0.2, -1, 1], [0, 0, 1.0], [1, 1, 0.5]])
    sky = 2e7 * up / np.linalg.norm(up, axis=1)[:, None]
    n, m = len(nodes), len(sky)
    times = np.array([s.interval[0] for s in graph.submaps])
    way = np.linalg.norm(there[:, None] - sky, axis=2) - 300.0
    ranges = Pseudoranges(
        times=times, offsets=m * np.arange(n + 1), ranges=way.ravel(), sigmas=np.full(n * m, 0.1),
        satellites=np.tile(sky, (n, 1)), ids=np.tile(np.arange(m), n), systems=np.ones(n * m, np.int64),
        elevation=np.full(n * m, 0.7), density=np.full(n * m, 50.0), lever=LEVER,
    )  # fmt: skip
    add_pseudoranges(graph, ranges, Flat(52.5, 13.4), nodes)
    BatchSolver(graph).solve_to_optimum()
    assert graph.objective()["pseudorange"].chi2 < 1.0
    np.testing.assert_allclose(antenna_positions(graph, nodes, LEVER)[0] + graph.gps_origin, there, atol=0.02)


def test_epochs_without_a_node_are_counted():
    log = simulate_satellites(1, SHORT)
    graph = FactorGraph(3)
    nodes = add_odometer(graph, log["odometry"])
    at = np.where(np.arange(len(nodes)) < 3, -1, nodes)
    add_pseudoranges(graph, log["pseudoranges"], PLANE, at)
    (event,) = [e for e in graph.events if e["event"] == "pseudoranges"]
    assert (event["epochs"], event["dropped"]) == (9, 21)


def test_a_bias_of_the_turn_rate_is_found():
    """The odometer's bias and scale are variables: by positions they are found, and the path is straight again."""
    config = SatelliteConfig(seconds=120.0, step=2.0, sigma=0.3, bias_sigma=0.3, density=(50.0, 52.0), rate_sigma=5e-3)
    log = simulate_satellites(2, config)
    graph = solve_street(log, PseudorangeConfig())
    read, true = (SE3.log(T)[:, 2] for T in (log["odometry"].increments[1:], _true_increments(log)))
    assert graph.values["odometer"][0, 0] == pytest.approx(float(np.mean(read - true)) / 2.0, abs=6e-4)


def _true_increments(log):
    poses = log["reference"].poses
    return SE3.between(poses[:-1], poses[1:])
