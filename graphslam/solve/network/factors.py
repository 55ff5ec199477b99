"""A pose network as GTSAM factors and values, native types only, and back."""

from __future__ import annotations

from itertools import compress
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt

from graphslam.core.errors import IndeterminateError, SolverError
from graphslam.core.geometry import Array
from graphslam.core.network import PoseNetwork
from graphslam.core.se3 import matrix_to_quat, quat_normalize, quat_to_matrix
from graphslam.graph.noise import whiteners

LANDMARK = "l"


def landmark_key(k: int) -> int:
    """Key of landmark index k."""
    return int(gtsam.symbol(LANDMARK, int(k)))


def pose_values(network: PoseNetwork, poses: Array) -> list[Any]:
    """Poses as GTSAM objects."""
    if network.dim == 2:
        return [gtsam.Pose2(x, y, t) for x, y, t in poses.tolist()]
    T = np.zeros((len(poses), 4, 4))
    T[:, :3, :3], T[:, :3, 3], T[:, 3, 3] = quat_to_matrix(poses[:, 3:]), poses[:, :3], 1.0
    return list(map(gtsam.Pose3, T))


def pose3_array(pose: gtsam.Pose3) -> Array:
    """``(7,)`` x y z qx qy qz qw of a GTSAM pose."""
    q: Any = pose.rotation().toQuaternion()
    return np.array([*pose.translation(), *quat_normalize(np.array([q.x(), q.y(), q.z(), q.w()]))])


def to_values(network: PoseNetwork, poses: Array, landmarks: Array) -> gtsam.Values:
    """All variables: pose k under key k, landmark k under ``l`` k."""
    values = gtsam.Values()
    for k, pose in enumerate(pose_values(network, poses)):
        values.insert(k, pose)
    for k, point in enumerate(landmarks):
        values.insert(landmark_key(k), point)
    return values


def from_values(network: PoseNetwork, values: gtsam.Values) -> tuple[Array, Array]:
    """Arrays ``(n, 3 | 7)`` and ``(l, 2)`` of GTSAM values that hold every variable."""
    n = len(network)
    if network.dim == 2:
        poses = np.array(gtsam.utilities.extractPose2(values))[:n]
    else:
        rows = np.asarray(gtsam.utilities.extractPose3(values))[:n]
        R = np.ascontiguousarray(rows[:, :9]).reshape(-1, 3, 3)
        poses = np.concatenate([rows[:, 9:], matrix_to_quat(R)], axis=1)
    landmarks = np.array([values.atPoint2(landmark_key(k)) for k in range(len(network.landmark_ids))])
    return poses, landmarks.reshape(-1, 2)


def _noise(information: Array) -> list[gtsam.noiseModel.Base]:
    """A noise model for each matrix; equal matrices share one, and most files use a handful of different ones."""
    if len(information) == 0:
        return []
    d = information.shape[1]
    rows = np.ascontiguousarray(information).reshape(-1, d * d).view(np.dtype((np.void, 8 * d * d))).ravel()
    _, first, which = np.unique(rows, return_index=True, return_inverse=True)
    models = [gtsam.noiseModel.Gaussian.SqrtInformation(R, True) for R in whiteners(information[first])]
    return [models[k] for k in which.tolist()]


def edge_factors(network: PoseNetwork) -> list[gtsam.NonlinearFactor]:
    """One ``BetweenFactor`` an edge, in the order of the edges."""
    make = gtsam.BetweenFactorPose2 if network.dim == 2 else gtsam.BetweenFactorPose3
    i, j = network.edges.T.tolist()
    return list(map(make, i, j, pose_values(network, network.measurements), _noise(network.information)))


def observation_factors(network: PoseNetwork) -> list[gtsam.NonlinearFactor]:
    """One native factor a landmark observation, in order.

    Raises
    ------
    SolverError
        Cartesian observations: GTSAM has no native factor for them (see :func:`as_bearing_range`).
    """
    if len(network.observations) and network.observation_kind != "bearing-range":
        raise SolverError("GTSAM has no native factor for Cartesian landmark observations")
    i, j = network.observations.T.tolist()
    bearing, distance = network.observation_values.T.tolist()
    marks = map(landmark_key, j)
    noise = _noise(network.observation_information)
    return list(map(gtsam.BearingRangeFactor2D, i, marks, map(gtsam.Rot2, bearing), distance, noise))


def anchor_factors(network: PoseNetwork) -> list[gtsam.NonlinearFactor]:
    """A gauge prior on the one held vertex, or hard constraints on several (their places are then evidence).

    The prior has the held value as mean. At the optimum its residual is zero whatever its information, because the
    rest of the network does not care where it lies; so it takes the median information of the edges, which is best
    for the conditioning of the system.
    """
    anchors = network.anchors
    make = gtsam.PriorFactorPose2 if network.dim == 2 else gtsam.PriorFactorPose3
    d = network.tangent_dim
    if len(anchors) == 1:
        diagonal = np.diagonal(network.information, axis1=1, axis2=2)
        scale = np.median(diagonal, axis=0) if len(diagonal) else np.ones(d)
        noise = gtsam.noiseModel.Diagonal.Precisions(np.where(scale > 0.0, scale, 1.0))
    else:
        noise = gtsam.noiseModel.Constrained.All(d)
    held = pose_values(network, network.poses[anchors])
    return [make(int(k), pose, noise) for k, pose in zip(anchors, held, strict=True)]


def to_graph(network: PoseNetwork, used: npt.NDArray[np.bool_] | None = None) -> gtsam.NonlinearFactorGraph:
    """Anchors, then edges, then observations; of these two only where ``used`` (m + k,) says so, if given."""
    graph = gtsam.NonlinearFactorGraph()
    measured = [*edge_factors(network), *observation_factors(network)]
    for factor in anchor_factors(network):
        graph.add(factor)
    for factor in measured if used is None else compress(measured, used.tolist()):
        graph.add(factor)
    return graph


def variable_name(network: PoseNetwork, key: int) -> str:
    """A GTSAM key in the file's words."""
    if key < len(network):
        return f"vertex {network.ids[key]}"
    return f"landmark {network.landmark_ids[gtsam.Symbol(key).index()]}"


def indeterminate(network: PoseNetwork, error: Exception) -> IndeterminateError:
    """Turn GTSAM's message about a key into one about the file's vertices."""
    text = str(error)
    names: tuple[str, ...] = ()
    for word in text.replace("'", " ").replace(",", " ").split():
        if word.startswith(LANDMARK) and word[1:].isdigit() and int(word[1:]) < len(network.landmark_ids):
            names = (variable_name(network, landmark_key(int(word[1:]))),)
            break
        if word.isdigit() and int(word) < len(network):
            names = (variable_name(network, int(word)),)
            break
    where = f" near {names[0]}" if names else ""
    return IndeterminateError(
        f"{network.source}: the network does not determine every variable{where}: it needs another edge there, an edge "
        "with information in every direction, or a FIX",
        names,
    )
