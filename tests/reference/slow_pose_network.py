"""A second pose-network solver that shares nothing with the library but the network's arrays.

Homogeneous matrices, logarithms through scipy's rotations and a numerically inverted V, Jacobians by central
differences, and a damped Gauss-Newton on the augmented system ``[I J; Jᵀ -λI]``, which does not square the condition
number. Slow and obvious; it exists to establish objectives independently of GTSAM.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from scipy.spatial.transform import Rotation

from graphslam.core.network import PoseNetwork


def matrices(poses: np.ndarray) -> np.ndarray:
    """Homogeneous ``(n, 3, 3)`` or ``(n, 4, 4)`` of ``(n, 3)`` or ``(n, 7)``."""
    n = len(poses)
    if poses.shape[1] == 3:
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        M = np.tile(np.eye(3), (n, 1, 1))
        M[:, 0, 0], M[:, 0, 1], M[:, 1, 0], M[:, 1, 1] = c, -s, s, c
        M[:, :2, 2] = poses[:, :2]
        return M
    M = np.tile(np.eye(4), (n, 1, 1))
    M[:, :3, :3] = Rotation.from_quat(poses[:, 3:]).as_matrix()
    M[:, :3, 3] = poses[:, :3]
    return M


def inverses(M: np.ndarray) -> np.ndarray:
    """Rigid inverses."""
    p = M.shape[-1] - 1
    out = np.zeros_like(M)
    out[:, :p, :p] = np.swapaxes(M[:, :p, :p], 1, 2)
    out[:, :p, p] = -np.einsum("kji,kj->ki", M[:, :p, :p], M[:, :p, p])
    out[:, p, p] = 1.0
    return out


def _skew(w: np.ndarray) -> np.ndarray:
    S = np.zeros((len(w), 3, 3))
    S[:, 0, 1], S[:, 0, 2], S[:, 1, 2] = -w[:, 2], w[:, 1], -w[:, 0]
    return S - np.swapaxes(S, 1, 2)


def _v_matrix(W: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """``V = ∫₀¹ exp(sW) ds`` by its power series; 40 terms are exact to rounding for angles up to π."""
    V = np.tile(np.eye(W.shape[-1]), (len(W), 1, 1))
    term = V.copy()
    for k in range(2, 42):
        term = term @ W / k
        V += term
    return V


def log(M: np.ndarray) -> np.ndarray:
    """Tangents: 2-D (x, y, θ), 3-D (rotation, translation)."""
    if M.shape[-1] == 3:
        theta = np.arctan2(M[:, 1, 0], M[:, 0, 0])
        W = np.zeros((len(M), 2, 2))
        W[:, 0, 1], W[:, 1, 0] = -theta, theta
        rho = np.linalg.solve(_v_matrix(W, theta), M[:, :2, 2:])[..., 0]
        return np.concatenate([rho, theta[:, None]], axis=1)
    w = Rotation.from_matrix(M[:, :3, :3]).as_rotvec()
    V = _v_matrix(_skew(w), np.linalg.norm(w, axis=1))
    return np.concatenate([w, np.linalg.solve(V, M[:, :3, 3:])[..., 0]], axis=1)


def exp(xi: np.ndarray) -> np.ndarray:
    """Inverse of :func:`log`."""
    n = len(xi)
    if xi.shape[1] == 3:
        M = matrices(np.concatenate([np.zeros((n, 2)), xi[:, 2:]], axis=1))
        W = np.zeros((n, 2, 2))
        W[:, 0, 1], W[:, 1, 0] = -xi[:, 2], xi[:, 2]
        M[:, :2, 2] = (_v_matrix(W, xi[:, 2]) @ xi[:, :2, None])[..., 0]
        return M
    M = np.tile(np.eye(4), (n, 1, 1))
    M[:, :3, :3] = Rotation.from_rotvec(xi[:, :3]).as_matrix()
    M[:, :3, 3] = (_v_matrix(_skew(xi[:, :3]), xi[:, 0]) @ xi[:, 3:, None])[..., 0]
    return M


class SlowSolver:
    """Damped Gauss-Newton on a pose network; vertex 0 held (or the network's anchors)."""

    def __init__(self, network: PoseNetwork) -> None:
        self.net = network
        self.i, self.j = network.edges.T
        self.z_inv = inverses(matrices(network.measurements))
        self.root = self._roots(network.information)
        self.mark_root = self._roots(network.observation_information)
        free = np.ones(len(network), dtype=bool)
        free[network.anchors] = False
        d = network.tangent_dim
        self.at = np.where(free, (np.cumsum(free) - 1) * d, -1)
        self.free, self.d = free, d
        self.marks_at = int(free.sum()) * d
        self.size = self.marks_at + 2 * len(network.landmark_ids)

    @staticmethod
    def _roots(omega: np.ndarray) -> np.ndarray:
        if len(omega) == 0:
            return omega
        w, V = np.linalg.eigh(omega)
        return np.sqrt(np.maximum(w, 0.0))[:, :, None] * np.swapaxes(V, 1, 2)

    def edge_residuals(self, Mi: np.ndarray, Mj: np.ndarray) -> np.ndarray:
        """Whitened residuals of all edges."""
        return np.einsum("kij,kj->ki", self.root, log(self.z_inv @ inverses(Mi) @ Mj))

    def mark_residuals(self, M: np.ndarray, marks: np.ndarray) -> np.ndarray:
        """Whitened residuals of all landmark observations."""
        net = self.net
        i, j = net.observations.T
        q = np.einsum("kji,kj->ki", M[i][:, :2, :2], marks[j] - M[i][:, :2, 2])
        if net.observation_kind == "bearing-range":
            b = np.arctan2(q[:, 1], q[:, 0]) - net.observation_values[:, 0]
            b = np.arctan2(np.sin(b), np.cos(b))
            r = np.stack([b, np.hypot(*q.T) - net.observation_values[:, 1]], axis=1)
        else:
            r = q - net.observation_values
        return np.einsum("kij,kj->ki", self.mark_root, r)

    def residuals(self, M: np.ndarray, marks: np.ndarray) -> np.ndarray:
        """All of them, stacked."""
        r = self.edge_residuals(M[self.i], M[self.j]).ravel()
        return np.concatenate([r, self.mark_residuals(M, marks).ravel()]) if len(self.net.observations) else r

    def objective(self, M: np.ndarray, marks: np.ndarray) -> float:
        """``Σ rᵀ Ω r``."""
        return float(np.sum(self.residuals(M, marks) ** 2))

    def jacobian(self, M: np.ndarray, marks: np.ndarray, h: float = 1e-6) -> sp.csc_matrix:
        """By central differences, one tangent component of all poses at a time."""
        d, net = self.d, self.net
        parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

        def add(block: np.ndarray, row0: int, columns: np.ndarray) -> None:
            m, height = block.shape
            rows = row0 + np.arange(m)[:, None] * height + np.arange(height)
            keep = np.broadcast_to((columns >= 0)[:, None], block.shape)
            parts.append((block[keep], rows[keep], np.broadcast_to(columns[:, None], block.shape)[keep]))

        below = len(net.edges) * d
        for k in range(d):
            step = np.zeros((1, d))
            step[0, k] = h
            up, down = M @ exp(step), M @ exp(-step)
            Mi, Mj = M[self.i], M[self.j]
            for block, vertex in (
                (self.edge_residuals(up[self.i], Mj) - self.edge_residuals(down[self.i], Mj), self.i),
                (self.edge_residuals(Mi, up[self.j]) - self.edge_residuals(Mi, down[self.j]), self.j),
            ):
                add(block / (2 * h), 0, np.where(self.at[vertex] >= 0, self.at[vertex] + k, -1))
            if len(net.observations):
                block = (self.mark_residuals(up, marks) - self.mark_residuals(down, marks)) / (2 * h)
                v = net.observations[:, 0]
                add(block, below, np.where(self.at[v] >= 0, self.at[v] + k, -1))
        if len(net.observations):
            for k in range(2):
                e = np.zeros(2)
                e[k] = h
                block = (self.mark_residuals(M, marks + e) - self.mark_residuals(M, marks - e)) / (2 * h)
                add(block, below, self.marks_at + 2 * net.observations[:, 1] + k)
        values, rows, columns = (np.concatenate(p) for p in zip(*parts, strict=True))
        return sp.csc_matrix((values, (rows, columns)), shape=(below + 2 * len(net.observations), self.size))

    def move(self, M: np.ndarray, marks: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Right perturbation of the free poses, landmarks by addition."""
        out = M.copy()
        out[self.free] = M[self.free] @ exp(step[: self.marks_at].reshape(-1, self.d))
        return out, marks + step[self.marks_at :].reshape(-1, 2)

    def solve(
        self, poses: np.ndarray, marks: np.ndarray, *, iterations: int = 60, tolerance: float = 1e-12, climb: int = 8
    ) -> tuple[float, np.ndarray, np.ndarray]:
        """Descend; full steps may climb for ``climb`` iterations, then damped ones must go down.

        Returns
        -------
        objective : float
        M : (n, p + 1, p + 1)
        marks : (l, 2)
        """
        M = matrices(poses)
        now = self.objective(M, marks)
        best = (now, M, marks)
        damping, since = 0.0, 0
        for _ in range(iterations):
            J = self.jacobian(M, marks)
            r = self.residuals(M, marks)
            m = len(r)
            K = sp.bmat(
                [[sp.identity(m), J], [J.T, -damping * sp.diags(np.asarray(J.power(2).sum(0)).ravel())]], format="csc"
            )
            step = spla.splu(K).solve(np.concatenate([-r, np.zeros(self.size)]))[m:]
            tried = self.move(M, marks, step)
            value = self.objective(*tried)
            if value < best[0]:
                small = best[0] - value <= tolerance * best[0]
                best, since = (value, *tried), 0
                M, marks = tried
                damping *= 0.1
                if small:
                    break
                continue
            if abs(value - best[0]) <= tolerance * best[0]:
                break
            since += 1
            if damping == 0.0 and since <= climb:
                M, marks = tried
                continue
            M, marks = best[1], best[2]
            damping = max(10.0 * damping, 1e-6)
            if damping > 1e6:
                break
        return best
