"""A robot that drives the same ring again and again, in space up a ramp: chains of poses with loops, simulated here.

Independent of the code under test: poses are composed with matrices, and noise is drawn in the right tangent.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.poses import SE2, SE3, compose_increments
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.ledger import EvidenceUse
from graphslam.join.graph_problem import JoinProblem


def pose_ramp(
    seed: int | np.random.Generator,
    *,
    dim: int = 3,
    submaps: int = 8,
    steps: int = 6,
    around: int = 16,
    loops: int = 30,
    metres: float = 0.05,
    radians: float = 0.01,
    level_sigma: float | None = None,
) -> tuple[JoinProblem, Array]:
    """A problem and its true poses ``(n, 3|7)`` in the frame of the first.

    Parameters
    ----------
    around : int
        Steps of one round; loops tie nodes of different rounds that lie above each other.
    metres, radians : float
        Standard deviations of a step; of a loop twice as much.
    level_sigma : float, optional
        In space: every base sees gravity with this [rad].
    """
    rng = np.random.default_rng(seed)
    g = SE2 if dim == 2 else SE3
    d, n = g.dof, submaps * steps + 1
    where, turn = g.position, 2 * np.pi / around
    step = np.zeros(d)
    step[where.start] = 1.0
    step[g.heading] = turn
    if dim == 3:
        step[5] = 0.06
    truth = [g.identity]
    for _ in range(n - 1):
        truth.append(g.compose(truth[-1], g.exp(step)))
    poses = np.stack(truth)
    sigma = np.full(d, radians)
    sigma[where] = metres
    ends = [(k, k + 1) for k in range(n - 1)]
    far = [(i, j) for i in range(n) for j in range(i + around - 1, n, around) if j - i > around // 2]
    picked = rng.permutation(len(far))[:loops]
    ends += [far[k] if rng.random() < 0.5 else far[k][::-1] for k in picked]
    size = np.where(np.arange(len(ends))[:, None] < n - 1, sigma, 2 * sigma)
    level_nodes = np.zeros(0, dtype=np.int64)
    directions = np.zeros((0, 3))
    if level_sigma is not None:
        level_nodes = np.arange(0, n, steps)
        down = g.between(poses[level_nodes], np.broadcast_to(g.identity, (len(level_nodes), 7)))
        tilted = g.compose(down, g.exp(np.zeros((len(level_nodes), 6))))
        noise = level_sigma * rng.normal(size=(len(level_nodes), 2))
        z = np.stack([noise[:, 1], -noise[:, 0], -np.ones(len(noise))], axis=1)  # down, tilted by the noise
        z /= np.linalg.norm(z, axis=1, keepdims=True)
        from graphslam.core.se3 import quat_rotate

        directions = quat_rotate(tilted[:, 3:], z)
    i, j = np.array(ends).T
    measured = g.compose(g.between(poses[i], poses[j]), g.exp(size * rng.normal(size=size.shape)))
    step_ij = measured[: n - 1]
    graph = FactorGraph(dim)
    start = compose_increments(step_ij)
    graph.add_betweens(
        np.array(ends), measured, np.array([np.diag(s**2) for s in size]), poses=start[1:],
        evidence=EvidenceUse(["ramp"], (0.0, float(n))),
    )  # fmt: skip
    for node, direction in zip(level_nodes.tolist(), directions):
        graph.add_attitude(node, direction, float(level_sigma or 1.0), evidence="levelled", group="levelled")
    bases = np.arange(0, n, steps)
    chains = np.concatenate([compose_increments(step_ij[a:b]) for a, b in pairwise(bases.tolist())])
    return JoinProblem(graph, np.arange(submaps), bases, np.arange(n, dtype=float), chains), poses
