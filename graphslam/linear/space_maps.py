"""Least squares over Gaussians of 3-D poses and points, each relative to one pose (e.g. 3-D submaps).

Examples: an odometry step (its end, no points), an observation (no pose, some points), a landmark submap (its end and
its landmarks), and a joined map (the ends of many submaps and their landmarks). Each is a Gaussian in the frame of its
base, in a given chart (:mod:`graphslam.core.charts`): its residual is

    u = (w_k, V(w_k)⁻¹ (t_k - t̂_k), …, V(w_a)⁻¹ (l - l̂), …),      w_k = Log(R_k R̂_kᵀ),

for all poses k and all points, with the rotation of the anchor pose a of a point; poses and points are in the base
frame. ``uᵀ I u`` is its part of the objective (no half), with the Cartesian information matrix I at the mean.

Values are perturbed in the frame of the problem: ``R ← Exp(φ) R``, ``t ← t + τ``, ``l ← l + λ``.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from graphslam.core.charts import inverse_left_jacobian_slopes, inverse_left_jacobians
from graphslam.core.errors import SolverError
from graphslam.core.geometry import Array
from graphslam.core.se3 import (
    quat_multiply,
    quat_normalize,
    quat_to_matrix,
    skew,
    so3_exp,
    so3_left_jacobian_inverse,
    so3_log,
)

logger = logging.getLogger(__name__)
Index = npt.NDArray[np.int64]

ORIGIN = -1
"""As a base: the frame of the problem. As an anchor: the base, without rotation."""
_CONJUGATE = np.array([-1.0, -1.0, -1.0, 1.0])
_SHORTEST = 0.05


@dataclass(frozen=True, eq=False)
class SpaceMap:
    """A Gaussian over poses and points in the frame of its base.

    Parameters
    ----------
    poses : (m, 7)
    points : (n, 3)
    anchors : (n,) int64
        Row of ``poses`` that is the anchor of each point; :data:`ORIGIN`: the base.
    information : sparse (6 m + 3 n, 6 m + 3 n)
        Of rotations about the axes of the base [rad] and translations [m], pose by pose, then the points.
    """

    poses: Array
    points: Array
    anchors: Index
    information: sp.csr_matrix
    chart: str = "group"


@dataclass(frozen=True, eq=False)
class PlacedMap:
    """A map, and its variables in a problem.

    Parameters
    ----------
    base : int
        Pose of the problem that is its base, or :data:`ORIGIN`.
    poses : (m,) int64
    points : (n,) int64
        A point can be repeated.
    """

    map: SpaceMap
    base: int
    poses: Index
    points: Index

    def residual(self, poses: Array, points: Array) -> Array:
        """``u`` ``(6 m + 3 n,)``."""
        return self._seen(poses, points)[0]

    def linearise(self, poses: Array, points: Array) -> tuple[Array, sp.csr_matrix]:
        """``u`` and its Jacobian with respect to all variables of the problem ``(6 m + 3 n, 6 M + 3 N)``."""
        u, seen = self._seen(poses, points)
        m, n, unknown = len(self.poses), len(self.points), 6 * len(poses)
        blocks = _Blocks()
        back, w, V, e = seen.back, seen.w, seen.V, seen.e
        if self.map.chart == "group":
            curve = inverse_left_jacobian_slopes(seen.turn, e)  # of every position by its rotation
            true = V
        else:
            curve, true = np.zeros((m + n, 3, 3)), so3_left_jacobian_inverse(w)
        swing = true @ back  # of the rotations of poses by their own φ; negative for the base
        at = np.concatenate([6 * np.arange(m) + 3, 6 * m + 3 * np.arange(n)])  # rows of positions
        column = np.concatenate([6 * self.poses + 3, unknown + 3 * self.points])
        blocks.add(6 * np.arange(m), 6 * self.poses, swing)
        blocks.add(at, column, seen.Va @ back)
        held = np.concatenate([np.arange(m), self.map.anchors])
        bends = np.flatnonzero(held >= 0)
        by_turn = curve[bends] @ swing[held[bends]]
        blocks.add(at[bends], 6 * self.poses[held[bends]], by_turn)
        if self.base >= 0:
            turn = seen.Va @ (back @ skew(seen.off))
            turn[bends] -= by_turn
            blocks.add(6 * np.arange(m), np.full(m, 6 * self.base), -swing)
            blocks.add(at, np.full(m + n, 6 * self.base), turn)
            blocks.add(at, np.full(m + n, 6 * self.base + 3), -(seen.Va @ back))
        return u, blocks.matrix(6 * m + 3 * n, unknown + 3 * len(points))

    def _seen(self, poses: Array, points: Array) -> tuple[Array, _Seen]:
        m, M = len(self.poses), self.map
        mine = poses[self.poses]
        off = np.concatenate([mine[:, :3], points[self.points]])
        q = mine[:, 3:]
        back = np.eye(3)
        if self.base >= 0:
            base = poses[self.base]
            back = quat_to_matrix(base[3:]).T
            off = off - base[:3]
            q = quat_multiply(np.broadcast_to(base[3:] * _CONJUGATE, q.shape), q)
        w = so3_log(quat_multiply(q, M.poses[:, 3:] * _CONJUGATE)) if m else np.zeros((0, 3))
        e = off @ back.T - np.concatenate([M.poses[:, :3], M.points])
        V = inverse_left_jacobians(w) if M.chart == "group" else np.broadcast_to(np.eye(3), (m, 3, 3))
        held = np.concatenate([np.arange(m), M.anchors])
        turn = np.where(held[:, None] >= 0, w[held], 0.0) if m else np.zeros((len(held), 3))
        Va = np.where(held[:, None, None] >= 0, V[held], np.eye(3)) if m else np.tile(np.eye(3), (len(held), 1, 1))
        bent = np.einsum("kij,kj->ki", Va, e)
        u = np.concatenate([np.hstack([w, bent[:m]]).ravel(), bent[m:].ravel()])
        return u, _Seen(back, w, V, turn, Va, e, off)


@dataclass(frozen=True, eq=False)
class _Seen:
    """Common terms of residual and Jacobian: rotation to the base, rotation residuals, positions and their factors."""

    back: Array
    w: Array
    V: Array
    turn: Array
    Va: Array
    e: Array
    off: Array


class _Blocks:
    """3 × 3 blocks of a sparse matrix; blocks at the same place are added."""

    def __init__(self) -> None:
        self.rows: list[Index] = []
        self.columns: list[Index] = []
        self.values: list[Array] = []

    def add(self, rows: Index, columns: Index, blocks: Array) -> None:
        """Add blocks ``(b, 3, 3)`` at ``rows`` and ``columns`` ``(b,)``."""
        k = np.arange(3)
        shape = (len(rows), 3, 3)
        self.rows.append(np.broadcast_to(rows[:, None, None] + k[:, None], shape).ravel())
        self.columns.append(np.broadcast_to(columns[:, None, None] + k, shape).ravel())
        self.values.append(np.broadcast_to(blocks, shape).ravel())

    def matrix(self, rows: int, columns: int) -> sp.csr_matrix:
        """The matrix ``(rows, columns)``."""
        at = (np.concatenate(self.rows), np.concatenate(self.columns))
        return sp.csr_matrix((np.concatenate(self.values), at), shape=(rows, columns))


def step_values(poses: Array, points: Array, step: Array) -> tuple[Array, Array]:
    """Values after a step ``(6 M + 3 N,)``."""
    d = step[: 6 * len(poses)].reshape(-1, 6)
    q = quat_normalize(quat_multiply(so3_exp(d[:, :3]), poses[:, 3:])) if len(poses) else poses[:, 3:]
    return np.hstack([poses[:, :3] + d[:, 3:], q]), points + step[6 * len(poses) :].reshape(-1, 3)


def space_objective(maps: Sequence[PlacedMap], poses: Array, points: Array) -> float:
    """``Σ uᵀ I u``."""
    total = 0.0
    for one in maps:
        u = one.residual(poses, points)
        total += float(u @ (one.map.information @ u))
    return total


def normal_equations(maps: Sequence[PlacedMap], poses: Array, points: Array) -> tuple[float, Array, sp.csc_matrix]:
    """Objective, half its gradient ``Jᵀ I u`` and the Gauss–Newton matrix ``Jᵀ I J``."""
    jacobians, weights, residuals = [], [], []
    for one in maps:
        u, J = one.linearise(poses, points)
        residuals.append(u)
        jacobians.append(J)
        weights.append(one.map.information)
    r, J, weight = np.concatenate(residuals), sp.vstack(jacobians, format="csr"), sp.block_diag(weights, format="csr")
    Wr = weight @ r
    return float(r @ Wr), J.T @ Wr, sp.csc_matrix(J.T @ (weight @ J))


@dataclass(frozen=True)
class SpaceMinimum:
    """Result of :func:`minimise_space_maps`: values, objective and Gauss–Newton matrix there, and convergence."""

    poses: Array
    points: Array
    objective: float
    information: sp.csc_matrix
    iterations: int
    converged: bool


def minimise_space_maps(
    maps: Sequence[PlacedMap], poses: Array, points: Array, *, rtol: float = 1e-12, max_iterations: int = 60
) -> SpaceMinimum:
    """Damped Gauss–Newton; it ends when the predicted decrease of the linear model is below ``rtol · max(f, 1)``."""
    from graphslam.linear.symmetric_factor import SymmetricFactor

    f, g, H = normal_equations(maps, poses, points)
    if not np.isfinite(f):
        raise SolverError(f"objective is {f} at the start; wanted a finite number")
    damping, iterations, converged = 0.0, 0, False
    while iterations < max_iterations and not converged:
        iterations += 1
        A = H if damping == 0.0 else sp.csc_matrix(H + damping * sp.diags(H.diagonal()))
        step = -SymmetricFactor(A).solve(g)
        promised = float(-(g @ step))
        small = promised <= rtol * max(f, 1.0)
        share = 1.0
        while True:
            trial = step_values(poses, points, share * step)
            found = space_objective(maps, *trial)
            if (np.isfinite(found) and found <= f) or small or share <= _SHORTEST:
                break
            share *= 0.5
        if np.isfinite(found) and found <= f + (rtol * max(f, 1.0) if small else 0.0):
            poses, points = trial
            f, g, H = normal_equations(maps, poses, points)
            damping = 0.0 if damping < 1e-6 else damping / 10.0
            converged = small and damping == 0.0
        elif small and damping == 0.0:
            converged = True  # the predicted decrease is below the rounding error of the objective
        else:
            damping = max(10.0 * damping, 1e-5)
            if damping > 1e12:
                break
    if not converged:
        logger.warning("no convergence after %d iterations: objective %.9g", iterations, f)
    return SpaceMinimum(poses, points, f, H, iterations, converged)
