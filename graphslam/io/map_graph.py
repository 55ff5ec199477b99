"""A solved submap graph as a g2o file that other tools can open.

g2o knows no joint measurement of a pose and many landmarks, so each submap becomes its marginals: one SE(2) edge along
the chain and one Cartesian observation per landmark. The correlations between them are lost, so another solver's
optimum of the file is near ours, not the same; the values of the vertices are ours. ``submaps/`` holds everything.
"""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.network import PoseNetwork
from graphslam.core.submap import Submap
from graphslam.io.g2o import write_g2o


def map_network(
    submaps: Sequence[Submap], poses: Array, landmark_ids: npt.NDArray[np.int64], landmarks: Array
) -> PoseNetwork:
    """Chain and landmark observations of submaps with known identities, at solved values.

    Parameters
    ----------
    submaps : sequence of Submap
        2-D, with landmark ids of the map.
    poses : (m + 1, 3)
        Nodes, in the frame of the first base.
    landmark_ids, landmarks : (n,), (n, 2)

    Raises
    ------
    DataError
        A submap names a landmark that is not in the map.
    """
    nodes = len(poses)
    if nodes != len(submaps) + 1:
        raise DataError("nodes do not fit the submaps", got=nodes, wanted=len(submaps) + 1)
    row = {int(i): k for k, i in enumerate(landmark_ids)}
    pairs, values, information = [], [], []
    for k, s in enumerate(submaps):
        if s.landmarks is None:
            continue
        P = s.landmarks.dense_covariance()
        for j, (i, p) in enumerate(zip(s.landmarks.ids.tolist(), s.landmarks.positions)):
            if i not in row:
                raise DataError(f"submap {s.key} names a landmark that is not in the map", got=i)
            block = slice(3 + 2 * j, 5 + 2 * j)
            pairs.append((k, row[i]))
            values.append(p)
            information.append(np.linalg.inv(P[block, block]))
    return PoseNetwork(
        dim=2,
        ids=np.arange(nodes, dtype=np.int64),
        poses=np.asarray(poses, dtype=np.float64),
        has_initial=np.ones(nodes, dtype=bool),
        edges=np.stack([np.arange(nodes - 1), np.arange(1, nodes)], axis=1),
        measurements=np.array([s.exit_pose for s in submaps]),
        information=np.array([np.linalg.inv(s.exit_covariance) for s in submaps]),
        fixed=np.arange(nodes) == 0,
        landmark_ids=nodes + np.arange(len(landmark_ids), dtype=np.int64),
        landmarks=np.asarray(landmarks, dtype=np.float64),
        has_landmark=np.ones(len(landmark_ids), dtype=bool),
        observations=np.array(pairs, dtype=np.intp).reshape(-1, 2),
        observation_values=np.array(values).reshape(-1, 2),
        observation_information=np.array(information).reshape(-1, 2, 2),
        observation_kind="cartesian",
    )


def write_map_graph(
    path: str | os.PathLike[str],
    submaps: Sequence[Submap],
    poses: Array,
    landmark_ids: npt.NDArray[np.int64],
    landmarks: Array,
) -> None:
    """Write :func:`map_network` as g2o."""
    write_g2o(path, map_network(submaps, poses, landmark_ids, landmarks))
