"""iSAM2 with GPS has its poses in the GPS frame: the same problem in other coordinates."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.poses import SE3
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.gps import datum_of, level_datum_pose
from graphslam.graph.ledger import EvidenceUse
from graphslam.graph.sensors.gps import GpsConfig
from graphslam.solve.batch import optimise_graph
from graphslam.solve.isam2 import Isam2Solver
from tests.benchmarks.bench_incremental import ours, problem
from tests.reference.graph_chain import make_chain, make_gps


def near_its_optimum(g: FactorGraph, solver: Isam2Solver, share: float) -> None:
    """The estimate is at most a share of the objective above the batch optimum, and iSAM2 gets to it."""
    assert "datum" not in solver._known
    before, best = g.objective().total, optimise_graph(g)
    solver.solve_to_optimum()
    assert before <= (1.0 + share) * g.objective().total
    found = solver.pull(g.values)
    assert found.distance(best.values) < 1e-5  # poses, landmarks, datum and tilt
    np.testing.assert_array_equal(found.poses[0], g.origin)
    for name in ("x0", "x3", f"x{found.count('x') - 1}"):
        np.testing.assert_allclose(solver.value(name), found.poses[int(name[1:])], atol=1e-9)


def test_landmarks_in_the_plane(rng):
    chain = make_chain(rng, m=30, landmarks=30, laps=2.0)
    g = FactorGraph()
    solver = Isam2Solver(g)
    g.add_sensor(make_gps(chain, rng, np.array([3.0, 4.0, 2.0]), step=2.5), config=GpsConfig(baseline=10.0))
    for s in chain.submaps:
        g.add_submap(s)
        solver.update()
    near_its_optimum(g, solver, 0.01)


@pytest.mark.parametrize("gravity", [False, True])
def test_space_with_a_level_first_base_and_with_a_measured_vertical(gravity, rng):
    n = 400
    _, _, _, graph = ours(n, problem(n, rng), False)
    solver = Isam2Solver(graph)
    if gravity:
        for k in range(0, n, 50):
            R = graph.values.poses[k]
            down = SE3.transform(SE3.inverse(np.append(np.zeros(3), R[3:])), np.array([0.02, 0.01, -1.0]))
            graph.add_attitude(k, down, 0.01, evidence=EvidenceUse(["gravity"], (k, k)))
    solver.update()
    near_its_optimum(graph, solver, 0.01)
    assert (graph.values.tilt is not None) == gravity


def test_a_factor_that_depends_on_the_world_frame_brings_the_datum_back(rng):
    chain = make_chain(rng, m=12)
    g = FactorGraph()
    solver = Isam2Solver(g)
    g.add_sensor(make_gps(chain, rng, np.array([3.0, 4.0, 2.0]), step=2.5), config=GpsConfig(baseline=10.0))
    for s in chain.submaps[:8]:
        g.add_submap(s)
        solver.update()
    assert "datum" not in solver._known
    wall = g.add_factor([4], lambda x: x[:1] - 10.0, [[0.01]], evidence="prior")
    solver.update()
    assert "datum" in solver._known
    solver.solve_to_optimum()
    assert solver.pull(g.values).distance(optimise_graph(g).values) < 1e-5
    g.remove(wall)
    for s in chain.submaps[8:]:
        g.add_submap(s)
        solver.update()
    near_its_optimum(g, solver, 0.01)


def test_datum_and_tilt_from_a_pose(rng):
    for tilt in (np.zeros(2), np.array([0.3, -0.7])):
        datum = np.array([1.0, 2.0, 3.0, -2.5])
        found = datum_of(level_datum_pose(datum, tilt))
        np.testing.assert_allclose(found[0], datum, atol=1e-12)
        np.testing.assert_allclose(found[1], tilt, atol=1e-12)
