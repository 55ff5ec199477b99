"""Paths of map samples, concatenated from their segments (A6)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.trajectory import Trajectory
from graphslam_frontends.segslam.sampling import OPEN, MapSample
from graphslam_frontends.segslam.segmap import SegMap

Ints = npt.NDArray[np.int64]


def concatenate_segments(segmap: SegMap, sample: MapSample, open_path: Array | None = None) -> Trajectory:
    """The path of a sample in the frame of its root (A6, eq. 11–12).

    A boundary belongs to two segments; its pose is the end pose of the first. Where two branches of the sample meet,
    the path has a jump by the loop closure error.

    Parameters
    ----------
    open_path : (n, 7) or (n, 3), optional
        ``T_segment_body`` of an open root, from its start to the current step; without it the path ends where the open
        segment begins.
    """
    g = segmap.group
    steps: list[Ints] = []
    poses: list[Array] = []
    last = -1
    for k in sample.in_time.tolist():
        i, (a, b) = int(sample.segments[k]), sample.intervals[k]
        path = open_path if i == OPEN else segmap.table.paths[i]
        if path is None:
            continue
        rows = np.asarray(path, dtype=np.float64)
        if i == OPEN and len(rows) != b - a + 1:
            raise DataError("the path of the open segment has the wrong length", got=len(rows), wanted=int(b - a + 1))
        new = np.arange(a, b + 1)
        skip = 1 if a == last else 0
        steps.append(new[skip:].astype(np.int64))
        poses.append(g.compose(np.broadcast_to(sample.poses[k], rows.shape), rows)[skip:])
        last = int(b)
    if not steps:
        raise DataError("a sample without any path", wanted="a closed segment, or the path of the open one")
    s = np.concatenate(steps)
    return Trajectory(segmap.times[s], np.concatenate(poses))
