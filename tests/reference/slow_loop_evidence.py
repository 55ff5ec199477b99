"""χ² of loops and of groups against everything else, the slow way: dense least squares, solved twice.

Nothing is shared with :mod:`graphslam.solve.network.leave_one_out` but the linearised arrays of the network.
"""

from __future__ import annotations

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.network import PoseNetwork
from tests.reference.plain_network import Layout, compose, edge_residuals, exp, linearise, square_root


def least(J: Array, r: Array) -> float:
    """``min_δ ‖J δ + r‖²``."""
    step = np.linalg.lstsq(J, -r, rcond=None)[0]
    return float(np.sum((J @ step + r) ** 2))


def fall_without(network: PoseNetwork, inliers: np.ndarray, row: int, poses: Array) -> float:
    """What the linearised objective of the inliers rises by because of edge ``row``, which may be among them."""
    J, r = _rows(network, poses)
    used = np.flatnonzero(inliers | (np.arange(len(inliers)) == row))
    other = used[used != row]
    return least(*_take(network, J, r, used)) - least(*_take(network, J, r, other))


def fall_if_moved(network: PoseNetwork, inliers: np.ndarray, group: np.ndarray, poses: Array) -> float:
    """What it rises by because the later ends of a group of edges may not move together, by numerical derivative."""
    J, r = _rows(network, poses)
    d = network.tangent_dim
    used = np.flatnonzero(inliers | np.isin(np.arange(len(inliers)), group))
    G = np.zeros((len(r), d))
    R = square_root(network.information)
    for k in group:
        late = int(network.edges[k].max())
        for axis in range(d):
            moved = []
            for sign in (1e-6, -1e-6):
                x = poses.copy()
                xi = np.zeros(d)
                xi[axis] = sign
                x[late] = compose(exp(xi), x[late])  # a motion of the world, the same for all
                moved.append(R[k] @ edge_residuals(network, x)[k])
            G[k * d : (k + 1) * d, axis] = (moved[0] - moved[1]) / 2e-6
    rows = (used[:, None] * d + np.arange(d)).ravel()
    return least(J[rows], r[rows]) - least(np.hstack([J, G])[rows], r[rows])


def _rows(network: PoseNetwork, poses: Array) -> tuple[Array, Array]:
    J, r = linearise(network, poses, np.zeros((0, 2)), Layout.of(network))
    return J.toarray(), r


def _take(network: PoseNetwork, J: Array, r: Array, edges: np.ndarray) -> tuple[Array, Array]:
    rows = (edges[:, None] * network.tangent_dim + np.arange(network.tangent_dim)).ravel()
    return J[rows], r[rows]
