"""Pieces of maps: what a submap knows, divided among the nodes of the graph that lie along its path.

A submap is rigid only as long as the graph bends at its ends alone. With nodes inside, each known voxel goes with the
node whose stretch of the path saw it most plausibly, and moves with that node.

**Whose voxel?** The nearest place of the path decides, with three amendments:

* *Storeys.* Heights count more than distances along the floor (`DivisionConfig.stretch`): of two paths one above the
  other, the floor slab between them goes with the upper one, which it carries, although the lower one may pass nearer.
* *Out and back.* Where the path comes within `DivisionConfig.retrace` of a place where it was before, the earlier visit
  owns. Voxels there hold the evidence of both visits, added up, and cannot be divided; the nearest place would deal a
  wall out by centimetres, and the graph could then tear it into dust. So the whole wall goes with one.
* *Maps that were entered again.* A segment that enters an older map begins with a copy of it. What lies farther from
  its path than its sensor reaches (`DivisionConfig.reach`) it cannot have seen; :mod:`graphslam.maps.increment` takes
  the rest of the older evidence out.

Stretches meet half-way between nodes, measured along the path, so that no voxel is led by a node that is farther along
than another.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.errors import ConfigError, DataError, GeometryError, GridError
from graphslam.core.geometry import Array, arc_length
from graphslam.core.poses import SE2, SE3
from graphslam.core.spill_cache import SPILL_CACHE, Arrays
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.layout import BRICK_EDGE, BRICK_VOXELS, UNKNOWN
from graphslam.evidence.spilled_grid import packed_values, unpacked_values
from graphslam.evidence.views import dense_view
from graphslam.maps.piece_kernels import count_owned, distribute_voxels, known_extents, own_voxels

Ints = npt.NDArray[np.int64]
Steps = npt.NDArray[np.int16]
PieceId: TypeAlias = Hashable
"""What a piece is called: anything that may be a key of a mapping; of submaps ``(key of the submap, node)``."""

MARGIN = 3
"""Bricks of nothing around the box of a piece. A brick of the world that meets the box around a turned brick of the
piece reaches at most 1 + √3/2 bricks along each axis from its middle, √3 times as far in all: 3.23, less than 3.5."""
TABLE_LIMIT = 1 << 26
"""Bricks of the box around a piece at most: what is wider than that is a stray beam, not a place."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DivisionConfig:
    """How the voxels of a submap are divided among its nodes."""

    stretch: float = 4.0
    """By how much more heights count than distances along the floor."""
    retrace: float = 1.0
    """A place within this of one where the path was before owns nothing [m]; 0 turns it off."""
    reach: float = float("inf")
    """Voxels farther from the nearest place belong to nobody [m]."""
    spacing: float = 0.25
    """Places of the path nearer to the one before are left out [m]."""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.stretch) and self.stretch > 0 and self.reach > 0 and self.spacing >= 0):
            raise ConfigError(
                f"division of a map: stretch {self.stretch}, reach {self.reach}, spacing {self.spacing}; wanted > 0"
            )
        if not (np.isfinite(self.retrace) and self.retrace >= 0 and np.isfinite(self.spacing)):
            raise ConfigError(f"division of a map: retrace {self.retrace}, spacing {self.spacing}; wanted ≥ 0 m")


class _Bricks:
    """Arrays of a piece, as they are needed."""

    __slots__ = ("__weakref__", "coordinates", "extents", "lookup", "table")

    def __init__(
        self, coordinates: Ints, lookup: Steps, extents: npt.NDArray[np.int8], first: Ints, shape: tuple[int, ...]
    ) -> None:
        self.coordinates, self.lookup, self.extents = coordinates, lookup, extents
        self.table = np.zeros(shape, np.int32)
        at = coordinates - first
        self.table[at[:, 2], at[:, 1], at[:, 0]] = np.arange(1, len(at) + 1)

    @property
    def nbytes(self) -> int:
        """Memory [bytes]."""
        return self.lookup.nbytes + self.table.nbytes + self.coordinates.nbytes

    def packed(self) -> Arrays:
        """For the shelf: values of known voxels only."""
        return [self.coordinates.astype(np.int32), *packed_values(self.lookup[1:]), self.extents]

    @classmethod
    def unpacked(cls, first: Ints, shape: tuple[int, ...], arrays: Arrays) -> _Bricks:
        """From the shelf."""
        coordinates, where, known, extents = arrays
        lookup = np.empty((len(coordinates) + 1, BRICK_VOXELS), np.int16)
        lookup[0], lookup[1:] = UNKNOWN, unpacked_values(where, known)
        return cls(coordinates.astype(np.int64), lookup, extents, first, shape)


class Piece:
    """Voxels that move with one node: a value that does not change, in the lattice of the frame of its submap's base.

    Its bricks lie on the shelf of the process (:mod:`graphslam.core.spill_cache`): take an array of them once, and use
    it.

    Parameters
    ----------
    voxel_size : float
        [m].
    dim : {2, 3}
    coordinates : (n, 3) int64
        Signed, of the bricks; each once.
    values : (n, 512) int16
        In units of `evidence.layout.STEP`, x fastest; `layout.UNKNOWN` where the piece knows nothing.
    T_base_node : (7,) or (3,)
        Pose of the node in the base's frame; default the identity: a submap in one piece, led by its base.
    """

    __slots__ = ("T_base_node", "_bricks", "corners", "dim", "first", "known", "nbytes", "voxel_size")

    first: Ints
    """Coordinates ``(3,)`` of the first brick of the box around the piece, its `MARGIN` included."""
    corners: Array
    """Of the box of the known voxels, in the node's frame ``(8, 3)`` or ``(4, 2)`` [m]; none of an empty piece."""
    known: int
    """Known voxels."""
    nbytes: int
    """Memory of the bricks, while they are in it [bytes]."""

    def __init__(self, voxel_size: float, dim: int, coordinates: Any, values: Any, T_base_node: Any = None) -> None:
        c = np.ascontiguousarray(coordinates, dtype=np.int64)
        v = np.ascontiguousarray(values)
        if dim not in (2, 3) or not (np.isfinite(voxel_size) and voxel_size > 0):
            raise GridError("impossible piece of a map", got=f"{dim}-D, voxels of {voxel_size} m")
        if c.ndim != 2 or c.shape[1] != 3 or v.shape != (len(c), BRICK_VOXELS) or v.dtype != np.int16:
            raise GridError(
                "bricks of a piece have the wrong shape or type",
                got=f"{c.shape}, {v.shape} {v.dtype}",
                wanted=f"(n, 3) and (n, {BRICK_VOXELS}) int16",
            )
        first = (c.min(axis=0) if len(c) else np.zeros(3, np.int64)) - MARGIN
        shape = ((c.max(axis=0) - first) if len(c) else np.zeros(3, np.int64)) + 1 + MARGIN
        if float(np.prod(shape.astype(np.float64))) > TABLE_LIMIT:
            raise GridError(
                "a piece of a map is too wide: is there a stray voxel in it?",
                got=f"{(shape * BRICK_EDGE * voxel_size).round().tolist()} m",
                wanted=f"at most {TABLE_LIMIT} bricks in the box around it",
            )
        lookup = np.empty((len(c) + 1, BRICK_VOXELS), np.int16)
        lookup[0], lookup[1:] = UNKNOWN, v
        box, extents = np.empty(6, np.int64), np.empty((len(c), 6), np.int8)
        size = tuple(shape[::-1].tolist())
        bricks = _Bricks(c, lookup, extents, first, size)
        if np.count_nonzero(bricks.table) != len(c):
            raise GridError("a brick is repeated in a piece", wanted="each brick once")
        if dim == 2 and len(c) and (np.any(c[:, 2]) or np.any(v[:, 64:] != UNKNOWN)):
            raise GridError("a 2-D piece leaves its layer", got=f"bricks {np.unique(c[:, 2]).tolist()}", wanted="k = 0")
        group = SE3 if dim == 3 else SE2
        T = checked_poses(group.identity if T_base_node is None else T_base_node, dim)
        self.known = int(known_extents(c, lookup[1:], extents, box))
        self.voxel_size, self.dim, self.T_base_node = float(voxel_size), dim, T
        self.first, self.nbytes = first, bricks.nbytes
        ends = box.reshape(2, 3)[:, :dim] * voxel_size
        which = np.stack(np.meshgrid(*[[0, 1]] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
        base = ends[which, np.arange(dim)] if self.known else np.zeros((0, dim))
        self.corners = group.transform(group.inverse(np.broadcast_to(T, (len(base), group.size))), base)
        self._bricks = SPILL_CACHE.put(bricks, bricks.nbytes, _Bricks.packed, partial(_Bricks.unpacked, first, size))

    @property
    def coordinates(self) -> Ints:
        """Of the bricks ``(n, 3)``."""
        return self._bricks.get().coordinates

    @property
    def values(self) -> Steps:
        """``(n, 512)``."""
        return self._bricks.get().lookup[1:]

    @property
    def lookup(self) -> Steps:
        """``values`` after a row that is all unknown ``(n + 1, 512)``."""
        return self._bricks.get().lookup

    @property
    def table(self) -> npt.NDArray[np.int32]:
        """Rows of ``lookup`` of the bricks of the box around it ``(nz, ny, nx)``, 0 where there is none."""
        return self._bricks.get().table

    @property
    def extents(self) -> npt.NDArray[np.int8]:
        """Of the known voxels of each brick: first one, and the one after the last ``(n, 6)``."""
        return self._bricks.get().extents

    def __repr__(self) -> str:
        return f"Piece({self.voxel_size:g} m, {self.dim}-D, {len(self.coordinates)} bricks, {self.known} known voxels)"


def checked_poses(poses: Any, dim: int) -> Array:
    """Poses ``(..., 7)``, or ``(..., 3)`` in 2-D, as floats, quaternions of unit length."""
    T = np.array(poses, dtype=np.float64)
    size = 7 if dim == 3 else 3
    if T.ndim < 1 or T.shape[-1] != size:
        raise GeometryError(f"a pose of a {dim}-D map has the wrong shape", got=T.shape, wanted=f"(..., {size})")
    if not np.all(np.isfinite(T)):
        raise GeometryError("a pose of a map is not finite", got=T[~np.isfinite(T).all(axis=-1)][:1].tolist())
    if dim == 3:
        T[..., 3:] = se3.quat_normalize(T[..., 3:])
    return T


def piece_of_grid(grid: EvidenceGrid, T_base_node: Any = None) -> Piece:
    """A grid in one piece.

    Parameters
    ----------
    T_base_node : (7,) or (3,), optional
        Default the identity.
    """
    return Piece(
        grid.voxel_size,
        grid.dim,
        grid.brick_coordinates(),
        grid.brick_values(),
        T_base_node,
    )


def divide_grid(
    grid: EvidenceGrid,
    path: Trajectory,
    node_times: Any,
    *,
    T_base_nodes: Any = None,
    config: DivisionConfig | None = None,
) -> list[Piece]:
    """A submap's grid, one piece for each node (see the module).

    Parameters
    ----------
    grid : EvidenceGrid
        In the base's frame.
    path : Trajectory
        ``T_base_body(t)``.
    node_times : (m,)
        Ascending, within the path [s].
    T_base_nodes : (m, 7) or (m, 3), optional
        Poses of the nodes; default the body's at those times.

    Returns
    -------
    list of Piece
        As many as nodes, in their order; a node that owns nothing has an empty piece.
    """
    config = DivisionConfig() if config is None else config
    times = np.asarray(node_times, dtype=np.float64)
    if times.ndim != 1 or len(times) == 0 or not np.all(np.diff(times) > 0):
        raise DataError("times of the nodes of a submap", got=times, wanted="(m,), m ≥ 1, ascending")
    if path.dim != grid.dim:
        raise DataError("a path and a grid of different dimensions", got=f"{path.dim}-D", wanted=f"{grid.dim}-D")
    T_nodes = checked_poses(path.interpolate(times) if T_base_nodes is None else T_base_nodes, grid.dim)
    if len(T_nodes) != len(times):
        raise DataError("poses and times of the nodes differ in number", got=len(T_nodes), wanted=len(times))
    coordinates, values = grid.brick_coordinates(), grid.brick_values()
    places, nodes = owning_places(path, times, config)
    owners = np.empty((len(values), BRICK_VOXELS), np.int32)
    points = np.zeros((len(places), 3))
    points[:, : grid.dim] = places / grid.voxel_size
    if grid.dim == 2:
        points[:, 2] = 0.5  # the middle of the only layer
    points[:, 2] *= config.stretch
    own_voxels(
        coordinates, values, config.stretch, points, nodes, config.reach / grid.voxel_size,
        1 if grid.dim == 2 else BRICK_EDGE, owners,
    )  # fmt: skip
    counts = np.zeros(len(times), np.int64)
    count_owned(owners, counts)
    ends = np.cumsum(counts)
    dealt = np.full((int(ends[-1]), BRICK_VOXELS), UNKNOWN, np.int16)
    rows = np.empty(int(ends[-1]), np.int64)
    distribute_voxels(owners, values, ends - counts, rows, dealt)
    return [
        Piece(grid.voxel_size, grid.dim, coordinates[rows[a:b]], dealt[a:b], T)
        for a, b, T in zip((ends - counts).tolist(), ends.tolist(), T_nodes)
    ]


def owning_places(path: Trajectory, node_times: Array, config: DivisionConfig) -> tuple[Array, Ints]:
    """Places ``(p, dim)`` of a path that own voxels, and their nodes ``(p,)``: thinned, first visits only.

    Stretches meet half-way between nodes along the path; where the body stands, half-way in time.
    """
    positions = path.positions
    arc = arc_length(positions)
    clock = 1e-6 * (path.times - path.times[0]) / max(path.times[-1] - path.times[0], 1e-9)  # [m]: tells standing apart
    along = arc + clock
    node_arc = np.interp(node_times, path.times, along)
    nodes = np.searchsorted(0.5 * (node_arc[:-1] + node_arc[1:]), along, side="right")
    keep: list[int] = []
    for k in range(len(positions)):
        last = keep[-1] if keep else -1
        if last < 0 or nodes[k] != nodes[last] or np.linalg.norm(positions[k] - positions[last]) >= config.spacing:
            keep.append(k)
    p, owner, s = positions[keep], nodes[keep].astype(np.int64), arc[keep]
    first = np.ones(len(p), bool)
    if config.retrace > 0:
        for k in range(len(p)):
            # π·r of way within r is a turn and no more: the far side of a half circle of that radius
            earlier = first[:k] & (s[:k] < s[k] - np.pi * config.retrace)
            first[k] = not np.any(np.linalg.norm(p[:k][earlier] - p[k], axis=1) < config.retrace)
    return p[first], owner[first]


def node_times_every(path: Trajectory, distance: float) -> Array:
    """Times ``(m,)`` along a path about every ``distance`` metres, beginning at its first."""
    if not (np.isfinite(distance) and distance > 0):
        raise ConfigError(f"nodes every {distance} m; wanted > 0")
    arc = arc_length(path.positions)
    count = max(round(float(arc[-1]) / distance), 1)
    index = np.searchsorted(arc, arc[-1] * np.arange(count) / count, side="left")
    return path.times[np.unique(index)]


def pieces_of_submap(
    submap: Submap,
    node_times: Any = None,
    *,
    T_base_nodes: Any = None,
    names: Sequence[PieceId] | None = None,
    config: DivisionConfig | None = None,
) -> dict[PieceId, Piece]:
    """The pieces of a submap by name; nodes that own nothing are left out.

    Parameters
    ----------
    submap : Submap
        With a dense map.
    node_times : (m,), optional
        Without, the submap is one piece led by its base.
    T_base_nodes : (m, 7) or (m, 3), optional
    names : sequence, optional
        Default ``(key, 0)``, ``(key, 1)`` …
    """
    grid = dense_view(submap).evidence()
    if node_times is None:
        pieces = [piece_of_grid(grid)]
    elif submap.trajectory is None:
        raise DataError(f"submap {submap.key} has no path to divide it along", wanted="a trajectory")
    else:
        pieces = divide_grid(grid, submap.trajectory, node_times, T_base_nodes=T_base_nodes, config=config)
    called: Sequence[PieceId] = [(submap.key, k) for k in range(len(pieces))] if names is None else names
    if len(called) != len(pieces) or len(set(called)) != len(called):
        raise DataError("names of pieces differ in number, or are repeated", got=called, wanted=f"{len(pieces)} names")
    return {name: piece for name, piece in zip(called, pieces) if piece.known}
