"""Places of a chain of submaps that a loop may tie: a node about every so many metres, and what is known between two.

A place is a node of the graph: the base of a submap, or a pose of its path. The *way* says how far along the whole
chain it lies, so that stretches can be told apart. What is known of the relative pose of two places is asked of the
graph (:class:`RelativePoses`); as long as there is no graph, the chain itself says it (:class:`ChainRelativePoses`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError, GeometryError
from graphslam.core.geometry import Array, arc_length
from graphslam.core.poses import compose_increments, group_of
from graphslam.core.submap import Submap

Ints = npt.NDArray[np.int64]


class RelativePoses(Protocol):
    """What is known of the pose of nodes j seen from nodes i, ``(k,)`` each.

    Returns ``T_ij (k, 7|3)`` and its covariance ``(k, d, d)`` in the right tangent, from the joint marginal of each
    pair.
    """

    def __call__(self, i: Ints, j: Ints) -> tuple[Array, Array]: ...


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Places of a chain of submaps, in the order of the way.

    Parameters
    ----------
    node : (n,) int64
        In the graph.
    submap : (n,) int64
        Number of the submap in the chain that each lies in.
    T_base_node : (n, 7) or (n, 3)
        In the frame of that submap's base.
    way : (n,)
        Length of the path from the beginning of the chain [m].
    time : (n,)
        When the body was there [s].
    """

    node: Ints
    submap: Ints
    T_base_node: Array
    way: Array
    time: Array

    def __post_init__(self) -> None:
        n = len(self.node)
        sizes = tuple(map(len, (self.node, self.submap, self.T_base_node, self.way, self.time)))
        if len(set(sizes)) != 1:
            raise GeometryError("places differ in number", got=sizes)
        group_of(self.T_base_node)  # refuses other shapes
        if n and np.any(np.diff(self.way) < 0):
            raise DataError("places are not in the order of the path", wanted="rising lengths")

    def __len__(self) -> int:
        return len(self.node)

    def of_submap(self, k: int) -> Ints:
        """Which places lie in submap ``k``."""
        return np.flatnonzero(self.submap == k).astype(np.int64)

    def nearest(self, submap: int, position: Array) -> int:
        """The place of a submap nearest to a position ``(dim,)`` in the frame of its base."""
        at = self.of_submap(submap)
        if not len(at):
            raise DataError(f"submap {submap} has no place")
        d = self.T_base_node[at, : len(position)] - position
        return int(at[np.argmin(np.einsum("ij,ij->i", d, d))])


def places_at_nodes(poses: Sequence[Array], times: Sequence[Array]) -> Places:
    """Places at the nodes of a chain of submaps; the way is that from node to node, enough to tell stretches apart.

    Parameters
    ----------
    poses : sequence of (n, 7) or (n, 3)
        ``T_base_node`` of every submap, the base first; the last is its exit and no place, for it is the next one's
        base.
    times : sequence of (n,)
    """
    stretches = []
    for T, t in zip(poses, times, strict=True):
        along = arc_length(T[:, : group_of(T).dim])
        stretches.append((T[:-1], along[:-1], np.asarray(t[:-1]), float(along[-1])))
    return _places(stretches)


def _places(stretches: Sequence[tuple[Array, Array, Array, float]]) -> Places:
    """Of every submap poses, ways from its base, times, and its whole length: one after the other."""
    poses, ways, times, lengths = zip(*stretches)
    begin = np.concatenate([[0.0], np.cumsum(lengths)])
    counts = [len(T) for T in poses]
    return Places(
        np.arange(sum(counts), dtype=np.int64),
        np.repeat(np.arange(len(counts), dtype=np.int64), counts),
        np.concatenate(poses),
        np.concatenate([b + w for b, w in zip(begin, ways)]),
        np.concatenate(times),
    )


class ChainRelativePoses:
    """What a chain of submaps alone says of two of its places: exits and paths, no loops.

    Parameters
    ----------
    places : Places
        Of these submaps, their nodes numbered as they come.

    Notes
    -----
    Increments between neighbouring places take up what the covariance of the path grows by from one to the other; the
    last of a submap ends in the covariance of its exit. ``P_{k+1} = A P_k Aᵀ + Q_k``, ``A = Ad(T_{k,k+1}⁻¹)``, says Q;
    what of it is not positive is set to a thousandth of the variance of the exit.
    """

    def __init__(self, submaps: Sequence[Submap], places: Places) -> None:
        self.places = places
        T, Q = chain_increments(submaps, places)
        g = group_of(T)
        self.increments, self.covariances = T, Q
        self.poses = compose_increments(T)
        """In the frame of the first ``(n + 1, 7|3)``; the last is the end of the chain."""
        # in the axes of the first place contributions add: W = Σ Ad(X_k) Q_k Ad(X_k)ᵀ
        A = g.adjoint(self.poses[1:])
        W = np.cumsum(A @ Q @ np.swapaxes(A, 1, 2), axis=0)
        self._sum = np.concatenate([np.zeros((1, g.dof, g.dof)), W])

    def __call__(self, i: Ints, j: Ints) -> tuple[Array, Array]:
        g = group_of(self.poses)
        a, b = np.minimum(i, j), np.maximum(i, j)
        T = g.between(self.poses[i], self.poses[j])
        # the error of x_b seen from x_a, in world axes; then in the right tangent at j
        A = g.adjoint(g.inverse(self.poses[j]))
        P = A @ (self._sum[b] - self._sum[a]) @ np.swapaxes(A, 1, 2)
        return T, 0.5 * (P + np.swapaxes(P, 1, 2))


def chain_increments(submaps: Sequence[Submap], places: Places) -> tuple[Array, Array]:
    """Relative poses ``(n, 7|3)`` from each place to the next, the last to the end of the chain, and covariances."""
    T_all, Q_all = [], []
    for k, s in enumerate(submaps):
        at = places.of_submap(k)
        path = s.trajectory
        if path is None or path.covariances is None:
            raise DataError(f"the path of submap {s.key} has no covariances")
        g = group_of(s.exit_pose)
        T = np.concatenate([places.T_base_node[at], s.exit_pose[None]])
        P = np.concatenate([path.interpolate_covariance(places.time[at]), s.exit_covariance[None]])
        P[0] = 0.0
        steps = g.between(T[:-1], T[1:])
        A = g.adjoint(g.inverse(steps))
        Q = P[1:] - A @ P[:-1] @ np.swapaxes(A, 1, 2)
        least = 1e-3 * np.diag(s.exit_covariance) / len(steps)
        w, V = np.linalg.eigh(0.5 * (Q + np.swapaxes(Q, 1, 2)))
        Q = (V * np.maximum(w, 0.0)[:, None]) @ np.swapaxes(V, 1, 2) + np.diag(least)
        T_all.append(steps)
        Q_all.append(Q)
    return np.concatenate(T_all), np.concatenate(Q_all)
