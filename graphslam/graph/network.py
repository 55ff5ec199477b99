"""A graph as a plain pose network, for g2o files and for tools that know no submaps."""

from __future__ import annotations

import numpy as np

from graphslam.core.geometry import Array, vector_to_tangent_covariance
from graphslam.core.network import PoseNetwork
from graphslam.graph.factors.between import BetweenRecord
from graphslam.graph.factors.landmark_submap import SubmapRecord
from graphslam.graph.pose_graph import PoseGraph


def to_network(graph: PoseGraph) -> PoseNetwork:
    """Nodes, landmarks, and everything that a network can hold.

    A landmark submap becomes one edge between its nodes and one observation per entry, each with its own marginal
    information: the correlations between them have no place in such a file, so its optimum is near the graph's but
    not the same. GPS factors, attitudes and robust kernels have no place either.

    Returns
    -------
    PoseNetwork
        Nodes are vertices 0 … m, with vertex 0 fixed; landmark i of the graph is vertex ``m + 1 + row``, because a
        file knows one space of vertex numbers only.
    """
    v = graph.values
    d = v.group.dof
    row_of = graph.flat().layout.row_of
    edges: list[tuple[int, int]] = []
    measured: list[Array] = []
    information: list[Array] = []
    seen: list[tuple[int, int]] = []
    where: list[Array] = []
    seen_information: list[Array] = []
    for r in graph.records.values():
        if isinstance(r, BetweenRecord):
            edges.append((r.i, r.j))
            measured.append(r.T_ij)
            information.append(r.whitener.T @ r.whitener)
        elif isinstance(r, SubmapRecord):
            L = np.linalg.inv(r.whitener)
            P = L @ L.T
            edges.append((r.start, r.start + 1))
            measured.append(r.z[:3])
            information.append(np.asarray(np.linalg.inv(vector_to_tangent_covariance(r.z[:3], P[:3, :3]))))
            for e, i in enumerate(r.landmark_ids.tolist()):
                c = slice(3 + 2 * e, 5 + 2 * e)
                seen.append((r.start, row_of[i]))
                where.append(r.z[c])
                seen_information.append(np.asarray(np.linalg.inv(P[c, c])))
    n = len(v.poses)
    return PoseNetwork(
        dim=graph.dim,
        ids=np.arange(n),
        poses=v.poses,
        has_initial=np.ones(n, dtype=bool),
        edges=np.array(edges, dtype=np.intp).reshape(-1, 2),
        measurements=np.array(measured).reshape(-1, v.group.size),
        information=np.array(information).reshape(-1, d, d),
        fixed=np.arange(n) == 0,
        landmark_ids=n + np.arange(len(v.landmarks)),
        landmarks=v.landmarks.reshape(-1, 2),
        has_landmark=np.ones(len(v.landmarks), dtype=bool),
        observations=np.array(seen, dtype=np.intp).reshape(-1, 2),
        observation_values=np.array(where).reshape(-1, 2),
        observation_information=np.array(seen_information).reshape(-1, 2, 2),
        source="pose graph",
    )
