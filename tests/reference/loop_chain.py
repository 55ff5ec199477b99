"""A drive round a square, one and a half times, as a chain of noisy increments, and loops between its two rounds."""

from __future__ import annotations

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.poses import group_of
from graphslam.loops.measure import Loop

STEP = {2: np.diag([0.03, 0.03, 0.004]) ** 2, 3: np.diag([0.001, 0.001, 0.004, 0.03, 0.03, 0.02]) ** 2}
MATCH = {2: np.diag([0.05, 0.05, 0.01]) ** 2, 3: np.diag([0.01, 0.01, 0.01, 0.05, 0.05, 0.05]) ** 2}


def square_poses(dim: int, side: int = 12, nodes: int = 72) -> Array:
    """True poses of nodes 1 m apart, in the frame of the first."""
    k = np.arange(nodes)
    leg, along = np.divmod(k, side)
    corner = np.array([[0, 0], [side, 0], [side, side], [0, side]])[leg % 4]
    turn = 0.5 * np.pi * (leg % 4)
    xy = corner + along[:, None] * np.stack([np.cos(turn), np.sin(turn)], 1)
    if dim == 2:
        return np.column_stack([xy, np.arctan2(np.sin(turn), np.cos(turn))])
    zero = np.zeros(nodes)
    return np.column_stack([xy, zero, zero, zero, np.sin(turn / 2), np.cos(turn / 2)])


def chain_of(poses: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Noisy increments ``(n - 1, 7|3)`` and their covariances."""
    g = group_of(poses)
    P = STEP[g.dim]
    noise = rng.standard_normal((len(poses) - 1, g.dof)) @ np.linalg.cholesky(P).T
    T = g.compose(g.between(poses[:-1], poses[1:]), g.exp(noise))
    return T, np.broadcast_to(P, (len(T), *P.shape)).copy()


def loop_of(poses: Array, i: int, j: int, rng: np.random.Generator, off: Array | None = None) -> Loop:
    """A loop from i to j with noise, and with an error ``off`` (tangent) besides."""
    g = group_of(poses)
    P = MATCH[g.dim]
    e = np.linalg.cholesky(P) @ rng.standard_normal(g.dof)
    T = g.compose(g.between(poses[i], poses[j]), g.exp(e))
    if off is not None:
        T = g.compose(T, g.exp(off))
    return Loop(i=i, j=j, T_ij=T, covariance=P, source="proximity", score=1.0, submaps=(0, 1))


def right_loops(poses: Array, rng: np.random.Generator, count: int = 6) -> list[Loop]:
    """Between the first round and the second."""
    starts = np.linspace(0, len(poses) - 49, count).astype(int)
    return [loop_of(poses, int(i), int(i) + 48, rng) for i in starts]
