"""What a chain of submaps says of two of its places as long as there is no graph."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.poses import compose_increments, group_of
from graphslam.core.submap import Submap
from graphslam.loops.places import Ints, Places


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
