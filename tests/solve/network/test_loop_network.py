"""A chain with loops by itself: optimum and marginals against dense twins, robust weights, removal."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import optimize

from graphslam.core.errors import CovarianceError, DataError
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of
from graphslam.graph.noise import NO_KERNEL, RobustKernel
from graphslam.graph.relative import relative_poses
from tests.reference.loop_chain import chain_of, loop_of, right_loops, square_poses
from tests.reference.loop_network import LoopNetwork


def plain_cost(T: Array, P: Array, loops: list, poses: Array, kernel: RobustKernel) -> float:  # type: ignore[type-arg]
    g, total = group_of(poses), 0.0
    for k in range(len(T)):
        r = g.log(g.between(T[k], g.between(poses[k], poses[k + 1])))
        total += r @ np.linalg.solve(P[k], r)
    for x in loops:
        r = g.log(g.between(x.T_ij, g.between(poses[x.i], poses[x.j])))
        total += float(kernel.loss(np.array([r @ np.linalg.solve(x.covariance, r)]))[0])
    return float(total)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kernel", [NO_KERNEL, RobustKernel("huber", 1.0)])
def test_nothing_near_the_solution_is_better(dim: int, kernel: RobustKernel) -> None:
    rng = np.random.default_rng(0)
    poses = square_poses(dim)
    T, P = chain_of(poses, rng)
    loops = right_loops(poses, rng, 4)
    net = LoopNetwork(T, P)
    for x in loops:
        net.add_loop(x, kernel)
    net.solve()
    best = plain_cost(T, P, loops, net.poses, kernel)
    g = group_of(poses)
    for _ in range(25):
        step = 1e-4 * rng.standard_normal((len(poses), g.dof))
        step[0] = 0.0
        assert plain_cost(T, P, loops, g.compose(net.poses, g.exp(step)), kernel) > best - 1e-9
    assert sum(net.chi2().values()) == pytest.approx(plain_cost(T, P, loops, net.poses, NO_KERNEL))
    assert sorted(net.chi2()) == list(range(len(T) + len(loops)))


def test_a_small_one_is_that_of_a_general_optimiser() -> None:
    rng = np.random.default_rng(4)
    poses = square_poses(2, side=2, nodes=7)
    T, P = chain_of(poses, rng)
    loops = [loop_of(poses, 0, 6, rng)]
    net = LoopNetwork(T, P)
    net.add_loop(loops[0], NO_KERNEL)
    net.solve()
    g = group_of(poses)

    def cost(x: Array) -> float:
        moved = net.poses.copy()
        moved[1:] = g.compose(moved[1:], g.exp(x.reshape(-1, 3)))
        return plain_cost(T, P, loops, moved, NO_KERNEL)

    start = 0.02 * rng.standard_normal(18)
    found = optimize.minimize(cost, start, method="BFGS", options={"gtol": 1e-6})
    assert cost(np.zeros(18)) == pytest.approx(found.fun, rel=1e-6)


@pytest.mark.parametrize("dim", [2, 3])
def test_relative_marginals_are_consistent(dim: int) -> None:
    """Monte Carlo: NEES of relative poses at the optimum, mean d, with loops in."""
    poses = square_poses(dim, nodes=60)
    g = group_of(poses)
    i, j = np.array([0, 3, 30, 58]), np.array([59, 40, 12, 20])
    true = g.between(poses[i], poses[j])
    sums = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        T, P = chain_of(poses, rng)
        net = LoopNetwork(T, P)
        for x in right_loops(poses, rng, 3):
            net.add_loop(x, NO_KERNEL)
        net.solve()
        got, S = net.relative(i, j)
        e = g.log(g.between(true, got))
        sums.append(np.einsum("ki,kij,kj->k", e, np.linalg.inv(S), e))
    mean = np.mean(sums, axis=0)
    sigma = np.sqrt(2 * g.dof / 40)
    assert np.all(np.abs(mean - g.dof) < 4 * sigma)


def test_relative_covariance_is_that_of_samples() -> None:
    rng = np.random.default_rng(2)
    g = group_of(np.zeros(7))
    A = 0.03 * rng.standard_normal((12, 12))
    J = A @ A.T
    x_i, x_j = (g.exp(rng.standard_normal(6)) for _ in range(2))
    T, P = relative_poses(x_i[None], x_j[None], J[None, :6, :6], J[None, :6, 6:], J[None, 6:, 6:])
    d = rng.standard_normal((40_000, 12)) @ np.linalg.cholesky(J).T
    n = len(d)
    moved = g.between(
        g.compose(np.broadcast_to(x_i, (n, 7)), g.exp(d[:, :6])),
        g.compose(np.broadcast_to(x_j, (n, 7)), g.exp(d[:, 6:])),
    )
    e = g.log(g.between(np.broadcast_to(T[0], moved.shape), moved))
    L = np.linalg.inv(np.linalg.cholesky(P[0]))
    np.testing.assert_allclose(L @ (e.T @ e / n) @ L.T, np.eye(6), atol=0.1)


def test_what_was_removed_is_gone() -> None:
    rng = np.random.default_rng(1)
    poses = square_poses(3)
    T, P = chain_of(poses, rng)
    net = LoopNetwork(T, P)
    net.solve()
    alone = net.poses.copy()
    fid = net.add_loop(right_loops(poses, rng, 1)[0], RobustKernel("huber", 3.0))
    net.solve()
    assert np.abs(net.poses - alone).max() > 1e-3
    net.remove_loop(fid)
    net.solve()
    np.testing.assert_allclose(net.poses, alone, atol=1e-6)
    for bad in (fid, 0, 999):
        with pytest.raises(DataError):
            net.remove_loop(bad)
    with pytest.raises(DataError):
        net.add_loop(loop_of(poses, 3, 3, rng), NO_KERNEL)
    with pytest.raises(CovarianceError):
        LoopNetwork(T, -P)
