"""Control points and distances in a graph: Jacobians, solvers, datum, removal, merging, refusals."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.geometry import se2_compose, se2_transform
from graphslam.core.se3 import se3_transform
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.batch import gtsam_factor
from graphslam.graph.factors.control import ControlBatch, ControlRecord, DistanceBatch, DistanceRecord
from graphslam.graph.sensors.control import ControlFactors
from graphslam.graph.sensors.gps import GpsConfig
from graphslam.solve.batch import BatchSolver
from graphslam.solve.isam2 import Isam2Solver
from tests.reference.graph_chain import make_chain, make_gps
from tests.reference.gtsam_twin import to_gtsam
from tests.reference.imu_ring import ring
from tests.reference.surveyed import T_SURVEY_WORLD, surveyed, table

SIGMA = 0.05


def planar(rng, rows=None, **chain_options) -> FactorGraph:
    """A loop of landmark submaps with control at bases and on landmarks, and two distances."""
    chain = make_chain(rng, m=14, landmarks=20, laps=1.6, **chain_options)
    g = FactorGraph()
    for s in chain.submaps:
        g.add_submap(s)
    g.add_sensor(table(planar_rows(chain, rng) if rows is None else rows(chain)))
    g.finish_sensors()
    return g


def planar_rows(chain, rng) -> list[dict]:
    lever = np.array([0.5, 0.2])
    places = [(10.0 * k, se2_transform(chain.poses[k], lever)) for k in (0, 4, 9)]
    rows = surveyed(places, rng, SIGMA, lever=lever)
    rows += surveyed([(f"l{k}", chain.landmarks[k]) for k in (1, 2)], rng, SIGMA)
    for a, b in ((0, 7), (3, 4)):
        d = np.linalg.norm(chain.landmarks[a] - chain.landmarks[b]) + SIGMA * rng.standard_normal()
        rows.append({"place": f"l{a}", "to": f"l{b}", "distance": d, "sigma": SIGMA})
    far = np.linalg.norm(chain.poses[5, :2] - chain.poses[8, :2]) + SIGMA * rng.standard_normal()
    return [*rows, {"place": 50.0, "to": 80.0, "distance": far, "sigma": SIGMA}]


def spatial(rng) -> FactorGraph:
    """The graph of :func:`spatial_world`."""
    return spatial_world(rng)[0]


def spatial_world(rng):
    """Dense submaps in space with inner nodes, a tilt, control at times and a distance; and the truth."""
    made = ring(rng, lean=0.05)
    g = FactorGraph(3)
    for s in made.submaps:
        g.add_submap(s, spacing=3.0)
    g.add_attitude(0, [0, 0, -1], 0.03, evidence="prior")
    rows = spatial_rows(made, rng, np.array([1.0, 8.0, 14.5, 20.0]))
    ends = made.truth(np.array([1.0, 14.5]))[:, :3]
    far = np.linalg.norm(ends[0] - ends[1]) + SIGMA * rng.standard_normal()
    rows.append({"place": 1.0, "to": 14.5, "distance": far, "sigma": SIGMA})
    g.add_sensor(table(rows))
    g.finish_sensors()
    return g, made


def spatial_rows(made, rng, t, **cells) -> list[dict]:
    lever = np.array([0.1, 0.2, 0.3])
    at = se3_transform(made.truth(t), np.tile(lever, (len(t), 1)))
    return surveyed(zip(t.tolist(), at), rng, SIGMA, lever=lever, **cells)


def control_records(g: FactorGraph) -> list[ControlRecord | DistanceRecord]:
    return [r for r in g.records.values() if isinstance(r, (ControlRecord, DistanceRecord))]


@pytest.mark.parametrize("make", [planar, spatial])
def test_jacobians_and_gtsam(rng, make):
    g = make(rng)
    assert {type(r) for r in control_records(g)} == {ControlRecord, DistanceRecord}
    lay, h = g.flat().layout, 1e-6
    values = g.values.retract(0.1 * rng.standard_normal(lay.size))
    for batch in (b for b in g.flat().batches if isinstance(b, (ControlBatch, DistanceBatch))):
        r, J = batch.whitened(values)
        columns, mine = batch.columns.reshape(len(batch), -1), np.zeros((*r.shape, lay.size))
        for k in range(len(batch)):
            free = columns[k] >= 0
            mine[k][:, columns[k][free]] = J[k][:, free]
        for c in range(lay.size):
            step = np.zeros(lay.size)
            step[c] = h
            there, back = batch.whitened(values.retract(step))[0], batch.whitened(values.retract(-step))[0]
            np.testing.assert_allclose(mine[:, :, c], (there - back) / (2 * h), atol=1e-5 * np.abs(mine).max())
    theirs, blocks = to_gtsam(values), g.flat().factor_blocks(values)
    for record, loss in zip(blocks.records, g.flat().evaluate(values, hessian=False).chi2):
        if isinstance(record, (ControlRecord, DistanceRecord)):
            assert 2 * gtsam_factor(record, {"x0": g.origin}).error(theirs) == pytest.approx(loss, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("make", [planar, spatial])
def test_solvers_agree(make):
    a, b = make(np.random.default_rng(4)), make(np.random.default_rng(4))
    BatchSolver(a).solve_to_optimum()
    solver = Isam2Solver(b)
    solver.update()
    solver.solve_to_optimum()
    assert b.objective().total == pytest.approx(a.objective().total, rel=1e-6)
    assert {"control", "distance"} <= set(a.objective())
    assert a.objective().dof == a.flat().measurements - a.flat().layout.size


def test_the_datum_is_that_of_the_survey(rng):
    g = planar(rng)
    BatchSolver(g).solve_to_optimum()
    control = ControlFactors.of(g)
    assert (control.frame, g.gps_origin) == ("survey", None)
    datum = g.values.datum.copy()
    datum[:2] += control.origin
    np.testing.assert_allclose(datum[2], T_SURVEY_WORLD[2], atol=0.02)
    np.testing.assert_allclose(datum[:2], T_SURVEY_WORLD[:2], atol=0.3)
    assert {e.stream for e in g.ledger.entries() if e.stream.startswith("control")} == {
        f"control rows/{k}" for k in range(2, 10)
    }


def test_distances_alone_need_no_datum_and_hold_the_scale(rng):
    def rows(chain):
        d = np.linalg.norm(chain.landmarks[0] - chain.landmarks[7])
        return [{"place": "l0", "to": "l7", "distance": d, "sigma": 1e-4}]

    g = planar(rng, rows)
    BatchSolver(g).solve_to_optimum()
    assert g.values.datum is None
    (record,) = control_records(g)
    assert np.linalg.norm(g.landmark(0) - g.landmark(7)) == pytest.approx(record.distance, abs=1e-3)


def test_gps_fixes_hold_the_datum(rng):
    chain = make_chain(rng, m=14, landmarks=20, laps=1.6)
    g = FactorGraph()
    for s in chain.submaps:
        g.add_submap(s)
    g.add_sensor(make_gps(chain, rng, T_SURVEY_WORLD, step=2.0), config=GpsConfig())
    places = [(f"l{k}", chain.landmarks[k]) for k in range(4)]
    rows = surveyed(places[:2], rng, SIGMA, frame="gps") + surveyed(places[2:], rng, SIGMA, frame="survey")
    g.add_sensor(table(rows))
    g.finish_sensors()
    assert len(control_records(g)) == 2
    refused = [e for e in g.events if e["event"] == "control-refused"]
    assert [e["line"] for e in refused] == [4, 5]
    assert refused[0]["why"] == "GPS fixes hold the datum; got survey; wanted coordinates in the frame gps"
    BatchSolver(g).solve_to_optimum()
    T = BatchSolver(g).solution().T_gps_world
    np.testing.assert_allclose(T[:2], T_SURVEY_WORLD[:2], atol=0.3)


def test_rows_that_the_map_cannot_use(rng):
    def rows(chain):
        found = surveyed([(f"l{k}", chain.landmarks[k]) for k in (1, 2)], rng, SIGMA)
        found += surveyed([("l99", [0, 0]), (-1.0, [0, 0]), (999.0, [0, 0])], rng, SIGMA)
        found += [{"place": 31.0, "to": 33.0, "distance": 1.0, "sigma": 0.1}]
        return [*found, *surveyed([("l3", chain.landmarks[3])], rng, SIGMA, frame="gps")]

    g = planar(rng, rows)
    reasons = {e["line"]: e["why"] for e in g.events if e["event"] == "control-refused"}
    assert len(control_records(g)) == 2
    assert reasons[4] == "no landmark has this id; got l99; wanted an id of landmarks.csv"
    assert reasons[5] == "the time is outside the map; got -1.000 s; wanted 0.000 to 140.000 s"
    assert reasons[6].startswith("the time is outside the map; got 999.000 s")
    assert reasons[7].startswith("both places are at one node")
    assert reasons[8] == "rows of one frame hold the datum; got gps; wanted coordinates in the frame survey"
    one = planar(rng, lambda chain: surveyed([("l1", chain.landmarks[1])], rng, SIGMA))
    assert not control_records(one)
    assert "do not span enough" in one.events[-1]["why"]
    assert not [e for e in one.ledger.entries() if e.stream.startswith("control")]


def test_they_go_with_their_submaps_and_landmarks(rng):
    g = planar(rng)
    for s in reversed(list(g.submaps)):
        g.remove(s.factor_id)
        names = {n for r in control_records(g) for n in r.variables()}
        assert names <= {"x0", "datum", *g.values.layout().names()}
    assert not control_records(g)
    assert g.values.datum is None


def test_they_follow_landmarks_that_are_merged(rng):
    g = planar(rng)
    g.merge_landmarks(10, 1)
    g.merge_landmarks(3, 4)  # a distance between them
    assert [r.landmark for r in control_records(g) if isinstance(r, ControlRecord)][-2:] == [10, 2]
    assert sum(isinstance(r, DistanceRecord) for r in control_records(g)) == 2
    BatchSolver(g).solve_to_optimum()


def test_one_wild_row_does_not_bend_the_map():
    def rows(wild):
        def make(chain):
            found = surveyed([(f"l{k}", chain.landmarks[k]) for k in range(8)], np.random.default_rng(1), SIGMA)
            found[3]["x"] += wild
            return found

        return make

    a, b = (planar(np.random.default_rng(2), rows(w)) for w in (0.0, 30.0))
    for g in (a, b):
        BatchSolver(g).solve_to_optimum()
    np.testing.assert_allclose(a.values.poses, b.values.poses, atol=0.05)
    assert se2_compose(a.values.datum, np.zeros(3)) == pytest.approx(b.values.datum, abs=0.05)
