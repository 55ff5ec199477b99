"""Full-batch landmark SLAM with known association, the slow and obvious way: one Gauss-Newton over every scan pose.

No submaps, no graph library, no marginalisation tricks: the least-squares optimum that every method should reach,
and the covariance that goes with it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from graphslam.core.geometry import (
    rotation2,
    se2_adjoint,
    se2_between,
    se2_compose,
    se2_exp,
    se2_inverse,
    se2_log,
    se2_right_jacobian,
    se2_transform,
    wrap_angle,
)
from graphslam.core.log import SensorLog
from graphslam.core.submap import LandmarkMap, Submap
from graphslam.core.trajectory import Trajectory
from graphslam_frontends.odometry.motion import MotionNoise, steering_odometry


@dataclass
class BatchResult:
    """Optimum: poses (k + 1, 3) with the first fixed, landmarks (n, 2) by ids, information of the free variables."""

    times: np.ndarray
    poses: np.ndarray
    ids: np.ndarray
    landmarks: np.ndarray
    information: sp.csc_matrix
    chi2: float
    dof: int
    iterations: int

    def covariance(self) -> np.ndarray:
        return np.linalg.inv(self.information.toarray())

    def trajectory(self, P: np.ndarray | None = None) -> Trajectory:
        if P is None:
            return Trajectory(self.times, self.poses)
        k = 3 * np.arange(len(self.poses) - 1)[:, None] + np.arange(3)
        C = np.concatenate([np.zeros((1, 3, 3)), P[k[:, :, None], k[:, None, :]]])
        return Trajectory(self.times, self.poses, C)

    def landmark_covariances(self, P: np.ndarray) -> np.ndarray:
        k = 3 * (len(self.poses) - 1) + 2 * np.arange(len(self.ids))[:, None] + np.arange(2)
        return P[k[:, :, None], k[:, None, :]]


def batch_slam(log: SensorLog, first: int = 0, last: int | None = None, *, iterations: int = 50) -> BatchResult:
    """Smooth scans ``first:last`` of a simulated log, in the frame of the pose one scan period before the first."""
    obs = log["landmarks"]
    noise = log.meta["noise"]
    last = len(obs.times) if last is None else last
    t0 = obs.times[first - 1] if first else log["controls"].times[0]
    times = np.concatenate([[t0], obs.times[first:last]])
    motion = MotionNoise(speed=noise["speed"], steering=noise["steering"], floor_position=1e-6, floor_heading=1e-8)
    odo = steering_odometry(log["controls"], times, motion)
    inc, W_odo = odo.increments[1:], np.linalg.inv(np.linalg.cholesky(odo.covariances[1:]))
    k = len(inc)

    rows = np.arange(obs.offsets[first], obs.offsets[last])
    rows = rows[obs.ids[rows] >= 0]
    pose = np.searchsorted(obs.offsets, rows, side="right") - first  # 1 … k
    ids, lm = np.unique(obs.ids[rows], return_inverse=True)
    r_m, b_m, s = obs.ranges[rows], obs.bearings[rows], obs.sigmas[rows]

    X = np.zeros((k + 1, 3))
    for i in range(k):
        X[i + 1] = se2_compose(X[i], inc[i])
    _, seen = np.unique(lm, return_index=True)
    local = np.stack([r_m[seen] * np.cos(b_m[seen]), r_m[seen] * np.sin(b_m[seen])], -1)
    L = se2_transform(X[pose[seen]], local)

    size, q = 3 * k + 2 * len(ids), len(rows)

    def residuals(X: np.ndarray, L: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        e = se2_log(se2_compose(se2_inverse(inc), se2_between(X[:-1], X[1:])))
        d = np.einsum("ij,ijk->ik", L[lm] - X[pose, :2], rotation2(X[pose, 2]))
        z = np.stack([np.hypot(*d.T) - r_m, wrap_angle(np.arctan2(d[:, 1], d[:, 0]) - b_m)], -1)
        return e, d, z

    def cost(X: np.ndarray, L: np.ndarray) -> float:
        e, _, z = residuals(X, L)
        return float(np.sum(np.einsum("kij,kj->ki", W_odo, e) ** 2) + np.sum((z / s) ** 2))

    damping, chi2, done = 0.0, cost(X, L), 0
    while done < iterations:
        done += 1
        e, d, z = residuals(X, L)
        Jj = np.linalg.inv(se2_right_jacobian(e))
        Ji = -Jj @ se2_adjoint(se2_inverse(se2_between(X[:-1], X[1:])))
        n2, n = np.sum(d**2, axis=1), np.hypot(*d.T)
        D = np.stack([d / n[:, None], np.stack([-d[:, 1], d[:, 0]], -1) / n2[:, None]], 1)  # ∂(r, b)/∂d
        Jp = D @ np.concatenate([np.tile(-np.eye(2), (q, 1, 1)), np.stack([d[:, 1], -d[:, 0]], -1)[:, :, None]], 2)
        Jl = D @ np.swapaxes(rotation2(X[pose, 2]), 1, 2)
        blocks = [
            (W_odo @ Jj, 3 * np.arange(k), 3 * np.arange(k)),
            ((W_odo @ Ji)[1:], 3 * np.arange(1, k), 3 * np.arange(k - 1)),
            (Jp / s[:, :, None], 3 * k + 2 * np.arange(q), 3 * (pose - 1)),
            (Jl / s[:, :, None], 3 * k + 2 * np.arange(q), 3 * k + 2 * lm),
        ]
        data, ri, ci = [], [], []
        for B, r0, c0 in blocks:
            data.append(B.ravel())
            ri.append(np.broadcast_to(r0[:, None, None] + np.arange(B.shape[1])[:, None], B.shape).ravel())
            ci.append(np.broadcast_to(c0[:, None, None] + np.arange(B.shape[2]), B.shape).ravel())
        J = sp.csc_matrix((np.concatenate(data), (np.concatenate(ri), np.concatenate(ci))), shape=(3 * k + 2 * q, size))
        res = np.concatenate([np.einsum("kij,kj->ki", W_odo, e).ravel(), (z / s).ravel()])
        A, g = sp.csc_matrix(J.T @ J), -(J.T @ res)
        while True:
            damped = A + sp.diags_array(damping * A.diagonal(), format="csc") if damping else A
            step = spla.spsolve(sp.csc_matrix(damped), g, permc_spec="MMD_AT_PLUS_A")
            X2 = X.copy()
            X2[1:] = se2_compose(X[1:], se2_exp(step[: 3 * k].reshape(-1, 3)))
            L2 = L + step[3 * k :].reshape(-1, 2)
            new = cost(X2, L2)
            if new <= chi2 * (1 + 1e-12):
                damping = damping / 10 if damping > 1e-9 else 0.0
                break
            damping = max(10 * damping, 1e-6)
            assert damping < 1e6, "batch SLAM finds no descent"
        small = chi2 - new < 1e-9 * chi2
        X, L, chi2 = X2, L2, new
        if small:
            break
    return BatchResult(times, X, ids, L, A, chi2, 3 * k + 2 * q - size, done)


def batch_submap(log: SensorLog, key: int, first: int, last: int) -> Submap:
    """Landmark submap of scans ``first:last``: the batch optimum marginalised onto [exit, landmarks]."""
    result = batch_slam(log, first, last)
    P = result.covariance()
    k = len(result.poses) - 1
    keep = np.concatenate([np.arange(3 * (k - 1), 3 * k), np.arange(3 * k, len(P))])
    joint = P[np.ix_(keep, keep)]
    G = np.eye(len(joint))
    G[:2, :2] = rotation2(result.poses[-1, 2])  # tangent at the exit → vector in the base frame (eq. 15)
    joint = G @ joint @ G.T
    return Submap.from_landmarks(
        key,
        LandmarkMap(ids=result.ids, exit_pose=result.poses[-1], positions=result.landmarks, covariance=joint),
        interval=(float(result.times[0]), float(result.times[-1])),
        trajectory=result.trajectory(),
        uses=frozenset({"controls", "landmarks"}),
        report={"why": "fixed number of scans", "chi2": result.chi2, "dof": result.dof},
    )
