"""Landmarks, gradient, product and keyframe network of a skeleton network against dense matrices."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graphslam.core.errors import ConfigError, DataError
from graphslam.skeleton.landmark_kernels import Poses
from graphslam.skeleton.preconditioner import (
    KeyframeNetwork,
    Preconditioner,
    PreconditionerLevels,
    keyframe_chain_blocks,
    keyframes_of,
)
from graphslam.skeleton.problem import SkeletonProblem
from graphslam.skeleton.relax import RelaxConfig, relax_skeleton
from graphslam.skeleton.schur import Network, Workers, WorkRanges
from graphslam.skeleton.tiles import write_tiled_problem
from graphslam_studies.sim.laps import Laps
from tests.reference import dense_skeleton as dense


def close(a: np.ndarray, b: np.ndarray, tolerance: float) -> bool:
    return float(np.abs(a - b).max()) <= tolerance * float(np.abs(b).max())


def test_the_twins_jacobian_is_that_of_its_residual(problem: SkeletonProblem, poses: Poses) -> None:
    landmarks = dense.best_landmarks(problem, poses)
    J = dense.rows(problem, poses, landmarks).jacobian
    rng = np.random.default_rng(0)
    for _ in range(4):
        x = rng.standard_normal(J.shape[1])
        h = 1e-6
        ahead = dense.rows(problem, *dense.moved(poses, landmarks, h * x)).residual
        back = dense.rows(problem, *dense.moved(poses, landmarks, -h * x)).residual
        # the turn of a measurement's noise with its pose is not a part of the residual in the body frame
        assert close((ahead - back) / (2 * h), J @ x, 1e-6)


def test_landmarks_and_objective(problem: SkeletonProblem, network: Network, written_out: dense.Rows) -> None:
    assert close(network.landmarks, dense.best_landmarks(problem, network.poses), 1e-12)
    assert network.objective == pytest.approx(float(written_out.residual @ written_out.residual), rel=1e-12)


def test_gradient_against_matrix_and_differences(network: Network, written_out: dense.Rows) -> None:
    _, g = dense.schur(written_out, len(network.poses.position))
    assert close(network.gradient.ravel(), g, 1e-9)
    rng = np.random.default_rng(1)
    from graphslam.skeleton.schur import step_poses

    for _ in range(3):
        v = rng.standard_normal(network.gradient.shape)
        h = 1e-5
        up, down = (Network(network.layout, step_poses(network.poses, s * h * v)).objective for s in (1, -1))
        assert (up - down) / (4 * h) == pytest.approx(float(np.sum(network.gradient * v)), rel=1e-6)


def test_product_against_dense_schur_complement(network: Network, written_out: dense.Rows) -> None:
    S, _ = dense.schur(written_out, len(network.poses.position))
    rng = np.random.default_rng(2)
    for _ in range(3):
        v = rng.standard_normal(network.gradient.shape)
        assert close(network.product(v).ravel(), S @ v.ravel(), 1e-10)
    N = len(S) // 6
    blocks = np.array([S[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i in range(N)])
    assert close(network.diagonal(), blocks, 1e-10)


@pytest.mark.parametrize("k", [1, 4, 7, 19, 95, 200])
def test_keyframe_network_is_the_restricted_schur_complement(network: Network, written_out: dense.Rows, k: int) -> None:
    N = len(network.poses.position)
    S, _ = dense.schur(written_out, N)
    P = dense.interpolation(network.poses, k)
    assert P.shape[1] == 6 * keyframes_of(N, k)
    coarse = KeyframeNetwork(network, k)
    wanted = P.T @ S @ P
    assert close(coarse.matrix().toarray(), wanted, 1e-8)
    r = np.random.default_rng(3).standard_normal((N, 6))
    out = np.zeros_like(r)
    coarse.apply(r, out)
    assert close(out.ravel(), P @ np.linalg.solve(wanted, P.T @ r.ravel()), 1e-6)
    jacobi = Preconditioner(network, PreconditionerLevels(k, 0))
    blocks = np.array([wanted[6 * c : 6 * c + 6, 6 * c : 6 * c + 6] for c in range(len(wanted) // 6)])
    assert close(np.linalg.inv(jacobi.keyframes), blocks, 1e-7)


def test_the_chain_alone_is_restricted_as_well(network: Network) -> None:
    N = len(network.poses.position)
    diagonal, upper = network.chain_blocks()
    A = np.zeros((6 * N, 6 * N))
    for i in range(N):
        A[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = diagonal[i]
        if i + 1 < N:
            A[6 * i : 6 * i + 6, 6 * i + 6 : 6 * i + 12] = upper[i]
            A[6 * i + 6 : 6 * i + 12, 6 * i : 6 * i + 6] = upper[i].T
    P = dense.interpolation(network.poses, 10)
    wanted = P.T @ A @ P
    D, U = keyframe_chain_blocks(network, 10)
    for c in range(len(D)):
        assert close(D[c], wanted[6 * c : 6 * c + 6, 6 * c : 6 * c + 6], 1e-9)
        if c + 1 < len(D):
            assert close(U[c], wanted[6 * c : 6 * c + 6, 6 * c + 6 : 6 * c + 12], 1e-9)


def test_preconditioner_is_symmetric_and_positive(network: Network) -> None:
    M = Preconditioner(network, PreconditionerLevels(4, 16))
    rng = np.random.default_rng(4)
    a, b = (rng.standard_normal(network.gradient.shape) for _ in range(2))
    assert np.sum(a * M(b)) == pytest.approx(np.sum(b * M(a)), rel=1e-9)
    assert np.sum(a * M(a)) > 0


def test_threads_change_no_byte(problem: SkeletonProblem, poses: Poses) -> None:
    found = []
    for threads in (1, 2, 3):
        network = Network(WorkRanges(problem, Workers(threads)), poses)
        v = np.sin(np.arange(network.gradient.size)).reshape(-1, 6)
        M = Preconditioner(network, PreconditionerLevels(4, 16))
        made = (network.landmarks, network.gradient, network.product(v), network.diagonal(), M(v))
        found.append((network.objective, *(x.tobytes() for x in made)))
    assert found[0] == found[1] == found[2]


def test_points_of_surfaces_against_dense_matrices(problem: SkeletonProblem, laps: Laps) -> None:
    """Each measures along its normal only; the extent of a landmark holds its position on the surface, and no pose."""
    rng = np.random.default_rng(6)
    truth, pose = laps.truth, np.repeat(np.arange(problem.poses), np.diff(problem.first))
    of_landmark = rng.standard_normal((problem.landmarks, 3))
    of_landmark /= np.linalg.norm(of_landmark, axis=1, keepdims=True)
    normals = np.einsum("mji,mj->mi", truth.rotation[pose], of_landmark[problem.landmark])
    surfaces = replace(problem, normals=normals, range_sigma=0.02, bearing_sigma=0.3, up=None)
    network = Network(WorkRanges(surfaces, Workers(1)), truth)
    N, L = problem.poses, problem.landmarks
    bare = replace(surfaces, points=surfaces.points[:0], normals=normals[:0], landmark=[], first=np.zeros(N + 1, int))
    chain = dense.rows(bare, truth, np.zeros((0, 3)))
    H, g = np.zeros((6 * N + 3 * L, 6 * N + 3 * L)), np.zeros(6 * N + 3 * L)
    H[: 6 * N, : 6 * N] = (chain.jacobian.T @ chain.jacobian).toarray()
    g[: 6 * N] = chain.jacobian.T @ chain.residual
    held, sums = np.zeros((L, 3)), np.zeros(L)
    for m, (i, j) in enumerate(zip(pose, problem.landmark)):
        n, q = of_landmark[j], network.landmarks[j] - truth.position[i]
        x = truth.rotation[i] @ problem.points[m].astype(float)
        J = np.concatenate([np.cross(n, q), -n]) / 0.02  # n · (q × w - u)
        columns = np.r_[6 * i : 6 * i + 6, 6 * N + 3 * j : 6 * N + 3 * j + 3]
        row = np.concatenate([J, n / 0.02])
        H[np.ix_(columns, columns)] += np.outer(row, row)
        g[columns] += row * (n @ (q - x)) / 0.02
        own = np.arange(6 * N + 3 * j, 6 * N + 3 * j + 3)
        H[own, own] += 0.3**-2
        held[j] += truth.position[i] + x
        sums[j] += 1
    assert close(network.landmarks, held / sums[:, None], 1e-5)  # the same normals: the mean in every direction
    n = 6 * N
    S = H[:n, :n] - H[:n, n:] @ np.linalg.solve(H[n:, n:], H[n:, :n])
    assert np.abs(g[n:]).max() < 1e-4 * np.abs(g[:n]).max()  # the landmarks are at their best positions
    assert close(network.gradient.ravel(), g[:n], 1e-5)
    v = rng.standard_normal((N, 6))
    assert close(network.product(v).ravel(), S @ v.ravel(), 1e-6)
    assert surfaces.freedom == problem.measurements - L + 3 * problem.fixes


def test_points_of_surfaces_need_initial_poses_and_unit_normals(problem: SkeletonProblem, tmp_path: Path) -> None:
    normals = np.tile([0.0, 0.0, 1.0], (problem.measurements, 1))
    surfaces = replace(problem, normals=normals)
    with pytest.raises(ConfigError, match="initial poses"):
        relax_skeleton(surfaces, RelaxConfig(split=False))
    with pytest.raises(ConfigError, match="tiles"):
        write_tiled_problem(surfaces, tmp_path)
    with pytest.raises(DataError, match="unit vectors"):
        replace(problem, normals=2.0 * normals)
