"""One submap as the arrays of its npz file, and back (``graphslam.submap/1``). No pickles; extra arrays are ignored."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import scipy.sparse as sp

from graphslam.core.errors import DataError, FormatError
from graphslam.core.geometry import tangent_to_vector_covariance
from graphslam.core.submap import LandmarkMap, Match, Submap
from graphslam.core.trajectory import Trajectory

SUBMAP_FORMAT = "graphslam.submap/1"


def submap_arrays(submap: Submap) -> dict[str, Any]:
    """Everything of a submap but its grid, as the arrays of its file."""
    d = submap.dim
    arrays: dict[str, Any] = {
        "format": SUBMAP_FORMAT,
        "key": np.int64(submap.key),
        "interval": np.asarray(submap.interval, dtype=np.float64),
        "dim": np.int64(d),
        "exit_pose": submap.exit_pose,
        "exit_covariance": submap.exit_covariance,
        "has_landmarks": np.bool_(submap.landmarks is not None),
        "used": np.array(sorted(submap.uses), dtype=np.str_),
        "report": json.dumps(dict(submap.report), sort_keys=True, default=_plain),
    }
    landmarks = submap.landmarks
    if landmarks is None:  # what measures the exit alone is still a joint Gaussian over [exit pose]
        P = submap.exit_covariance
        arrays["covariance"] = tangent_to_vector_covariance(submap.exit_pose, P) if d == 2 else P
        arrays["landmark_ids"], arrays["landmarks"] = np.zeros(0, dtype=np.int64), np.zeros((0, d))
    else:
        arrays["landmark_ids"], arrays["landmarks"] = landmarks.ids, landmarks.positions
        if landmarks.information is None:
            arrays["covariance"] = landmarks.covariance
        else:
            for part in ("data", "indices", "indptr"):
                arrays[f"information_{part}"] = getattr(landmarks.information, part)
        if landmarks.sightings is not None:
            arrays["sightings"] = landmarks.sightings
    if submap.trajectory is not None:
        arrays["trajectory_times"] = submap.trajectory.times
        arrays["trajectory_poses"] = submap.trajectory.poses
        if submap.trajectory.covariances is not None:
            arrays["trajectory_covariances"] = submap.trajectory.covariances
    if submap.cloud is not None:
        arrays["cloud"] = submap.cloud
    if submap.matches:
        arrays["match_targets"] = np.array([q.target for q in submap.matches], dtype=np.int64)
        arrays["match_poses"] = np.array([q.T_target_here for q in submap.matches])
        arrays["match_covariances"] = np.array([q.covariance for q in submap.matches])
        arrays["match_fitness"] = np.array([q.fitness for q in submap.matches])
        arrays["match_support"] = np.array([q.support for q in submap.matches])
    return arrays


def _plain(value: Any) -> Any:
    """NumPy scalars and arrays of a report as JSON values."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise FormatError("a submap's report holds something JSON has no word for", got=type(value).__name__)


def submap_from_arrays(arrays: Mapping[str, Any], *, where: str) -> Submap:
    """The submap that :func:`submap_arrays` wrote down; optional arrays may be missing.

    Raises
    ------
    FormatError
        An array is missing or of the wrong kind.
    DataError
        Its values are impossible (the particular kind of :class:`DataError` is kept); names the file.
    """

    def need(name: str) -> Any:
        if name not in arrays:
            raise FormatError(f"array {name!r} is missing", where=where, got=sorted(arrays))
        return arrays[name]

    try:
        dim, d = int(need("dim")), {2: 3, 3: 6}.get(int(need("dim")))
        exit_pose = np.asarray(need("exit_pose"), dtype=np.float64)
        if d is None or exit_pose.shape != ({2: 3, 3: 7}[dim],):
            raise FormatError("dim and exit_pose do not agree", where=where, got=(dim, exit_pose.shape))
        interval = np.asarray(need("interval"), dtype=np.float64)
        if interval.shape != (2,):
            raise FormatError("interval is not two times", where=where, got=interval.shape)
        rest: dict[str, Any] = {
            "uses": frozenset(str(s) for s in np.asarray(arrays.get("used", ()), dtype=np.str_).ravel()),
            "report": json.loads(str(arrays["report"])) if "report" in arrays else {},
            "trajectory": _trajectory(arrays),
            "matches": _matches(arrays),
            "cloud": arrays.get("cloud"),
        }
        key, span = int(need("key")), (float(interval[0]), float(interval[1]))
        if bool(arrays.get("has_landmarks", True)):
            landmarks = _landmark_map(arrays, need, exit_pose, dim, d, where)
            if "exit_covariance" not in arrays:
                return Submap.from_landmarks(key, landmarks, interval=span, **rest)
            rest["landmarks"] = landmarks
        return Submap(key=key, interval=span, exit_pose=exit_pose, exit_covariance=need("exit_covariance"), **rest)
    except DataError as error:
        if error.where is not None and error.where.startswith(where):
            raise
        inside = f"{where}: {error.where}" if error.where else where
        raise type(error)(error.what, where=inside, got=error.got, wanted=error.wanted) from None
    except (ValueError, TypeError, KeyError) as error:
        raise FormatError(f"an array is of the wrong kind ({error})", where=where) from None


def _landmark_map(
    arrays: Mapping[str, Any], need: Callable[[str], Any], exit_pose: Any, dim: int, d: int, where: str
) -> LandmarkMap:
    ids = np.asarray(need("landmark_ids"))
    positions = np.asarray(need("landmarks"), dtype=np.float64)
    if ids.ndim != 1 or (len(ids) and not np.issubdtype(ids.dtype, np.integer)):
        raise FormatError("landmark_ids are not a list of integers", where=where, got=f"{ids.dtype} {ids.shape}")
    if positions.size != len(ids) * dim:
        raise FormatError("landmarks do not fit landmark_ids", where=where, got=positions.shape, wanted=(len(ids), dim))
    information = None
    if "covariance" not in arrays:
        n = d + dim * len(ids)
        parts = [np.asarray(need(f"information_{p}")) for p in ("data", "indices", "indptr")]
        information = sp.csc_matrix((parts[0], parts[1], parts[2]), shape=(n, n))
        information.check_format(full_check=True)
    return LandmarkMap(
        ids=ids.astype(np.int64),
        exit_pose=exit_pose,
        positions=positions,
        covariance=arrays.get("covariance"),
        information=information,
        sightings=arrays.get("sightings"),
    )


def _trajectory(arrays: Mapping[str, Any]) -> Trajectory | None:
    if "trajectory_times" not in arrays or len(arrays["trajectory_times"]) == 0:
        return None
    return Trajectory(arrays["trajectory_times"], arrays["trajectory_poses"], arrays.get("trajectory_covariances"))


def _matches(arrays: Mapping[str, Any]) -> tuple[Match, ...]:
    if "match_targets" not in arrays:
        return ()
    names = ("targets", "poses", "covariances", "fitness", "support")
    return tuple(
        Match(target=int(t), T_target_here=T, covariance=P, fitness=float(f), support=float(s))
        for t, T, P, f, s in zip(*(arrays[f"match_{n}"] for n in names), strict=True)
    )
