"""Local maps as 2D I-SLSJF publishes them: one ``localmap_<i>.mat`` each (Huang, Wang, Dissanayake, 2008).

``localmap_st`` is (n, 2): feature id (0 for the three rows of the robot) and value, in the order final robot pose
(x, y, φ) in the frame of the map's first pose, then x and y of each feature; ``localmap_P`` is their covariance. That
is the vector of :class:`~graphslam.core.submap.LandmarkMap`, so a map loads without conversion. The end pose of map i
is the frame of map i + 1.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np

from graphslam.core.errors import CovarianceError, FormatError, MissingDataError
from graphslam.core.gaussian import check_covariance
from graphslam.core.reading import integer_mask
from graphslam.core.submap import LandmarkMap, Submap
from graphslam_studies.io.mat import read_mat

_NAME = re.compile(r"localmap_(\d+)\.mat")


def read_slsjf_local_maps(folder: str | os.PathLike[str]) -> list[Submap]:
    """Local maps of a folder in numeric order.

    Parameters
    ----------
    folder : path
        Holds ``localmap_1.mat``, ``localmap_2.mat`` …, or a folder ``slsjf_200_local_maps`` that does.

    Returns
    -------
    list of Submap
        Keys 0, 1, …; landmark ids are feature ids; without a clock the interval of submap k is [k, k + 1]. The
        covariance is as published, rounding asymmetry averaged away.
    """
    root = Path(folder)
    inner = root / "slsjf_200_local_maps"
    if inner.is_dir():
        root = inner
    files = {int(m[1]): p for p in root.glob("localmap_*.mat") if (m := _NAME.fullmatch(p.name))}
    if not files:
        raise MissingDataError("holds no local map", where=str(root), wanted="localmap_1.mat, localmap_2.mat, …")
    numbers = sorted(files)
    missing = sorted(set(range(numbers[0], numbers[-1] + 1)) - set(numbers))
    if missing:
        raise MissingDataError(
            f"{len(missing)} local maps of the chain are missing",
            where=str(root),
            got=f"{len(numbers)} maps, {numbers[0]} to {numbers[-1]}",
            wanted=f"localmap_{missing[0]}.mat",
        )
    return [read_slsjf_local_map(files[n], key) for key, n in enumerate(numbers)]


def read_slsjf_local_map(path: str | os.PathLike[str], key: int) -> Submap:
    """One local map as submap ``key``."""
    where = str(path)
    state, P = read_mat(path, "localmap_st", "localmap_P")
    if state.ndim != 2 or state.shape[1] != 2 or len(state) < 3 or len(state) % 2 == 0:
        raise FormatError("state has the wrong shape", where=where, got=state.shape, wanted="(3 + 2 features, 2)")
    ids, values = state[:, 0], state[:, 1]
    if not np.isfinite(state).all():
        k = int(np.flatnonzero(~np.isfinite(state).all(axis=1))[0])
        raise FormatError(f"row {k} of the state is not finite", where=where, got=state[k])
    features = ids[3:].reshape(-1, 2)
    twice = np.all(features[:, 0] == features[:, 1]) and np.all(features > 0)
    if np.any(ids[:3] != 0) or not twice or not np.all(integer_mask(features)):
        raise FormatError("feature ids are not robot, robot, robot, a, a, b, b, …", where=where, got=ids[:7])
    try:
        covariance = check_covariance(P, what="covariance", where=where, dim=len(values))
        landmarks = LandmarkMap(
            ids=features[:, 0].astype(np.int64),
            exit_pose=values[:3],
            positions=values[3:].reshape(-1, 2),
            covariance=covariance,
        )
    except CovarianceError as error:
        raise CovarianceError(error.what, where=where, got=error.got, wanted=error.wanted) from None
    return Submap.from_landmarks(
        key, landmarks, uses=frozenset({"controls", "laser"}), report={"source": Path(path).name}
    )
