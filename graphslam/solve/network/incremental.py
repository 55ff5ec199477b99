"""A pose network fed to iSAM2 pose by pose, as a robot would have built it.

iSAM2 (Kaess et al. 2012) keeps old linearisation points and stops solving where steps are small. With its default
thresholds it is fast and *near* the optimum; how near is not something it knows. So its estimate is a start of the
descent, whose end the gap is measured against.
"""

from __future__ import annotations

import heapq
import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from graphslam.core.errors import IndeterminateError
from graphslam.core.geometry import Array, se2_transform
from graphslam.core.network import PoseNetwork
from graphslam.core.poses import group_of
from graphslam.core.progress import Bar
from graphslam.graph.factors.batch import gtsam_pose, pose_array
from graphslam.graph.network import problem_of_network
from graphslam.graph.variables import gtsam_key
from graphslam.solve.network.factors import (
    anchor_factors,
    measured_factors,
    translate_indeterminate,
)
from graphslam.solve.network.start import cartesian_observations, neighbours

log = logging.getLogger(__name__)
X, L = gtsam_key("x0"), gtsam_key("l0")


@dataclass(frozen=True, slots=True)
class Isam2Options:
    """How iSAM2 is run.

    Parameters
    ----------
    relinearize_threshold : float
        A variable is relinearised when its step exceeds this (GTSAM's default 0.1).
    relinearize_skip : int
        Only every so many updates (GTSAM's default 10).
    batch : int
        Poses an update. 1 is a robot's life; more is faster and, as each update then relinearises more at once,
        usually nearer to the optimum. 0 chooses about five hundred updates.
    factorization : {"CHOLESKY", "QR"}
    """

    relinearize_threshold: float = 0.1
    relinearize_skip: int = 10
    batch: int = 0
    factorization: str = "CHOLESKY"

    def params(self) -> gtsam.ISAM2Params:
        """GTSAM's parameter object."""
        p = gtsam.ISAM2Params()
        p.setRelinearizeThreshold(self.relinearize_threshold)
        p.relinearizeSkip = self.relinearize_skip
        p.setFactorization(self.factorization)
        return p


def insertion_order(network: PoseNetwork) -> Iterator[tuple[int, list[int]]]:
    """Vertices in id order as far as the network allows, each with the edges to vertices already in.

    A vertex enters when it is connected to what is there; among those that are, the lowest id first. A chain of
    odometry therefore comes in its own order.
    """
    first, edge, other = neighbours(network)
    inside = np.zeros(len(network), dtype=bool)
    queued = np.zeros(len(network), dtype=bool)
    heap = [int(a) for a in network.anchors]
    heapq.heapify(heap)
    queued[network.anchors] = True
    while heap:
        v = heapq.heappop(heap)
        inside[v] = True
        span = slice(first[v], first[v + 1])
        yield v, [int(e) for e, w in zip(edge[span], other[span], strict=True) if inside[w]]
        for w in other[span]:
            if not queued[w]:
                queued[w] = True
                heapq.heappush(heap, int(w))


def run_isam2(network: PoseNetwork, options: Isam2Options | None = None, *, progress: bool = False) -> gtsam.Values:
    """:func:`feed_isam2`, with QR where Cholesky fails on the way (large or badly scaled information)."""
    options = options or Isam2Options()
    try:
        return feed_isam2(network, options, progress=progress)
    except IndeterminateError:
        if options.factorization == "QR":
            raise
        log.info("%s: iSAM2 with Cholesky failed, starting again with QR", network.source)
        return feed_isam2(network, replace(options, factorization="QR"), progress=progress)


def feed_isam2(network: PoseNetwork, options: Isam2Options | None = None, *, progress: bool = False) -> gtsam.Values:
    """Estimate of iSAM2 after the whole network has been fed to it in :func:`insertion_order`.

    A new pose starts from the current estimate of the neighbour with the nearest id, composed with the measurement;
    a new landmark from the pose that first sees it.
    """
    options = options or Isam2Options()
    isam = gtsam.ISAM2(options.params())
    edges, sightings = measured_factors(problem_of_network(network, ordered=False))
    seen_from: list[list[int]] = [[] for _ in range(len(network))]
    for k, (v, _) in enumerate(network.observations.tolist()):
        seen_from[v].append(k)
    local, _ = cartesian_observations(network)
    z, z_inv = network.measurements, group_of(network.poses).inverse(network.measurements)
    poses: dict[int, Array] = {}  # where each inserted vertex was thought to be when it was last looked up
    anchors = dict(zip(network.anchors.tolist(), anchor_factors(network), strict=True))
    known_marks: set[int] = set()
    graph, values, fresh = gtsam.NonlinearFactorGraph(), gtsam.Values(), set[int]()
    steps = list(insertion_order(network))
    batch = options.batch or max(1, round(len(network) / 500))
    for count, (v, links) in enumerate(Bar(steps, name="iSAM2", unit="pose", shown=progress), 1):
        if v in anchors:
            poses[v] = network.poses[v]
            graph.push_back(anchors[v])
        else:
            poses[v] = _from_neighbour(network, v, links, poses, fresh, isam, z, z_inv)
        values.insert(X + v, gtsam_pose(poses[v]))
        fresh.add(v)
        for e in links:
            graph.push_back(edges[e])
        for k in seen_from[v]:
            graph.push_back(sightings[k])
            mark = int(network.observations[k, 1])
            if mark not in known_marks:
                known_marks.add(mark)
                values.insert(L + int(network.landmark_ids[mark]), se2_transform(poses[v], local[k]))
        if count % batch == 0 or count == len(steps):
            try:
                isam.update(graph, values)
            except RuntimeError as error:
                raise translate_indeterminate(network, error) from None
            graph, values, fresh = gtsam.NonlinearFactorGraph(), gtsam.Values(), set()
    return isam.calculateEstimate()


def _from_neighbour(
    network: PoseNetwork,
    v: int,
    links: list[int],
    poses: dict[int, Array],
    fresh: set[int],
    isam: gtsam.ISAM2,
    z: Array,
    z_inv: Array,
) -> Array:
    ends = network.edges[links]
    others = np.where(ends[:, 0] == v, ends[:, 1], ends[:, 0])
    best = int(np.argmin(np.abs(others - v)))
    near, edge = int(others[best]), links[best]
    if near not in fresh:
        poses[near] = _current(network, isam, near)
    return np.asarray(group_of(z).compose(poses[near], z[edge] if ends[best, 1] == v else z_inv[edge]))


def _current(network: PoseNetwork, isam: gtsam.ISAM2, k: int) -> Array:
    estimate = isam.calculateEstimatePose2 if network.dim == 2 else isam.calculateEstimatePose3
    return pose_array(estimate(X + k))
