"""A chain with loops against Gauss-Newton on dense matrices, whose derivatives are differences."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.errors import CovarianceError, DataError
from graphslam.core.se3 import matrix_to_quat, quat_to_matrix, so3_exp, so3_log
from graphslam.skeleton.chain_graph import ChainGraph, relax_chain
from graphslam.skeleton.landmark_kernels import Poses


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


def residuals(graph: ChainGraph, poses: Poses) -> np.ndarray:
    """Normalised residuals of all links, one after the other."""
    out = []
    k = np.arange(graph.poses - 1)
    for pairs, Z, d, cov in (
        (np.column_stack([k, k + 1]), graph.rotation, graph.translation, graph.covariance),
        (graph.ends, graph.loop_rotation, graph.loop_translation, graph.loop_covariance),
    ):
        for n, (i, j) in enumerate(pairs):
            w = so3_log(matrix_to_quat(Z[n].T @ poses.rotation[i].T @ poses.rotation[j]))
            r = np.concatenate([w, poses.rotation[i].T @ (poses.position[j] - poses.position[i]) - d[n]])
            L = np.linalg.cholesky(np.linalg.inv(cov[n if len(cov) > 1 else 0]))
            out.append(L.T @ r)
    return np.concatenate(out)


def at(poses: Poses, x: np.ndarray) -> Poses:
    v = np.concatenate([np.zeros(6), x]).reshape(-1, 6)  # the first pose is held
    return Poses(quat_to_matrix(so3_exp(v[:, :3])) @ poses.rotation, poses.position + v[:, 3:])


def slow_optimum(graph: ChainGraph, poses: Poses) -> tuple[Poses, float]:
    n, h = 6 * (graph.poses - 1), 1e-6
    for _ in range(12):
        r = residuals(graph, poses)
        J = np.column_stack(
            [(residuals(graph, at(poses, h * e)) - residuals(graph, at(poses, -h * e))) / (2 * h) for e in np.eye(n)]
        )
        x = np.linalg.lstsq(J, -r, rcond=None)[0]
        poses = at(poses, x)
        if np.abs(x).max() < 1e-9:
            break
    r = residuals(graph, poses)
    return poses, float(r @ r)


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
