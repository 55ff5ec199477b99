"""A joined map on disk: ``joined.npz`` and ``nodes.tum``."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import numpy.typing as npt

from graphslam.core.atomic import read_npz, write_npz
from graphslam.core.errors import FormatError
from graphslam.core.geometry import Array
from graphslam.core.npz import floats, ints
from graphslam.core.trajectory import Trajectory
from graphslam.io.tum import write_tum

JOINED_FORMAT = "graphslam.joined/1"
JOINED = {"times": floats("m"), "poses": floats("m", 3), "landmark_ids": ints("n"), "landmarks": floats("n", 2)}


def write_joined(
    folder: str | os.PathLike[str],
    times: npt.ArrayLike,
    poses: Array,
    landmark_ids: npt.NDArray[np.int64],
    landmarks: Array,
) -> None:
    """Write nodes ``(m + 1, 3)`` at ``times`` and landmarks ``(n, 2)``, in the frame of the first base."""
    root = Path(folder)
    root.mkdir(parents=True, exist_ok=True)
    stamps = np.asarray(times, dtype=np.float64)
    write_npz(
        root / "joined.npz",
        {
            "format": JOINED_FORMAT,
            "times": stamps,
            "poses": poses,
            "landmark_ids": landmark_ids,
            "landmarks": landmarks,
        },
    )
    write_tum(root / "nodes.tum", Trajectory(stamps, poses))


def read_joined(folder: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """Arrays ``times, poses, landmark_ids, landmarks`` of a joined map.

    Raises
    ------
    MissingDataError, FormatError
    """
    file = Path(folder) / "joined.npz"
    arrays = read_npz(file, fmt=JOINED_FORMAT, fields=JOINED)
    if np.any(np.diff(arrays["times"]) <= 0):
        raise FormatError("stamps of the nodes do not rise", where=str(file))
    return arrays
