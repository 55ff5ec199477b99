"""A drive through a city of square blocks, with loops where it comes by again: pose networks of any size."""

from __future__ import annotations

import numpy as np

from graphslam.core.geometry import Array, rotation2, se2_between, se2_compose, wrap_angle
from graphslam.core.network import PoseNetwork
from graphslam.core.se3 import matrix_to_quat, se3_between, se3_compose, se3_exp


def drive(n: int, rng: np.random.Generator, *, side: int, block: int = 5) -> Array:
    """True poses ``(n, 3)``: a metre a step along the streets of a square city, a turn at some crossings."""
    turns = rng.choice([-1, 0, 0, 1], size=n)
    x, y, heading = 0, 0, 0
    poses = np.empty((n, 3))
    steps = ((1, 0), (0, 1), (-1, 0), (0, -1))
    for k in range(n):
        poses[k] = x, y, heading * np.pi / 2.0
        if x % block == 0 and y % block == 0:
            heading = (heading + int(turns[k])) % 4
            while not (0 <= x + steps[heading][0] <= side and 0 <= y + steps[heading][1] <= side):
                heading = (heading + 1) % 4
        x, y = x + steps[heading][0], y + steps[heading][1]
    poses[:, 2] = wrap_angle(poses[:, 2])
    return poses


def loops_of(poses: Array, rng: np.random.Generator, *, share: float, apart: int = 50) -> np.ndarray:
    """Pairs (later, earlier) ``(m, 2)``: a pose and the last visit of its place, at a share of all returns."""
    place = np.unique(np.round(poses[:, :2]), axis=0, return_inverse=True)[1]
    order = np.lexsort((np.arange(len(poses)), place))
    same = place[order[1:]] == place[order[:-1]]
    pairs = np.stack([order[1:], order[:-1]], axis=1)[same]
    pairs = pairs[pairs[:, 0] - pairs[:, 1] >= apart]
    return pairs[rng.random(len(pairs)) < share]


def grid_world(
    n: int, rng: np.random.Generator, *, dim: int = 2, share: float = 0.3, sigma: tuple[float, float] = (0.05, 0.01)
) -> PoseNetwork:
    """A pose network of ``n`` poses, white noise of ``sigma`` (m, rad) a step, its odometry as initial values."""
    truth = drive(n, rng, side=5 * max(4, round(np.sqrt(n) / 12.0)))
    k = np.arange(n - 1)
    edges = np.concatenate([np.stack([k, k + 1], axis=1), loops_of(truth, rng, share=share)[:, ::-1]])
    i, j = edges.T
    if dim == 2:
        spread = np.array([sigma[0], sigma[0], sigma[1]])
        z = se2_compose(se2_between(truth[i], truth[j]), rng.normal(size=(len(i), 3)) * spread)
        poses, compose = np.zeros((n, 3)), se2_compose
    else:
        R = np.zeros((n, 3, 3))
        R[:, :2, :2], R[:, 2, 2] = rotation2(truth[:, 2]), 1.0
        T = np.concatenate([truth[:, :2], np.zeros((n, 1)), matrix_to_quat(R)], axis=1)
        spread = np.array([sigma[1]] * 3 + [sigma[0]] * 3)
        z = se3_compose(se3_between(T[i], T[j]), se3_exp(rng.normal(size=(len(i), 6)) * spread))
        poses, compose = np.tile([0.0] * 6 + [1.0], (n, 1)), se3_compose
    # dead reckoning by doubling: after round r every pose is composed with the 2^r before it
    total, width = np.concatenate([poses[:1], z[: n - 1]]), 1
    while width < n:
        total[width:] = compose(total[:-width].copy(), total[width:])
        width *= 2
    information = np.broadcast_to(np.diag(spread**-2.0), (len(i), len(spread), len(spread)))
    return PoseNetwork(dim, np.arange(n), total, np.ones(n, bool), edges, z, information, source="grid world")
