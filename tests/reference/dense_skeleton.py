"""The skeleton network written out: every residual a row, every pose and landmark columns, dense matrices."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from graphslam.core.geometry import Array
from graphslam.core.se3 import matrix_to_quat, quat_to_matrix, skew, so3_exp, so3_left_jacobian_inverse, so3_log
from graphslam.skeleton.landmark_kernels import Poses
from graphslam.skeleton.problem import SkeletonProblem


class Rows(NamedTuple):
    """Normalised residuals ``(n,)`` and their derivatives by poses and landmarks, one after the other."""

    residual: Array
    jacobian: sp.csr_matrix


def root(information: Array) -> Array:
    """``U`` with ``Uᵀ U`` the information matrix."""
    return np.linalg.cholesky(information).T


def rows(problem: SkeletonProblem, poses: Poses, landmarks: Array) -> Rows:
    """All residuals in the frames in which their noise is stated, measurement by measurement."""
    N = problem.poses
    e_z = np.array([0.0, 0.0, 1.0])
    blocks: list[tuple[Array, list[tuple[int, Array]]]] = []
    for i in range(N):
        R, p = poses.rotation[i], poses.position[i]
        for m in range(problem.first[i], problem.first[i + 1]):
            z, j = problem.points[m].astype(np.float64), problem.landmark[m]
            d = z / np.linalg.norm(z)
            along, across = problem.range_sigma**-2, (problem.bearing_sigma * np.linalg.norm(z)) ** -2
            U = root(across * np.eye(3) + (along - across) * np.outer(d, d))
            q = landmarks[j] - p
            J_pose = U @ np.hstack([R.T @ skew(q), -R.T])
            blocks.append((U @ (R.T @ q - z), [(6 * i, J_pose), (6 * N + 3 * j, U @ R.T)]))
        if problem.up is not None:
            s = np.broadcast_to(np.asarray(problem.up_sigma, float), N)[i]
            J = np.hstack([R.T @ skew(e_z), np.zeros((3, 3))])
            blocks.append(((R.T @ e_z - problem.up[i]) / s, [(6 * i, J / s)]))
    for k in range(N - 1):
        Ra, Rb = poses.rotation[k], poses.rotation[k + 1]
        d = poses.position[k + 1] - poses.position[k]
        w = so3_log(matrix_to_quat(problem.odometry_rotation[k].T @ Ra.T @ Rb))
        r = np.concatenate([w, Ra.T @ d - problem.odometry_translation[k]])
        right = so3_left_jacobian_inverse(-w) @ Rb.T
        Z = np.zeros((3, 3))
        A, B = np.block([[-right, Z], [Ra.T @ skew(d), -Ra.T]]), np.block([[right, Z], [Z, Ra.T]])
        info = problem.odometry_information
        U = root(info[k if len(info) > 1 else 0])
        blocks.append((U @ r, [(6 * k, U @ A), (6 * k + 6, U @ B)]))
    for g in range(problem.fixes):
        i = int(problem.gps_pose[g])
        info = problem.gps_information
        U = root(info[g if len(info) > 1 else 0])
        blocks.append((U @ (poses.position[i] - problem.gps_position[g]), [(6 * i + 3, U)]))
    w = so3_log(matrix_to_quat(poses.rotation[0] @ problem.start_rotation.T))
    J = np.eye(6)
    J[:3, :3] = so3_left_jacobian_inverse(w)
    U = root(problem.start_information)
    blocks.append((U @ np.concatenate([w, poses.position[0] - problem.start_position]), [(0, U @ J)]))

    r_all, at, to, values, row = [], [], [], [], 0
    for r, parts in blocks:
        for first, J in parts:
            a, b = np.meshgrid(np.arange(J.shape[0]), np.arange(J.shape[1]), indexing="ij")
            at.append((row + a).ravel())
            to.append((first + b).ravel())
            values.append(J.ravel())
        r_all.append(r)
        row += len(r)
    shape = (row, 6 * N + 3 * problem.landmarks)
    jacobian = sp.csr_matrix((np.concatenate(values), (np.concatenate(at), np.concatenate(to))), shape=shape)
    return Rows(np.concatenate(r_all), jacobian)


def best_landmarks(problem: SkeletonProblem, poses: Poses) -> Array:
    """Places of the landmarks that fit best, given the poses, one after the other."""
    D, b = np.zeros((problem.landmarks, 3, 3)), np.zeros((problem.landmarks, 3))
    for i in range(problem.poses):
        R, p = poses.rotation[i], poses.position[i]
        for m in range(problem.first[i], problem.first[i + 1]):
            z = problem.points[m].astype(np.float64)
            d = R @ z / np.linalg.norm(z)
            across = (problem.bearing_sigma * np.linalg.norm(z)) ** -2
            W = across * np.eye(3) + (problem.range_sigma**-2 - across) * np.outer(d, d)
            D[problem.landmark[m]] += W
            b[problem.landmark[m]] += W @ (p + R @ z)
    return np.linalg.solve(D, b[..., None])[..., 0]


def moved(poses: Poses, landmarks: Array, x: Array) -> tuple[Poses, Array]:
    """Poses and landmarks after a step."""
    N = len(poses.position)
    v = x[: 6 * N].reshape(N, 6)
    R = quat_to_matrix(so3_exp(v[:, :3])) @ poses.rotation
    return Poses(R, poses.position + v[:, 3:]), landmarks + x[6 * N :].reshape(-1, 3)


def schur(found: Rows, poses: int) -> tuple[Array, Array]:
    """Dense Schur complement of the landmarks, and half the gradient that is left."""
    H = (found.jacobian.T @ found.jacobian).toarray()
    g = found.jacobian.T @ found.residual
    n = 6 * poses
    X = np.linalg.solve(H[n:, n:], np.column_stack([H[n:, :n], g[n:]]))
    return H[:n, :n] - H[:n, n:] @ X[:, :-1], g[:n] - H[:n, n:] @ X[:, -1]


def optimum(problem: SkeletonProblem, poses: Poses, iterations: int = 30) -> tuple[Poses, Array, float]:
    """Gauss-Newton over poses and landmarks together, by sparse normal equations; to the last digits."""
    landmarks = best_landmarks(problem, poses)
    found = rows(problem, poses, landmarks)
    for _ in range(iterations):
        H = sp.csc_matrix(found.jacobian.T @ found.jacobian)
        x = spla.spsolve(H, -(found.jacobian.T @ found.residual))
        poses, landmarks = moved(poses, landmarks, x)
        found = rows(problem, poses, landmarks)
        if np.abs(x).max() < 1e-10:
            break
    return poses, landmarks, float(found.residual @ found.residual)


def interpolation(poses: Poses, k: int) -> Array:
    """P ``(6 N, 6 K)``: how keyframes carry the poses between them, from its definition."""
    N = len(poses.position)
    at = sorted({*range(0, N - 1, k), N - 1})
    P = np.zeros((6 * N, 6 * len(at)))
    for i in range(N):
        c = min(i // k, len(at) - 2)
        h = (i - at[c]) / (at[c + 1] - at[c])
        for frame, share in ((c, 1.0 - h), (c + 1, h)):
            d = poses.position[i] - poses.position[at[frame]]
            block = np.block([[np.eye(3), np.zeros((3, 3))], [-skew(d), np.eye(3)]])
            P[6 * i : 6 * i + 6, 6 * frame : 6 * frame + 6] += share * block
    return P
