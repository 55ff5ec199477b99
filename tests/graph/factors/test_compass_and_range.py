"""Headings of a compass and distances: Jacobians, GTSAM's factors, every solver, honesty, where beacons are placed."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from graphslam.core.errors import ConfigError, DataError, EvidenceReusedError
from graphslam.core.geometry import wrap_angle
from graphslam.core.poses import SE2, SE3, Group
from graphslam.core.records import Compass, Gps, LandmarkObservations
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.batch import gtsam_factor
from graphslam.graph.factors.compass import CompassRecord, DeclinationRecord, DeviationPriorRecord
from graphslam.graph.factors.range import BeaconRangeRecord, RangeRecord
from graphslam.graph.sensors.beacons import trilaterate
from graphslam.graph.sensors.compass import CompassConfig
from graphslam.graph.sensors.gps import GpsConfig
from graphslam.solve.batch import BatchSolver
from graphslam.solve.isam2 import Isam2Solver
from tests.reference.gtsam_optimum import optimise_with_gtsam
from tests.reference.gtsam_twin import to_gtsam

SIGMA = {2: np.array([0.05, 0.05, 0.02]), 3: np.array([0.002, 0.002, 0.02, 0.05, 0.05, 0.05])}
KINDS = (CompassRecord, DeclinationRecord, DeviationPriorRecord, RangeRecord, BeaconRangeRecord)


def group(dim: int) -> Group:
    return SE2 if dim == 2 else SE3


def drive(dim: int, n: int = 24) -> np.ndarray:
    """A circle with a radius that changes, one pose a second; in space it climbs."""
    step = np.array([3.0, 0.0, 0.3]) if dim == 2 else np.array([0.0, 0.0, 0.3, 3.0, 0.0, 1.0])
    poses = [group(dim).identity]
    for k in range(n):
        some = step.copy()
        some[0 if dim == 2 else 3] += 1.5 * np.sin(0.9 * k)
        poses.append(group(dim).compose(poses[-1], group(dim).exp(some)))
    return np.array(poses)


def submap(k: int, T: np.ndarray, P: np.ndarray) -> Submap:
    G = SE2 if len(T) == 3 else SE3
    path = Trajectory(np.array([k, k + 1.0]), np.stack([G.identity, T]), np.stack([0 * P, P]))
    return Submap(
        key=k, interval=(float(k), k + 1.0), exit_pose=T, exit_covariance=P, trajectory=path,
        uses=frozenset({"wheels"}),
    )  # fmt: skip


HIGH = np.array([[5.0, 20.0, 4.0], [-14.0, 4.0, 1.0], [12.0, -6.0, 3.0]])
BEACONS = {2: HIGH[:, :2], 3: HIGH}


def world(rng: np.random.Generator, dim: int, *, zero: float = 0.7, iron: tuple[float, float] = (0.0, 0.0)):
    """True poses, a graph's submaps, a compass and distances, all with the noise that they state."""
    G, truth = group(dim), drive(dim)
    n = len(truth) - 1
    P = np.diag(SIGMA[dim] ** 2)
    submaps = []
    for k in range(n):
        T = G.compose(G.between(truth[k], truth[k + 1]), G.exp(SIGMA[dim] * rng.standard_normal(G.dof)))
        submaps.append(submap(k, T, P))
    times = np.arange(n) + 0.0
    x = truth[:-1]
    ahead = G.transform(x, np.tile(np.eye(dim)[0], (n, 1))) - x[:, :dim]
    z = np.arctan2(ahead[:, 1], ahead[:, 0]) + zero
    for _ in range(30):  # z stands on both sides of the deviation
        z = np.arctan2(ahead[:, 1], ahead[:, 0]) + zero + iron[0] * np.sin(z) + iron[1] * np.cos(z)
    compass = Compass(times=times, headings=z + 0.03 * rng.standard_normal(n), sigma=np.full(n, 0.03))
    which = np.arange(2 * n) % 3
    d = np.linalg.norm(x[np.repeat(np.arange(n), 2), :dim] - BEACONS[dim][which], axis=1)
    ranges = LandmarkObservations.range_only(
        times=times, offsets=2 * np.arange(n + 1), ranges=d + 0.1 * rng.standard_normal(2 * n),
        range_sigma=np.full(2 * n, 0.1), ids=which + 40,
    )  # fmt: skip
    return truth, submaps, compass, ranges


def graph_of(dim: int, submaps, compass=None, ranges=None, config: CompassConfig | None = None) -> FactorGraph:
    graph = FactorGraph(dim)
    if compass is not None:
        graph.add_sensor(compass, config=config)
    if ranges is not None:
        graph.add_sensor(ranges)
    for s in submaps:
        graph.add_submap(s)
    graph.finish_sensors()
    return graph


def everything(rng: np.random.Generator, dim: int) -> FactorGraph:
    """A graph with all five kinds of factors, away from its optimum."""
    truth, submaps, compass, ranges = world(rng, dim)
    graph = FactorGraph(dim)
    fixes = truth[:-1, :dim] + 0.2 * rng.standard_normal((len(truth) - 1, dim))
    times, sigma = np.arange(len(fixes)) + 0.5, np.full(len(fixes), 0.2)
    gps = Gps(times=times, positions=fixes, sigma=sigma, lever=np.zeros(dim))
    graph.add_sensor(gps, config=GpsConfig(baseline=5.0))
    graph.add_sensor(compass, config=CompassConfig(declination=0.1, hard_iron=0.2))
    graph.add_sensor(ranges)
    for s in submaps:
        graph.add_submap(s)
    graph.finish_sensors()
    graph.finish_sensors()
    arm = 0.3 * rng.standard_normal((4, dim))
    graph.add_range(2, 9, 4.0, 0.3, arm_i=arm[0], arm_j=arm[1], evidence="shared-scan")
    graph.add_range(0, 12, 7.0, 0.3, arm_i=arm[2], arm_j=arm[3], evidence="shared-scan")
    graph.add_range(7, 0, 9.0, 0.3, evidence="shared-scan")
    return graph


@pytest.mark.parametrize("dim", [2, 3])
def test_jacobians_are_those_of_differences(rng, dim):
    graph = everything(rng, dim)
    values = graph.values.retract(0.1 * rng.standard_normal(graph.flat().layout.size))
    flat, h = graph.flat(), 1e-6
    mine = [b for b in flat.batches if b.record in KINDS]
    assert len(mine) == len(KINDS)
    for batch in mine:
        r, J = batch.whitened(values)
        numeric = np.zeros((len(batch), r.shape[1], flat.layout.size))
        for c in range(flat.layout.size):
            step = np.zeros(flat.layout.size)
            step[c] = h
            up, down = batch.whitened(values.retract(step))[0], batch.whitened(values.retract(-step))[0]
            numeric[:, :, c] = (up - down) / (2 * h)
        dense = np.zeros_like(numeric)
        columns = batch.columns.reshape(len(batch), -1)
        for k in range(len(batch)):
            free = columns[k] >= 0
            dense[k][:, columns[k][free]] = J[k][:, free]
        np.testing.assert_allclose(dense, numeric, atol=1e-5 * np.abs(dense).max())


@pytest.mark.parametrize("dim", [2, 3])
def test_gtsam_factors_are_the_batches(rng, dim):
    graph = everything(rng, dim)
    values = graph.values.retract(0.1 * rng.standard_normal(graph.flat().layout.size))
    blocks, theirs, seen = graph.flat().factor_blocks(values), to_gtsam(values), set()
    for record, columns, H, d2 in zip(blocks.records, blocks.columns, blocks.H, blocks.d2):
        if isinstance(record, KINDS):
            factor = gtsam_factor(record, {"x0": graph.origin})
            assert 2 * factor.error(theirs) == pytest.approx(d2, rel=1e-8)
            A, _ = factor.linearize(theirs).jacobian()
            free = columns >= 0
            np.testing.assert_allclose(A.T @ A, H[np.ix_(free, free)], atol=1e-8 * np.abs(H).max())
            seen.add(type(record))
    assert seen == set(KINDS)


@pytest.mark.parametrize("dim", [2, 3])
def test_every_solver_ends_at_the_same_optimum(rng, dim):
    graph = everything(rng, dim)
    solver = Isam2Solver(graph)
    solver.solve_to_optimum()
    assert solver.solution().converged
    own = graph.objective().total
    BatchSolver(graph).solve_to_optimum()
    assert graph.objective().total == pytest.approx(own, rel=1e-9)
    assert optimise_with_gtsam(graph)[1] == pytest.approx(own, rel=1e-6)
    assert {"compass", "declination", "deviation", "range", "beacon"} <= set(graph.objective())
    assert graph.objective().dof == sum(r.rows for r in graph.records.values()) - graph.flat().layout.size


@pytest.mark.parametrize("dim", [2, 3])
def test_heading_and_position_are_consistent_with_a_compass_and_beacons(rng, dim):
    """NEES of the last pose and of the beacons over 60 runs, two-sided; and each sensor makes the end surer."""
    G, own = group(dim), {"both": [], "none": []}
    sigma = {}
    for _ in range(60):
        truth, submaps, compass, ranges = world(rng, dim)
        for name, sensors in (("both", (compass, ranges)), ("none", (None, None))):
            graph = graph_of(dim, submaps, *sensors)
            BatchSolver(graph).solve_to_optimum()
            P = graph.covariance().marginal(f"x{len(submaps)}")
            e = G.log(G.between(graph.values.poses[-1], truth[-1]))
            own[name].append(float(e @ np.linalg.solve(P, e)))
            sigma[name] = np.sqrt(np.diag(P))
            if name == "both":
                assert graph.structure.count("beacon") == 3
                for k in range(3):
                    number = next(x["beacon"] for x in graph.events if x.get("variable") == f"beacon{k}")
                    d = graph.values["beacon"][k] - BEACONS[dim][number - 40]
                    own.setdefault("beacons", []).append(
                        float(d @ np.linalg.solve(graph.covariance().marginal(f"beacon{k}"), d))
                    )
    for name, dof in (("both", G.dof), ("none", G.dof), ("beacons", dim)):
        runs = 60 if name == "beacons" else len(own[name])  # the three beacons of a run share its path
        low, high = chi2.ppf([0.001, 0.999], dof * runs) / runs
        assert low < np.mean(own[name]) < high, name
    heading, x = (2, 0) if dim == 2 else (2, 3)
    assert sigma["both"][heading] < 0.7 * sigma["none"][heading]
    assert sigma["both"][x] < 0.5 * sigma["none"][x]


def test_hard_iron_is_found_and_its_neglect_is_seen(rng):
    _, submaps, compass, _ = world(rng, 2, iron=(0.3, -0.2))
    found = graph_of(2, submaps, compass, config=CompassConfig(hard_iron=0.5))
    BatchSolver(found).solve_to_optimum()
    np.testing.assert_allclose(found.values["deviation"][0], [0.3, -0.2], atol=0.06)
    assert found.objective()["compass"].chi2_per_dof < 2.0
    blind = graph_of(2, submaps, compass)
    BatchSolver(blind).solve_to_optimum()
    assert blind.objective()["compass"].chi2_per_dof > 4.0


def test_the_declination_ties_the_compass_to_the_frame_of_gps(rng):
    """With GPS that saw only a short way, the datum's heading is the compass's word."""
    truth, submaps, compass, _ = world(rng, 2, zero=0.25)  # magnetic east lies 0.25 rad off the first base's x axis
    fixes = truth[:-1, :2][:8] + 1.0 * rng.standard_normal((8, 2))
    sigma = {}
    for declination in (None, 0.1):
        graph = FactorGraph(2)
        gps = Gps(times=np.arange(8) + 0.5, positions=fixes, sigma=np.full(8, 1.0), lever=np.zeros(2))
        graph.add_sensor(gps, config=GpsConfig(baseline=5.0))
        graph.add_sensor(compass, config=CompassConfig(declination=declination))
        for s in submaps:
            graph.add_submap(s)
        graph.finish_sensors()
        graph.finish_sensors()
        BatchSolver(graph).solve_to_optimum()
        sigma[declination] = float(np.sqrt(graph.covariance().marginal("datum")[2, 2]))
        if declination is not None:
            assert abs(wrap_angle(graph.values.datum[2] + declination - 0.25)) < 0.05
    assert sigma[0.1] < 0.5 * sigma[None]


def test_beacons_wait_until_their_place_is_known(rng):
    """From a straight line a beacon is as far on either side: no place, no factor, and it is said."""
    line = np.column_stack([np.arange(12.0), np.zeros(12)])
    assert trilaterate(line, np.hypot(line[:, 0] - 4, 3.0), np.full(12, 0.1)) is None
    bent = line.copy()
    bent[6:, 1] = np.arange(6.0)
    np.testing.assert_allclose(
        trilaterate(bent, np.hypot(bent[:, 0] - 4, bent[:, 1] - 3.0), np.full(12, 0.1)), [4.0, 3.0], atol=1e-8
    )
    P = np.diag(SIGMA[2] ** 2)
    graph = FactorGraph(2)
    graph.add_sensor(
        LandmarkObservations.range_only(
            times=np.arange(10.0), offsets=np.arange(11), ranges=np.full(10, 5.0), range_sigma=np.full(10, 0.1),
            ids=np.full(10, 7),
        )
    )  # fmt: skip
    for k in range(10):
        graph.add_submap(submap(k, np.array([1.0, 0.0, 0.0]), P))
    graph.finish_sensors()
    assert graph.structure.count("beacon") == 0
    assert [e["distances"] for e in graph.events if e["event"] == "beacon-not-placed"] == [10]
    assert not graph.ledger.table()["stream"].str.contains("beacons").any()


def test_readings_are_spent_once_thinned_and_dropped_by_name(rng):
    _, submaps, compass, _ = world(rng, 2)
    graph = FactorGraph(2)
    ids = graph.add_sensor(compass, config=CompassConfig(every=2.0))
    assert len(ids) == 12
    assert [e["count"] for e in graph.events if e["event"] == "readings-thinned"] == [12]
    with pytest.raises(EvidenceReusedError):
        graph.add_sensor(compass)
    for s in submaps[:10]:
        graph.add_submap(s)
    graph.finish_sensors()
    assert len(graph.records) == 10 + 6
    assert [e["why"] for e in graph.events if e["event"] == "readings-dropped"] == ["no submap covers it"]
    with pytest.raises(ConfigError, match="hard_iron"):
        CompassConfig(hard_iron=0.0)
    with pytest.raises(DataError, match="known identities"):
        graph.add_sensor(
            LandmarkObservations.range_only(
                times=np.zeros(1),
                offsets=np.array([0, 1]),
                ranges=np.ones(1),
                range_sigma=np.ones(1),
                ids=np.array([-1]),
            )
        )


@pytest.mark.parametrize("solver", [Isam2Solver, BatchSolver])
def test_what_is_removed_takes_its_variables_with_it(rng, solver):
    """A submap takes its readings along; a beacon or a compass that nothing holds any more is no variable."""
    graph = everything(rng, 2)
    made = solver(graph)
    made.update()
    made.solve_to_optimum()
    beacon = {r.beacon for r in graph.records.values() if isinstance(r, BeaconRangeRecord)}
    assert beacon == {0, 1, 2}
    second = [f for f, r in graph.records.items() if isinstance(r, BeaconRangeRecord) and r.beacon == 1]
    places = graph.values["beacon"].copy()
    for fid in second:
        if fid in graph.records:
            graph.remove(fid, reason="an outlier")
    assert graph.structure.count("beacon") == 2
    np.testing.assert_array_equal(graph.values["beacon"], places[[0, 2]])
    made.update()
    made.solve_to_optimum()
    assert made.solution().converged
    last = graph.submaps[-1]
    inside = [r for r in graph.records.values() if isinstance(r, CompassRecord) and r.node in last.nodes[:-1]]
    assert inside
    graph.remove(last.factor_id)
    assert not [r for r in inside if r.factor_id in graph.records]
    for fid in [f for f, r in graph.records.items() if isinstance(r, CompassRecord)]:
        graph.remove(fid)
    assert graph.structure.count("compass") == graph.structure.count("deviation") == 0
    assert not [r for r in graph.records.values() if isinstance(r, (DeclinationRecord, DeviationPriorRecord))]
    made.update()
    made.solve_to_optimum()
    assert made.solution().converged
    assert graph.objective().dof == sum(r.rows for r in graph.records.values()) - graph.flat().layout.size


def test_an_unknown_kind_of_factor_is_refused_at_once():
    class Odd:
        factor_id, group, rows = 0, "odd", 1

    with pytest.raises(ConfigError, match="no kind of factor is registered for Odd"):
        FactorGraph(2).insert(Odd())
