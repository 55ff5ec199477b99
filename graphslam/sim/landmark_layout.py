"""Feature positions of the landmark field: scattered, in close pairs, in two rows along the route."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from graphslam.core.geometry import Array
from graphslam.core.random import SeedTree
from graphslam.sim.landmark_config import LandmarkFieldConfig
from graphslam.sim.vehicle import offset_from_route, wavy_loop


def landmark_layout(config: LandmarkFieldConfig, seed: int) -> tuple[Array, Array]:
    """Route and features of a world, from the layout's own branch of the seed.

    Returns
    -------
    route : (m, 2)
    features : (n, 2)
        In the first base's frame: ``config.landmarks`` scattered ones (the first ``pair_fraction`` of them in pairs,
        numbers 2k and 2k + 1), then the left row, then the right row, both in the direction of travel.
    """
    route = wavy_loop(config.lap_length, config.route_waves, config.route_amplitude)
    layout_seed = seed if config.layout_seed is None else config.layout_seed
    branch = SeedTree(layout_seed).child("landmark-field", "layout")
    rng = branch.generator()
    s = rng.uniform(0.0, config.lap_length, config.landmarks)
    side = rng.choice([-1.0, 1.0], config.landmarks)
    lateral = rng.uniform(config.lateral_min, config.lateral_max, config.landmarks)
    scattered = offset_from_route(route, s, side * lateral)
    _pair(config, route, scattered, branch.child("pairs").generator())
    return route, np.vstack([scattered, _rows(config, route, branch.child("rows").generator())])


def _pair(config: LandmarkFieldConfig, route: Array, points: Array, rng: np.random.Generator) -> None:
    """Move every second of the first features beside the one before it."""
    pairs = int(config.pair_fraction * config.landmarks) // 2
    angle = rng.uniform(-np.pi, np.pi, pairs)
    step = config.pair_distance * np.stack([np.cos(angle), np.sin(angle)], -1)
    stems = points[0 : 2 * pairs : 2]
    # a twin nearer to the route than its stem is moved to the other side of the stem, away from the road
    tree = cKDTree(route)
    inward = tree.query(stems + step)[0] < tree.query(stems)[0]
    points[1 : 2 * pairs : 2] = stems + np.where(inward[:, None], -step, step)


def _rows(config: LandmarkFieldConfig, route: Array, rng: np.random.Generator) -> Array:
    """Both rows of an avenue ``(2 row_periods, 2)``."""
    n = config.row_periods
    s = (np.arange(n) + 0.5) * config.lap_length / max(n, 1)
    out = []
    for side in (1.0, -1.0):
        along, across = config.row_jitter * rng.standard_normal((2, n))
        out.append(offset_from_route(route, s + along, side * config.row_lateral + across))
    return np.vstack(out)
