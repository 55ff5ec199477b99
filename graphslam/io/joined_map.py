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

from graphslam.core.atomic import check_format, write_npz
from graphslam.core.errors import FormatError
from graphslam.core.npz import check_arrays, floats, ints, read_arrays, texts
from graphslam.core.trajectory import Trajectory
from graphslam.io.tum import write_tum

if TYPE_CHECKING:
    from graphslam.join.graph_join import GraphEstimate
    from graphslam.join.submap_solver import SubmapEstimate

FORMAT_1, JOINED_FORMAT = "graphslam.joined/1", "graphslam.joined/2"
STATES = ("vector", "tangent")
JOINED = {
    "times": floats("m"),
    "poses": floats("m", "p"),
    "landmark_ids": ints("n"),
    "landmarks": floats("n", "c"),
    "state": texts(optional=True),
    "chart": texts(optional=True),
    "anchors": ints("n", optional=True),
    "information_data": floats("k", optional=True),
    "information_indices": ints("k", optional=True),
    "information_indptr": ints("s+1", optional=True),
    "covariance": floats("s", "s", optional=True),
}


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


def read_joined(folder: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """Arrays of a joined map: ``times, poses, landmark_ids, landmarks``, and the uncertainty where the file has it."""
    file = Path(folder) / "joined.npz"
    where = str(file)
    found = read_arrays(file)
    if (got := str(found.get("format", "none"))) != FORMAT_1:
        check_format(got, JOINED_FORMAT, where=where)
    arrays = check_arrays(found, JOINED, where)
    if np.any(np.diff(arrays["times"]) <= 0):
        raise FormatError("stamps of the nodes do not rise", where=where)
    dim = {3: 2, 7: 3}.get(arrays["poses"].shape[1])
    if dim is None or arrays["landmarks"].shape[1] != dim:
        raise FormatError(
            "poses and landmarks do not fit", where=where, got=(arrays["poses"].shape, arrays["landmarks"].shape)
        )
    if str(arrays.get("state", "vector")) not in STATES:
        raise FormatError("unknown kind of state", where=where, got=str(arrays["state"]), wanted=STATES)
    A, P = information_of(arrays), arrays.get("covariance")
    poses = {2: 3, 3: 6}[dim] * (len(arrays["poses"]) - 1) + dim * len(arrays["landmarks"])
    sizes = [M.shape[0] for M in (A, P) if M is not None]
    if any(size not in (poses, poses + 2) for size in sizes):  # with the direction up
        raise FormatError("uncertainty and state of a joined map do not fit", where=where, got=sizes, wanted=poses)
    return arrays


def information_of(joined: dict[str, np.ndarray]) -> sp.csc_matrix | None:
    """Information matrix ``(s, s)`` of a joined map that was read; None where it has none."""
    names = [f"information_{part}" for part in ("data", "indices", "indptr")]
    if not any(name in joined for name in names):
        return None
    missing = [name for name in names if name not in joined]
    if missing:
        raise FormatError("information matrix of a joined map is not whole", got=f"no {missing[0]}", wanted=names)
    data, indices, indptr = (joined[name] for name in names)
    n = len(indptr) - 1
    bad = indptr[0] != 0 or indptr[-1] != len(data) or np.any(np.diff(indptr) < 0)
    if bad or (len(indices) and (indices.min() < 0 or indices.max() >= n)):
        raise FormatError("information matrix of a joined map is damaged", got=(len(data), n), wanted="sorted columns")
    return sp.csc_matrix((data, indices, indptr), shape=(n, n))
