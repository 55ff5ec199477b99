"""Landmark submaps in space through GTSAM's iSAM2, one update a submap."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.poses import SE3
from graphslam.core.progress import Bar
from graphslam.core.se3 import se3_compose, se3_transform
from graphslam.graph.factors.space_map import gtsam_pose3, pose_of_gtsam, space_factor
from graphslam.linear.space_maps import PlacedMap


def run_space_isam2(
    placed: Sequence[PlacedMap], poses: Array, points: Array, *, progress: bool = False
) -> tuple[Array, Array, int]:
    """Values of iSAM2 after the last submap, and the number of its updates.

    Parameters
    ----------
    placed : sequence of PlacedMap
        Submap k speaks of pose k, seen from pose k - 1.
    poses, points : (m, 7), (n, 3)
        Give the shapes; a new variable begins where its submap puts it from where iSAM2 has its base.

    Returns
    -------
    (m, 7), (n, 3), int
    """
    solver = gtsam.ISAM2(gtsam.ISAM2Params())
    here: gtsam.Values = gtsam.Values()
    known: set[int] = set()
    updates = 0
    for k, one in enumerate(Bar(placed, name="iSAM2", unit="submap", shown=progress)):
        graph, new = gtsam.NonlinearFactorGraph(), gtsam.Values()
        graph.push_back(space_factor(one))
        base = SE3.identity if k == 0 else pose_of_gtsam(here.atPose3(gtsam.symbol("x", k)))
        new.insert(gtsam.symbol("x", k + 1), gtsam_pose3(se3_compose(base, one.map.poses[0])))
        for j, point in zip(one.points.tolist(), se3_transform(base, one.map.points)):
            if j not in known:
                known.add(j)
                new.insert(gtsam.symbol("l", j), np.asarray(point))
        solver.update(graph, new)
        updates += 1
        here = solver.calculateEstimate()
    at = [gtsam.symbol("x", k + 1) for k in range(len(poses))]
    marks = [gtsam.symbol("l", j) for j in range(len(points))]
    ends = np.array([pose_of_gtsam(here.atPose3(k)) for k in at]).reshape(-1, 7)
    return ends, np.array([here.atPoint3(k) for k in marks]).reshape(-1, 3), updates
