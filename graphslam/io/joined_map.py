"""A joined map on disk: ``joined.npz`` and ``nodes.tum``.

Format 2 holds the uncertainty of the whole map: its information matrix, sparse by columns, or the covariance of a
filter that carries one. ``state`` says of what: ``vector`` are poses as (x, y, θ) and landmarks, ``tangent`` the right
tangents of poses and, where bases are levelled, two turns of the direction up. The first base is not part of it.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from graphslam.core.atomic import write_npz
from graphslam.core.trajectory import Trajectory
from graphslam.io.tum import write_tum

if TYPE_CHECKING:
    from graphslam.join.graph_join import GraphEstimate
    from graphslam.join.submap_solver import SubmapEstimate

JOINED_FORMAT = "graphslam.joined/2"


def write_joined(
    folder: str | os.PathLike[str],
    times: npt.ArrayLike,
    estimate: SubmapEstimate | GraphEstimate,
    state: str,
) -> None:
    """Write a joined map, in the frame of the first base.

    Parameters
    ----------
    times : (m + 1,)
        Of its poses [s].
    estimate : SubmapEstimate or GraphEstimate
        With its uncertainty; a vector also says in which chart it is Gaussian (:mod:`graphslam.core.charts`), and in
        the group chart the end pose that each landmark hangs on.
    state : {"vector", "tangent"}
        Coordinates of the uncertainty.
    """
    root = Path(folder)
    root.mkdir(parents=True, exist_ok=True)
    stamps = np.asarray(times, dtype=np.float64)
    arrays = {
        "format": JOINED_FORMAT,
        "times": stamps,
        "poses": estimate.poses,
        "landmark_ids": estimate.landmark_ids,
        "landmarks": estimate.landmarks,
        "state": state,
    }
    if state == "vector":
        arrays["chart"] = getattr(estimate, "chart", "cartesian")
        if (anchors := getattr(estimate, "anchors", None)) is not None:
            arrays["anchors"] = anchors
    information, covariance = estimate.map_information(), estimate.map_covariance()
    if information is not None:
        A = sp.csc_matrix(information)
        arrays |= {f"information_{part}": getattr(A, part) for part in ("data", "indices", "indptr")}
    elif covariance is not None:
        arrays["covariance"] = covariance
    write_npz(root / "joined.npz", arrays)
    write_tum(root / "nodes.tum", Trajectory(stamps, estimate.poses))
