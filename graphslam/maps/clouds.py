"""One cloud from the clouds of all submaps: each point moves with the node of the nearest part of the path."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial import cKDTree

from graphslam.core.dense import CloudMap
from graphslam.core.geometry import Array
from graphslam.core.points import voxel_downsample
from graphslam.core.poses import group_of, remove_roll_pitch
from graphslam.core.submap import Submap
from graphslam.evidence.views import dense_view, has_dense_view
from graphslam.maps.pieces import DivisionConfig, owning_places
from graphslam.maps.submaps import local_nodes


def fused_points(
    submaps: Sequence[Submap],
    nodes: Mapping[int, tuple[Array, Array]],
    *,
    level_nodes: bool = False,
    config: DivisionConfig | None = None,
) -> Array | None:
    """Points ``(n, dim)`` of all clouds in the world [m], downsampled to their smallest cell; None without clouds.

    Parameters
    ----------
    nodes : mapping of key to ((m,), (m, 3|7))
        Times of the graph's nodes in each submap [s], its base first, and ``T_world_node``.
    level_nodes : bool
        As in `graphslam.maps.submaps.divide_submaps`.
    """
    made, cells = [], []
    for s in submaps:
        cloud = dense_view(s).cloud if has_dense_view(s) else None
        if cloud is None:
            continue
        times, T_world = nodes[s.key]
        local = local_nodes(s, times, level_nodes) if len(times) > 1 else group_of(T_world).identity[None]
        T_world = remove_roll_pitch(T_world) if level_nodes else T_world
        made.append(_placed(cloud, s, times, local, T_world, DivisionConfig() if config is None else config))
        cells.append(cloud.cell)
    if not made:
        return None
    points = np.concatenate(made)
    made.clear()
    return voxel_downsample(points, min(cells))


def _placed(cloud: CloudMap, s: Submap, times: Array, local: Array, T_world: Array, config: DivisionConfig) -> Array:
    """Points of one cloud in the world, each moved with its node."""
    g, p = group_of(T_world), cloud.points
    owner = np.zeros(len(p), np.int64)
    if len(times) > 1 and s.trajectory is not None:
        places, nodes = owning_places(s.trajectory, times, config)
        scale = np.array([1.0, 1.0, config.stretch])[: g.dim]
        owner = nodes[cKDTree(places * scale).query(p * scale)[1]]
    T = g.compose(T_world, g.inverse(local))  # T_world_base according to each node
    return np.asarray(g.transform(T[owner], p))
