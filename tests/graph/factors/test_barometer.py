"""Heights of a barometer: Jacobians, both solvers, consistency, removal, and a run of a log that has one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.errors import DataError, GeometryError
from graphslam.core.gaussian import chi2_mean_bounds
from graphslam.core.records import Barometer
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.barometer import BarometerBatch, BarometerRecord
from graphslam.graph.factors.batch import gtsam_factor
from graphslam.io.log_store import load_log, save_log
from graphslam.solve.batch import BatchSolver
from graphslam.solve.isam2 import Isam2Solver
from tests.app.run.test_imu_run import made as logged
from tests.app.run.test_imu_run import solved
from tests.reference.gtsam_twin import to_gtsam
from tests.reference.imu_ring import ring

SIGMA = 0.1


def heights(made, rng, until: float = 23.9) -> Barometer:
    t = np.arange(0.2, until, 0.4)
    z = made.truth(t)[:, 2] + 30.0 + SIGMA * rng.standard_normal(len(t))
    return Barometer(times=t, heights=z, sigma=np.full(len(t), SIGMA))


def graph(rng, lean: float = 0.0) -> tuple[FactorGraph, Barometer]:
    made = ring(rng, lean=lean)
    g, readings = FactorGraph(3), heights(made, rng)
    g.add_sensor(readings.take(slice(0, 20)))
    for s in made.submaps:
        g.add_submap(s, spacing=3.0)
    g.add_sensor(readings.take(slice(20, None)))
    g.finish_sensors()
    return g, readings


def records(g) -> list[BarometerRecord]:
    return [r for r in g.records.values() if isinstance(r, BarometerRecord)]


@pytest.mark.parametrize("tilt", [False, True])
def test_jacobians_and_gtsam(rng, tilt):
    g, readings = graph(rng)
    assert len(records(g)) == len(readings.times)
    if tilt:
        g.add_attitude(0, [0, 0, -1], 0.03, evidence="prior")
        assert all("tilt" in r.variables() for r in records(g))
    lay, h = g.flat().layout, 1e-6
    values = g.values.retract(0.1 * rng.standard_normal(lay.size))
    batch = next(b for b in g.flat().batches if isinstance(b, BarometerBatch))
    _, J = batch.whitened(values)
    columns, mine = batch.columns.reshape(len(batch), -1), np.zeros((len(batch), lay.size))
    for k in range(len(batch)):
        free = columns[k] >= 0
        mine[k, columns[k][free]] = J[k, 0, free]
    for c in range(lay.size):
        step = np.zeros(lay.size)
        step[c] = h
        numeric = (batch.whitened(values.retract(step))[0] - batch.whitened(values.retract(-step))[0])[:, 0] / (2 * h)
        np.testing.assert_allclose(mine[:, c], numeric, atol=1e-5 * np.abs(mine).max())
    theirs, blocks = to_gtsam(values), g.flat().factor_blocks(values)
    for record, d2 in zip(blocks.records, blocks.d2):
        if isinstance(record, BarometerRecord):
            assert 2 * gtsam_factor(record, {"x0": g.origin}).error(theirs) == pytest.approx(d2, rel=1e-9)


def test_solvers_agree_and_heights_are_consistent():
    runs, chi2, dof, errors = 12, 0.0, 0.0, []
    for k in range(runs):
        g, _ = graph(np.random.default_rng([5, k]))
        BatchSolver(g).solve_to_optimum()
        score = g.objective()["barometer"]
        chi2, dof = chi2 + score.chi2, dof + score.dof
        errors.append((g.values["baselevel"][0, 0] - 30.0) ** 2 / g.covariance().marginal("baselevel0")[0, 0])
    low, high = np.array(chi2_mean_bounds(dof, 1, 0.999)) / dof
    assert low < chi2 / dof < high < 2 * chi2 / dof
    low, high = chi2_mean_bounds(1, runs, 0.999)
    assert low < np.mean(errors) < high
    total = g.objective().total
    other, _ = graph(np.random.default_rng([5, runs - 1]))
    solver = Isam2Solver(other)
    solver.update()
    solver.solve_to_optimum()
    assert other.objective().total == pytest.approx(total, rel=1e-6)


def test_it_goes_with_its_submaps_and_refuses(rng):
    g, readings = graph(rng)
    for s in list(g.submaps):
        g.remove(s.factor_id)
    assert not records(g)
    assert not g.values.count("baselevel")
    with pytest.raises(GeometryError, match="in the plane"):
        FactorGraph(2).add_sensor(readings)
    with pytest.raises(DataError, match="sigma of barometer reading 3"):
        replace(readings, sigma=np.where(np.arange(len(readings.times)) == 3, 0.0, SIGMA))


def test_a_run_finds_it_in_a_log(monkeypatch, tmp_path):
    log, submaps = logged()
    t = np.arange(0.2, 47.0, 0.4)
    z = log.truth.trajectory.interpolate(t)[:, 2] + 30.0
    both = replace(log, streams={**log.streams, "air": Barometer(times=t, heights=z, sigma=np.full(len(t), SIGMA))})
    save_log(both, tmp_path / "log")
    run = solved(load_log(tmp_path / "log"), submaps, monkeypatch)
    (row,) = [s for s in run.report["streams"] if s["name"] == "air"]
    assert (row["role"], row["used"], row["why"]) == ("barometer", len(t), "")
    assert len(records(run.graph)) == len(t)
