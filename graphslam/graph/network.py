"""Conversion between pose networks (file contents) and graphs or least-squares problems."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from graphslam.core.errors import SolverError
from graphslam.core.geometry import Array, vector_to_tangent_covariance
from graphslam.core.network import Mask, PoseNetwork
from graphslam.core.poses import group_of
from graphslam.graph.factor_arrays import FactorArrays
from graphslam.graph.factors.batch import FactorBatch
from graphslam.graph.factors.between import BetweenBatch, BetweenRecord
from graphslam.graph.factors.landmark_submap import SubmapRecord
from graphslam.graph.factors.observation import ObservationBatch
from graphslam.graph.factors.position import PositionBatch
from graphslam.graph.factors.space_submap import SpaceSubmapRecord
from graphslam.graph.noise import whiteners
from graphslam.graph.variables import KINDS, Values, VariableLayout
from graphslam.linear.symmetric_factor import elimination_order

if TYPE_CHECKING:
    from graphslam.graph.factor_graph import FactorGraph


def network_values(network: PoseNetwork, poses: Array, landmarks: Array | None = None) -> Values:
    """Values of the variables of a network's problem; the landmarks are the network's own if not given."""
    marks = network.landmarks if landmarks is None else landmarks
    return Values(network.dim, {"x": poses, "l": marks}, network.landmark_ids)


def problem_of_network(network: PoseNetwork, used: Mask | None = None, *, ordered: bool = True) -> FactorArrays:
    """The measurements of a network as a least-squares problem, stored as arrays.

    Factors are numbered through the edges, with position priors last, then the observations. Fixed vertices (or the
    first one) are held.

    Parameters
    ----------
    used : (m + k,) bool, optional
        Edges and observations to use; default: all.
    ordered : bool
        Columns in a minimum-degree elimination order, faster than ordering the scalars; otherwise in their own order.
    """
    n, l, m = len(network), len(network.landmark_ids), len(network.edges)
    e = slice(None) if used is None else np.flatnonzero(used[:m])
    o = slice(None) if used is None else np.flatnonzero(used[m:])
    edges, seen = network.edges[e], network.observations[o]
    z, information, relative = network.measurements[e], network.information[e], ~network.position_priors[e]
    counts = tuple({"x": n, "l": l}.get(word, 0) for word in KINDS)
    fixed = tuple(network.anchors.tolist())
    order = None
    if ordered:
        at = np.full(n + l, -1)
        free = np.setdiff1d(np.arange(n + l), network.anchors)
        at[free] = np.arange(len(free))
        i, j = at[np.concatenate([edges, seen + [0, n]])].T
        free_pair = (i >= 0) & (j >= 0)
        order = free[elimination_order(i[free_pair], j[free_pair], len(free))] if len(free) else free
    layout = VariableLayout(network.dim, counts, network.landmark_ids, fixed, order)
    batches: list[FactorBatch] = [
        BetweenBatch.of_arrays(edges[relative], z[relative], whiteners(information[relative]), layout)
    ]
    if not relative.all():
        d, block = network.dim, group_of(network.poses).position
        W = whiteners(information[~relative, block, block])
        batches.append(PositionBatch.of_arrays(edges[~relative, 1], z[~relative, :d], W, layout))
    if len(seen):
        polar = network.observation_kind == "bearing-range"
        W = whiteners(network.observation_information[o])
        batches.append(ObservationBatch.of_arrays(seen, network.observation_values[o], polar, W, layout))
    return FactorArrays((), layout, batches)


def network_of(flat: FactorArrays, values: Values) -> PoseNetwork:
    """A problem of relative poses as a network, for methods that accept nothing else (chordal start, certificate)."""
    others = sorted({name for f in flat.batches if not isinstance(f, BetweenBatch) for name, _ in f.classes()})
    if others or flat.has_kernels:
        what = f"factors of other kinds ({', '.join(others)})" if others else "robust kernels"
        raise SolverError(f"only relative poses are part of the relaxation, and the graph holds {what}")
    edges = [f for f in flat.batches if isinstance(f, BetweenBatch)]
    size, d = values.group.size, values.group.dof
    W = np.concatenate([np.zeros((0, d, d)), *(f.whiteners for f in edges)])
    return PoseNetwork(
        dim=flat.layout.dim,
        ids=np.arange(flat.layout.nodes),
        poses=values.poses,
        has_initial=np.ones(flat.layout.nodes, dtype=bool),
        edges=np.concatenate([np.zeros((0, 2), dtype=np.intp), *(f.ends for f in edges)]),
        measurements=np.concatenate([np.zeros((0, size)), *(f.measured for f in edges)]),
        information=np.swapaxes(W, 1, 2) @ W,
        fixed=np.isin(np.arange(flat.layout.nodes), flat.layout.fixed),
        source="graph",
    )


def to_network(graph: FactorGraph) -> PoseNetwork:
    """Nodes, landmarks, and all measurements that a network can have.

    A landmark submap becomes one edge between its nodes and one observation per entry, each with its own marginal
    information. The file format has no correlations between them, so its optimum is near the graph's but not the same.
    GPS factors, attitudes, robust kernels and 3-D landmarks are omitted.

    Returns
    -------
    PoseNetwork
        Nodes are vertices 0 … m, with vertex 0 fixed; landmark i of the graph is vertex ``m + 1 + row``, because a
        file has one numbering for all vertices.
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
            L = np.linalg.inv(r.own[1])
            P = L @ L.T
            edges.append((r.start, r.start + 1))
            measured.append(r.z[:3])
            information.append(np.asarray(np.linalg.inv(vector_to_tangent_covariance(r.z[:3], P[:3, :3]))))
            for e, i in enumerate(r.landmark_ids.tolist()):
                c = slice(3 + 2 * e, 5 + 2 * e)
                seen.append((r.start, row_of[i]))
                where.append(r.z[c])
                seen_information.append(np.asarray(np.linalg.inv(P[c, c])))
        elif isinstance(r, SpaceSubmapRecord):
            edges.append((r.start, r.start + 1))
            measured.append(r.map.poses[0])
            information.append(np.asarray(np.linalg.inv(r.exit_covariance())))
    n = len(v.poses)
    marks = np.zeros((0, 2)) if graph.dim == 3 else v.landmarks.reshape(-1, 2)
    return PoseNetwork(
        dim=graph.dim,
        ids=np.arange(n),
        poses=v.poses,
        has_initial=np.ones(n, dtype=bool),
        edges=np.array(edges, dtype=np.intp).reshape(-1, 2),
        measurements=np.array(measured).reshape(-1, v.group.size),
        information=np.array(information).reshape(-1, d, d),
        fixed=np.arange(n) == 0,
        landmark_ids=n + np.arange(len(marks)),
        landmarks=marks,
        has_landmark=np.ones(len(marks), dtype=bool),
        observations=np.array(seen, dtype=np.intp).reshape(-1, 2),
        observation_values=np.array(where).reshape(-1, 2),
        observation_information=np.array(seen_information).reshape(-1, 2, 2),
        source="pose graph",
    )
