"""Values of a graph as GTSAM's."""

from __future__ import annotations

from itertools import starmap
from typing import Any

import gtsam
import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.se3 import quat_normalize, quat_to_matrix
from graphslam.graph.gtsam_values import insert_values
from graphslam.graph.variables import Values, gtsam_key


def gtsam_poses(poses: Array) -> list[Any]:
    """:func:`gtsam_pose` of many ``(n, 3|7)``."""
    if poses.shape[1] == 3:
        return list(starmap(gtsam.Pose2, poses.tolist()))
    T = np.zeros((len(poses), 4, 4))
    T[:, :3, :3], T[:, :3, 3], T[:, 3, 3] = quat_to_matrix(quat_normalize(poses[:, 3:])), poses[:, :3], 1.0
    return list(map(gtsam.Pose3, T))


def to_gtsam(values: Values, *, held: bool = False) -> gtsam.Values:
    """All free variables as GTSAM values; with ``held`` the first pose, too."""
    out, layout = gtsam.Values(), values.layout()
    first, begin = gtsam_key("x0"), 0 if held else 1
    for k, pose in enumerate(gtsam_poses(values.poses[begin:]), begin):
        out.insert(first + k, pose)
    insert_values(out, (n for n in layout.names() if n[0] != "x"), values, layout.row_of)
    return out
