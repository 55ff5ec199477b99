"""A Gaussian of poses and points in space as a GTSAM factor (landmark submaps in SE₁₊ₙ(3))."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.se3 import matrix_to_quat, quat_to_matrix
from graphslam.graph.factors.batch import safe_factor
from graphslam.linear.space_maps import ORIGIN, PlacedMap


def pose_of_gtsam(pose: gtsam.Pose3) -> Array:
    """``(7,)``."""
    return np.concatenate([pose.translation(), matrix_to_quat(pose.rotation().matrix())])


def gtsam_pose3(pose: Array) -> gtsam.Pose3:
    """A pose ``(7,)``."""
    return gtsam.Pose3(gtsam.Rot3(quat_to_matrix(pose[3:])), pose[:3])


def space_factor(one: PlacedMap) -> gtsam.CustomFactor:
    """A factor on the poses ``x{k}`` and points ``l{j}`` of a placed map, whitened, with its analytic Jacobian.

    Pose ``k`` of the problem is the variable ``x{k + 1}``, as in the graphs of submaps: ``x0`` is the fixed first base.
    """
    own = list(dict.fromkeys([*([one.base] if one.base != ORIGIN else []), *one.poses.tolist()]))
    marks = list(dict.fromkeys(one.points.tolist()))
    names = [*(f"x{k + 1}" for k in own), *(f"l{j}" for j in marks)]
    keys = [gtsam.symbol(n[0], int(n[1:])) for n in names]
    here, there = {k: i for i, k in enumerate(own)}, {j: i for i, j in enumerate(marks)}
    small = replace(
        one, base=ORIGIN if one.base == ORIGIN else here[one.base],
        poses=np.array([here[k] for k in one.poses.tolist()], dtype=np.int64),
        points=np.array([there[j] for j in one.points.tolist()], dtype=np.int64),
    )  # fmt: skip
    W = np.linalg.cholesky(one.map.information.toarray()).T
    p, rows = len(own), len(W)

    def terms(values: gtsam.Values, H: list[Array] | None) -> Array:
        poses = np.array([pose_of_gtsam(values.atPose3(k)) for k in keys[:p]]).reshape(-1, 7)
        points = np.array([values.atPoint3(k) for k in keys[p:]]).reshape(-1, 3)
        if H is None:
            return np.asarray(W @ small.residual(poses, points))
        u, J = small.linearise(poses, points)
        J = W @ J.toarray()
        for i in range(p):  # a right tangent (ω, ρ) turns and shifts along the axes of the body
            both = np.kron(np.eye(2), quat_to_matrix(poses[i, 3:]))
            H[i] = np.asfortranarray(J[:, 6 * i : 6 * i + 6] @ both)
        for i in range(len(keys) - p):
            H[p + i] = np.asfortranarray(J[:, 6 * p + 3 * i : 6 * p + 3 * i + 3])
        return np.asarray(W @ u)

    widths = [6] * p + [3] * len(marks)
    return safe_factor(gtsam.noiseModel.Unit.Create(rows), names, widths, rows, terms)
