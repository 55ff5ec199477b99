"""Joint covariances of any variables of a graph, from its own Gauss-Newton matrix.

GTSAM's joint marginals are too slow for dozens of keys at once. With few columns the inverse Cholesky factor is dense,
and every block of the covariance is then one small product; otherwise sparse solves on the requested columns
(Algorithm 1 of Combined SLAM) never form the whole inverse.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.linalg import lapack

from graphslam.core.errors import IndeterminateError
from graphslam.core.geometry import Array
from graphslam.graph.variables import VariableLayout
from graphslam.linear.symmetric_factor import SymmetricFactor


class JointCovariance:
    """Covariance ``A⁻¹`` of all variables, by blocks; of poses in the right tangent (3-D: rotation first).

    Parameters
    ----------
    A : (n, n) dense or CSC
        Gauss-Newton matrix.
    """

    def __init__(self, layout: VariableLayout, A: Array | sp.csc_matrix) -> None:
        self.layout = layout
        self._inverse_factor: Array | None = None
        self._sparse: SymmetricFactor | None = None
        if sp.issparse(A):
            self._sparse = SymmetricFactor(A)  # type: ignore[arg-type]
            return
        # Columns scaled to a unit diagonal: metres, radians and tight or loose factors then have one scale.
        scale = 1.0 / np.sqrt(np.maximum(np.diag(A), 1e-300))
        M = A * scale[:, None]
        M *= scale
        L, info = lapack.dpotrf(M.T, lower=1, clean=1, overwrite_a=1)  # .T: LAPACK's order, no copy
        if info == 0:
            L, info = lapack.dtrtri(L, lower=1, overwrite_c=1)
        if info != 0:
            raise IndeterminateError("the Gauss-Newton matrix is singular: some variables are not constrained")
        L *= scale
        self._inverse_factor = L  # A⁻¹ = (L⁻¹ S)ᵀ (L⁻¹ S)

    def columns(self, ix: npt.ArrayLike) -> Array:
        """Covariance of the columns ``ix`` ``(q,)`` in that order, ``(q, q)``."""
        c = np.asarray(ix, dtype=np.intp)
        if self._inverse_factor is not None:
            W = self._inverse_factor[:, c]
            return np.asarray(W.T @ W)
        assert self._sparse is not None
        return self._sparse.inverse_block(c)

    def solve(self, b: Array) -> Array:
        """``A⁻¹ b`` of a vector ``(n,)``."""
        if self._inverse_factor is not None:
            return np.asarray(self._inverse_factor.T @ (self._inverse_factor @ b))
        assert self._sparse is not None
        return np.asarray(self._sparse.solve(b))

    def joint(self, names: Iterable[str]) -> Array:
        """Joint covariance of named variables in that order; the fixed ``x0`` contributes no columns."""
        return self.columns(self.layout.columns_of(names))

    def marginal(self, name: str) -> Array:
        """Covariance of one variable; zeros for the fixed ``x0``."""
        d = self.layout.pose_dof
        return np.zeros((d, d)) if name == "x0" else self.joint([name])

    def pose_and_points(self, pose: npt.ArrayLike, first: npt.ArrayLike) -> tuple[Array, Array, Array]:
        """Blocks of one pose and of each of many points, without blocks between points.

        Parameters
        ----------
        pose : (k,) int
            Columns of the pose (k = 0 for the fixed first base).
        first : (c,) int
            First column of every point.

        Returns
        -------
        P_xx : (k, k)
        P_xl : (c, k, 2)
        P_ll : (c, 2, 2)
        """
        x, f = np.asarray(pose, dtype=np.intp), np.asarray(first, dtype=np.intp)
        if self._inverse_factor is not None:
            W_x = self._inverse_factor[:, x]
            W_l = self._inverse_factor[:, (f[:, None] + np.arange(2)).ravel()]
            P_xl = (W_x.T @ W_l).reshape(len(x), len(f), 2).transpose(1, 0, 2)
            a, b = W_l[:, 0::2], W_l[:, 1::2]
            P_ll = np.empty((len(f), 2, 2))
            P_ll[:, 0, 0], P_ll[:, 1, 1] = np.einsum("rc,rc->c", a, a), np.einsum("rc,rc->c", b, b)
            P_ll[:, 0, 1] = P_ll[:, 1, 0] = np.einsum("rc,rc->c", a, b)
            return W_x.T @ W_x, P_xl, P_ll
        P_xx, P_xl, P_ll = np.zeros((len(x), len(x))), np.zeros((len(f), len(x), 2)), np.zeros((len(f), 2, 2))
        for c in range(0, len(f), 30):  # a few dozen columns at a time
            some = f[c : c + 30]
            B = self.columns(np.concatenate([x, (some[:, None] + np.arange(2)).ravel()]))
            k, n = len(x), len(some)
            P_xx = B[:k, :k]
            P_xl[c : c + n] = B[:k, k:].reshape(k, n, 2).transpose(1, 0, 2)
            P_ll[c : c + n] = B[k:, k:].reshape(n, 2, n, 2)[np.arange(n), :, np.arange(n), :]
        return P_xx, P_xl, P_ll

    def full(self) -> Array:
        """The whole covariance ``(n, n)``."""
        return self.columns(np.arange(self.layout.size))

    def poses(self) -> Array:
        """Marginal of every node ``(m + 1, d, d)``, d = 3 or 6; zeros for the fixed first base."""
        d = self.layout.pose_dof
        blocks = self._diagonal_blocks(0, self.layout.stop("x"), d)
        return np.concatenate([np.zeros((1, d, d)), blocks])

    def cross(self, first: npt.ArrayLike, second: npt.ArrayLike) -> Array:
        """Cross-covariances ``(k, d, d)`` of pairs of nodes ``(k,)``; zeros where one is the fixed first base."""
        i, j = np.asarray(first, dtype=np.int64), np.asarray(second, dtype=np.int64)
        d = self.layout.pose_dof
        out = np.zeros((len(i), d, d))
        free = np.flatnonzero((i > 0) & (j > 0))
        step = 60 // d  # number of pairs whose columns are solved together
        for c in range(0, len(free), step):
            k = free[c : c + step]
            nodes, at = np.unique(np.concatenate([i[k], j[k]]), return_inverse=True)
            B = self.columns(self.layout.pose_columns(nodes).ravel()).reshape(len(nodes), d, len(nodes), d)
            out[k] = B[at[: len(k)], :, at[len(k) :], :]
        return out

    def landmarks(self) -> Array:
        """Marginal of every landmark ``(n, dim, dim)``."""
        return self._diagonal_blocks(self.layout.start("l"), self.layout.stop("l"), self.layout.dim)

    def _diagonal_blocks(self, start: int, stop: int, d: int) -> Array:
        if self._inverse_factor is not None:
            W = self._inverse_factor[:, start:stop].reshape(self.layout.size, -1, d)
            return np.einsum("rkd,rke->kde", W, W, optimize=True)
        step = 60  # columns solved together
        out = [np.zeros((0, d, d))]
        for c in range(start, stop, step):
            ix = np.arange(c, min(c + step, stop))
            B = self.columns(ix)
            k = len(ix) // d
            out.append(B.reshape(k, d, k, d)[np.arange(k), :, np.arange(k), :])
        return np.concatenate(out)
