"""Conversion of a submap to the arrays of its npz file and back (``graphslam.submap/2``); no pickles are used."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from graphslam.core.charts import check_chart
from graphslam.core.dense import CloudMap
from graphslam.core.errors import ConfigError, DataError, FormatError
from graphslam.core.gaussian import check_covariance
from graphslam.core.geometry import tangent_to_vector_covariance
from graphslam.core.json_file import check_json, parse_json
from graphslam.core.npz import check_arrays, flags, floats, ints, texts
from graphslam.core.path_points import PathPoints
from graphslam.core.sensor_biases import SensorBiases
from graphslam.core.submap import LandmarkMap, Match, Submap
from graphslam.core.trajectory import Trajectory

SUBMAP_FORMAT = "graphslam.submap/2"
Arrays = Mapping[str, npt.NDArray[Any]]


def submap_arrays(submap: Submap) -> dict[str, Any]:
    """The arrays of a submap's file: everything except its grid."""
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
        "aided": np.array(sorted(submap.assisting_streams), dtype=np.str_),
        "report": json.dumps(dict(submap.report), sort_keys=True, default=_plain),
    }
    landmarks = submap.landmarks
    arrays["chart"] = "cartesian" if landmarks is None else landmarks.chart
    if landmarks is None:  # the joint Gaussian is that of the exit (end pose) only
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
        if landmarks.detections is not None:
            arrays["detections"] = landmarks.detections
        if landmarks.path is not None:
            for part in ("times", "lever", "positions", "covariance", "cross"):
                arrays[f"path_{part}"] = getattr(landmarks.path, part)
        if landmarks.biases is not None:
            arrays["biases_names"] = np.array(landmarks.biases.names, dtype=np.str_)
            for part in _BIASES:
                arrays[f"biases_{part}"] = getattr(landmarks.biases, part)
    if submap.trajectory is not None:
        arrays["trajectory_times"] = submap.trajectory.times
        arrays["trajectory_poses"] = submap.trajectory.poses
        if submap.trajectory.covariances is not None:
            arrays["trajectory_covariances"] = submap.trajectory.covariances
    if submap.cloud is not None:
        c = submap.cloud
        arrays["cloud"], arrays["cloud_cell"] = c.points, np.float64(c.cell)
        if c.origins is not None:
            arrays["cloud_origins"], arrays["cloud_scan"] = c.origins, c.scan
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
    raise FormatError("a submap's report holds a value that JSON cannot store", got=type(value).__name__)


def submap_from_arrays(arrays: Arrays, *, where: str) -> Submap:
    """Inverse of :func:`submap_arrays`; optional arrays may be missing."""

    a = check_arrays(arrays, _FIELDS, where)
    try:
        dim, exit_pose, interval = int(a["dim"]), a["exit_pose"], a["interval"]
        if len(exit_pose) != {2: 3, 3: 7}.get(dim):
            raise FormatError("dim and exit_pose do not agree", where=where, got=(dim, exit_pose.shape))
        rest: dict[str, Any] = {
            "uses": frozenset(a["used"].tolist()) if "used" in a else frozenset(),
            "assisting_streams": frozenset(a["aided"].tolist()) if "aided" in a else frozenset(),
            "report": check_json(parse_json(str(a.get("report", "{}")), f"{where}, report"), {str: object}, where),
            "trajectory": _trajectory(a, where),
            "matches": _matches(a, where),
            "cloud": _cloud(a),
        }
        key, span = int(a["key"]), (float(interval[0]), float(interval[1]))
        if bool(a.get("has_landmarks", True)):
            landmarks = _landmark_map(a, dim, where)
            if "exit_covariance" not in a:
                return Submap.from_landmarks(key, landmarks, interval=span, **rest)
            rest["landmarks"] = landmarks
        return Submap(
            key=key, interval=span, exit_pose=exit_pose, exit_covariance=_need(a, "exit_covariance", where), **rest
        )
    except DataError as error:
        if error.where is not None and error.where.startswith(where):
            raise
        inside = f"{where}: {error.where}" if error.where else where
        raise type(error)(error.what, where=inside, got=error.got, wanted=error.wanted) from None


_FIELDS = {
    "key": ints(),
    "dim": ints(),
    "interval": floats(2),
    "exit_pose": floats("p"),
    "exit_covariance": floats("d", "d", optional=True),
    "has_landmarks": flags(optional=True),
    "used": texts("u", optional=True),
    "aided": texts("a", optional=True),
    "report": texts(optional=True),
    "chart": texts(),
    "landmark_ids": ints("l", optional=True),
    "landmarks": floats("l", "c", optional=True),
    "covariance": floats("v", "v", optional=True),
    "information_data": floats("z", optional=True),
    "information_indices": ints("z", optional=True),
    "information_indptr": ints("v+1", optional=True),
    "detections": ints("q", 2, optional=True),
    "path_times": floats("f", optional=True),
    "path_lever": floats("c", optional=True),
    "path_positions": floats("f", "c", optional=True),
    "path_covariance": floats("g", "g", optional=True),
    "path_cross": floats("g", "v", optional=True),
    "biases_names": texts(6, optional=True),
    "biases_sigmas": floats(6, optional=True),
    "biases_response": floats("v", 6, optional=True),
    "biases_score": floats(6, optional=True),
    "biases_information": floats(6, 6, optional=True),
    "biases_path": floats("n", 3, 6, optional=True),
    "biases_points": floats("g", 6, optional=True),
    "trajectory_times": floats("n", optional=True),
    "trajectory_poses": floats("n", "p", optional=True),
    "trajectory_covariances": floats("n", "d", "d", optional=True),
    "cloud": floats("k", "e", optional=True),
    "cloud_cell": floats(optional=True),
    "cloud_origins": floats("w", "e", optional=True),
    "cloud_scan": ints("k", optional=True),
    "match_targets": ints("r", optional=True),
    "match_poses": floats("r", "p", optional=True),
    "match_covariances": floats("r", "d", "d", optional=True),
    "match_fitness": floats("r", optional=True),
    "match_support": floats("r", optional=True),
}


def _need(arrays: Arrays, name: str, where: str) -> npt.NDArray[Any]:
    if name not in arrays:
        raise FormatError(f"array {name!r} is missing", where=where, got=sorted(arrays))
    return arrays[name]


def _landmark_map(a: Arrays, dim: int, where: str) -> LandmarkMap:
    ids, positions = _need(a, "landmark_ids", where), _need(a, "landmarks", where)
    if positions.shape[1] != dim:
        raise FormatError(
            "landmarks do not fit the dimension", where=where, got=positions.shape, wanted=(len(ids), dim)
        )
    information = None
    if "covariance" not in a:
        n = (3 if dim == 2 else 6) + positions.size
        data, indices, indptr = (_need(a, f"information_{p}", where) for p in ("data", "indices", "indptr"))
        if len(indptr) != n + 1 or indptr[0] != 0 or np.any(np.diff(indptr) < 0) or indptr[-1] != len(data):
            raise FormatError("information_indptr is impossible", where=where, got=indptr.shape, wanted=f"({n + 1},)")
        if len(indices) and (indices.min() < 0 or indices.max() >= n):
            raise FormatError("information_indices are impossible", where=where, wanted=f"0 … {n - 1}")
        information = sp.csc_matrix((data, indices, indptr), shape=(n, n))
        off = abs(information - information.T)
        if off.nnz and off.max() > 1e-6 * abs(information).max():
            raise FormatError("information is not symmetric", where=where)
    return LandmarkMap(
        ids=ids,
        exit_pose=a["exit_pose"],
        positions=positions,
        covariance=a.get("covariance"),
        information=information,
        detections=a.get("detections"),
        chart=_chart(a, where),
        path=_path(a, where),
        biases=_biases(a, where),
    )


def _path(a: Arrays, where: str) -> PathPoints | None:
    if "path_times" not in a:
        return None
    parts = ("times", "lever", "positions", "covariance", "cross")
    return PathPoints(**{part: _need(a, f"path_{part}", where) for part in parts})


_BIASES = ("sigmas", "response", "score", "information", "path", "points")


def _biases(a: Arrays, where: str) -> SensorBiases | None:
    if "biases_names" not in a:
        return None
    arrays = {part: _need(a, f"biases_{part}", where) for part in _BIASES}
    return SensorBiases(names=tuple(a["biases_names"].tolist()), **arrays)


def _chart(a: Arrays, where: str) -> str:
    try:
        return check_chart(str(a["chart"]))
    except ConfigError as error:
        raise FormatError(str(error), where=where) from None


def _trajectory(a: Arrays, where: str) -> Trajectory | None:
    if len(a.get("trajectory_times", ())) == 0:
        return None
    return Trajectory(a["trajectory_times"], _need(a, "trajectory_poses", where), a.get("trajectory_covariances"))


def _cloud(a: Arrays) -> CloudMap | None:
    if "cloud" not in a:
        return None
    cell = {"cell": float(a["cloud_cell"])} if "cloud_cell" in a else {}
    return CloudMap(points=a["cloud"], origins=a.get("cloud_origins"), scan=a.get("cloud_scan"), **cell)


def _matches(a: Arrays, where: str) -> tuple[Match, ...]:
    if "match_targets" not in a:
        return ()
    names = ("targets", "poses", "covariances", "fitness", "support")
    found = tuple(
        Match(target=int(t), T_target_here=T, covariance=P, fitness=float(f), support=float(s))
        for t, T, P, f, s in zip(*(_need(a, f"match_{n}", where) for n in names), strict=True)
    )
    for k, q in enumerate(found):
        check_covariance(q.covariance, what=f"covariance of match {k}", where=where)
    return found
