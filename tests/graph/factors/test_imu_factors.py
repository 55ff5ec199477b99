"""IMU factors in a graph: Jacobians, both solvers, GTSAM's own factor, the ledger, what is left out, and removal."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from graphslam.core import se3
from graphslam.core.errors import ConfigError, DataError, EvidenceReusedError
from graphslam.core.imu import GRAVITY
from graphslam.core.poses import SE3
from graphslam.core.records import Gps
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.batch import gtsam_factor, gtsam_pose
from graphslam.graph.factors.imu.config import ImuConfig, places_on_nodes
from graphslam.graph.factors.imu.preintegration import preintegrate
from graphslam.graph.factors.imu.records import ForceRecord, GyroRecord, ImuBiasRecord, ImuRecord
from graphslam.graph.ledger import EvidenceUse
from graphslam.graph.sensors.gps import GpsConfig
from graphslam.graph.sensors.imu import ImuFactors
from graphslam.graph.variables import gtsam_key, key_name
from graphslam.solve.batch import BatchSolver, linearisation_gap
from graphslam.solve.isam2 import Isam2Solver
from tests.reference.gtsam_optimum import optimise_with_gtsam
from tests.reference.gtsam_twin import to_gtsam
from tests.reference.imu_ring import MOUNT, NOISE, Ring, ring, true_readings

EVERY = ("imu", "gyro", "imu-bias", "imu-gravity")


def chain(made: Ring, spacing: float | None = 3.0, **levelled: float) -> FactorGraph:
    g = FactorGraph(3)
    for s in made.submaps:
        g.add_submap(s, spacing=spacing, **levelled)
    return g


def mixed(rng) -> tuple[Ring, FactorGraph]:
    """A graph with every kind of factor of an IMU: two units, one by its gyro alone, pauses, far nodes."""
    made = ring(rng, submaps=4, seconds=6.0)
    g = chain(made)
    hole = made.imu.take((made.imu.times < 6.5) | (made.imu.times > 13.0))
    g.add_sensor(hole, stream="imu")
    g.add_sensor(replace(made.imu, T_base_imu=MOUNT), stream="second", config=ImuConfig(accelerometer=False))
    g.add_sensor(made.imu, stream="third", config=ImuConfig(longest=0.6, acceleration=2.0))
    return made, g


def kinds(g: FactorGraph) -> list[type]:
    return [type(r) for r in g.records.values()]


def wobbled(g: FactorGraph, rng, size: float = 0.02):
    return g.values.retract(size * rng.standard_normal(g.flat().layout.size))


def test_every_kind_is_there_and_named(rng):
    _, g = mixed(rng)
    assert {ImuRecord, GyroRecord, ImuBiasRecord, ForceRecord} <= set(kinds(g))
    lay = g.flat().layout
    assert len(lay.owner_of_columns()) == lay.size == g.flat().evaluate(g.values).A.shape[0]
    for name in lay.names():
        assert key_name(gtsam_key(name)) == name
        assert [lay.owner_of_columns()[c] for c in lay.columns(name)] == [name] * len(lay.columns(name))
    score = g.objective()
    assert score.dof == sum(r.rows for r in g.records.values()) - lay.size
    assert g.diagnose().ok
    assert set(score) >= {"imu", "imu-bias", "imu-gravity"}


def test_jacobians_are_those_of_differences(rng):
    """Of every batch, at values where nothing is small."""
    _, g = mixed(rng)
    values = wobbled(g, rng, 0.1)
    lay, h = g.flat().layout, 1e-6
    for batch in g.flat().batches[-4:]:
        r, J = batch.whitened(values)
        columns = batch.columns.reshape(len(batch), -1)
        numeric = np.zeros((len(batch), r.shape[1], lay.size))
        for c in range(lay.size):
            step = np.zeros(lay.size)
            step[c] = h
            numeric[:, :, c] = (batch.whitened(values.retract(step))[0] - batch.whitened(values.retract(-step))[0]) / (
                2 * h
            )
        mine = np.zeros_like(numeric)
        for k in range(len(batch)):
            for q, c in enumerate(columns[k]):
                if c >= 0:
                    mine[k, :, c] += J[k, :, q]
        np.testing.assert_allclose(mine, numeric, atol=2e-5 * np.abs(mine).max())


def test_the_way_is_gtsams_own(rng):
    """With the unit at the node and no lean the residuals are those of ``CombinedImuFactor``, covariance and all."""
    hz = 1000
    t = np.arange(0, 2 * hz + 2) / hz
    rate, force = true_readings(t)
    made = ring(rng, submaps=1)
    imu = replace(made.imu, times=t, angular_rate=rate, specific_force=force)
    pim = preintegrate(imu, [0.0], [1.0])
    parameters = gtsam.PreintegrationCombinedParams.MakeSharedU(GRAVITY)
    for name, sigma in (("Gyroscope", NOISE.gyro), ("Accelerometer", NOISE.accelerometer)):
        getattr(parameters, f"set{name}Covariance")(sigma**2 * np.eye(3))
    parameters.setBiasOmegaCovariance(NOISE.gyro_walk**2 * np.eye(3))
    parameters.setBiasAccCovariance(NOISE.accelerometer_walk**2 * np.eye(3))
    parameters.setIntegrationCovariance(1e-16 * np.eye(3))
    theirs = gtsam.PreintegratedCombinedMeasurements(parameters, gtsam.imuBias.ConstantBias())
    for k in range(hz):
        theirs.integrateMeasurement(0.5 * (force[k] + force[k + 1]), 0.5 * (rate[k] + rate[k + 1]), 1.0 / hz)
    P = pim.covariance[0]
    record = ImuRecord(
        0, "imu", 1, 2, (0.0, 1.0), (0, 1), (0, 1), SE3.identity, SE3.identity, pim.R[0], pim.p[0], pim.v[0],
        pim.J[0], pim.bias[0], np.linalg.inv(np.linalg.cholesky(P)), np.zeros((2, 6, 6)),
    )  # fmt: skip
    x = SE3.exp(rng.normal(size=(1, 6)))[0]
    turn, v = se3.quat_to_matrix(x[3:]), rng.normal(size=3)
    g = np.array([0, 0, -GRAVITY])
    y = np.concatenate([x[:3] + v + 0.5 * g + turn @ pim.p[0], se3.quat_multiply(x[3:], se3.matrix_to_quat(pim.R[0]))])
    w, sigma = v + g + turn @ pim.v[0], np.sqrt(np.diag(P))
    values, theirs_factor = gtsam.Values(), gtsam.CombinedImuFactor(0, 1, 2, 3, 4, 5, theirs)
    factor = gtsam_factor(record, {"x0": SE3.identity})
    at = SE3.compose(y, SE3.exp(2 * sigma[:6] * rng.normal(size=6)))
    w = w + 2 * sigma[6:9] * rng.normal(size=3)
    a, b = 0.01 * rng.normal(size=(2, 6)) * [1, 1, 1, 5, 5, 5]
    b = a + sigma[9:] * rng.normal(size=6)
    bias = [gtsam.imuBias.ConstantBias(c[3:], c[:3]) for c in (a, b)]
    for key, value in enumerate([gtsam_pose(x), v, gtsam_pose(at), w, *bias]):
        values.insert(key, value)
    mine = gtsam.Values()
    named = {"x1": gtsam_pose(x), "velocity0": v, "imubias0": a, "x2": gtsam_pose(at), "velocity1": w, "imubias1": b}
    for name, value in (named | {"tilt": np.zeros(2)}).items():
        mine.insert(gtsam_key(name), value)
    assert factor.error(mine) > 3
    assert factor.error(mine) == pytest.approx(theirs_factor.error(values), rel=0.05)


def test_gtsam_factors_are_the_batches(rng):
    """Residual and Jacobian of every factor, the fixed base among them."""
    _, g = mixed(rng)
    values = wobbled(g, rng)
    flat, theirs = g.flat(), to_gtsam(values)
    blocks = flat.factor_blocks(values)
    seen = 0
    for record, columns, H, d2 in zip(blocks.records, blocks.columns, blocks.H, blocks.d2):
        if not isinstance(record, ImuRecord | ImuBiasRecord | ForceRecord):
            continue
        factor = gtsam_factor(record, {"x0": g.origin})
        assert 2 * factor.error(theirs) == pytest.approx(d2, rel=1e-9)
        A, _ = factor.linearize(theirs).jacobian()
        free = columns >= 0
        np.testing.assert_allclose(A.T @ A, H[np.ix_(free, free)], atol=1e-8 * np.abs(H).max())
        seen += 1
    assert seen > 20


def test_both_solvers_agree(rng):
    _, g = mixed(rng)
    solver = Isam2Solver(g)
    solver.update()
    assert linearisation_gap(solver.graph) >= -1e-9
    theirs, objective = optimise_with_gtsam(g)
    solver.solve_to_optimum()
    mine = g.values
    assert g.objective().total == pytest.approx(objective, rel=1e-6)
    np.testing.assert_allclose(theirs.poses, mine.poses, atol=1e-5)
    np.testing.assert_allclose(theirs.velocities, mine.velocities, atol=1e-5)
    np.testing.assert_allclose(theirs.imu_biases, mine.imu_biases, atol=1e-5)
    np.testing.assert_allclose(theirs.tilt, mine.tilt, atol=1e-6)
    solution = solver.solution()
    assert solution.converged
    assert solution.covariance("velocity0").shape == (3, 3)
    assert solution.covariance("imubias0").shape == (6, 6)


def test_online_is_offline(rng):
    """Readings in two portions and submaps one by one, solved in between, end where all at once do."""
    made = ring(rng, submaps=3, seconds=4.0)
    whole = chain(made)
    whole.add_sensor(made.imu)
    BatchSolver(whole).solve_to_optimum()
    g, cut = FactorGraph(3), 5.3
    solver = Isam2Solver(g)
    early, late = made.imu.take(made.imu.times <= cut), made.imu.take(made.imu.times > cut)
    for k, s in enumerate(made.submaps):
        g.add_submap(s, spacing=3.0)
        g.add_sensor(early if k == 0 else late if k == 1 else late.take(slice(0, 0)))
        solver.update()
    with pytest.raises(DataError, match="were given before"):
        g.add_sensor(late)
    solver.solve_to_optimum()
    for _ in range(3):
        ImuFactors.of(g).recentre(limit=0.0)
        BatchSolver(g).solve_to_optimum()
        ImuFactors.of(whole).recentre(limit=0.0)
        BatchSolver(whole).solve_to_optimum()
    np.testing.assert_allclose(g.values.poses, whole.values.poses, atol=1e-5)
    assert len(g.values.velocities) == len(whole.values.velocities)
    assert g.objective().total == pytest.approx(whole.objective().total, rel=1e-4)


def test_the_last_node_waits_for_the_submap_that_begins_there(rng):
    """A far node would see gravity; with the next submap it begins a way, and readings are spent once."""
    made = ring(rng, submaps=3, seconds=6.0)
    spacings = (None, 3.0, None)  # far, near, far
    config = ImuConfig(longest=4.0)
    whole, g = FactorGraph(3), FactorGraph(3)
    for k, (s, spacing) in enumerate(zip(made.submaps, spacings)):
        whole.add_submap(s, spacing=spacing)
        g.add_submap(s, spacing=spacing)
        readings = made.imu.take(slice(None) if k == 0 else slice(0, 0))
        ImuFactors.of(g).add(readings, config=config, more=k < 2)
    whole.add_sensor(made.imu, config=config)

    def told(graph: FactorGraph) -> list[tuple[str, ...]]:
        return sorted((type(r).__name__, *(v for v in r.variables() if v[0] == "x")) for r in graph.records.values())

    assert told(g) == told(whole)
    assert ImuRecord in kinds(g)
    assert [e for e in g.events if e["event"] == "imu"] == [e for e in whole.events if e["event"] == "imu"]


def test_recentring_leaves_what_is_right(rng):
    made = ring(rng, submaps=2, noise=replace(NOISE, gyro_bias=0.05))
    g = chain(made, spacing=None)
    g.add_sensor(made.imu)
    solver = BatchSolver(g)
    solver.solve_to_optimum()
    for _ in range(5):
        if not ImuFactors.of(g).recentre(limit=1e-6):
            break
        solver.solve_to_optimum()
    assert ImuFactors.of(g).recentre(limit=1e-6) == 0
    for r in g.records.values():
        if isinstance(r, ImuRecord):
            direct = preintegrate(made.imu, [r.interval[0]], [r.interval[1]], g.values.imu_biases[r.biases[0]])
            np.testing.assert_allclose(r.p, direct.p[0], atol=1e-4)


# ------------------------------------------------------------------- the ledger


def test_a_submap_that_used_it_refuses_it(rng):
    made = ring(rng, submaps=3)
    g = FactorGraph(3)
    for k, s in enumerate(made.submaps):
        g.add_submap(replace(s, uses=frozenset({"laser", "imu"} if k == 1 else {"laser"})), spacing=3.0)
    before = (len(g.records), len(g.ledger), g.values.layout())
    with pytest.raises(EvidenceReusedError, match=r"use stream 'imu' .* a second time: submap 1"):
        g.add_sensor(made.imu)
    assert (len(g.records), len(g.ledger), g.values.layout()) == before
    assert not ImuFactors.of(g).used
    g.add_sensor(made.imu, stream="other")


def test_and_the_other_way_round(rng):
    made = ring(rng, submaps=2)
    g = chain(made)
    g.add_sensor(made.imu)
    with pytest.raises(EvidenceReusedError, match="imu x0"):
        g.add_between(0, 2, SE3.identity, np.eye(6), evidence=EvidenceUse(["imu"], (0.0, 1.0)))
    node = g.start_session(SE3.identity)
    again = replace(made.submaps[0], key=7, uses=frozenset({"imu"}))
    with pytest.raises(EvidenceReusedError, match="submap 7 would use stream 'imu'"):
        g.add_submap(again)
    assert node == len(g.values.poses) - 1
    table = g.ledger.table()
    assert (table[table["stream"] == "imu"]["kind"] == "measurement").all()


# ------------------------------------------------------------------- what is left out


def dropped(g: FactorGraph) -> dict[str, int]:
    return [e for e in g.events if e["event"] == "imu"][-1]["dropped"]


def test_what_is_left_out_is_counted(rng):
    made = ring(rng, submaps=4)
    t = made.imu.times
    g = chain(made)
    steps = sum(len(s.nodes) - 1 for s in g.submaps)
    late = made.imu.take((t > 4.0) & ~((t > 9.0) & (t < 10.0)) & (t < 20.0))
    ids = g.add_sensor(late, config=ImuConfig(gravity=False))
    counts = dropped(g)
    assert set(counts) == {"before the first reading", "a pause in the readings", "after the last reading"}
    factors = sum(isinstance(r, ImuRecord) for r in g.records.values())
    assert factors + sum(counts.values()) == steps
    links = [r for r in g.records.values() if isinstance(r, ImuBiasRecord)]
    assert [r.before is None for r in links] == [True, False]  # the start, and the walk over the pause
    assert len(ids) == factors + 2
    far = chain(made)
    far.add_sensor(made.imu, config=ImuConfig(longest=1.0))
    assert dropped(far)["too far apart"] == steps
    slow = chain(made)
    slow.add_sensor(made.imu.take(slice(None, None, 100)), config=ImuConfig(pause=5.0))
    assert dropped(slow)["too few readings"] > 0
    bare = FactorGraph(3)
    for s in made.submaps:
        bare.add_submap(replace(s, trajectory=None))
    bare.add_sensor(made.imu)
    assert dropped(bare) == {"the path does not reach the node": 4}


def test_what_it_refuses(rng):
    made = ring(rng, submaps=2)
    g = chain(made)
    with pytest.raises(DataError, match="needs readings"):
        g.add_sensor(made.imu.take(slice(0, 1)))
    for bad in ({"longest": 0.0}, {"window": -1.0}, {"pause": np.nan}, {"axes": "shrug"}):
        with pytest.raises(ConfigError, match=f"imu.{next(iter(bad))}"):
            ImuConfig(**bad)
    with pytest.raises(ConfigError, match="without noise"):
        g.add_sensor(replace(made.imu, noise=replace(NOISE, accelerometer=0.0)))
    assert not any(isinstance(r, ImuRecord) for r in g.records.values())


def test_swapped_axes_are_named(rng):
    made = ring(rng, submaps=4)
    A = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    swapped = replace(made.imu, angular_rate=made.imu.angular_rate @ A.T, specific_force=made.imu.specific_force @ A.T)
    g = chain(made)
    size = len(g.records)
    with pytest.raises(DataError, match=r"imu: the axes .*: x reads −y, y reads x"):
        g.add_sensor(swapped)
    assert len(g.records) == size
    g.add_sensor(swapped, config=ImuConfig(axes="warn"))
    events = [e for e in g.events if e["event"] == "imu-axes"]
    assert [e["verdict"] for e in events] == ["wrong", "wrong"]
    right = chain(made)
    right.add_sensor(made.imu)
    assert [e["verdict"] for e in right.events if e["event"] == "imu-axes"] == ["as stated"]
    brief = chain(ring(rng, submaps=1))
    brief.add_sensor(made.imu)
    assert [e["verdict"] for e in brief.events if e["event"] == "imu-axes"] == ["not checked"]


# ------------------------------------------------------------------- removal


def test_removal_gives_back_and_links(rng):
    made = ring(rng, submaps=3)
    g = chain(made)
    g.add_sensor(made.imu)
    solver = Isam2Solver(g)
    solver.update()
    middle = [r for r in g.records.values() if isinstance(r, ImuRecord)][3]
    states = len(g.values.imu_biases)
    g.remove(middle.factor_id)
    assert len(g.values.imu_biases) == states  # both are still held by their neighbours
    walks = [r for r in g.records.values() if isinstance(r, ImuBiasRecord) and r.before is not None]
    assert [(r.before, r.bias) for r in walks] == [middle.biases]
    solver.update()
    g.ledger.check("again", ["imu"], middle.interval)
    g.remove(g.submaps[0].factor_ids[0])
    g.remove(g.submaps[-1].factor_ids[0])
    assert g.values.is_finite()
    bases = [r for r in g.records.values() if isinstance(r, ImuBiasRecord) and r.before is None]
    assert len(bases) == 1
    every = {k for r in g.records.values() if isinstance(r, ImuRecord) for k in r.biases}
    assert every == set(range(len(g.values.imu_biases)))
    for fid in [i for i, r in g.records.items() if isinstance(r, ImuRecord)]:
        g.remove(fid)
    assert len(g.values.imu_biases) == len(g.values.velocities) == 0
    assert g.values.tilt is None
    assert not any(isinstance(r, ImuBiasRecord) for r in g.records.values())


def test_the_body_is_where_the_path_says(rng):
    """Bases lean; the body on them does not, and the last exit is where the last path ends."""
    made = ring(rng, submaps=2, step=np.full(6, 1e-9), lean=0.2)
    g = chain(made)
    places = places_on_nodes(g.submaps, 1.0)
    assert set(places) == set(range(len(g.values.poses)))
    for n, place in places.items():
        body = SE3.compose(g.values.poses[n], place.T_node_body)
        np.testing.assert_allclose(SE3.log(SE3.between(body, made.truth(np.array([place.time]))[0])), 0.0, atol=1e-6)


def test_fixes_take_the_tilt_when_it_comes(rng):
    """GPS that was there before the IMU is turned by the tilt that the IMU brings in."""
    made = ring(rng, submaps=4, seconds=8.0, lean=0.15)
    t = np.arange(0.5, 32, 1.0)
    z = made.truth(t)[:, :3] + 0.05 * rng.standard_normal((32, 3))
    gps = Gps(times=t, positions=z, sigma=np.full(32, 0.05), lever=np.zeros(3))
    g = chain(made)
    g.add_sensor(gps, config=GpsConfig(baseline=5.0))
    g.finish_sensors()
    g.add_sensor(made.imu)
    solver = Isam2Solver(g)
    solver.update()
    solver.solve_to_optimum()
    assert all("tilt" in r.variables() for r in g.records.values() if r.group == "gps")


def test_inside_levelled_submaps_the_gyro_says_roll_and_pitch(rng):
    """Increments between inner nodes give it up where a way is, and take it back when that goes."""
    made = ring(rng, submaps=2)
    g = chain(made, level_sigma=0.03)
    s = g.submaps[0]
    before = [g.records[f].whitener for f in s.factor_ids[: len(s.nodes) - 1]]
    ids = g.add_sensor(made.imu)
    s = g.submaps[0]
    after = [g.records[f].whitener for f in s.factor_ids[: len(s.nodes) - 1]]
    assert all(c[0, 0] > 1.0 > d[0, 0] for c, d in zip(s.covariances, s.stated))
    np.testing.assert_array_equal(before[-1], after[-1])
    for W, V, P in zip(before[:-1], after[:-1], s.stated[:-1]):
        np.testing.assert_allclose(np.linalg.inv(V.T @ V)[2:, 2:], P[2:, 2:], rtol=1e-6, atol=1e-12)
        assert not np.allclose(W, V)
    BatchSolver(g).solve_to_optimum()
    g.remove(ids[0])
    np.testing.assert_allclose(g.records[s.factor_ids[0]].whitener, before[0], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(g.submaps[0].covariances[0], s.stated[0])
    BatchSolver(g).solve_to_optimum()
    plain = chain(made)
    first = plain.records[plain.submaps[0].factor_ids[0]]
    plain.add_sensor(made.imu)
    assert plain.records[first.factor_id] is first  # a path that did not take them from gravity keeps them
