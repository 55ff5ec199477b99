"""Conversion between values of a graph and GTSAM's values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import gtsam
import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.se3 import matrix_to_quat
from graphslam.graph.factors.batch import gtsam_value, read_value
from graphslam.graph.variables import KINDS, Values, gtsam_key, key_name, split_name


def value_of(values: Values, name: str, row_of: Mapping[int, int]) -> Array:
    """Value ``(size,)`` of one variable; ``row_of``: row of each landmark id."""
    kind, k = split_name(name)
    return values[kind.word][row_of[k] if kind.word == "l" else k]


def insert_values(
    out: gtsam.Values, names: Iterable[str], values: Values, row_of: Mapping[int, int], frame: Any = None
) -> None:
    """Insert variables of ``values`` into GTSAM's; poses and places in another frame if its pose is given."""
    for name in names:
        value = gtsam_value(value_of(values, name, row_of), name, values.dim)
        if frame is not None and (word := split_name(name)[0].word) in PLACED:
            value = frame.compose(value) if word == "x" else frame.transformFrom(value)
        out.insert(gtsam_key(name), value)


PLACED = ("x", "l", "point")
"""Kinds with values in the world frame that follow if the frame is changed (:attr:`FactorBatch.relative`)."""


def placed(values: Values, T: Array) -> Values:
    """The same values in another frame, whose pose of the old one is ``T`` ``(3|7,)``; datum and tilt are kept."""
    out, group = values.copy(), values.group
    out.poses = group.compose(np.broadcast_to(T, out.poses.shape), out.poses)
    for word in PLACED[1:]:
        if out.count(word):
            out[word] = group.transform(T, out[word])
    return out


def from_gtsam(estimate: gtsam.Values, like: Values, row_of: Mapping[int, int] | None = None) -> Values:
    """GTSAM values → ours; variables that are not in GTSAM keep their value in ``like``."""
    out = like.copy()
    row_of = like.layout().row_of if row_of is None else row_of
    keys = np.array(list(estimate.keys()), dtype=np.uint64)
    letter = (keys >> np.uint64(56)).astype(np.int64)
    index = (keys & np.uint64((1 << 56) - 1)).astype(np.int64)
    nodes = letter == ord("x")
    _poses_from_gtsam(estimate, out, letter, index)
    done = nodes
    if like.dim == 2:  # bulk extraction is in the order of the keys; in 3-D it leaves rows of other sizes unset
        points = np.isin(letter, [ord(k.letter) for k in KINDS.values() if k.dof(2) == 2])
        p = np.asarray(gtsam.utilities.extractPoint2(estimate)).reshape(-1, 2)
        if len(p) == points.sum():
            l = letter[points] == ord("l")
            rows = np.array([row_of[int(i)] for i in index[points][l]], dtype=np.intp)
            out.landmarks[rows] = p[l]
            done = nodes | (letter == ord("l"))
    for key in keys[~done].tolist():
        name = key_name(key)
        kind, k = split_name(name)
        out[kind.word][row_of[k] if kind.word == "l" else k] = read_value(estimate, name, key, like.dim)
    return out


def _poses_from_gtsam(estimate: gtsam.Values, out: Values, letter: Any, index: Any) -> None:
    x = letter == ord("x")
    if out.dim == 2:
        posed = np.isin(letter, [ord("g"), ord("x")])
        P = np.asarray(gtsam.utilities.extractPose2(estimate)).reshape(-1, 3)
        out.poses[index[x]] = P[x[posed]]
        return
    P = np.asarray(gtsam.utilities.extractPose3(estimate)).reshape(-1, 12)  # rotation by rows, then position
    rotations = P[:, :9].reshape(-1, 3, 3)
    finite = np.all(np.isfinite(P), axis=1)
    out.poses[index[x]] = np.nan
    out.poses[index[x][finite], :3] = P[finite, 9:]
    out.poses[index[x][finite], 3:] = matrix_to_quat(rotations[finite])
