"""A second form of the problem of a pose network, by rows: GTSAM's and g2o's objective, the linearised system.

GTSAM 4.3 evaluates a ``BetweenFactor`` as ``r = Log(z⁻¹ x_i⁻¹ x_j)`` with the full logarithm in 2-D and in 3-D
(its default build) and with exact Jacobians; the agreement is tested. g2o takes the vector (x, y, θ), in 3-D
(t, vec q), of the same transform, so its objective differs wherever a residual is not small.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from graphslam.core import se3
from graphslam.core.geometry import (
    Array,
    rotation2,
    se2_adjoint,
    se2_between,
    se2_compose,
    se2_exp,
    se2_inverse,
    se2_log,
    se2_right_jacobian,
    wrap_angle,
)
from graphslam.core.network import PoseNetwork
from graphslam.linear.symmetric_factor import elimination_order

Residual = Literal["gtsam", "g2o"]


def compose(a: Array, b: Array) -> Array:
    """``T_ac``, 2-D or 3-D by the width of the arrays."""
    return se2_compose(a, b) if a.shape[-1] == 3 else se3.se3_compose(a, b)


def inverse(a: Array) -> Array:
    """``T_ba``, 2-D or 3-D."""
    return se2_inverse(a) if a.shape[-1] == 3 else se3.se3_inverse(a)


def between(a: Array, b: Array) -> Array:
    """``T_ab = T_wa⁻¹ T_wb``, 2-D or 3-D."""
    return se2_between(a, b) if a.shape[-1] == 3 else se3.se3_between(a, b)


def exp(xi: Array) -> Array:
    """Exponential of tangents ``(..., 3)`` or ``(..., 6)``."""
    return se2_exp(xi) if xi.shape[-1] == 3 else se3.se3_exp(xi)


def edge_residuals(network: PoseNetwork, poses: Array, residual: Residual = "gtsam") -> Array:
    """Residuals of the edges ``(m, d)`` in GTSAM's tangent order."""
    i, j = network.edges.T
    error = between(network.measurements, between(poses[i], poses[j]))
    if residual == "g2o":
        return error if network.dim == 2 else np.concatenate([error[:, 3:6], error[:, :3]], axis=1)
    return se2_log(error) if network.dim == 2 else se3.se3_log(error)


def observation_residuals(network: PoseNetwork, poses: Array, landmarks: Array) -> Array:
    """Residuals of the landmark observations ``(k, 2)``: predicted minus measured, bearings wrapped."""
    i, j = network.observations.T
    local = _in_frame(poses[i], landmarks[j])
    if network.observation_kind == "cartesian":
        return local - network.observation_values
    bearing = wrap_angle(np.arctan2(local[:, 1], local[:, 0]) - network.observation_values[:, 0])
    return np.stack([bearing, np.hypot(local[:, 0], local[:, 1]) - network.observation_values[:, 1]], axis=1)


def _in_frame(poses: Array, points: Array) -> Array:
    return np.einsum("kji,kj->ki", rotation2(poses[:, 2]), points - poses[:, :2])


def edge_costs(network: PoseNetwork, poses: Array, residual: Residual = "gtsam") -> Array:
    """``rᵀ Ω r`` of every edge, ``(m,)``."""
    r = edge_residuals(network, poses, residual)
    return np.einsum("mi,mij,mj->m", r, network.information, r)


def observation_costs(network: PoseNetwork, poses: Array, landmarks: Array) -> Array:
    """``rᵀ Ω r`` of every landmark observation, ``(k,)``."""
    r = observation_residuals(network, poses, landmarks)
    return np.einsum("mi,mij,mj->m", r, network.observation_information, r)


def objective(network: PoseNetwork, poses: Array, landmarks: Array, residual: Residual = "gtsam") -> float:
    """``Σ rᵀ Ω r`` over edges and observations, without the factor ½.

    Parameters
    ----------
    poses : (n, 3) or (n, 7)
    landmarks : (l, 2)
    residual : {"gtsam", "g2o"}
        Which program's residual of an edge.
    """
    total = edge_costs(network, poses, residual).sum()
    return float(total + observation_costs(network, poses, landmarks).sum())


def edge_jacobians(network: PoseNetwork, poses: Array) -> tuple[Array, Array, Array]:
    """Residuals ``(m, d)`` and Jacobians ``(m, d, d)`` with respect to the right tangents of x_i and x_j.

    ``r(x_j Exp δ) = Log(E Exp δ)``, so ``J_j = J_r⁻¹(r)``; moving x_i by δ moves x_i⁻¹x_j by ``-Ad(x_j⁻¹ x_i) δ`` on
    the right, so ``J_i = -J_r⁻¹(r) Ad(x_j⁻¹ x_i)``.
    """
    i, j = network.edges.T
    r = edge_residuals(network, poses)
    relative = between(poses[j], poses[i])
    if network.dim == 2:
        J_j: Array = np.asarray(np.linalg.inv(se2_right_jacobian(r)), dtype=np.float64)
        return r, -J_j @ se2_adjoint(relative), J_j
    J_j = np.asarray(np.linalg.inv(se3.se3_right_jacobian(r)), dtype=np.float64)
    return r, -J_j @ se3.se3_adjoint(relative), J_j


def observation_jacobians(network: PoseNetwork, poses: Array, landmarks: Array) -> tuple[Array, Array, Array]:
    """Residuals ``(k, 2)``, Jacobians by pose tangent ``(k, 2, 3)`` and by landmark ``(k, 2, 2)``."""
    i, j = network.observations.T
    local = _in_frame(poses[i], landmarks[j])
    r = observation_residuals(network, poses, landmarks)
    J_pose = np.zeros((len(r), 2, 3))
    J_pose[:, 0, 0] = J_pose[:, 1, 1] = -1.0
    J_pose[:, 0, 2], J_pose[:, 1, 2] = local[:, 1], -local[:, 0]
    J_mark = np.swapaxes(rotation2(poses[i, 2]), 1, 2)
    if network.observation_kind == "bearing-range":
        square = np.maximum(np.sum(local**2, axis=1), 1e-12)
        distance = np.sqrt(square)
        P = np.empty((len(r), 2, 2))  # d(bearing, range) / d(x, y)
        P[:, 0, 0], P[:, 0, 1] = -local[:, 1] / square, local[:, 0] / square
        P[:, 1, 0], P[:, 1, 1] = local[:, 0] / distance, local[:, 1] / distance
        J_pose, J_mark = P @ J_pose, P @ J_mark
    return r, J_pose, np.asarray(J_mark)


def square_root(information: Array) -> Array:
    """Matrices R ``(m, d, d)`` with ``RᵀR = Ω``, upper triangular where Ω is positive definite."""
    if len(information) == 0:
        return information
    try:
        return np.asarray(np.swapaxes(np.linalg.cholesky(information), 1, 2))
    except np.linalg.LinAlgError:
        w, V = np.linalg.eigh(information)
        return np.asarray(np.sqrt(np.maximum(w, 0.0))[:, :, None] * np.swapaxes(V, 1, 2))


def subnetwork(network: PoseNetwork, used: npt.NDArray[np.bool_]) -> PoseNetwork:
    """The network with only the edges and observations of ``used`` (m + k,)."""
    m = len(network.edges)
    e, o = np.flatnonzero(used[:m]), np.flatnonzero(used[m:])
    return replace(
        network,
        edges=network.edges[e],
        measurements=network.measurements[e],
        information=network.information[e],
        observations=network.observations[o],
        observation_values=network.observation_values[o],
        observation_information=network.observation_information[o],
    )


def _free_nodes(network: PoseNetwork) -> np.ndarray:
    """Poses that are not held, then landmarks, counted through."""
    free = np.ones(len(network) + len(network.landmark_ids), dtype=bool)
    free[network.anchors] = False
    return np.flatnonzero(free)


@dataclass(frozen=True, slots=True)
class Layout:
    """Where the free scalars of a network stand in the state vector; anchors are left out."""

    pose_at: np.ndarray  # (n,) first column of a pose, -1 for an anchor
    mark_at: np.ndarray  # (l,)
    size: int

    @classmethod
    def of(cls, network: PoseNetwork) -> Layout:
        """Poses in order, then landmarks."""
        return cls._in_order(network, _free_nodes(network))

    @classmethod
    def for_elimination(cls, network: PoseNetwork) -> Layout:
        """Poses and landmarks in a minimum-degree order of elimination: quicker than to order their scalars."""
        nodes, n = _free_nodes(network), len(network)
        at = np.full(n + len(network.landmark_ids), -1)
        at[nodes] = np.arange(len(nodes))
        i, j = at[np.concatenate([network.edges, network.observations + [0, n]])].T
        free_pair = (i >= 0) & (j >= 0)
        order = elimination_order(i[free_pair], j[free_pair], len(nodes)) if len(nodes) else nodes
        return cls._in_order(network, nodes[order])

    @classmethod
    def _in_order(cls, network: PoseNetwork, nodes: np.ndarray) -> Layout:
        n = len(network)
        width = np.where(nodes < n, network.tangent_dim, 2)
        begin = np.full(n + len(network.landmark_ids), -1)
        begin[nodes] = np.cumsum(width) - width
        return cls(begin[:n], begin[n:], int(width.sum()))

    def retract(self, poses: Array, landmarks: Array, step: Array) -> tuple[Array, Array]:
        """Poses moved by ``Exp`` on the right, landmarks by addition."""
        d = 3 if poses.shape[1] == 3 else 6
        free = np.flatnonzero(self.pose_at >= 0)
        moved = poses.copy()
        moved[free] = compose(poses[free], exp(step[self.pose_at[free, None] + np.arange(d)]))
        return moved, landmarks + step[self.mark_at[:, None] + np.arange(2)]


def linearise(network: PoseNetwork, poses: Array, landmarks: Array, layout: Layout) -> tuple[sp.csr_matrix, Array]:
    """Whitened Jacobian and residual: the objective is ``‖J δ + r‖²`` to first order.

    Returns
    -------
    J : (rows, layout.size) CSR
    r : (rows,)
        Edges first, then observations.
    """
    d = network.tangent_dim
    r, J_i, J_j = edge_jacobians(network, poses)
    R = square_root(network.information)
    whitened = [np.einsum("mij,mj->mi", R, r).ravel()]
    i, j = network.edges.T
    parts = [_triplets(R @ J_i, layout.pose_at[i], 0), _triplets(R @ J_j, layout.pose_at[j], 0)]
    if len(network.observations):
        i, j = network.observations.T
        r, J_pose, J_mark = observation_jacobians(network, poses, landmarks)
        R = square_root(network.observation_information)
        whitened.append(np.einsum("mij,mj->mi", R, r).ravel())
        row = len(network.edges) * d
        parts += [_triplets(R @ J_pose, layout.pose_at[i], row), _triplets(R @ J_mark, layout.mark_at[j], row)]
    values, rows, columns = (np.concatenate(p) for p in zip(*parts, strict=True))
    residual = np.concatenate(whitened)
    return sp.csr_matrix((values, (rows, columns)), shape=(len(residual), layout.size)), residual


def _triplets(blocks: Array, at: np.ndarray, first_row: int) -> tuple[Array, np.ndarray, np.ndarray]:
    m, height, width = blocks.shape
    rows = first_row + (np.arange(m)[:, None] * height + np.arange(height))[:, :, None]
    columns = at[:, None, None] + np.arange(width)
    rows, columns = np.broadcast_arrays(rows, columns)
    keep = np.broadcast_to((at >= 0)[:, None, None], blocks.shape)
    return blocks[keep], rows[keep], columns[keep]
