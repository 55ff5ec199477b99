"""An IMU in a graph of the plane: Jacobians, both solvers, consistency, both kinds of submaps, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.errors import DataError, GeometryError
from graphslam.core.gaussian import chi2_mean_bounds
from graphslam.core.imu import GRAVITY
from graphslam.evaluate.residual_consistency import class_consistency
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.batch import gtsam_factor
from graphslam.graph.factors.imu.config import ImuConfig
from graphslam.graph.factors.imu.plane import LEAN, LEAN_TIME
from graphslam.graph.factors.imu.records import ForceRecord, GyroRecord, ImuBiasRecord, ImuRecord
from graphslam.graph.sensors.imu import ImuFactors
from graphslam.solve.batch import BatchSolver
from graphslam.solve.isam2 import Isam2Solver
from tests.reference import imu_plane, imu_ring
from tests.reference.gtsam_optimum import optimise_with_gtsam
from tests.reference.gtsam_twin import to_gtsam

T = np.arange(-10, 2420) / 100
RUNS = 60


def chain(rng, **options) -> FactorGraph:
    g = FactorGraph(2)
    for s in imu_plane.submaps(rng, **options):
        g.add_submap(s, spacing=3.0)
    return g


def mixed(rng) -> FactorGraph:
    """Two units on dense submaps and submaps with landmarks, one by its gyro alone, and a pause."""
    g = chain(rng)
    imu, _ = imu_plane.readings(T, rng)
    g.add_sensor(imu.take((imu.times < 6.5) | (imu.times > 13.0)), stream="imu")
    g.add_sensor(imu_plane.readings(T, rng)[0], stream="second", config=ImuConfig(accelerometer=False))
    return g


def test_both_kinds_of_submaps_are_tied(rng):
    g = mixed(rng)
    kinds = {type(r) for r in g.records.values()}
    assert {ImuRecord, GyroRecord, ImuBiasRecord} <= kinds
    assert ForceRecord not in kinds
    ends = {(r.i, r.j) for r in g.records.values() if type(r) is GyroRecord}
    assert {(s.nodes[k], s.nodes[k + 1]) for s in g.submaps for k in range(len(s.nodes) - 1)} == ends
    assert g.values.velocities.shape[1] == 2
    assert g.values.imu_biases.shape[1] == 3
    lay = g.flat().layout
    assert g.objective().dof == sum(r.rows for r in g.records.values()) - lay.size
    assert g.diagnose().ok  # no start velocity is needed
    assert g.values.tilt is None


def test_jacobians_are_those_of_differences(rng):
    g = mixed(rng)
    lay, h = g.flat().layout, 1e-6
    values = g.values.retract(0.1 * rng.standard_normal(lay.size))
    seen = 0
    for batch in g.flat().batches:
        if not issubclass(batch.record, ImuRecord | ImuBiasRecord) or not len(batch):
            continue
        _, J = batch.whitened(values)
        columns = batch.columns.reshape(len(batch), -1)
        mine = np.zeros((*J.shape[:2], lay.size))
        for k in range(len(batch)):
            free = columns[k] >= 0
            mine[k][:, columns[k][free]] = J[k][:, free]
        for c in range(lay.size):
            step = np.zeros(lay.size)
            step[c] = h
            numeric = (batch.whitened(values.retract(step))[0] - batch.whitened(values.retract(-step))[0]) / (2 * h)
            np.testing.assert_allclose(mine[:, :, c], numeric, atol=2e-5 * np.abs(mine).max())
        seen += len(batch)
    assert seen > 15


def test_gtsam_factors_are_the_batches(rng):
    g = mixed(rng)
    values = g.values.retract(0.02 * rng.standard_normal(g.flat().layout.size))
    blocks, theirs, seen = g.flat().factor_blocks(values), to_gtsam(values), 0
    for record, columns, H, d2 in zip(blocks.records, blocks.columns, blocks.H, blocks.d2):
        if isinstance(record, ImuRecord | ImuBiasRecord):
            factor = gtsam_factor(record, {"x0": g.origin})
            assert 2 * factor.error(theirs) == pytest.approx(d2, rel=1e-9)
            A, _ = factor.linearize(theirs).jacobian()
            free = columns >= 0
            np.testing.assert_allclose(A.T @ A, H[np.ix_(free, free)], atol=1e-8 * np.abs(H).max())
            seen += 1
    assert seen > 15


def test_both_solvers_agree(rng):
    g = mixed(rng)
    solver = Isam2Solver(g)
    solver.update()
    theirs, objective = optimise_with_gtsam(g)
    solver.solve_to_optimum()
    assert g.objective().total == pytest.approx(objective, rel=1e-6)
    for word in ("x", "l", "velocity", "imubias"):
        np.testing.assert_allclose(theirs[word], g.values[word], atol=1e-5)
    assert solver.solution().covariance("velocity0").shape == (2, 2)


def test_readings_without_error_have_no_residual(rng, monkeypatch):
    """Of a planar unit that is turned on the body, and of one with three axes on a level body."""
    monkeypatch.setattr(imu_plane, "STEP", np.full(3, 1e-9))
    for lean in (None, np.zeros((len(T), 2))):
        g = chain(rng, landmarks=False)
        g.add_sensor(imu_plane.readings(T, None, lean=lean)[0])
        BatchSolver(g).solve_to_optimum()
        assert g.objective()["imu"].chi2 < 1e-2
        np.testing.assert_allclose(g.values.imu_biases, 0.0, atol=1e-3)


@pytest.mark.parametrize("leaning", [False, True])
def test_nees_by_block_is_inside_two_sided_bounds(leaning):
    """Nodes of one run are alike, so the bounds are those of the runs; a covariance that is halved is outside."""
    trials, chi2, bare = [], np.zeros(2), []
    for k in range(RUNS):
        rng = np.random.default_rng([7, k])
        lean = None
        if leaning:  # starts within LEAN and walks by as much in LEAN_TIME
            steps = LEAN / np.sqrt(LEAN_TIME) * 0.1 * rng.standard_normal((len(T), 2))
            steps[0] = LEAN * rng.standard_normal(2)
            lean = np.cumsum(steps, axis=0)
        made = imu_plane.submaps(rng, landmarks=False)
        imu, bias = imu_plane.readings(T, rng, lean=lean)
        g = imu_plane.solved(made, imu)
        trials.append(imu_plane.nees(g, imu, bias))
        c = class_consistency(g)["imu"]
        chi2 += c.chi2, c.dof
        without = imu_plane.solved(made, None).values.poses[-1] - imu_plane.true_pose(np.array([24.0]))[0]
        bare.append((without[:2] @ without[:2], np.sum((g.values.poses[-1] - imu_plane.true_pose(24.0))[:2] ** 2)))
    for block, n in {"position": 2, "heading": 1, "velocity": 2, "gyro bias": 1, "force bias": 2}.items():
        mean = np.mean([t[block] for t in trials])
        low, high = np.array(chi2_mean_bounds(n, RUNS, 0.999)) / n
        assert low < mean < high, block
        assert 2 * mean > high, block
    low, high = np.array(chi2_mean_bounds(chi2[1], 1, 0.999)) / chi2[1]
    assert low < chi2[0] / chi2[1] < high
    assert 2 * chi2[0] / chi2[1] > high
    without, with_imu = np.mean(bare, axis=0)
    assert with_imu < 0.8 * without


def test_what_it_refuses(rng):
    g = chain(rng)
    tilted = replace(
        imu_ring.ring(rng, submaps=1).imu, T_base_imu=np.array([0.0, 0, 0, np.sin(0.4), 0, 0, np.cos(0.4)])
    )
    with pytest.raises(DataError, match=r"imu: .*not level.*mean specific force .* T_base_imu as it is mounted"):
        g.add_sensor(tilted)
    planar, _ = imu_plane.readings(T, rng)
    with pytest.raises(GeometryError, match="a planar IMU does not say how a body moves in space"):
        FactorGraph(3).add_sensor(planar)
    assert not any(isinstance(r, ImuRecord) for r in g.records.values())


def test_wrong_axes_are_named(rng):
    """A gyro with the wrong sign, and exchanged axes of the forces, by a planar unit and one with gravity."""
    for lean in (None, np.zeros((len(T), 2))):
        imu, _ = imu_plane.readings(T, rng, lean=lean, turn=0.0)
        g = chain(rng)
        g.add_sensor(imu)
        assert [e["verdict"] for e in g.events if e["event"] == "imu-axes"] == ["as stated"]
        with pytest.raises(DataError, match="z reads −z"):
            ImuFactors.of(g).check(replace(imu, angular_rate=-imu.angular_rate))
    assert abs(imu.specific_force[:, 2].mean() - GRAVITY) < 1e-9


def test_it_goes_with_its_submap(rng):
    g = mixed(rng)
    g.remove(g.submaps[-1].factor_id)
    assert {r.j for r in g.records.values() if isinstance(r, GyroRecord)} == set(range(1, len(g.values.poses)))
    assert g.diagnose().ok
    for fid in [i for i, r in g.records.items() if isinstance(r, ImuRecord)]:
        g.remove(fid)
    assert len(g.values.velocities) == len(g.values.imu_biases) == 0
