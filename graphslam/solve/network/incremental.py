"""Incremental solution of a pose network with iSAM2, pose by pose.

iSAM2 (Kaess et al. 2012) keeps old linearisation points and does not update variables with small steps. With GTSAM's
default thresholds it is fast and *near* the optimum, with an unknown gap. So its estimate is used as a start of the
descent, and the gap is measured from its end.
"""

from __future__ import annotations

import heapq
import logging
from collections.abc import Iterator

import numpy as np

from graphslam.core.errors import IndeterminateError, SolverError
from graphslam.core.geometry import Array, se2_transform
from graphslam.core.network import Ids, PoseNetwork
from graphslam.core.poses import group_of
from graphslam.core.position_priors import HELD
from graphslam.core.progress import Bar
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.between import BetweenRecord
from graphslam.graph.factors.observation import ObservationRecord
from graphslam.graph.factors.position import PositionRecord
from graphslam.graph.network import network_values
from graphslam.graph.noise import whiteners
from graphslam.graph.variables import Values
from graphslam.solve.isam2 import Isam2Solver
from graphslam.solve.network.start import cartesian_observations, chordal_start, neighbours

log = logging.getLogger(__name__)
# Default limit of updates: each then relinearises more variables and usually gets nearer to the optimum.
UPDATES = 500
# GTSAM's defaults: thresholds of positions [m] and of headings [rad], checked at every tenth update.
THRESHOLD, SKIP = 0.1, 10
# Other fixed vertices are connected to the first one with this standard deviation [m, rad].
HELD_SIGMA = 1e-6
# The first vertex of a part whose frame comes from position priors has this standard deviation [m, rad] until the end.
BEGIN_SIGMA = 1.0


def insertion_order(network: PoseNetwork) -> Iterator[tuple[int, list[int]]]:
    """Vertices in id order as far as possible, each with its edges to previous vertices.

    A vertex is added when it is connected to previous ones, the lowest id first. A chain of odometry therefore keeps
    its order. Position priors connect nothing: a part without a fixed vertex begins at the lowest one with a prior.
    """
    first, edge, other = neighbours(network)
    inside = np.zeros(len(network), dtype=bool)
    queued = np.zeros(len(network), dtype=bool)
    heap = [int(a) for a in network.anchors]
    heapq.heapify(heap)
    queued[network.anchors] = True
    relative = network.relative
    begins = iter(np.unique(network.edges[~relative, 1]).tolist())
    while True:
        while not heap and (begin := next(begins, None)) is not None:
            if not queued[begin]:
                heap, queued[begin] = [begin], True
        if not heap:
            return
        v = heapq.heappop(heap)
        inside[v] = True
        span = slice(first[v], first[v + 1])
        yield v, [int(e) for e, w in zip(edge[span], other[span], strict=True) if inside[w]]
        for e, w in zip(edge[span], other[span], strict=True):
            if relative[e] and not queued[w]:
                queued[w] = True
                heapq.heappush(heap, int(w))


def grow_with_isam2(network: PoseNetwork, *, batch: int = 0, progress: bool = False) -> Values:
    """Estimate of iSAM2 after adding the whole network in :func:`insertion_order`.

    With Cholesky factorisation; repeated with QR if that fails (large or badly scaled information).

    Parameters
    ----------
    batch : int
        Poses per update; 0: total over :data:`UPDATES`.
    """
    batch = batch or -(-len(network) // UPDATES)
    try:
        return _grow(network, "CHOLESKY", batch, progress)
    except (SolverError, IndeterminateError) as error:
        log.info("%s: iSAM2 with Cholesky failed (%s), starting again with QR", network.source, error)
    try:
        return _grow(network, "QR", batch, progress)
    except (SolverError, IndeterminateError) as error:
        raise IndeterminateError(f"{network.source}: iSAM2 failed on the way: {error}") from None


def _grow(network: PoseNetwork, factorization: str, batch: int, progress: bool) -> Values:
    """Grow the graph; its nodes are the vertices in insertion order, its landmarks rows."""
    steps = list(insertion_order(network))
    vertices = np.array([v for v, _ in steps])
    node = np.empty(len(network), dtype=np.int64)
    node[vertices] = np.arange(len(vertices))
    held = {int(a): network.poses[a] for a in network.anchors}
    origin = network.poses[vertices[0]]
    graph = FactorGraph.with_values(Values(network.dim, {"x": origin[None].copy()}))
    solver = Isam2Solver(graph, relinearize_threshold=THRESHOLD, relinearize_angle=THRESHOLD, relinearize_skip=SKIP)
    solver.factorization = factorization
    group, W, W_seen = group_of(origin), whiteners(network.information), whiteners(network.observation_information)
    z, ends, polar = network.measurements, node[network.edges], network.observation_kind == "bearing-range"
    z_back = group.inverse(z)
    local, _ = cartesian_observations(network)
    relative, aligned = network.relative, None
    begun: list[int] = []
    seen_from: list[list[int]] = [[] for _ in range(len(network))]
    for k, (v, _) in enumerate(network.observations.tolist()):
        seen_from[v].append(k)
    for e in np.flatnonzero(~relative & ~network.position_priors):
        # directions of a frame, which cost nothing at any weight; GTSAM needs information in every one
        W[e] = whiteners(network.information[e : e + 1] / HELD + 1e-6 * np.eye(group.dof))[0]
    for count, (v, links) in enumerate(Bar(steps, name="iSAM2", unit="pose", shown=progress)):
        if count:
            near = [e for e in links if relative[e]]
            if v in held or near:
                pose = held[v] if v in held else _from_neighbour(graph, network, v, near, node, z, z_back)
            else:
                aligned = chordal_start(network)[0] if aligned is None else aligned
                pose = aligned[v]
            graph.append_node(pose)
            if v not in held and not near:
                # its orientation, until there are enough positions for the frame
                begun.append(graph.next_factor())
                graph.insert(
                    BetweenRecord(begun[-1], 0, count, group.between(origin, pose), np.eye(group.dof) / BEGIN_SIGMA)
                )
            if v in held:
                offset = group.between(origin, pose)
                graph.insert(BetweenRecord(graph.next_factor(), 0, count, offset, np.eye(group.dof) / HELD_SIGMA))
        for e in links:
            i, j = ends[e].tolist()
            if network.position_priors[e]:
                root = whiteners(network.information[e : e + 1, group.position, group.position])[0]
                graph.insert(PositionRecord(graph.next_factor(), j, z[e, : group.dim], root))
            else:
                graph.insert(BetweenRecord(graph.next_factor(), i, j, z[e], W[e]))
        for k in seen_from[v]:
            mark = network.observations[k, 1:]
            graph.start_landmarks(mark, se2_transform(graph.structure.poses[count], local[k])[None])
            record = ObservationRecord(
                graph.next_factor(), count, int(mark[0]), network.observation_values[k], polar, W_seen[k]
            )
            graph.insert(record)
        if (count + 1) % batch == 0 or count + 1 == len(steps):
            solver.update()
    for factor in begun:
        graph.remove(factor)
    if begun:
        solver.update()
    found = graph.values
    poses, marks = network.poses.copy(), network.landmarks.copy()
    poses[vertices] = found.poses
    if len(marks):
        marks[found.landmark_ids] = found.landmarks
    poses[network.anchors] = network.poses[network.anchors]
    return network_values(network, poses, marks)


def _from_neighbour(
    graph: FactorGraph, network: PoseNetwork, v: int, links: list[int], node: Ids, z: Array, z_back: Array
) -> Array:
    """A new pose from the neighbour with the nearest id and the measurement between them."""
    e = links[int(np.argmin(np.abs(network.edges[links].sum(axis=1) - 2 * v)))]
    i, j = network.edges[e].tolist()
    known = graph.pose(int(node[i if j == v else j]))
    return np.asarray(group_of(known).compose(known, z[e] if j == v else z_back[e]))
