"""Values of a graph ↔ GTSAM's values."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.se3 import matrix_to_quat, quat_normalize
from graphslam.graph.state import Layout, Values, gtsam_key


def gtsam_pose(pose: Array) -> Any:
    """``Pose2`` of ``(3,)``, ``Pose3`` of ``(7,)``; GTSAM takes any quaternion in silence, so it is normalised here."""
    if len(pose) == 3:
        return gtsam.Pose2(*pose)
    x, y, z, w = quat_normalize(pose[3:])
    return gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), pose[:3])


def pose_array(pose: Any) -> Array:
    """Inverse of :func:`gtsam_pose`."""
    if isinstance(pose, gtsam.Pose2):
        return np.array([pose.x(), pose.y(), pose.theta()])
    return np.concatenate([pose.translation(), matrix_to_quat(pose.rotation().matrix())])


def insert_value(out: gtsam.Values, name: str, values: Values, row_of: dict[int, int]) -> None:
    """Insert one variable of ``values`` into GTSAM's."""
    key = gtsam_key(name)
    if name == "datum":
        assert values.datum is not None
        out.insert(key, gtsam.Pose2(*values.datum) if values.dim == 2 else values.datum)
    elif name == "tilt":
        assert values.tilt is not None
        out.insert(key, values.tilt)
    elif name.startswith("velocity"):
        out.insert(key, values.velocities[int(name[8:])])
    elif name.startswith("imubias"):
        out.insert(key, values.imu_biases[int(name[7:])])
    elif name.startswith("bias"):
        out.insert(key, values.biases[int(name[4:])])
    elif name[0] == "x":
        out.insert(key, gtsam_pose(values.poses[int(name[1:])]))
    else:
        out.insert(key, values.landmarks[row_of[int(name[1:])]])


def to_gtsam(values: Values) -> gtsam.Values:
    """All free variables as GTSAM values."""
    out, layout = gtsam.Values(), values.layout()
    for name in layout.names():
        insert_value(out, name, values, layout.row_of)
    return out


def from_gtsam(estimate: gtsam.Values, like: Values, layout: Layout | None = None) -> Values:
    """GTSAM values → ours; variables that GTSAM does not hold keep their value in ``like``."""
    out = like.copy()
    keys = np.array(list(estimate.keys()), dtype=np.uint64)
    letter = (keys >> np.uint64(56)).astype(np.int64)
    index = (keys & np.uint64((1 << 56) - 1)).astype(np.int64)
    if like.dim == 3:
        _from_gtsam_in_space(estimate, out, keys, letter, index)
        return out
    row_of = (layout or like.layout()).row_of
    # bulk extraction comes in the order of the keys, one array a type
    posed, pointed = np.isin(letter, [ord("g"), ord("x")]), np.isin(letter, [ord("b"), ord("l")])
    P = np.asarray(gtsam.utilities.extractPose2(estimate)).reshape(-1, 3)
    p = np.asarray(gtsam.utilities.extractPoint2(estimate)).reshape(-1, 2)
    x = letter[posed] == ord("x")
    out.poses[index[posed][x]] = P[x]
    if np.any(~x):
        out.datum = P[~x][0].copy()
    l = letter[pointed] == ord("l")
    rows = np.array([row_of[int(i)] for i in index[pointed][l]], dtype=np.intp)
    out.landmarks[rows] = p[l]
    out.biases[index[pointed][~l]] = p[~l]
    return out


def _from_gtsam_in_space(estimate: gtsam.Values, out: Values, keys: Any, letter: Any, index: Any) -> None:
    P = np.asarray(gtsam.utilities.extractPose3(estimate)).reshape(-1, 12)  # rotation by rows, then position
    x = letter == ord("x")
    rotations = P[:, :9].reshape(-1, 3, 3)
    finite = np.all(np.isfinite(P), axis=1)
    out.poses[index[x]] = np.nan
    out.poses[index[x][finite], :3] = P[finite, 9:]
    out.poses[index[x][finite], 3:] = matrix_to_quat(rotations[finite])
    # the few others one by one: extractPoint3 also counts vectors of other sizes and leaves their rows unset
    for key, what, i in zip(keys[~x].tolist(), letter[~x].tolist(), index[~x].tolist()):
        if what == ord("g"):
            out.datum = np.array(estimate.atVector(key))
        elif what == ord("t"):
            out.tilt = np.array(estimate.atVector(key))
        else:
            rows = {"b": out.biases, "v": out.velocities, "i": out.imu_biases}[chr(what)]
            rows[i] = estimate.atVector(key)
