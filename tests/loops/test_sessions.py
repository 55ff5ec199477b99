"""Several chains in one graph: start values from shared landmarks, one optimum, and what cannot be aligned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.errors import DataError, GeometryError, IndeterminateError
from graphslam.core.geometry import se2_between, se2_compose, se2_inverse, se2_transform
from graphslam.graph.factor_graph import FactorGraph
from graphslam.loops.sessions import align_by_constellation, align_by_identity
from graphslam.solve.batch import BatchSolver
from graphslam.solve.registry import make_solver
from tests.reference.graph_chain import make_chain

T_AB = np.array([3.0, -2.0, 2.2])


@pytest.fixture
def maps(rng):
    a = rng.uniform(-10, 10, (18, 2))
    b = se2_transform(se2_inverse(T_AB), a[4:]) + 0.02 * rng.standard_normal((14, 2))
    return a, b


def test_identities_align_in_spite_of_a_wrong_one(maps):
    a, b = maps
    ids = np.arange(4, 18)
    wrong = ids.copy()
    wrong[[2, 9]] = wrong[[9, 2]]
    found = align_by_identity(wrong, b, np.arange(18), a)
    np.testing.assert_allclose(se2_between(found.T_reference_map, T_AB), 0, atol=0.02)
    assert found.rejected == 2
    assert len(found.pairs) == 12
    assert found.rms < 0.05


def test_two_common_landmarks_are_enough_and_one_is_not(maps):
    a, b = maps
    found = align_by_identity([5, 11, 99], b[[1, 7, 3]], np.arange(18), a)
    np.testing.assert_allclose(se2_between(found.T_reference_map, T_AB), 0, atol=0.05)
    with pytest.raises(DataError, match="1 common ids"):
        align_by_identity([5, 99], b[[1, 3]], np.arange(18), a)
    with pytest.raises(DataError, match="as far apart in both maps"):
        align_by_identity([5, 11], [[0.0, 0.0], [90.0, 0.0]], np.arange(18), a)


def test_a_constellation_is_recognised_without_names(maps, rng):
    a, b = maps
    order = rng.permutation(len(b))
    clutter = rng.uniform(-10, 10, (4, 2))
    found = align_by_constellation(np.vstack([b[order], clutter]), a)
    np.testing.assert_allclose(se2_between(found.T_reference_map, T_AB), 0, atol=0.03)
    right = {(int(np.flatnonzero(order == k)[0]), k + 4) for k in range(len(b))}
    assert right <= {tuple(r) for r in found.pairs.tolist()}
    assert found.runner_up < 0.75 * len(found.pairs)


def test_a_symmetric_constellation_is_refused(rng):
    grid = 3.0 * np.stack(np.meshgrid(np.arange(4), np.arange(4)), -1).reshape(-1, 2)
    with pytest.raises(DataError, match="about as well"):
        align_by_constellation(grid + 0.01 * rng.standard_normal(grid.shape), grid)
    with pytest.raises(DataError, match=r"do not say|as far apart in both maps"):
        align_by_constellation(rng.uniform(-10, 10, (3, 2)), rng.uniform(-10, 10, (3, 2)), tolerance=2.0)


def two_sessions(chain, cut, start):
    """The same chain with a break: the second part begins at a free base."""
    g = FactorGraph()
    for s in chain.submaps[:cut]:
        g.add_submap(s)
    node = g.start_session(start)
    for s in chain.submaps[cut:]:
        g.add_submap(s)
    return g, node


@pytest.mark.parametrize("solver", ["batch", "isam2"])
def test_a_free_base_is_found_from_common_landmarks(rng, solver):
    chain = make_chain(rng, m=12, landmarks=25)
    g, node = two_sessions(chain, 6, se2_compose(chain.poses[6], [0.4, -0.3, 0.2]))
    s = make_solver(solver, g)
    s.update()
    s.solve_to_optimum()
    solution = s.solution()
    assert solution.converged
    assert solution.submap_keys.tolist() == list(range(12))
    assert solution.exit_nodes.tolist() == [*range(1, 7), *range(8, 14)]
    error = se2_between(solution.poses[node], chain.poses[6])
    P = solution.node_covariances()[node]
    assert error @ np.linalg.solve(P, error) < 16.3  # χ²_3 at 99.9 %
    # the break costs three scalars of information and nothing else
    whole = FactorGraph()
    for x in chain.submaps:
        whole.add_submap(x)
    BatchSolver(whole).solve_to_optimum()
    assert solution.states == whole.flat().layout.size + 3
    assert solution.objective < whole.objective().total
    path = solution.trajectory(keys=range(6, 12))
    assert path.times[0] == 60.0
    np.testing.assert_allclose(path.poses[0], solution.poses[node], atol=1e-12)


def test_chains_without_common_landmarks_are_named(rng):
    chain = make_chain(rng, m=4, landmarks=20)
    g = FactorGraph()
    for s in chain.submaps[:2]:
        g.add_submap(s)
    node = g.start_session(chain.poses[2])
    for s in chain.submaps[2:]:
        g.add_submap(replace(s.with_ids(1000 * (s.key + 1) + s.landmarks.ids)))
    with pytest.raises(IndeterminateError, match=f"x{node}"):
        BatchSolver(g).solve_to_optimum()


def test_impossible_sessions_are_refused(rng):
    g = FactorGraph()
    with pytest.raises(DataError, match="first session"):
        g.start_session([0, 0, 0])
    g.add_submap(make_chain(rng, m=1, landmarks=10).submaps[0])
    with pytest.raises(GeometryError, match="session"):
        g.start_session([0, np.nan, 0])
