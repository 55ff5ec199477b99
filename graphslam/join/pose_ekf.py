"""The dense baseline for poses: an extended Kalman filter over all nodes, submap by submap.

The same submaps, each at its own optimum, the same ties, linearised once at the same values as in the information
filter in sequence, so the two agree to rounding. A submap appends its nodes, ``X_i = X_end ∘ B.X_i`` with the error
``Ad(B.X_i⁻¹) ξ_end + ξ_i``; its ties, and that its own word of where up is must be that of the map, are measurements.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from graphslam.core.errors import CovarianceError, DataError
from graphslam.core.geometry import Array
from graphslam.core.poses import SE3
from graphslam.core.se3 import quat_to_matrix
from graphslam.join.pose_map import PoseMap, SymmetricBlocks, level_meeting, level_tangent
from graphslam.join.pose_problem import PoseProblem, RelativePoseFactors
from graphslam.join.submap_solver import dense_inverse

MOST = 8000
"""States up to which there is a dense filter: its covariance takes half a gigabyte then."""


class PoseFilter:
    """A map in covariance form.

    Parameters
    ----------
    problem : PoseProblem
        What it has to have room for.
    """

    def __init__(self, problem: PoseProblem) -> None:
        if problem.states > MOST:
            raise DataError("the dense filter has no room for so many states", got=problem.states, wanted=f"≤ {MOST}")
        g = problem.group
        self._levels = 2 * problem.levelled  # the level frame stands first, the poses follow
        self.poses = g.identity[None]
        self.up: Array | None = None
        self._P = np.zeros((problem.states + 2, problem.states + 2))

    @property
    def _n(self) -> int:
        return self._levels + self._d * (len(self.poses) - 1)

    @property
    def _d(self) -> int:
        return 3 if self.poses.shape[1] == 3 else 6

    @property
    def covariance(self) -> Array:
        """Over the poses but the base, then the level frame ``(n, n)``."""
        order = np.roll(np.arange(self._n), -self._levels)
        return self._P[np.ix_(order, order)]

    def join(self, leaf: PoseMap, ties: RelativePoseFactors) -> None:
        """Append a submap, then one measurement update."""
        d, n, P = self._d, self._n, self._P
        Q = dense_inverse(leaf.matrix())
        g, k = leaf.group, d * (len(leaf.poses) - 1)
        end = self.poses[-1]
        columns = np.arange(n - d, n) if len(self.poses) > 1 else np.zeros(0, dtype=np.int64)
        F = g.adjoint(g.inverse(leaf.poses[1:])).reshape(k, d)
        new = np.arange(n, n + k)
        seen = None
        if leaf.up is not None:
            seen = SE3.compose(end, leaf.up)
            turned = np.zeros((2, d))
            turned[:, :3] = quat_to_matrix(leaf.up[3:]).T[:2]  # R Exp(δ) R_up = R R_up Exp(R_upᵀ δ)
            F = np.concatenate([F, turned])
            # of the first that knows it that is the level frame; of others it is compared, and forgotten
            new = np.append(new, np.arange(2) if self.up is None else n + k + np.arange(2))
        old = np.setdiff1d(np.arange(n), new)
        F = F[:, : len(columns)] if len(columns) else np.zeros((len(F), 0))
        cross = F @ P[np.ix_(columns, old)]
        P[np.ix_(new, old)] = cross
        P[np.ix_(old, new)] = cross.T
        P[np.ix_(new, new)] = F @ P[np.ix_(columns, columns)] @ F.T + Q
        self.poses = np.concatenate([self.poses, g.compose(end, leaf.poses[1:])])
        rows = n + k
        H, y = self._measured(ties, rows)
        noise = np.ones(len(y))
        if seen is not None and self.up is not None:
            step, turn, self.up = level_meeting(self.up, seen)
            P[:2] = turn @ P[:2]
            P[:, :2] = P[:, :2] @ turn.T
            # the submap's own word is step + T τ, and is to be that
            meet = np.zeros((2, rows + 2))
            meet[:, :2], meet[:, rows:] = level_tangent(step), -np.eye(2)
            H = sp.vstack([sp.hstack([H, sp.csr_matrix((len(y), 2))]), sp.csr_matrix(meet)], format="csr")
            y, noise, rows = np.append(y, step), np.append(noise, np.zeros(2)), rows + 2
        elif seen is not None:
            self.up = seen
        if len(y):
            self._update(sp.csr_matrix(H), y, noise, rows)

    def _measured(self, ties: RelativePoseFactors, rows: int) -> tuple[sp.csr_matrix, Array]:
        """Whitened Jacobian ``(e d, rows)`` and residuals of ties here."""
        d = self._d
        r, J, _, _ = ties.whitened(self.poses, None)
        at = self._levels + d * (ties.ends - 1)
        columns = (at[:, :, None] + np.arange(d)).reshape(-1, 2 * d)
        free = np.repeat(ties.ends > 0, d, axis=1)
        row = np.arange(len(r) * d).reshape(-1, d, 1) + np.zeros((1, 1, 2 * d), dtype=np.int64)
        keep = np.broadcast_to(free[:, None, :], J.shape)
        column = np.broadcast_to(columns[:, None, :], J.shape)
        return sp.csr_matrix((J[keep], (row[keep], column[keep])), shape=(len(r) * d, rows)), r.ravel()

    def _update(self, H: sp.csr_matrix, y: Array, noise: Array, rows: int) -> None:
        d, n = self._d, self._n
        P = self._P[:rows, :rows]
        HP = np.asarray(H @ P)
        S = np.asarray(H @ HP.T) + np.diag(noise)
        try:
            L = la.cholesky(0.5 * (S + S.T), lower=True)
        except la.LinAlgError:
            raise CovarianceError("innovation covariance of the EKF is not positive definite") from None
        W = la.solve_triangular(L, HP[:, :n], lower=True)
        x = -W.T @ la.solve_triangular(L, y, lower=True)
        P = self._P[:n, :n]
        P -= W.T @ W
        # the errors are now those about the new values
        here = PoseMap(self.poses, self.up, SymmetricBlocks(np.zeros((0, 2), dtype=np.int64), np.zeros((0, d, d))))
        step = np.zeros((len(self.poses) + 1, d))
        step[1:-1] = x[self._levels :].reshape(-1, d)
        step[-1, : self._levels] = x[: self._levels]
        moved, T = here.moved(step), np.linalg.inv(here.tangents(step))
        self.poses, self.up = moved.poses, moved.up
        if self._levels:
            P[:2] = T[-1, :2, :2] @ P[:2]
            P[:, :2] = P[:, :2] @ T[-1, :2, :2].T
        a, m = self._levels, len(self.poses) - 1
        P[a:] = (T[1:-1] @ P[a:].reshape(m, d, n)).reshape(m * d, n)
        P[:, a:] = (T[1:-1] @ P[:, a:].T.reshape(m, d, n)).reshape(m * d, n).T
