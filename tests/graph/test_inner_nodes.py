"""Dense submaps cut into chains: nothing is gained or lost by it, and loops bend them."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from graphslam.core.errors import ConfigError
from graphslam.core.gaussian import chi2_mean_bounds
from graphslam.core.poses import SE2, SE3
from graphslam.core.records import Gps
from graphslam.core.submap import Match
from graphslam.core.trajectory import Trajectory
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.gps import GpsRecord
from graphslam.graph.inner_nodes import cut_submap, inner_rows
from graphslam.graph.sensors.gps import GpsConfig
from graphslam.solve.batch import BatchSolver
from graphslam.solve.isam2 import Isam2Solver
from tests.reference.space_chain import STEP_SIGMA, dense_chain

GROUP = {2: SE2, 3: SE3}


def composed(group, increments, covariances) -> np.ndarray:
    """First-order covariance of a chain of independent increments, step by step."""
    P = np.zeros_like(covariances[0])
    for T, Q in zip(increments, covariances, strict=True):
        ad = group.adjoint(group.inverse(T))
        P = ad @ P @ ad.T + Q
    return P


def levelled(submap):
    """The same submap as if gravity held roll and pitch all along and heights and spread were known better later."""
    path = submap.trajectory
    P = path.covariances.copy()
    u = np.linspace(0, 1, len(P))[:, None, None]
    P[:, :2, :] *= 0.05
    P[:, :, :2] *= 0.05
    P[:, [0, 1], [0, 1]] += 1e-5
    P = (1.0 - 0.4 * u**2) * P
    exit = P[-1].copy()
    exit[[0, 1], [0, 1]] = 4e-6
    exit[:2, 2:] = exit[2:, :2] = 0.0
    return replace(submap, exit_covariance=exit, trajectory=Trajectory(path.times, path.poses, P))


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", ["steps", "no covariances", "levelled", "shrinking"])
def test_the_chain_composes_to_the_exit(rng, dim, kind):
    group, submap = GROUP[dim], dense_chain(rng, dim, m=1, steps=40).submaps[0]
    path = submap.trajectory
    if kind == "no covariances":
        submap = replace(submap, trajectory=Trajectory(path.times, path.poses))
    elif kind == "levelled" and dim == 3:
        submap = levelled(submap)
    elif kind == "shrinking":
        w = 1.0 - 0.8 * np.linspace(0, 1, len(path))[:, None, None]
        submap = replace(
            submap,
            exit_covariance=0.2 * submap.exit_covariance,
            trajectory=Trajectory(path.times, path.poses, w * path.covariances),
        )
    cut = cut_submap(submap, 3.0)
    assert len(cut.increments) == round(path.length() / 3.0) == 7
    T = group.identity
    for step in cut.increments:
        T = group.compose(T, step)
    np.testing.assert_allclose(T, submap.exit_pose, atol=1e-12)
    P, exit = composed(group, cut.increments, cut.covariances), submap.exit_covariance
    scale = np.sqrt(np.outer(np.diag(exit), np.diag(exit)))
    np.testing.assert_allclose(P / scale, exit / scale, atol=1e-9)
    assert all(np.linalg.eigvalsh(Q / scale)[0] > 1e-5 for Q in cut.covariances)


@pytest.mark.parametrize("dim", [2, 3])
def test_increments_of_a_true_chain_are_found_again(rng, dim):
    """Where the marginals are those of independent steps, the increments are the sums of these steps."""
    group, submap = GROUP[dim], dense_chain(rng, dim, m=1, steps=40).submaps[0]
    cut, path = cut_submap(submap, 3.0), submap.trajectory
    Q = np.diag(STEP_SIGMA[dim] ** 2)
    rows = np.searchsorted(path.times, cut.times)
    for k, (a, b) in enumerate(pairwise(rows)):
        steps = group.between(path.poses[a:b], path.poses[a + 1 : b + 1])
        expected = composed(group, steps, np.broadcast_to(Q, (b - a, *Q.shape)))
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        np.testing.assert_allclose(cut.covariances[k] / scale, expected / scale, atol=0.1)


@pytest.mark.parametrize("dim", [2, 3])
def test_composition_by_monte_carlo(rng, dim):
    group, submap = GROUP[dim], levelled_or_plain(rng, dim)
    cut = cut_submap(submap, 3.0)
    n = 20_000
    T = np.broadcast_to(group.identity, (n, group.size))
    for step, Q in zip(cut.increments, cut.covariances, strict=True):
        e = rng.standard_normal((n, group.dof)) @ np.linalg.cholesky(Q).T
        T = group.compose(group.compose(T, step), group.exp(e))
    e = group.log(group.between(np.broadcast_to(submap.exit_pose, T.shape), T))
    W = np.linalg.inv(np.linalg.cholesky(submap.exit_covariance))
    np.testing.assert_allclose(W @ np.cov(e.T) @ W.T, np.eye(group.dof), atol=0.06)


def levelled_or_plain(rng, dim):
    submap = dense_chain(rng, dim, m=1, steps=40).submaps[0]
    return levelled(submap) if dim == 3 else submap


def test_rows_are_spread_over_the_way():
    times = np.arange(30.0)
    x = np.concatenate([np.linspace(0, 4, 10), np.full(10, 4.0), np.linspace(4, 12, 10)])  # a stop in the middle
    path = Trajectory(times, np.column_stack([x, 0 * x, 0 * x]))
    rows = inner_rows(path, 3.0)
    np.testing.assert_allclose(x[rows], [3.0, 6.0, 9.0], atol=0.5)
    assert len(inner_rows(path, 30.0)) == 0
    assert len(inner_rows(Trajectory(times, np.zeros((30, 3))), 3.0)) == 0
    assert len(inner_rows(path.take(slice(0, 2)), 0.1)) == 0


@pytest.mark.parametrize("dim", [2, 3])
def test_an_open_chain_is_the_same_graph(rng, dim):
    """Without a loop, nodes inside change neither the bases nor what is known of them."""
    chain = dense_chain(rng, dim, m=3)
    whole, cut = FactorGraph(dim), FactorGraph(dim)
    for s in chain.submaps:
        whole.add_submap(s)
        cut.add_submap(s, spacing=3.0)
    BatchSolver(cut).solve_to_optimum()
    assert cut.objective().total == pytest.approx(0.0, abs=1e-9)
    assert [len(s.inner) for s in cut.submaps] == [3, 3, 3]
    for a, b in zip(whole.submaps, cut.submaps, strict=True):
        np.testing.assert_allclose(cut.values.poses[b.exit_node], whole.values.poses[a.exit_node], atol=1e-9)
        P = whole.covariance().marginal(f"x{a.exit_node}")
        scale = np.sqrt(np.outer(np.diag(P), np.diag(P)))
        np.testing.assert_allclose(cut.covariance().marginal(f"x{b.exit_node}") / scale, P / scale, atol=1e-8)
    assert cut.objective().dof == 0


@pytest.mark.parametrize("dim", [2, 3])
def test_loops_bend_a_cut_submap(rng, dim):
    """A steady turn too much in one long submap: rigid submaps cannot bend, chains can."""
    group = GROUP[dim]
    chain = dense_chain(rng, dim, m=2, steps=60, noise=0.0, laps=1.05)
    bias = np.zeros(group.dof)
    bias[group.heading] = 1.5 * STEP_SIGMA[dim][group.heading]
    bent = []
    for s, truth in zip(chain.submaps, chain.path, strict=True):
        steps = group.compose(group.between(truth[:-1], truth[1:]), group.exp(bias))
        seen = [group.identity]
        for step in steps:
            seen.append(group.compose(seen[-1], step))
        path = Trajectory(s.trajectory.times, np.array(seen), s.trajectory.covariances)
        bent.append(replace(s, exit_pose=seen[-1], trajectory=path))
    C = np.diag(np.full(group.dof, 1e-4))
    T = group.between(chain.poses[0], chain.poses[2])
    error, solutions = {}, {}
    for spacing in (None, 3.0):
        g = FactorGraph(dim)
        solver = Isam2Solver(g)
        for s in bent:
            g.add_submap(s, spacing=spacing)
            solver.update()
        end = g.submaps[-1].exit_node
        g.add_between(0, end, T, C, evidence="shared-scan")
        solver.update()
        solver.solve_to_optimum()
        solutions[spacing] = solver.solution()
        path = solutions[spacing].trajectory()
        truth = np.concatenate([chain.path[0][:-1], chain.path[1]])
        assert len(path) == len(truth)
        error[spacing] = np.sqrt(np.mean(np.sum((path.poses - truth)[:, :dim] ** 2, axis=1)))
    assert error[3.0] < 0.5 * error[None]
    bent = solutions[3.0].trajectory()
    steps = np.linalg.norm(np.diff(bent.positions, axis=0), axis=1)
    np.testing.assert_allclose(steps, 0.5, atol=0.01)  # it runs through its nodes without a jump
    nodes = np.concatenate([s.T_base_node[1:-1] for s in g.submaps])
    assert len(nodes) == 2 * 9
    for s in solutions[3.0].submaps:
        for node, t in zip(s.inner, s.times[1:-1], strict=True):
            np.testing.assert_allclose(bent.interpolate([t])[0], solutions[3.0].poses[node], atol=1e-9)


def closed_ring(rng, dim, steps):
    """Two dense submaps around, cut every 3 m, closed by a loop of 1 cm and 10 mrad, solved; chain and graph."""
    group, chain = GROUP[dim], dense_chain(rng, dim, m=2, steps=steps)
    g = FactorGraph(dim)
    for s in chain.submaps:
        g.add_submap(s, spacing=3.0)
    e = group.exp(1e-2 * rng.standard_normal(group.dof))
    T = group.compose(group.between(chain.poses[0], chain.poses[2]), e)
    g.add_between(0, g.submaps[-1].exit_node, T, np.diag(np.full(group.dof, 1e-4)), evidence="shared-scan")
    solver = BatchSolver(g)
    solver.solve_to_optimum()
    return chain, g, solver


@pytest.mark.parametrize("dim", [2, 3])
def test_path_covariance_is_consistent(rng, dim):
    """At full rate, nodes and the way between them, with a loop: two-sided."""
    group = GROUP[dim]
    ratios, runs = [], 25
    for _ in range(runs):
        chain, _, solver = closed_ring(rng, dim, 30)
        path = solver.solution().trajectory()
        truth = np.concatenate([chain.path[0][:-1], chain.path[1]])
        e = group.log(group.between(path.poses, truth))[1:]
        P = path.covariances[1:]
        ratios.append(np.mean(np.einsum("ki,kij,kj->k", e, np.linalg.inv(P), e)) / group.dof)
    spread = np.std(ratios) / np.sqrt(runs)
    assert spread < 0.12
    assert abs(np.mean(ratios) - 1.0) < 3.0 * spread + 0.03


@pytest.mark.parametrize("dim", [2, 3])
def test_nodes_of_a_loop_graph_by_monte_carlo(rng, dim):
    group, runs, d2 = GROUP[dim], 40, []
    for _ in range(runs):
        chain, g, _ = closed_ring(rng, dim, 24)
        truth = [chain.poses[0]]
        for s, p in zip(g.submaps, chain.path, strict=True):
            truth += list(p[np.searchsorted(s.trajectory.times, s.times[1:])])
        e = group.log(group.between(g.values.poses, np.array(truth)))[1:].ravel()
        d2.append(float(e @ np.linalg.solve(g.covariance().full(), e)))
    low, high = chi2_mean_bounds(len(e), runs, 0.99)
    assert low < np.mean(d2) < high


@pytest.mark.parametrize("dim", [2, 3])
def test_a_match_hangs_on_the_nearest_inner_node(rng, dim):
    group, chain = GROUP[dim], dense_chain(rng, dim, m=4, noise=0.0)
    g = FactorGraph(dim)
    for s in chain.submaps:
        g.add_submap(s, spacing=3.0)
    target = g.submap(1)
    body = group.compose(chain.path[1][14], group.exp(np.full(group.dof, 0.01)))  # beside step 14 of submap 1
    T = group.between(chain.poses[1], body)
    C = np.diag(np.full(group.dof, 1e-3))
    record = g.records[g.add_match(3, Match(target=1, T_target_here=T, covariance=C, fitness=1.0, support=0.5))]
    times = target.trajectory.times
    k = int(np.argmin(np.abs(target.times[:-1] - times[14])))
    assert k > 0
    assert (record.i, record.j) == (target.nodes[k], g.node_of(3))
    np.testing.assert_allclose(group.compose(target.T_base_node[k], record.T_ij), T, atol=1e-12)
    P = np.linalg.inv(record.whitener.T @ record.whitener)
    steps = abs(int(np.searchsorted(times, target.times[k])) - 14)
    extra = P - C
    assert np.linalg.eigvalsh(extra)[0] > -1e-12
    heading = group.heading
    np.testing.assert_allclose(extra[heading, heading], steps * STEP_SIGMA[dim][heading] ** 2, rtol=0.05)
    base = g.records[g.add_match(3, Match(target=0, T_target_here=group.exp(np.full(group.dof, 0.1)), covariance=C,
                                          fitness=1.0, support=0.5))]  # fmt: skip
    assert base.i == g.node_of(0)
    np.testing.assert_allclose(np.linalg.inv(base.whitener.T @ base.whitener), C, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("dim", [2, 3])
def test_fixes_hang_on_the_node_nearest_in_time(rng, dim):
    chain = dense_chain(rng, dim, m=3)
    g = FactorGraph(dim)
    times = np.arange(0.2, 30.0, 0.7)
    points = np.array([_at(chain, t, dim) for t in times]) + 0.05 * rng.standard_normal((len(times), dim))
    g.add_sensor(
        Gps(times=times, positions=points, sigma=np.full(len(times), 0.05), lever=np.zeros(dim)),
        config=GpsConfig(baseline=5.0),
    )
    for s in chain.submaps:
        g.add_submap(s, spacing=3.0)
    g.finish_sensors()
    records = [r for r in g.records.values() if isinstance(r, GpsRecord)]
    assert len(records) == len(times)
    for r in records:
        s = next(s for s in g.submaps if s.interval[0] <= r.time < s.interval[1])
        assert r.node == s.nodes[int(np.argmin(np.abs(s.times[:-1] - r.time)))]
        assert np.linalg.norm(r.arm) < 4.0
    assert len({r.node for r in records}) == 12
    BatchSolver(g).solve_to_optimum()
    assert 0.6 < g.objective()["gps"].chi2_per_dof < 1.5


def _at(chain, t, dim):
    k = min(int(t // 10), len(chain.path) - 1)
    return Trajectory(chain.times[k], chain.path[k]).interpolate([t])[0][:dim]


@pytest.mark.parametrize("dim", [2, 3])
def test_local_poses_both_ways_compose_to_the_path(rng, dim):
    """A body before its node and after it: pose exact, covariance that of the steps between."""
    group, chain = GROUP[dim], dense_chain(rng, dim, m=1)
    g = FactorGraph(dim)
    g.add_submap(chain.submaps[0], spacing=3.0)
    s = g.submaps[0]
    path, k = s.trajectory, 2
    row = int(np.searchsorted(path.times, s.times[k]))
    for other in (row - 2, row + 2):
        T, P = s.local(path.times[[other]], np.array([k]))
        np.testing.assert_allclose(group.compose(s.T_base_node[k], T[0]), path.poses[other], atol=1e-12)
        a, b = min(row, other), max(row, other)
        steps = group.between(path.poses[a:b], path.poses[a + 1 : b + 1])
        Q = composed(group, steps, np.broadcast_to(np.diag(STEP_SIGMA[dim] ** 2), (2, group.dof, group.dof)))
        if other < row:  # the same error, told at the other end
            ad = group.adjoint(T[0])
            Q = ad @ Q @ ad.T
        scale = np.sqrt(np.outer(np.diag(Q), np.diag(Q)))
        np.testing.assert_allclose(P[0] / scale, Q / scale, atol=1e-5)


def test_a_chain_comes_and_goes_as_one(rng):
    chain = dense_chain(rng, 3, m=3)
    g = FactorGraph(3)
    for s in chain.submaps[:2]:
        g.add_submap(s, spacing=3.0)
    before = len(g.values.poses), len(g.records), len(g.ledger)
    fid = g.add_submap(chain.submaps[2], spacing=3.0)
    assert g.submaps[2].factor_ids[0] == fid
    g.remove(g.submaps[2].factor_ids[2])  # any of them
    assert (len(g.values.poses), len(g.records), len(g.ledger)) == before
    assert len(g.submaps) == 2
    g.add_submap(chain.submaps[2], spacing=3.0)  # its evidence is free again
    with pytest.raises(ConfigError, match="positive spacing"):
        g.add_submap(replace(chain.submaps[2], key=9, interval=(40.0, 50.0)), spacing=0.0)
    short = replace(chain.submaps[2], key=9, interval=(40.0, 50.0), trajectory=None)
    g.add_submap(short, spacing=3.0)
    assert g.submap(9).inner == ()
