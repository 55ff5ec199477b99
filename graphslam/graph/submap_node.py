"""Nodes of a submap in a graph, and the body poses between them.

A dense submap may have *inner nodes*: frames ``T_base_node`` at poses of its own path, so that a loop can deform it. A
factor at time t (a fix, a match) and the full-rate path are attached to the nearest node by a fixed local pose; its
covariance is the one that the path accumulates between the two.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.path_points import PathPoints
from graphslam.core.poses import Group, group_of
from graphslam.core.sensor_biases import SensorBiases
from graphslam.core.trajectory import Trajectory
from graphslam.graph.factors.landmark_submap import PathRecord, SubmapRecord
from graphslam.graph.noise import whitener

# The difference of two marginals of a path is made positive semi-definite; directions below this share of the path's
# own variance are rounding errors.
_FLOOR = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class PathBridge:
    """Path instants between two nodes a and b, conditioned on both.

    Between the nodes the error is a random walk. If the increment a → b has the covariance S, with Q accumulated up to
    the instant, and the residual at b is e, the conditional mean of the error at the instant is ``K e``,
    ``K = Q Aᵀ S⁻¹`` (A transforms an error at the instant to b), and its conditional covariance is ``Q - K A Q``.

    Parameters
    ----------
    T_node_body : (q, 3|7)
        Relative to node a.
    gain : (q, d, d)
        K.
    left : (q, d, d)
        ``Q - K A Q``.
    """

    T_node_body: Array
    gain: Array
    left: Array


@dataclass(frozen=True, slots=True, eq=False)
class InnerPoints:
    """Points of the path of a landmark submap, with their factor in the graph.

    Parameters
    ----------
    mean, joint : (n,), (n, n)
        Of end pose and landmarks, from the submap.
    scale : float
        Factor on all covariances.
    factor_id : int or None
        Its :class:`~graphslam.graph.factors.landmark_submap.PathRecord`, once a fix is used.
    rows : mapping of int to int
        Used points → rows of the graph's points.
    biases : SensorBiases or None
        Dependence of these quantities on constant errors.
    """

    path: PathPoints
    mean: Array
    joint: Array
    scale: float = 1.0
    factor_id: int | None = None
    rows: Mapping[int, int] = field(default_factory=dict)
    biases: SensorBiases | None = None

    def record(self, submap: SubmapRecord, factor_id: int) -> PathRecord:
        """Factor of the used points, in addition to the submap's own."""
        used = sorted(self.rows)
        gain, left = self.path.given(self.joint, used)
        W = whitener(left, what=f"path of submap {submap.submap_key} at its fixes", scale=self.scale)
        z, parts = [self.mean, self.path.positions[used].ravel()], [-W @ gain, W]
        if self.biases is not None:
            moved = self.biases.points[self.path.scalars(used)] - gain @ self.biases.response
            z, parts = [*z, np.zeros(moved.shape[1])], [*parts, -W @ moved]
        return PathRecord(
            factor_id, submap.submap_key, submap.start, submap.landmark_ids,
            np.array([self.rows[k] for k in used], dtype=np.int64), np.concatenate(z), np.hstack(parts), submap.chart,
            robot=submap.robot,
        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class SubmapNode:
    """A submap in a graph.

    Parameters
    ----------
    node : int
        Node at its base.
    interval : (t_start, t_end)
    trajectory : Trajectory or None
        ``T_base_body(t)``.
    factor_id : int
        Its factor, or the first of the factors of its chain.
    nodes : (k + 2,) int
        Base, inner nodes in order of time, end.
    times : (k + 2,)
        Time of each node [s].
    T_base_node : (k + 2, 3|7)
        Identity, poses of the path, end pose.
    covariances : (k + 1, d, d)
        Of the increments between nodes as in the graph, right tangent at the later node.
    stated : (k + 1, d, d)
        The same before relative roll and pitch were removed from a levelled end pose: uncertainty of the chain of
        relative poses alone, for instance in cycles of loops and chain. For a landmark submap, its end pose.
    inner_points : InnerPoints or None
        Of a landmark submap with points of its path.
    biases : SensorBiases or None
        Dependence of a landmark submap on constant errors of the robot's wheels and sensor.
    robot : int
        Row of these errors in the graph; -1: none.
    factor_ids : tuple of int
        The chain between the nodes, and factors added with it (the attitude of a levelled end pose).
    """

    key: int
    node: int
    interval: tuple[float, float]
    trajectory: Trajectory | None
    factor_id: int
    nodes: tuple[int, ...] = ()
    times: Array = field(default_factory=lambda: np.zeros(0))
    T_base_node: Array = field(default_factory=lambda: np.zeros((0, 3)))
    factor_ids: tuple[int, ...] = ()
    covariances: Array = field(default_factory=lambda: np.zeros((0, 3, 3)))
    stated: Array = field(default_factory=lambda: np.zeros((0, 3, 3)))
    inner_points: InnerPoints | None = None
    biases: SensorBiases | None = None
    robot: int = -1

    @property
    def exit_node(self) -> int:
        """Node at its end, the base of the next submap."""
        return self.nodes[-1]

    @property
    def inner(self) -> tuple[int, ...]:
        """Nodes between base and end."""
        return self.nodes[1:-1]

    def before(self, times: Array) -> npt.NDArray[np.intp]:
        """Index ``(q,)`` into :attr:`nodes` of the last node at or before each of ``times``; never the end node."""
        return np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.nodes) - 2)

    def nearest(self, times: Array) -> npt.NDArray[np.intp]:
        """Index ``(q,)`` into :attr:`nodes` of the node nearest in time; never the end node."""
        t = np.asarray(times, dtype=np.float64)
        i = self.before(t)
        j = np.minimum(i + 1, len(self.nodes) - 2)
        return np.asarray(np.where(np.abs(self.times[j] - t) < np.abs(t - self.times[i]), j, i))

    def local(self, times: Array, at: npt.NDArray[np.intp]) -> tuple[Array, Array | None]:
        """Poses of the body relative to nodes, and their covariances.

        Parameters
        ----------
        times : (q,)
        at : (q,) int
            Index into :attr:`nodes`, not the end node.

        Returns
        -------
        T_node_body : (q, 3|7)
        covariance : (q, d, d) or None
            Right tangent at the body; None if the path has none.
        """
        assert self.trajectory is not None
        path = self.trajectory
        P = None if path.covariances is None else path.interpolate_covariance(times)
        return self._seen(np.asarray(times, dtype=np.float64), path.interpolate(times), P, at)

    def local_rows(self, rows: npt.NDArray[Any], at: npt.NDArray[np.intp]) -> tuple[Array, Array | None]:
        """The same at the path's own times, ``rows`` (mask or integers)."""
        assert self.trajectory is not None
        path = self.trajectory
        P = None if path.covariances is None else path.covariances[rows]
        return self._seen(path.times[rows], path.poses[rows], P, at)

    def between(self, rows: npt.NDArray[Any], at: npt.NDArray[np.intp]) -> PathBridge:
        """Path rows between the nodes ``at`` and the next ones, conditioned on both nodes."""
        T, Q = self.local_rows(rows, at)
        if self.trajectory is None or Q is None:
            raise DataError(f"path of submap {self.key} has no covariances", wanted="covariances")
        group = group_of(T)
        ahead = group.between(self.trajectory.poses[rows], self.T_base_node[at + 1])
        A = group.adjoint(group.inverse(ahead))  # transforms an error of the body to the next node
        L = np.linalg.cholesky(self.covariances)[at]
        B = np.linalg.solve(L, A)
        M = B @ Q @ np.swapaxes(B, 1, 2)
        w, V = np.linalg.eigh(0.5 * (M + np.swapaxes(M, 1, 2)))
        w = np.clip(w, 0.0, 1.0)[:, None, :]  # a marginal covariance may exceed that of the whole increment
        Vt = np.swapaxes(V, 1, 2)
        back = np.linalg.solve(B, np.broadcast_to(np.eye(group.dof), B.shape))
        gain = back @ ((V * w) @ Vt) @ np.linalg.inv(L)
        left = back @ ((V * (w * (1.0 - w))) @ Vt) @ np.swapaxes(back, 1, 2)
        return PathBridge(T, gain, left)

    def _seen(self, t: Array, T: Array, P: Array | None, at: npt.NDArray[np.intp]) -> tuple[Array, Array | None]:
        assert self.trajectory is not None
        path, group = self.trajectory, group_of(T)
        out = T.copy()
        inner = np.flatnonzero(at > 0)
        origin = self.T_base_node[at[inner]]
        out[inner] = group.between(origin, T[inner])
        if P is not None and len(inner):
            P = P.copy()
            P_node = path.interpolate_covariance(self.times[at[inner]])
            after = t[inner] >= self.times[at[inner]]
            ahead = added_covariance(group, P_node, P[inner], out[inner])
            # a body before the node: the error between them, transformed to the body
            back = group.inverse(out[inner])
            ad = group.adjoint(out[inner])
            behind = ad @ added_covariance(group, P[inner], P_node, back) @ np.swapaxes(ad, 1, 2)
            P[inner] = np.where(after[:, None, None], ahead, behind)
        return out, P


def added_covariance(group: Group, P_a: Array, P_b: Array, T_ab: Array) -> Array:
    """Covariance ``(q, d, d)`` that a path adds from a to b: ``P_b - Ad(T_ab⁻¹) P_a Ad(T_ab⁻¹)ᵀ``.

    Made positive semi-definite (in units of the spread at b): marginal covariances of a path may decrease with time,
    for example roll and pitch of a levelled path.

    Parameters
    ----------
    P_a, P_b : (q, d, d)
        Right tangents at a and b.
    T_ab : (q, 3|7)
    """
    ad = group.adjoint(group.inverse(T_ab))
    Q = P_b - ad @ P_a @ np.swapaxes(ad, 1, 2)
    s = np.sqrt(np.maximum(np.diagonal(P_b, axis1=1, axis2=2), 1e-300))
    scaled = Q / (s[:, :, None] * s[:, None, :])
    w, V = np.linalg.eigh(0.5 * (scaled + np.swapaxes(scaled, 1, 2)))
    scaled = (V * np.maximum(w, _FLOOR)[:, None, :]) @ np.swapaxes(V, 1, 2)
    return np.asarray(scaled * (s[:, :, None] * s[:, None, :]))
