"""One start, and more only on doubt: minima that are not the best are told, right ones are not suspected."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import graphslam.core.network as core
import graphslam.solve.network.solve as solving
import graphslam.solve.network.start as starts
import graphslam.solve.sparse as sparse
from graphslam.core.errors import CovarianceError
from graphslam.core.network import PoseNetwork
from graphslam.graph.network import network_values, problem_of_network
from graphslam.solve.descent import descend_to_minimum
from graphslam.solve.network.multistart import suspicion_of_answer
from graphslam.solve.network.solve import solve_network
from graphslam.solve.network.start import (
    chordal_rotations,
    chordal_start,
    odometry_start,
    spanning_tree,
    translations_from,
    tree_poses,
    wound_cycles,
)
from graphslam.solve.sparse import SparseProblem
from tests.reference.grid_world import grid_world
from tests.reference.gtsam_network import gauss_newton_step
from tests.reference.plain_network import compose, inverse
from tests.solve.network.test_certificate import twisted_ring
from tests.solve.network.test_model import random_network


def in_space(net: PoseNetwork) -> PoseNetwork:
    """The same network in the plane z = 0 of space."""

    def lifted(poses: np.ndarray) -> np.ndarray:
        half, zero = 0.5 * poses[:, 2], np.zeros(len(poses))
        return np.stack([poses[:, 0], poses[:, 1], zero, zero, zero, np.sin(half), np.cos(half)], axis=1)

    omega = np.tile(np.diag([1.0, 1, 1, 1e-3, 1e-3, 1e-3]), (len(net.edges), 1, 1))
    return replace(net, dim=3, poses=lifted(net.poses), measurements=lifted(net.measurements), information=omega)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_wound_up_ring_is_distinguished_from_a_straight_one(dim: int) -> None:
    net, wound = twisted_ring(20, 1)
    straight = net.poses
    if dim == 3:
        net, wound, straight = (
            in_space(net),
            in_space(replace(net, poses=wound)).poses,
            in_space(replace(net, poses=straight)).poses,
        )
    assert wound_cycles(net, wound) == (1, 0, 1)
    assert wound_cycles(net, straight) == (0, 0, 1)


def rotated(net: PoseNetwork, rng: np.random.Generator, sigma: float) -> np.ndarray:
    """A start with random headings."""
    R = chordal_rotations(net)
    turn = np.concatenate([np.zeros((len(net), 2)), sigma * rng.standard_normal((len(net), 1))], axis=1)
    angle = np.arctan2(R[:, 1, 0], R[:, 0, 0]) + turn[:, 2]
    c, s = np.cos(angle), np.sin(angle)
    R = np.stack([np.stack([c, -s], axis=1), np.stack([s, c], axis=1)], axis=1)
    R[0] = np.eye(2)
    return translations_from(net, R)[0]


def test_every_other_minimum_from_random_starts_is_doubted(rng: np.random.Generator) -> None:
    net = grid_world(300, rng, share=0.8)
    problem = SparseProblem(problem_of_network(net))
    best = solve_network(net)
    assert best.details["doubt"] == ""
    found = 0
    for _ in range(12):
        end = descend_to_minimum(problem, network_values(net, rotated(net, rng, 2.0)))
        worse = end.objective > 1.001 * best.objective
        found += worse
        assert bool(suspicion_of_answer(net, end)) == worse or end.status != "converged"
    assert found >= 3


def test_one_start_by_default_and_all_on_request_or_on_doubt(rng: np.random.Generator) -> None:
    net = grid_world(120, rng, share=0.8)
    one, every = solve_network(net), solve_network(net, starts="all")
    assert [s.name for s in one.starts] == ["chordal"]
    assert [s.name for s in every.starts] == ["chordal", "file", "tree", "odometry"]
    assert one.objective == pytest.approx(every.objective, rel=1e-8)
    assert [s.name for s in solve_network(net, starts=["tree"]).starts] == ["tree"]
    marked, _, _ = random_network(rng, 2, marks="bearing-range")
    doubtful = solve_network(marked)
    assert "landmarks" in doubtful.details["doubt"]
    assert len(doubtful.starts) > 1


def test_doubt_that_a_certificate_settles_needs_no_other_start(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    net = grid_world(120, rng, share=0.8)
    quiet = replace(net, information=20.0 * net.information)  # the same answer, with noise stated too small
    doubtful = solve_network(quiet)
    assert "degrees of freedom" in doubtful.details["doubt"]
    assert [s.name for s in doubtful.starts] == ["chordal"]
    monkeypatch.setattr(solving, "_certified", lambda network, end: False)
    assert len(solve_network(quiet).starts) > 1


def test_a_tree_is_walked_as_one_walks_it(rng: np.random.Generator) -> None:
    net = grid_world(90, rng, dim=3, share=0.8)
    fixed = np.zeros(len(net), bool)
    fixed[[4, 60]] = True
    net = replace(net, fixed=fixed)
    for chain in (False, True):
        tree = spanning_tree(net, chain=chain)
        assert (tree.edge[[4, 60]] == -1).all()
        poses, done = net.poses.copy(), {4, 60}
        while len(done) < len(net):
            for v in range(len(net)):
                if v not in done and int(tree.parent[v]) in done:
                    z = net.measurements[tree.edge[v]]
                    assert set(net.edges[tree.edge[v]].tolist()) == {v, int(tree.parent[v])}
                    poses[v] = compose(poses[tree.parent[v]], z if tree.forward[v] else inverse(z))
                    done.add(v)
        assert np.allclose(tree_poses(net, tree), poses, atol=1e-9)
    chained = spanning_tree(replace(net, fixed=np.arange(len(net)) == 0), chain=True)
    assert (chained.parent[1:] == np.arange(len(net) - 1)).all()
    assert np.allclose(odometry_start(replace(net, fixed=np.arange(len(net)) == 0)), net.poses, atol=1e-9)


@pytest.mark.parametrize("dim", [2, 3])
def test_the_chordal_start_by_blocks_is_the_same(
    rng: np.random.Generator, dim: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    net = grid_world(150, rng, dim=dim, share=0.8)
    fixed = np.zeros(len(net), bool)
    fixed[[0, 149]] = True
    plain, held = chordal_start(net)[0], chordal_start(replace(net, fixed=fixed))[0]
    monkeypatch.setattr(starts, "MANY", {2: 0, 3: 0})
    assert np.allclose(chordal_start(net)[0], plain, atol=1e-6)
    assert np.allclose(chordal_start(replace(net, fixed=fixed))[0], held, atol=1e-6)


@pytest.mark.parametrize("dim", [2, 3])
def test_elimination_by_blocks_takes_the_same_step(
    rng: np.random.Generator, dim: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    net = grid_world(200, rng, dim=dim, share=0.8)
    start = network_values(net, net.poses)
    a, fall, now = SparseProblem(problem_of_network(net)).newton_step(start)
    monkeypatch.setattr(sparse, "MANY", {2: 0, 3: 0})
    b, fall_b, now_b = SparseProblem(problem_of_network(net, ordered=False)).newton_step(start)
    values, fall_c = gauss_newton_step(net, start)
    assert fall_b == pytest.approx(fall, rel=1e-9)
    assert fall_c == pytest.approx(fall, rel=1e-6)
    assert now_b == pytest.approx(now, rel=1e-6)
    assert np.allclose(a.poses, b.poses, atol=1e-6)
    assert np.allclose(values.poses, b.poses, atol=1e-4)


def test_too_few_digits_are_an_error_and_not_a_step() -> None:
    """A chain of 20 poses whose one far edge is 10^19 times as certain: its normal equations hold nothing else."""
    n = 20
    edges = np.stack([np.arange(n - 1), np.arange(1, n)], axis=1)
    z = np.tile([1.0, 0.1, 0.2], (n - 1, 1))
    omega = np.tile(np.eye(3), (n - 1, 1, 1))
    omega[::2] *= 1e19
    net = PoseNetwork(2, np.arange(n), np.zeros((n, 3)), np.ones(n, bool), edges, z, omega)
    solution = solve_network(net)
    # 10^20 at the start; whether the last 10^-11 count as converged depends on the processor
    assert solution.objective < 1e-6


def test_matrices_are_checked_in_parts(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(core, "_PART", 4)
    net = grid_world(30, rng)
    for change, message in (
        (np.diag([1.0, 1.0, -1.0]), "1 of .* are indefinite: 9 -> 10"),
        (np.diag([1.0, np.nan, 1.0]), "1 of .* are not finite: 9 -> 10"),
        (np.array([[1.0, 0.5, 0], [0, 1, 0], [0, 0, 1]]), "1 of .* are not symmetric: 9 -> 10"),
    ):
        omega = net.information.copy()
        omega[9] = change
        with pytest.raises(CovarianceError, match=message):
            replace(net, information=omega)
