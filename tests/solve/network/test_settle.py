"""Loops and groups against the posterior of everything else: a dense twin, Monte Carlo, tails, what settling mends."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from graphslam.core.network import PoseNetwork
from graphslam.core.random import SeedTree
from graphslam.graph.network import network_values, problem_of_network
from graphslam.solve.descent import descend_to_minimum
from graphslam.solve.network.leave_one_out import (
    LARGEST,
    family_quantile,
    groups_of,
    leave_one_out_test,
    loop_evidence,
    tail_limit,
)
from graphslam.solve.network.solve import solve_network
from graphslam.solve.sparse import SparseProblem
from tests.reference.plain_network import edge_costs, subnetwork
from tests.reference.slow_loop_evidence import fall_if_moved, fall_without
from tests.reference.wrong_loops import add_wrong_loops, is_odometry
from tests.sim.test_wrong_loops import ring_drive


def thinned(dim: int, n: int = 100, seed: int = 0) -> PoseNetwork:
    """A ring drive with three stretches of loops, of four, of one, and of three."""
    net = ring_drive(dim, n=n, lap=30, seed=seed)
    loops = np.flatnonzero(~is_odometry(net.edges))
    drop = np.setdiff1d(np.arange(len(loops)), [5, 6, 7, 8, 30, 60, 61, 62])
    return subnetwork(net, ~np.isin(np.arange(len(net.edges)), loops[drop]))


@pytest.mark.parametrize("dim", [2, 3])
def test_evidence_is_that_of_a_dense_solver(dim: int) -> None:
    net = thinned(dim)
    # one direction of a loop is as good as the other
    turned = np.flatnonzero(~is_odometry(net.edges))[1]
    edges = net.edges.copy()
    assert edges[turned, 0] > edges[turned, 1]
    rows = np.flatnonzero(~is_odometry(net.edges))
    everything = np.ones(len(edges), bool)
    poses = solve_network(net, starts=("chordal",)).poses
    single, group, label = loop_evidence(
        problem_of_network(net), everything, rows, network_values(net, poses), accepted=True
    )
    assert sorted(np.bincount(label).tolist()) == [1, 3, 4]
    for k, row in enumerate(rows):
        assert single[k] == pytest.approx(fall_without(net, everything, int(row), poses), rel=1e-5)
        members = rows[label == label[k]]
        assert group[k] == pytest.approx(fall_if_moved(net, everything, members, poses), rel=1e-4)
    # refused: three of them, of two groups, from the answer without them
    out = rows[[0, 1, -1]]
    inliers = ~np.isin(np.arange(len(edges)), out)
    poses = solve_network(subnetwork(net, inliers), starts=("chordal",)).poses
    single, group, label = loop_evidence(
        problem_of_network(net), inliers, out, network_values(net, poses), accepted=False
    )
    for k, row in enumerate(out):
        assert single[k] == pytest.approx(fall_without(net, inliers, int(row), poses), rel=1e-5)
        members = out[label == label[k]]
        assert group[k] == pytest.approx(fall_if_moved(net, inliers, members, poses), rel=1e-4)
    assert group[0] == group[1] != single[0]
    assert group[2] == pytest.approx(single[2])


@pytest.mark.parametrize("inflated", [1.0, 2.0])
def test_evidence_of_right_loops_is_chi_squared(inflated: float) -> None:
    """Mean and tail over 60 drives; with noise that is twice what is stated (in variance) both lie outside."""
    single, group = [], []
    for seed in range(60):
        net = thinned(2, seed=seed)
        net = replace(net, information=net.information * inflated)
        rows = np.flatnonzero(~is_odometry(net.edges))
        problem = SparseProblem(problem_of_network(net))
        values = descend_to_minimum(problem, network_values(net, net.poses)).values
        s, g, label = loop_evidence(problem.flat, np.ones(len(net.edges), bool), rows, values, accepted=True)
        single.append(s[4])  # alone
        group += [g[np.flatnonzero(label == name)[0]] for name in np.unique(label)]
    for D2 in (np.array(single), np.array(group)):
        n = len(D2)
        low, high = stats.chi2.ppf([0.0005, 0.9995], 3 * n) / n
        tail = stats.binom.ppf([0.0005, 0.9995], n, 0.1)
        beyond = int((stats.chi2.ppf(0.9, 3) < D2).sum())
        assert (low < D2.mean() < high) == (inflated == 1.0)
        if inflated == 1.0:
            assert tail[0] <= beyond <= tail[1]


def test_the_tail_is_followed_as_far_as_it_is_populated(rng: np.random.Generator) -> None:
    gauss = 0.01 * rng.chisquare(3, 2000)
    limit, scale = tail_limit(gauss, 3)
    assert scale == pytest.approx(0.01, rel=0.1)
    assert gauss.max() < limit < 3.0 * gauss.max()
    # a heavy tail (index 0.5, as recorded loops have) is kept, and what lies beyond a gap changes nothing
    heavy = 0.01 * rng.chisquare(3, 2000) * np.maximum(1.0, rng.pareto(2.0, 2000))
    limit_heavy, _ = tail_limit(heavy, 3)
    assert (heavy > limit_heavy).mean() < 2e-3
    assert limit_heavy > 3.0 * limit
    # two in a hundred wrong, a hundred times beyond the tail
    with_wrong, _ = tail_limit(np.concatenate([gauss, 50.0 + rng.random(40)]), 3)
    assert gauss.max() < with_wrong < 2.0 * limit
    assert tail_limit(np.zeros(0), 3) == (np.inf, 1.0)
    assert np.isfinite(tail_limit(np.zeros(50), 3)[0])


def test_more_loops_are_not_refused_more_often() -> None:
    assert family_quantile(0.9999, 50) == pytest.approx(0.9999)
    for n in (100, 1000, 5000):
        assert 1.0 - family_quantile(0.9999, n) ** n == pytest.approx(0.01, rel=0.01)


def test_groups_are_loops_beside_each_other() -> None:
    ends = [(10, 100), (101, 11), (12, 102), (12, 50), (60, 10), (14, 104)]
    label = groups_of(np.array(ends))
    assert label[0] == label[1] == label[2] == label[5]
    assert len(np.unique(label)) == 3
    assert len(groups_of(np.zeros((0, 2)))) == 0


def test_a_wrong_loop_that_bends_the_map_to_itself_is_taken_out_and_a_right_one_taken_back() -> None:
    """Both would stay where they are by their own costs."""
    net = thinned(2)
    loops = np.flatnonzero(~is_odometry(net.edges))
    clean = solve_network(net, starts=("chordal",)).poses
    # the group of four says that the stretch lies elsewhere, by ten times what the others allow
    shift = np.zeros(3)
    shift[1] = 0.6
    measurements = net.measurements.copy()
    measurements[loops[:4]] += shift
    wrong = replace(net, measurements=measurements)
    limit = np.full(len(net.edges), stats.chi2.ppf(0.9999, 3))
    limit[is_odometry(net.edges)] = np.inf
    inliers = np.ones(len(net.edges), bool)
    inliers[loops[4]] = False
    begun = solve_network(subnetwork(wrong, inliers), starts=("chordal",))
    costs = edge_costs(wrong, begun.poses)
    assert (costs[loops[:4]] < limit[loops[:4]]).all()
    start = network_values(wrong, begun.poses)
    end = leave_one_out_test(wrong, problem_of_network(wrong), start, inliers, limit, own_tail=False)
    assert not end.inliers[loops[:4]].any()
    assert end.inliers[loops[4:]].all()
    poses = end.end.values.poses
    # the answer is that of the right loops alone, and nearer to that of all of them than where it began
    alone = solve_network(subnetwork(net, end.inliers), starts=("chordal",)).poses
    assert np.abs(poses[:, :2] - alone[:, :2]).max() < 1e-4
    error = np.linalg.norm(poses[:, :2] - clean[:, :2], axis=1)
    assert error.mean() < 0.7 * np.linalg.norm(begun.poses[:, :2] - clean[:, :2], axis=1).mean()
    # nothing to do where all is right
    everything = np.ones(len(net.edges), bool)
    same = leave_one_out_test(net, problem_of_network(net), network_values(net, clean), everything, limit)
    assert same.inliers.all()
    assert same.rounds == 1


def test_wrong_groups_that_the_odometry_would_have_to_pay_for() -> None:
    """Half of the loops wrong, in groups that agree: none is kept, and hardly a right one is lost."""
    net = ring_drive(2, n=300, lap=60)
    clean = solve_network(net, starts=("chordal",))
    mixed = add_wrong_loops(net, 0.5, SeedTree(1).generator(), kind="aliased", reference=clean.poses)
    assert int(np.bincount(mixed.group[mixed.wrong]).max()) <= LARGEST
    answer = solve_network(mixed.network, "gnc")
    assert answer.inliers is not None
    assert not (answer.inliers & mixed.wrong).any()
    assert edge_costs(mixed.network, answer.poses)[~mixed.wrong].sum() <= 1.01 * clean.objective
