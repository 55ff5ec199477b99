"""Plain twins of the kernels of surfaces: sums of points over voxels and beams through them, with dicts."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np

Voxel = tuple[int, int, int]


def plain_weight(d: float, along: float) -> int:
    """Of a point for a voxel ``d`` before its plane and ``along`` from it in the plane."""
    if along >= 1.5 or not -2.0 < d < 2.0:
        return 0
    behind = min(1.0, 2.0 + d)
    return math.floor(16.0 * (1.0 - along / 1.5) * behind + 0.5)


def plain_planes(points: Any, normals: Any) -> dict[Voxel, list[int]]:
    """Of every voxel: weighted distance, weight, points inside."""
    out: dict[Voxel, list[int]] = {}
    for p, n in zip(np.asarray(points), np.asarray(normals)):
        home = np.floor(p).astype(int)
        for step in itertools.product(range(-2, 3), repeat=3):
            v = home + step
            off = v + 0.5 - p
            d = float(n @ off)
            w = plain_weight(d, math.sqrt(max(float(off @ off) - d * d, 0.0)))
            inside = int(not any(step))
            if w or inside:
                sums = out.setdefault((int(v[0]), int(v[1]), int(v[2])), [0, 0, 0])
                sums[0] += math.floor(w * d * 1024 / 16 + 0.5)
                sums[1] += w
                sums[2] += inside
    return out


def plain_pose(
    cells: dict[Voxel, tuple[float, np.ndarray, int]], R: np.ndarray, t: np.ndarray
) -> dict[Voxel, tuple[int, int]]:
    """What a piece at a pose says: weighted distance and weight of the voxels of the world.

    ``cells``: distance, gradient and weight of the piece's own voxels.
    """
    at = np.array([R @ (np.array(v) + 0.5) + t for v in cells])
    low, high = np.floor(at.min(axis=0)).astype(int) - 2, np.floor(at.max(axis=0)).astype(int) + 3
    out = {}
    for v in itertools.product(*(range(a, b) for a, b in zip(low, high))):
        q = R.T @ (np.array(v) + 0.5 - t)
        home = np.floor(q).astype(int)
        cell = cells.get((int(home[0]), int(home[1]), int(home[2])))
        if cell is not None and cell[2]:
            d = cell[0] + float(cell[1] @ (q - home - 0.5))
            out[v] = (math.floor(cell[2] * d * 1024 / 16 + 0.5), cell[2])
    return out
