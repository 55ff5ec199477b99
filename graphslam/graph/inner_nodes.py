"""Cut a dense submap into a chain of nodes with an approximately constant spacing.

Input are its path ``T_base_body(t)`` with marginal covariances ``P_k``, and its end pose with covariance ``P``. The
chain has nodes at some of the path's poses, with independent increments between them::

    P_{k+1} = Ad(T_{k,k+1}⁻¹) P_k Ad(T_{k,k+1}⁻¹)ᵀ + Q_k          (right tangents)

which is solved for ``Q_k``. Marginals of a path need not be those of a chain of independent steps: roll and pitch of a
levelled path do not grow, and the spread of a filter may shrink. So the increments are transformed to the end and
expressed in units of its covariance, ``Y_k = L⁻¹ A_k Q_k A_kᵀ L⁻ᵀ`` with ``P = L Lᵀ``. There they are projected to
positive definite with a floor (a small share of the end-pose covariance), and corrected so that their sum is the
identity, ``Y_k ← S^{-1/2} Y_k S^{-1/2}``, ``S = Σ Y_k``: the smallest such correction (the symmetric one is the optimal
transport between the two Gaussians). To first order the composition of the increments then has exactly the end-pose
covariance, so cutting a submap neither adds nor loses information.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graphslam.core.geometry import Array, arc_length
from graphslam.core.poses import Group, group_of
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory

FLOOR = 0.02
"""Minimum share of the end-pose covariance for all increments together, divided by their path lengths."""


@dataclass(frozen=True, slots=True, eq=False)
class SubmapChain:
    """A submap as a chain of nodes.

    Parameters
    ----------
    times : (k + 2,)
        Base, inner nodes, end [s].
    T_base_node : (k + 2, 3|7)
    increments : (k + 1, 3|7)
        ``T_{node, next node}``.
    covariances : (k + 1, d, d)
        Right tangent at the next node.
    """

    times: Array
    T_base_node: Array
    increments: Array
    covariances: Array


def inner_rows(path: Trajectory, spacing: float) -> npt.NDArray[np.intp]:
    """Rows of a path about every ``spacing`` metres of path length, without its ends."""
    if len(path) < 3:
        return np.zeros(0, dtype=np.intp)
    along = arc_length(path.positions)
    pieces = round(along[-1] / spacing)
    goals = along[-1] * np.arange(1, pieces) / max(pieces, 1)
    after = np.clip(np.searchsorted(along, goals), 1, len(along) - 1)
    rows = np.where(goals - along[after - 1] < along[after] - goals, after - 1, after)
    rows = np.unique(rows)
    return np.asarray(rows[(rows > 0) & (rows < len(path) - 1)], dtype=np.intp)


def cut_submap(submap: Submap, spacing: float | None) -> SubmapChain:
    """The chain of a dense submap; one increment if it has no path, is short, or without ``spacing``.

    Parameters
    ----------
    spacing : float or None
        Path length between nodes [m]; None: no inner nodes.
    """
    group, path = group_of(submap.exit_pose), submap.trajectory
    rows = inner_rows(path, spacing) if spacing is not None and path is not None else np.zeros(0, dtype=np.intp)
    if path is not None and len(rows):  # a path may extend slightly beyond its submap
        inside = (path.times[rows] > submap.interval[0]) & (path.times[rows] < submap.interval[1])
        rows = rows[inside]
    inner = path.poses[rows] if path is not None and len(rows) else np.zeros((0, group.size))
    T = np.concatenate([group.identity[None], inner, submap.exit_pose[None]])
    t0, t1 = submap.interval
    times = np.concatenate([[t0], path.times[rows] if path is not None else [], [t1]])
    if len(rows) == 0 or path is None:
        return SubmapChain(times, T, submap.exit_pose[None].copy(), submap.exit_covariance[None].copy())
    increments = group.between(T[:-1], T[1:])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(increments[:, : group.dim], axis=1))])
    share = np.diff(along) / along[-1] if along[-1] > 0 else np.full(len(increments), 1.0 / len(increments))
    if path.covariances is None:
        Q = share[:, None, None] * np.diag(np.diag(submap.exit_covariance))
    else:
        P = np.concatenate([np.zeros((1, group.dof, group.dof)), path.covariances[rows], submap.exit_covariance[None]])
        ad = group.adjoint(group.inverse(increments))
        Q = P[1:] - ad @ P[:-1] @ np.swapaxes(ad, 1, 2)
    return SubmapChain(times, T, increments, reconcile_increments(group, T, Q, submap.exit_covariance, share))


def reconcile_increments(group: Group, T_base_node: Array, Q: Array, P_exit: Array, share: Array) -> Array:
    """Increment covariances ``(k, d, d)`` that compose to ``P_exit``, from the differences of the marginals.

    Parameters
    ----------
    T_base_node : (k + 1, 3|7)
    Q : (k, d, d)
        Symmetric, not necessarily positive; right tangents at nodes 1 … k.
    P_exit : (d, d)
    share : (k,)
        Share of the path length, for the floor; sums to one.
    """
    L = np.linalg.cholesky(P_exit)
    to_exit = group.adjoint(group.between(T_base_node[-1], T_base_node[1:]))  # ξ_exit = Ad(T_exit⁻¹ T_node) ξ_node
    A = np.linalg.solve(np.broadcast_to(L, to_exit.shape), to_exit)
    Y = A @ Q @ np.swapaxes(A, 1, 2)
    w, V = np.linalg.eigh(0.5 * (Y + np.swapaxes(Y, 1, 2)))
    w = np.maximum(w, FLOOR * np.maximum(share, 1e-3 / len(share))[:, None])
    Y = (V * w[:, None, :]) @ np.swapaxes(V, 1, 2)
    s, U = np.linalg.eigh(Y.sum(axis=0))
    root = (U / np.sqrt(s)) @ U.T  # S^{-1/2}
    Y = root @ Y @ root
    back = np.linalg.solve(to_exit, np.broadcast_to(L, to_exit.shape))
    out = back @ Y @ np.swapaxes(back, 1, 2)
    return np.asarray(0.5 * (out + np.swapaxes(out, 1, 2)))
