"""A pose network as GTSAM factors, native types only."""

from __future__ import annotations

import re
from itertools import compress
from typing import cast

import gtsam
import numpy as np
import numpy.typing as npt

from graphslam.core.errors import IndeterminateError
from graphslam.core.network import PoseNetwork
from graphslam.graph.factor_arrays import FactorArrays
from graphslam.graph.factors.batch import gtsam_poses
from graphslam.graph.factors.between import BetweenBatch
from graphslam.graph.factors.sighting import SightingBatch
from graphslam.graph.network import problem_of_network
from graphslam.graph.variables import gtsam_key


def measured_factors(flat: FactorArrays) -> list[list[gtsam.NonlinearFactor]]:
    """Native factors of the edges, and of the observations."""
    found = [cast("BetweenBatch | SightingBatch", f).natives for f in flat.batches]
    return [found[0], found[1] if len(found) > 1 else []]


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
    held = gtsam_poses(network.poses[anchors])
    keys = (gtsam_key("x0") + anchors).tolist()
    return [make(k, pose, noise) for k, pose in zip(keys, held, strict=True)]


def to_graph(
    network: PoseNetwork, used: npt.NDArray[np.bool_] | None = None, flat: FactorArrays | None = None
) -> gtsam.NonlinearFactorGraph:
    """Anchors, then edges, then observations; of these two only where ``used`` (m + k,) says so, if given."""
    graph = gtsam.NonlinearFactorGraph()
    edges, observations = measured_factors(flat or problem_of_network(network, ordered=False))
    measured = edges + observations
    for factor in anchor_factors(network):
        graph.add(factor)
    for factor in measured if used is None else compress(measured, used.tolist()):
        graph.add(factor)
    return graph


def translate_indeterminate(network: PoseNetwork, error: Exception) -> IndeterminateError:
    """Turn GTSAM's message about a key into one about the file's vertices."""
    found = re.search(r"Symbol: (x|l)(\d+)", str(error))
    names: tuple[str, ...] = ()
    if found is not None:
        k = int(found[2])
        names = (f"landmark {k}" if found[1] == "l" else f"vertex {network.ids[k]}",)
    where = f" near {names[0]}" if names else ""
    return IndeterminateError(
        f"{network.source}: the network does not determine every variable{where}: it needs another edge there, an edge "
        "with information in every direction, or a FIX",
        names,
    )
