"""A pose graph that is a chain with loops, written out: every residual a row, derivatives by differences."""

from __future__ import annotations

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.se3 import matrix_to_quat, quat_to_matrix, so3_exp, so3_log
from graphslam.skeleton.chain_graph import ChainGraph
from graphslam.skeleton.landmark_kernels import Poses


def residuals(graph: ChainGraph, poses: Poses) -> Array:
    """Normalised residuals of all links, one after the other."""
    out = []
    k = np.arange(graph.poses - 1)
    for pairs, Z, d, cov in (
        (np.column_stack([k, k + 1]), graph.rotation, graph.translation, graph.covariance),
        (graph.ends, graph.loop_rotation, graph.loop_translation, graph.loop_covariance),
    ):
        i, j = pairs.T
        back = poses.rotation[i].swapaxes(1, 2)
        w = so3_log(matrix_to_quat(Z.swapaxes(1, 2) @ back @ poses.rotation[j]))
        t = np.einsum("nab,nb->na", back, poses.position[j] - poses.position[i]) - d
        L = np.linalg.cholesky(np.linalg.inv(cov))
        root = np.broadcast_to(L.swapaxes(1, 2), (len(pairs), 6, 6))
        out.append(np.einsum("nab,nb->na", root, np.concatenate([w, t], axis=1)).ravel())
    return np.concatenate(out)


def at(poses: Poses, x: Array) -> Poses:
    """Poses after the steps ``x`` of all but the first, which is held."""
    v = np.concatenate([np.zeros(6), x]).reshape(-1, 6)
    return Poses(quat_to_matrix(so3_exp(v[:, :3])) @ poses.rotation, poses.position + v[:, 3:])


def jacobian(graph: ChainGraph, poses: Poses, h: float = 1e-6) -> Array:
    """Derivatives of the residuals by all poses but the first, as differences."""
    return np.column_stack(
        [
            (residuals(graph, at(poses, h * e)) - residuals(graph, at(poses, -h * e))) / (2 * h)
            for e in np.eye(6 * (graph.poses - 1))
        ]
    )


def slow_optimum(graph: ChainGraph, poses: Poses) -> tuple[Poses, float]:
    """Gauss-Newton on dense matrices: the poses, and the objective there."""
    for _ in range(12):
        r = residuals(graph, poses)
        J = jacobian(graph, poses)
        x = np.linalg.lstsq(J, -r, rcond=None)[0]
        poses = at(poses, x)
        if np.abs(x).max() < 1e-9:
            break
    r = residuals(graph, poses)
    return poses, float(r @ r)
