"""Surface piece of one node: bricks of signed distances from its scans, in the node's frame."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from graphslam.core import se3
from graphslam.core.config import check_options
from graphslam.core.errors import ConfigError, DataError, GridError
from graphslam.core.geometry import Array
from graphslam.evidence.layout import BRICK_VOXELS
from graphslam.maps.surface.field_kernels import (
    COLUMNS,
    add_planes,
    add_rays,
    count_passing_beams,
    field_distances,
    mark_bricks,
)

Ints = npt.NDArray[np.int64]
Scan: TypeAlias = tuple[Array, Array]
"""Points ``(n, 3)`` and the position of the scanner ``(3,)``, or one per point ``(n, 3)`` [m]."""
_TABLE_LIMIT = 1 << 27


@dataclass(frozen=True, slots=True, kw_only=True)
class SurfaceConfig:
    """Configuration of the surface reconstruction."""

    voxel: float = 0.05
    """Edge of a voxel [m]."""
    normal_radius: float = 0.3
    """Radius of the neighbours for the plane of a point [m]; at least five are needed."""
    normal_neighbours: int = 30
    """… and the largest number of neighbours."""
    most_range: float = 40.0
    """Points farther from the scanner are ignored [m]."""
    data: Literal["planes", "rays"] = "planes"
    """``planes``: distances to the plane of each point; ``rays``: along its beam (truncated signed distance)."""
    enough: float = 0.06
    """Least weight of a known voxel: a point whose normal passes through its centre counts 1, at the rim 1/16."""
    flatness: float = 4.0
    """Least ratio of the scatter (squared) along the plane to that across it."""
    carving: bool = True
    """Beams carve free space."""
    carve_beams: int = 4
    """A voxel behind a surface is free if at least this number of beams passed …"""
    carve_ratio: float = 3.0
    """… and more than this per point in it."""
    smoothing: float = 0.1
    """λ: weight of curvature relative to the data (W / (W + 3) for W points); in voxel units, so that its error
    decreases with the square of the voxel size."""
    steps: int = 6
    """Steps of the evolution …"""
    redistance_steps: int = 2
    """… and of the redistancing. Both are fixed: a voxel depends only on voxels up to that distance, so changes can be
    recomputed locally with a bitwise equal result."""
    dt: float = 0.2
    """Step size of the evolution."""

    def __post_init__(self) -> None:
        ranges = {
            "> 0": "voxel normal_radius most_range enough flatness carve_ratio dt",
            "≥ 0": "smoothing steps redistance_steps",
            "≥ 1": "carve_beams",
            "≥ 5": "normal_neighbours",
        }
        check_options(self, "surface: ", ranges)
        if self.dt * (1.0 + 8.0 * self.smoothing) > 2.0:
            raise ConfigError(f"surface: smoothing {self.smoothing}, dt {self.dt}; wanted dt · (1 + 8 smoothing) ≤ 2")

    @property
    def halo(self) -> int:
        """Number of bricks that a change can reach."""
        return -(-(self.steps + self.redistance_steps) // 8)


@dataclass(frozen=True, slots=True, eq=False)
class SurfacePiece:
    """Bricks of signed distances that move with one node.

    Parameters
    ----------
    coordinates : (n, 3) int64
        Coordinates of the bricks in the node's frame; each once.
    distance : (n, 512) float32
    normal : (n, 512, 3) int8
    counts : (n, 512, 3) uint16
        Distances, their gradients, and weight, passing beams and points of every voxel; see
        :func:`~graphslam.maps.surface.field_kernels.field_distances`.
    """

    coordinates: Ints
    distance: npt.NDArray[np.float32]
    normal: npt.NDArray[np.int8]
    counts: npt.NDArray[np.uint16]
    first: Ints = field(init=False, repr=False)
    table: npt.NDArray[np.int32] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        c = np.ascontiguousarray(self.coordinates, dtype=np.int64).reshape(-1, 3)
        for name, last in (("distance", ()), ("normal", (3,)), ("counts", (3,))):
            got, wanted = getattr(self, name).shape, (len(c), BRICK_VOXELS, *last)
            if got != wanted:
                raise GridError(f"{name} of a surface piece", got=got, wanted=wanted)
        first, shape = _box(c)
        table = np.zeros(shape[::-1], np.int32)
        at = c - first
        table[at[:, 2], at[:, 1], at[:, 0]] = np.arange(1, len(c) + 1)
        for name, value in (("coordinates", c), ("first", first), ("table", table)):
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.coordinates)

    @property
    def nbytes(self) -> int:
        """Memory [bytes]."""
        return sum(a.nbytes for a in (self.coordinates, self.table, self.distance, self.normal, self.counts))


def _box(coordinates: Ints) -> tuple[Ints, Ints]:
    """First brick ``(3,)`` and shape of the bounding box of bricks."""
    if not len(coordinates):
        return np.zeros(3, np.int64), np.zeros(3, np.int64)
    first = coordinates.min(axis=0)
    shape = coordinates.max(axis=0) - first + 1
    if float(np.prod(shape.astype(np.float64))) > _TABLE_LIMIT:
        raise GridError("a piece of a surface is too wide: is there a stray point in it?", got=(8 * shape).tolist())
    return first, shape


def normals_of(points: Array, towards: Array, config: SurfaceConfig) -> Array:
    """Normals ``(n, 3)`` of points, oriented towards the sensor positions ``(n, 3)``; NaN with too few neighbours.

    A normal is the direction of least scatter of the neighbours.
    """
    out = np.full((len(points), 3), np.nan)
    if len(points) < 5:
        return out
    most = min(config.normal_neighbours, len(points))
    reach, index = cKDTree(points).query(points, k=most, distance_upper_bound=config.normal_radius)
    near = np.isfinite(reach)
    at = points[np.where(near, index, 0)]
    count = near.sum(axis=1)
    mean = np.einsum("nk,nkj->nj", near, at) / np.maximum(count, 1)[:, None]
    off = (at - mean[:, None]) * near[..., None]
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", off, off))
    n = vectors[..., 0]
    n = n * np.where(np.sum(n * (towards - points), axis=1) < 0.0, -1.0, 1.0)[:, None]
    flat = (count >= 5) & (values[:, 1] > config.flatness * values[:, 0])  # points on a line define no plane
    out[flat] = n[flat]
    return out


def piece_of_scans(scans: Iterable[Scan], pose: Array, config: SurfaceConfig) -> SurfacePiece:
    """The piece of a node at ``pose`` ``(7,)`` from scans with points and scanner positions in the world frame."""
    parts, origins = [], []
    to_node = se3.se3_inverse(np.asarray(pose, dtype=np.float64))
    for points, origin in scans:
        p = np.asarray(points, dtype=np.float64)
        if p.ndim != 2 or p.shape[1] != 3 or not np.all(np.isfinite(p)):
            raise DataError("impossible points of a surface", got=p.shape, wanted="(n, 3), finite")
        o = np.broadcast_to(np.asarray(origin, dtype=np.float64), p.shape)
        near = np.linalg.norm(p - o, axis=1) < config.most_range
        back = np.broadcast_to(to_node, (int(near.sum()), 7))
        parts.append(se3.se3_transform(back, p[near]))
        origins.append(se3.se3_transform(back, o[near]))
    if not parts:
        return _piece_of_sums(np.zeros((0, 3), np.int64), np.zeros((0, BRICK_VOXELS, COLUMNS), np.int32))
    own, seen_from = np.concatenate(parts), np.concatenate(origins)
    if config.data == "rays":
        return piece_of_planes(own, seen_from, np.zeros_like(own), np.ones(len(own), np.bool_), config)
    normals = normals_of(own, seen_from, config)
    flat = np.isfinite(normals[:, 0])
    return piece_of_planes(own, seen_from, np.where(flat[:, None], normals, 0.0), flat, config)


def piece_of_planes(
    points: Array, seen_from: Array, normals: Array, flat: npt.NDArray[np.bool_], config: SurfaceConfig
) -> SurfacePiece:
    """A piece from points ``(n, 3)`` with normals in the node's frame; points that are not ``flat`` only carve."""
    p = np.ascontiguousarray(points / config.voxel)
    at = np.floor(p[flat]).astype(np.int64) // 8
    first, shape = _box(at)
    table = np.zeros((shape + 2 * (shape > 0))[::-1], np.int32)
    first = first - 1
    mark_bricks(p[flat], first, table)
    where = np.argwhere(table)
    table[where[:, 0], where[:, 1], where[:, 2]] = np.arange(1, len(where) + 1)
    sums = np.zeros((len(where), BRICK_VOXELS, COLUMNS), np.int32)
    beams = np.ascontiguousarray(seen_from / config.voxel)
    if config.data == "rays":
        add_rays(p, beams, first, table, sums)
    else:
        add_planes(p[flat], np.ascontiguousarray(normals[flat]), first, table, sums)
    if config.carving and len(where):
        count_passing_beams(p, beams, 2.5, first, table, sums)
    return _piece_of_sums(where[:, ::-1] + first, sums)


def _piece_of_sums(coordinates: Ints, sums: npt.NDArray[np.int32]) -> SurfacePiece:
    n = len(coordinates)
    distance, normal = np.zeros((n, BRICK_VOXELS), np.float32), np.zeros((n, BRICK_VOXELS, 3), np.int8)
    counts = np.zeros((n, BRICK_VOXELS, 3), np.uint16)
    field_distances(sums, distance, normal, counts)
    return SurfacePiece(coordinates, distance, normal, counts)
