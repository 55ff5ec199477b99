"""A pose network as GTSAM factors, native types only: what ours is compared with."""

from __future__ import annotations

from typing import Any

import gtsam

from graphslam.core.network import PoseNetwork
from graphslam.graph.gtsam_values import from_gtsam
from graphslam.graph.variables import Values, gtsam_key
from tests.reference.gtsam_twin import gtsam_poses, to_gtsam


def to_graph(network: PoseNetwork) -> gtsam.NonlinearFactorGraph:
    """Anchors (a prior on one, hard constraints on several), then edges, then observations by bearing and range."""
    plane, d = network.dim == 2, network.tangent_dim
    graph, first = gtsam.NonlinearFactorGraph(), gtsam_key("x0")
    prior = gtsam.PriorFactorPose2 if plane else gtsam.PriorFactorPose3
    between = gtsam.BetweenFactorPose2 if plane else gtsam.BetweenFactorPose3
    one = len(network.anchors) == 1
    held: Any = gtsam.noiseModel.Unit.Create(d) if one else gtsam.noiseModel.Constrained.All(d)
    for a, pose in zip(network.anchors.tolist(), gtsam_poses(network.poses[network.anchors]), strict=True):
        graph.add(prior(first + a, pose, held))
    noise = gtsam.noiseModel.Gaussian.Information
    for (i, j), z, omega in zip(
        network.edges.tolist(), gtsam_poses(network.measurements), network.information, strict=True
    ):
        graph.add(between(first + i, first + j, z, noise(omega)))
    marks = gtsam_key("l0") + network.landmark_ids
    assert len(marks) == 0 or network.observation_kind == "bearing-range"
    for (i, j), z, omega in zip(
        network.observations.tolist(), network.observation_values, network.observation_information, strict=True
    ):
        graph.add(gtsam.BearingRangeFactor2D(first + i, int(marks[j]), gtsam.Rot2(z[0]), z[1], noise(omega)))
    return graph


def gauss_newton_step(network: PoseNetwork, values: Values) -> tuple[Values, float]:
    """GTSAM's own step from ``values``, and the fall of the objective that it predicts."""
    start = to_gtsam(values, held=True)
    optimizer = gtsam.GaussNewtonOptimizer(to_graph(network), start, gtsam.GaussNewtonParams())
    before = optimizer.error()
    linear = optimizer.iterate()
    moved = optimizer.values()
    return from_gtsam(moved, values), float(2.0 * (before - linear.error(start.localCoordinates(moved))))
