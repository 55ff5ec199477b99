"""What a solved graph knows of pairs of its nodes: relative poses and their covariances from its joint marginals."""

from __future__ import annotations

import numpy as np

from graphslam.core.geometry import Array
from graphslam.graph.graph_record import GraphRecord
from graphslam.graph.relative import relative_poses
from graphslam.loops.places import Ints


class GraphRelative:
    """A :class:`~graphslam.loops.places.Relative` of a graph at its values, which must be its optimum.

    Parameters
    ----------
    graph : GraphRecord
    """

    def __init__(self, graph: GraphRecord) -> None:
        self.graph = graph

    def __call__(self, i: Ints, j: Ints) -> tuple[Array, Array]:
        nodes, at = np.unique(np.concatenate([i, j]), return_inverse=True)
        a, b = at[: len(i)], at[len(i) :]
        poses, d = self.graph.values.poses, self.graph.values.group.dof
        free = np.flatnonzero(nodes > 0)  # x0 is held
        P = self.graph.covariance().joint([f"x{n}" for n in nodes[free]]).reshape(len(free), d, len(free), d)
        S = np.zeros((len(nodes), d, len(nodes), d))
        S[free[:, None], :, free[None, :]] = np.swapaxes(P, 1, 2)
        return relative_poses(poses[i], poses[j], S[a, :, a], S[a, :, b], S[b, :, b])
