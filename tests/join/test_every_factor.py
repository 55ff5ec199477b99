"""Every kind of factor through every method: one optimum, and each join equals its slow twin."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import graphslam as gs
from graphslam.app.compare import compare_methods
from graphslam.core.errors import IndeterminateError
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.imu.config import ImuConfig
from graphslam.graph.noise import RobustKernel
from graphslam.join.gaussian_map import GaussianMap, add_maps, join_gaussian_maps
from graphslam.join.graph_join import JoinSchedule, join_graph_ekf, join_graph_sequential
from graphslam.join.graph_problem import JoinProblem
from graphslam.solve.batch import BatchSolver
from tests.agreement.test_graph_solvers import build
from tests.graph.factors.test_compass_and_range import everything
from tests.graph.factors.test_control import planar as surveyed_in_the_plane
from tests.graph.factors.test_control import spatial as surveyed_in_space
from tests.graph.factors.test_imu_plane import mixed
from tests.reference.imu_ring import ring
from tests.reference.imu_study import solved
from tests.reference.slow_graph_join import SlowJoin


def in_space(rng: np.random.Generator) -> FactorGraph:
    """Dense submaps with inner nodes, IMU, GPS and gravity."""
    return solved(ring(rng, submaps=4, seconds=4.0, lean=0.02), rng, ImuConfig(), True, 6.0)


def with_constants(rng: np.random.Generator) -> FactorGraph:
    """Landmark submaps whose wheels and sensor have constant errors, with GPS at points of their paths."""
    log = gs.simulate("mixed", preset="quick", seed=3)
    log = log.slice(log.interval[0], log.interval[0] + 90.0)
    sigmas = {"distance_scale": 0.02, "range_offset": 0.05}
    options = {"frontend": {"biases": sigmas, "particles": 2}, "gps": {"use": "all", "baseline": 5.0}}
    run = gs.run(log, frontend="rbpf-ekf", config=options, progress=False)
    assert run.graph is not None
    return run.graph


def points_in_space(rng: np.random.Generator) -> FactorGraph:
    """Landmark submaps in space."""
    log = gs.simulate("point-field", seed=7, seconds=30.0, points=40)
    return FactorGraph.from_submaps(gs.local_maps(log, "points", options={"max_distance": 8.0}))


CASES: dict[str, Callable[[np.random.Generator], FactorGraph]] = {
    "landmarks, GPS with biases, relative poses": lambda rng: build(rng, gps=True, robust=RobustKernel()),
    "the same with robust kernels": lambda rng: build(rng, gps=True, robust=RobustKernel("huber", 1.0)),
    "constant errors and points of the path": with_constants,
    "both kinds of submaps and an IMU in the plane": mixed,
    "compass, beacons and GPS in the plane": lambda rng: everything(rng, 2),
    "compass, beacons and GPS in space": lambda rng: everything(rng, 3),
    "IMU, GPS and gravity in space": in_space,
    "landmarks in space": points_in_space,
    "control points and distances in the plane": surveyed_in_the_plane,
    "control points and distances in space": surveyed_in_space,
}


@pytest.fixture(params=CASES)
def problem(request: pytest.FixtureRequest) -> JoinProblem:
    graph = CASES[request.param](np.random.default_rng(11))
    BatchSolver(graph).solve_to_optimum()
    return JoinProblem.of_graph(graph)


def test_every_method_solves_the_same_factors(problem: JoinProblem) -> None:
    table = compare_methods(problem, memory=False)
    assert len(set(table["factors"])) == 1
    assert len(set(table["dof"])) == len(set(table["states"])) == 1
    best = problem.graph.objective().total + problem.offset
    np.testing.assert_allclose(table["objective_polished"], best, rtol=1e-9, atol=1e-9)
    assert (table["objective"] >= best * (1 - 1e-9) - 1e-9).all()
    assert set(problem.factor_counts()) == {r.group for r in problem.graph.records.values()}


def test_a_join_equals_its_slow_twin(problem: JoinProblem) -> None:
    plan, slow = JoinSchedule(problem), SlowJoin(problem)
    leaves = [GaussianMap.leaf(problem, k, plan.inside[k]) for k in range(min(4, len(problem.keys)))]
    joins = [(leaves[0], leaves[1], plan.at_last[1])]
    a = join_gaussian_maps(*joins[0], passes=1)
    if len(leaves) == 4:
        low, high = plan.low, plan.high
        meet = [f for f in plan.across if low[f] == 2 and high[f] == 3]
        b = join_gaussian_maps(leaves[2], leaves[3], np.array(meet, dtype=np.int64), passes=1)
        later = np.array([f for f in plan.across if low[f] < 2 <= high[f] < 4], dtype=np.int64)
        joins.append((a, b, later))
    for one, other, factors in joins:
        fast = join_gaussian_maps(one, other, factors, passes=1)
        begin, enter = add_maps(one, other)[0].admitted(factors)
        twin = slow.joined(one, other, begin, enter.tolist())
        assert twin.names == [problem.names[v] for v in fast.variables.tolist()]
        step = slow.coordinates(twin, fast.values, twin.names)
        # a ten-thousandth of a standard deviation; a tilt known in two frames is compared to first order
        loose = 1e4 if "tilt" in problem.words else 1.0
        assert step @ twin.information @ step < 1e-8 * loose * len(step)
        A, B = fast.information.toarray(), twin.information
        size = np.sqrt(np.outer(np.diag(A), np.diag(A))) + 1e-9 * np.abs(A).max()
        np.testing.assert_allclose(A / size, B / size, atol=2e-5 * np.sqrt(loose))


def test_the_dense_filter_is_the_information_filter_in_sequence(problem: JoinProblem) -> None:
    dense, sparse = join_graph_ekf(problem), join_graph_sequential(problem, passes=1)
    for word in problem.words:
        np.testing.assert_allclose(dense.values[word], sparse.values[word], atol=1e-6, err_msg=word)
    P = np.linalg.inv(sparse.information.toarray())
    scale = np.sqrt(np.outer(np.diag(P), np.diag(P)))
    np.testing.assert_allclose(dense.covariance / scale, P / scale, atol=1e-5)


def test_a_map_that_factors_do_not_determine_is_named() -> None:
    """A bias of GPS fixes without its prior: the variable, the submaps and the remedy are in the message."""
    graph = build(np.random.default_rng(3), gps=True, robust=RobustKernel())
    BatchSolver(graph).solve_to_optimum()
    prior = next(r for r in graph.records.values() if r.group == "gps-bias" and r.bias == 2)
    fixes = [r for r in graph.records.values() if r.group == "gps" and r.bias == 2]
    for r in fixes[:-1]:
        graph.take_out(r.factor_id, "test")
    graph.take_out(prior.factor_id, "test")
    last = fixes[-1]
    graph.insert(replace(last, whitener=np.array([[last.whitener[0, 0], 0.0], [0.0, 0.0]])))
    problem = JoinProblem.of_graph(graph)
    with pytest.raises(
        IndeterminateError, match=r"submaps \d+ to \d+ do not determine bias2: .*set bias_sigma"
    ) as error:
        join_graph_sequential(problem)
    assert error.value.variables == ("bias2",)
