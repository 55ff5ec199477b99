"""A pose network as GTSAM factors and values, native types only, and back."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt

from graphslam.core.errors import IndeterminateError, SolverError
from graphslam.core.geometry import Array
from graphslam.core.network import PoseNetwork
from graphslam.core.se3 import quat_normalize
from graphslam.solve.network.model import square_root

LANDMARK = "l"


def landmark_key(k: int) -> int:
    """Key of landmark index k."""
    return int(gtsam.symbol(LANDMARK, int(k)))


def pose_values(network: PoseNetwork, poses: Array) -> list[Any]:
    """Poses as GTSAM objects."""
    if network.dim == 2:
        return [gtsam.Pose2(x, y, t) for x, y, t in poses.tolist()]
    return [
        gtsam.Pose3(gtsam.Rot3.Quaternion(qw, qx, qy, qz), np.array([x, y, z]))
        for x, y, z, qx, qy, qz, qw in poses.tolist()
    ]


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
        poses = np.asarray(gtsam.utilities.extractPose2(values))[:n]
        poses = poses.copy()
    else:
        poses = np.empty((n, 7))
        for k in range(n):
            p = values.atPose3(k)
            poses[k] = pose3_array(p)
    landmarks = np.array([values.atPoint2(landmark_key(k)) for k in range(len(network.landmark_ids))])
    return poses, landmarks.reshape(-1, 2)


class _Noise:
    """Noise models by matrix: most files use a handful of different ones."""

    def __init__(self, information: Array) -> None:
        self._roots = square_root(information)
        self._models: dict[bytes, gtsam.noiseModel.Base] = {}

    def __getitem__(self, k: int) -> gtsam.noiseModel.Base:
        root = self._roots[k]
        key = root.tobytes()
        if key not in self._models:
            self._models[key] = gtsam.noiseModel.Gaussian.SqrtInformation(root, True)
        return self._models[key]


def edge_factors(network: PoseNetwork) -> list[gtsam.NonlinearFactor]:
    """One ``BetweenFactor`` an edge, in the order of the edges."""
    make = gtsam.BetweenFactorPose2 if network.dim == 2 else gtsam.BetweenFactorPose3
    noise = _Noise(network.information)
    measured = pose_values(network, network.measurements)
    return [make(i, j, z, noise[k]) for k, ((i, j), z) in enumerate(zip(network.edges.tolist(), measured, strict=True))]


def observation_factors(network: PoseNetwork) -> list[gtsam.NonlinearFactor]:
    """One native factor a landmark observation, in order.

    Raises
    ------
    SolverError
        Cartesian observations: GTSAM has no native factor for them (see :func:`as_bearing_range`).
    """
    if len(network.observations) and network.observation_kind != "bearing-range":
        raise SolverError("GTSAM has no native factor for Cartesian landmark observations")
    noise = _Noise(network.observation_information)
    factors: list[gtsam.NonlinearFactor] = []
    for k, ((i, j), (b, r)) in enumerate(
        zip(network.observations.tolist(), network.observation_values.tolist(), strict=True)
    ):
        factors.append(gtsam.BearingRangeFactor2D(i, landmark_key(j), gtsam.Rot2(b), r, noise[k]))
    return factors


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
    for factor in anchor_factors(network):
        graph.push_back(factor)
    for k, factor in enumerate((*edge_factors(network), *observation_factors(network))):
        if used is None or used[k]:
            graph.push_back(factor)
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
