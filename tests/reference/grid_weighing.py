"""The slow obvious twin of weighing particles: beam by beam, voxel by voxel, in plain Python."""

from __future__ import annotations

import math

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.poses import group_of
from graphslam.evidence.grid import EvidenceGrid
from graphslam_frontends.grid.config import GridFilterConfig


def probability(grid: EvidenceGrid, point: Array, unknown: float) -> float:
    """Occupancy at a point, between the centres of the voxels around it."""
    d = grid.dim
    u = point / grid.voxel_size - 0.5
    low = np.floor(u)
    total = 0.0
    for corner in range(2**d):
        bits = np.array([(corner >> a) & 1 for a in range(d)])
        share = float(np.prod(np.where(bits == 1, u - low, 1.0 - (u - low))))
        value = float(grid.log_odds_at(((low + bits + 0.5) * grid.voxel_size)[None])[0])
        total += share * (unknown if math.isnan(value) else 1.0 / (1.0 + math.exp(-value)))
    return total


def endpoint_gains(
    grids: list[EvidenceGrid], poses: Array, points: Array, exponent: float, config: GridFilterConfig
) -> Array:
    """Tempered log-likelihoods ``(N,)`` of the ends of beams ``(m, dim)`` in each particle's own map."""
    transform = group_of(poses).transform
    out = np.zeros(len(grids))
    for i, (grid, pose) in enumerate(zip(grids, poses)):
        for point in points:
            p = probability(grid, transform(pose, point), config.unknown)
            out[i] += exponent * math.log(config.floor + (1.0 - config.floor) * p)
    return out
