"""Pieces of maps: the voxels of a submap, divided among the graph nodes on its path.

If the graph has nodes inside a submap, the submap is not rigid. Each known voxel moves with the node from whose part of
the path it was most plausibly observed.

The nearest place of the path decides, with three exceptions:

* *Floors.* Vertical distances are multiplied by `DivisionConfig.stretch`: the slab between two floors moves with the
  path on the upper floor, although the lower path can be nearer.
* *Revisits.* If the path comes within `DivisionConfig.retrace` of an earlier place, the earlier visit owns the voxels.
  They contain the sum of both visits, which cannot be divided; with the nearest place a wall would be split among both
  and could fall apart when the graph moves.
* *Entered maps.* A segment that enters an older map starts with a copy of it. Voxels farther from its path than the
  sensor range (`DivisionConfig.reach`) are dropped; :mod:`graphslam.maps.increment` subtracts the rest.

The parts of the path meet half-way between nodes, measured along the path.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.config import check_options
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
"""Name of a piece: any hashable; for submaps ``(key of the submap, node)``."""

MARGIN = 3
"""Empty bricks around the box of a piece. A world brick that overlaps the box around a rotated brick of the piece
extends at most 1 + √3/2 bricks along each axis from its centre, √3 times that in total: 3.23 < 3.5."""
TABLE_LIMIT = 1 << 26
"""Most bricks in the box around a piece: a larger box has a stray voxel."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DivisionConfig:
    """How the voxels of a submap are divided among its nodes."""

    stretch: float = 4.0
    """Factor of vertical distances relative to horizontal ones."""
    retrace: float = 1.0
    """A place within this distance of an earlier part of the path owns nothing [m]; 0 turns it off."""
    reach: float = float("inf")
    """Voxels farther from the nearest place are dropped [m]."""
    spacing: float = 0.25
    """Places of the path nearer to the previous one are skipped [m]."""

    def __post_init__(self) -> None:
        ranges = {"> 0": "stretch", "> 0 or inf": "reach", "≥ 0": "spacing retrace"}
        check_options(self, "division of a map: ", ranges)


class _Bricks:
    """Arrays of a piece in memory."""

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
        """Compressed form for the spill cache: values of known voxels only."""
        return [self.coordinates.astype(np.int32), *packed_values(self.lookup[1:]), self.extents]

    @classmethod
    def unpacked(cls, first: Ints, shape: tuple[int, ...], arrays: Arrays) -> _Bricks:
        """From the compressed form."""
        coordinates, where, known, extents = arrays
        lookup = np.empty((len(coordinates) + 1, BRICK_VOXELS), np.int16)
        lookup[0], lookup[1:] = UNKNOWN, unpacked_values(where, known)
        return cls(coordinates.astype(np.int64), lookup, extents, first, shape)


class Piece:
    """Voxels that move with one node, in the lattice of its submap's base frame. Immutable.

    Its bricks are in the spill cache (:mod:`graphslam.core.spill_cache`): get an array once and reuse it.

    Parameters
    ----------
    voxel_size : float
        [m].
    dim : {2, 3}
    coordinates : (n, 3) int64
        Signed coordinates of the bricks; each once.
    values : (n, 512) int16
        In units of `evidence.layout.STEP`, x fastest; `layout.UNKNOWN` for unknown voxels.
    T_base_node : (7,) or (3,)
        Pose of the node in the base's frame; default the identity: a submap in one piece, which moves with its base.
    """

    __slots__ = ("T_base_node", "_bricks", "corners", "dim", "first", "known", "nbytes", "voxel_size")

    first: Ints
    """Coordinates ``(3,)`` of the first brick of the box around the piece, its `MARGIN` included."""
    corners: Array
    """Corners of the box of the known voxels in the node's frame ``(8, 3)`` or ``(4, 2)`` [m]; empty without known
    voxels."""
    known: int
    """Number of known voxels."""
    nbytes: int
    """Memory of the bricks when they are loaded [bytes]."""

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
        """Brick coordinates ``(n, 3)``."""
        return self._bricks.get().coordinates

    @property
    def values(self) -> Steps:
        """Log-odds ``(n, 512)``."""
        return self._bricks.get().lookup[1:]

    @property
    def lookup(self) -> Steps:
        """``values`` after a row of unknown voxels ``(n + 1, 512)``."""
        return self._bricks.get().lookup

    @property
    def table(self) -> npt.NDArray[np.int32]:
        """Row of ``lookup`` for each brick of the box ``(nz, ny, nx)``, 0 if there is none."""
        return self._bricks.get().table

    @property
    def extents(self) -> npt.NDArray[np.int8]:
        """First known voxel of each brick and one after the last ``(n, 6)``."""
        return self._bricks.get().extents

    def __repr__(self) -> str:
        return f"Piece({self.voxel_size:g} m, {self.dim}-D, {len(self.coordinates)} bricks, {self.known} known voxels)"


def checked_poses(poses: Any, dim: int) -> Array:
    """Validated poses ``(..., 7)``, or ``(..., 3)`` in 2-D, with unit quaternions."""
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
    """Divide a submap's grid into one piece per node (see the module).

    Parameters
    ----------
    grid : EvidenceGrid
        In the base frame.
    path : Trajectory
        ``T_base_body(t)``.
    node_times : (m,)
        Ascending, within the path [s].
    T_base_nodes : (m, 7) or (m, 3), optional
        Poses of the nodes; default the body poses at these times.

    Returns
    -------
    list of Piece
        One per node, in order; empty if the node owns no voxel.
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
        points[:, 2] = 0.5  # centre of the only layer
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
    """Places ``(p, dim)`` of a path that own voxels, and their nodes ``(p,)``: downsampled, first visits only.

    The parts of two nodes meet half-way along the path; at standstill, half-way in time.
    """
    positions = path.positions
    arc = arc_length(positions)
    clock = 1e-6 * (path.times - path.times[0]) / max(path.times[-1] - path.times[0], 1e-9)  # [m]: never constant
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
            # within radius r up to π·r of path is a turn (half circle), not a revisit
            earlier = first[:k] & (s[:k] < s[k] - np.pi * config.retrace)
            first[k] = not np.any(np.linalg.norm(p[:k][earlier] - p[k], axis=1) < config.retrace)
    return p[first], owner[first]


def node_times_every(path: Trajectory, distance: float) -> Array:
    """Times ``(m,)`` along a path about every ``distance`` metres, from its start."""
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
    """The pieces of a submap by name, without empty pieces.

    Parameters
    ----------
    submap : Submap
        With a dense map.
    node_times : (m,), optional
        Without them the submap is one piece that moves with its base.
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
