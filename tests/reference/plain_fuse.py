"""Slow, obvious twins of divided and fused maps: dictionaries of voxels, one voxel at a time."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from graphslam.core.poses import SE2, SE3
from graphslam.core.se3 import pose_to_matrix
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.layout import UNKNOWN
from graphslam.maps.pieces import Piece

Voxel = tuple[int, int, int]


def voxels_of(coordinates: np.ndarray, values: np.ndarray) -> dict[Voxel, int]:
    """Known voxels by their signed coordinates."""
    out = {}
    for brick, row in zip(coordinates.tolist(), values):
        for v in np.flatnonzero(row != UNKNOWN).tolist():
            out[8 * brick[0] + (v & 7), 8 * brick[1] + (v >> 3 & 7), 8 * brick[2] + (v >> 6)] = int(row[v])
    return out


def voxels_of_grid(grid: EvidenceGrid) -> dict[Voxel, int]:
    return voxels_of(grid.brick_coordinates(), grid.brick_values())


def matrix(T: Any) -> np.ndarray:
    """``(4, 4)`` of a pose of either dimension."""
    T = np.asarray(T, dtype=np.float64)
    if len(T) == 7:
        return pose_to_matrix(T)
    c, s = math.cos(T[2]), math.sin(T[2])
    return np.array([[c, -s, 0, T[0]], [s, c, 0, T[1]], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def posed_voxels(piece: Piece, T_world_node: Any) -> dict[Voxel, int]:
    """Every voxel of the world whose centre lies in a known voxel of the piece takes its value."""
    known = voxels_of(piece.coordinates, piece.values)
    if not known:
        return {}
    group = SE3 if piece.dim == 3 else SE2
    M = matrix(group.compose(np.asarray(T_world_node, dtype=np.float64), group.inverse(piece.T_base_node)))
    inverse = np.linalg.inv(M)
    ends = np.array(list(known)) * piece.voxel_size
    low, high = ends.min(axis=0), ends.max(axis=0) + piece.voxel_size
    corners = np.array([[*c, 1.0] for c in itertools.product(*zip(low, high))]) @ M.T
    first = np.floor(corners[:, :3].min(axis=0) / piece.voxel_size).astype(int) - 1
    last = np.ceil(corners[:, :3].max(axis=0) / piece.voxel_size).astype(int) + 1
    if piece.dim == 2:
        first[2], last[2] = 0, 1
    out = {}
    for voxel in itertools.product(*(range(a, b) for a, b in zip(first, last))):
        centre = [(i + 0.5) * piece.voxel_size for i in voxel]
        at = inverse @ [*centre, 1.0]
        there = tuple(math.floor(x / piece.voxel_size) for x in at[:3])
        if there in known:
            out[voxel] = known[there]
    return out


def fused_voxels(pieces: Mapping[Any, Piece], poses: Mapping[Any, Any], clamp: tuple[int, int]) -> dict[Voxel, int]:
    """Log-odds added up in full, then clamped."""
    total: dict[Voxel, int] = {}
    for name, piece in pieces.items():
        for voxel, value in posed_voxels(piece, poses[name]).items():
            total[voxel] = total.get(voxel, 0) + value
    return {voxel: min(max(value, clamp[0]), clamp[1]) for voxel, value in total.items()}


def nearest_owner(
    voxel: Voxel, size: float, places: np.ndarray, nodes: np.ndarray, stretch: float, reach: float
) -> int:
    """Node of the place of a path ``(p, 3)`` [m] nearest to a voxel's centre, heights stretched; -1 out of reach."""
    centre = (np.array(voxel) + 0.5) * size
    d = (places - centre) * [1.0, 1.0, stretch]
    k = int(np.argmin(np.sum(d**2, axis=1)))
    return int(nodes[k]) if np.linalg.norm(places[k] - centre) <= reach else -1
