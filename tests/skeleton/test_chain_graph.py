"""A chain with loops against Gauss-Newton on dense matrices, whose derivatives are differences."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.errors import CovarianceError, DataError
from graphslam.core.se3 import quat_to_matrix, so3_exp
from graphslam.skeleton import segment_kernels as kernels
from graphslam.skeleton.chain_graph import ChainGraph, relax_chain
from graphslam.skeleton.landmark_kernels import Poses
from graphslam.skeleton.schur import step_poses
from tests.reference.dense_chain import jacobian, residuals, slow_optimum


def drawn(N: int, ends: list[tuple[int, int]], seed: int = 0, noise: float = 0.02) -> tuple[ChainGraph, Poses]:
    """A round trip, measured with noise."""
    rng = np.random.default_rng(seed)
    t = 2 * np.pi * np.arange(N) / N
    w = np.column_stack([0.2 * np.sin(t), 0.1 * np.cos(3 * t), t])
    R, p = quat_to_matrix(so3_exp(w)), np.column_stack([9 * np.cos(t), 9 * np.sin(t), np.sin(2 * t)])
    p = (p - p[0]) @ R[0]
    R = R[0].T @ R

    def measured(i: np.ndarray, j: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        Q = quat_to_matrix(so3_exp(noise * rng.standard_normal((len(i), 3))))
        d = np.einsum("nji,nj->ni", R[i], p[j] - p[i]) + noise * rng.standard_normal((len(i), 3))
        return R[i].swapaxes(1, 2) @ R[j] @ Q, d

    k, e = np.arange(N - 1), np.array(ends, dtype=int).reshape(-1, 2)
    A = rng.standard_normal((6, 6))
    cov = noise**2 * (np.eye(6) + 0.05 * A @ A.T)
    each = np.array([noise**2 * np.diag(rng.uniform(0.5, 2.0, 6)) for _ in ends]).reshape(-1, 6, 6)
    graph = ChainGraph(*measured(k, k + 1), cov, e, *measured(e[:, 0], e[:, 1]), each if ends else cov)
    return graph, Poses(R, p)


@pytest.mark.parametrize(
    "ends",
    [[(0, 23)], [(2, 20), (20, 5), (2, 20), (11, 3), (12, 11)], [(23, 1), (4, 5)], []],
    ids=["ends", "crossed, twice and backwards", "neighbours", "none"],
)
def test_the_optimum_is_the_dense_one(ends: list[tuple[int, int]]) -> None:
    graph, _ = drawn(24, ends)
    poses, objective = slow_optimum(graph, graph.dead_reckoning())
    found = relax_chain(graph, gain=1e-14)
    assert found.objective == pytest.approx(objective, rel=1e-9, abs=1e-9)
    assert np.abs(found.poses.position - poses.position).max() < 1e-5
    assert np.abs(found.poses.rotation - poses.rotation).max() < 1e-5
    assert found.converged
    r = residuals(graph, found.poses)
    assert found.objective == pytest.approx(float(r @ r), rel=1e-12, abs=1e-12)


def test_loops_of_a_long_chain_bring_it_back() -> None:
    graph, truth = drawn(4000, [(k, 3999 - k) for k in range(0, 1900, 190)], noise=0.005)
    found = relax_chain(graph)
    off = np.linalg.norm(graph.dead_reckoning().position - truth.position, axis=1)
    near = np.linalg.norm(found.poses.position - truth.position, axis=1)
    assert found.converged
    assert near.mean() < 0.5 * off.mean()
    assert found.objective / (6 * 10) == pytest.approx(1.0, abs=0.5)
    assert found.history == sorted(found.history, reverse=True)


def test_impossible_graphs_are_refused() -> None:
    graph, _ = drawn(12, [(1, 9)])
    with pytest.raises(DataError, match="two different poses"):
        ChainGraph(
            graph.rotation, graph.translation, np.eye(6), [[3, 3]], *(np.eye(3)[None], np.zeros((1, 3)), np.eye(6))
        )
    with pytest.raises(CovarianceError, match="loop_covariance"):
        ChainGraph(
            graph.rotation,
            graph.translation,
            np.eye(6),
            graph.ends,
            graph.loop_rotation,
            graph.loop_translation,
            -np.eye(6),
        )


def test_a_segment_joined_to_one_link_is_the_dense_elimination() -> None:
    graph, truth = drawn(9, [])
    rng = np.random.default_rng(3)
    poses = step_poses(truth, 0.1 * rng.standard_normal((9, 6)))  # residuals that are not small
    poses = Poses(poses.rotation[0].T @ poses.rotation, (poses.position - poses.position[0]) @ poses.rotation[0])
    odometry, _ = graph.links()
    covariance, misfit = np.empty((1, 6, 6)), np.empty((1, 6))
    total = kernels.join_links(odometry, poses, covariance, misfit)
    r, J = residuals(graph, poses), jacobian(graph, poses)
    assert total == pytest.approx(float(r @ r), rel=1e-9)
    b = 0.1 * rng.standard_normal(6)  # a step of the last pose; the first is held
    inner = np.linalg.lstsq(J[:, :-6], -r - J[:, -6:] @ b, rcond=None)[0]
    left = r + J @ np.concatenate([inner, b])
    y = np.concatenate([b[:3], b[3:] - np.cross(b[:3], poses.position[-1])]) + misfit[0]
    assert y @ np.linalg.solve(covariance[0], y) == pytest.approx(float(left @ left), rel=1e-7)
    x = np.zeros((9, 6))
    x[-1] = b
    kernels.follow_links(odometry, poses, np.linalg.inv(covariance), misfit, x)
    np.testing.assert_allclose(x[1:-1].ravel(), inner, atol=1e-6)


def test_joined_links_tie_their_ends_as_the_dense_matrix_does() -> None:
    graph, truth = drawn(5, [(1, 3), (4, 2), (3, 1)])
    poses = step_poses(truth, 0.1 * np.random.default_rng(4).standard_normal((5, 6)))
    poses = Poses(poses.rotation[0].T @ poses.rotation, (poses.position - poses.position[0]) @ poses.rotation[0])
    covariance, misfit = np.empty((3, 6, 6)), np.empty((3, 6))
    total = kernels.join_links(graph.links()[1], poses, covariance, misfit)
    blocks, g = np.zeros((7, 6, 6)), np.zeros((5, 6))
    place = np.arange(5), np.array([5, 6, 5])
    energy, bad = kernels.add_end_blocks(graph.ends, poses.position, covariance, misfit, place, blocks, g)
    r, J = residuals(graph, poses)[-18:], jacobian(graph, poses)[-18:]
    dense = J.T @ J
    assert bad == -1
    assert energy == pytest.approx(total, rel=1e-9)
    assert total == pytest.approx(float(r @ r), rel=1e-9)
    np.testing.assert_allclose(g[1:].ravel(), J.T @ r, rtol=1e-6, atol=1e-4)
    for block, i, j in [(blocks[k], k, k) for k in range(1, 5)] + [(blocks[5], 1, 3), (blocks[6], 2, 4)]:
        wanted = dense[6 * (i - 1) : 6 * i, 6 * (j - 1) : 6 * j]
        np.testing.assert_allclose(block, wanted, rtol=1e-6, atol=1e-4)


def test_a_better_start_than_dead_reckoning_is_taken() -> None:
    graph, truth = drawn(40, [(3, 38)])
    found = relax_chain(graph, truth)
    assert found.history[0] == pytest.approx(float(np.sum(residuals(graph, truth) ** 2)), rel=1e-9)
    assert found.objective == pytest.approx(relax_chain(graph).objective, rel=1e-6)
