"""Writer of a joined map: ``joined.npz`` and ``nodes.tum``.

Format 2 contains the uncertainty of the whole map: its sparse information matrix (CSC), or the covariance of a filter.
``state`` is its parametrisation: ``vector``: poses as (x, y, θ) and landmarks; ``tangent``: right tangent vectors of
poses and, if bases are levelled, two rotations of the up direction. The first base is not part of the state.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from graphslam.core.atomic import write_npz
from graphslam.core.output_folder import output_folder
from graphslam.core.trajectory import Trajectory
from graphslam.io.tum import write_tum

if TYPE_CHECKING:
    from graphslam.join.graph_join import GraphEstimate
    from graphslam.join.submap_solver import SubmapEstimate

JOINED_FORMAT = "graphslam.joined/2"
KIND = "joined map"
"""See :func:`~graphslam.core.output_folder.check_folder_target`."""


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
        Stamps of its poses [s].
    estimate : SubmapEstimate or GraphEstimate
        With its uncertainty; for ``vector`` also the parametrisation in which it is Gaussian
        (:mod:`graphslam.core.charts`) and, if present, the ``anchors`` of the landmarks.
    state : {"vector", "tangent"}
        Coordinates of the uncertainty.
    """
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
    with output_folder(folder, KIND, last=("joined.npz",)) as new:
        write_npz(new / "joined.npz", arrays)
        write_tum(new / "nodes.tum", Trajectory(stamps, estimate.poses))
