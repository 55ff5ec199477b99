"""FusedMap: one evidence grid of many pieces, recomputed only where pieces moved, without reading scans again.

Each piece (:mod:`graphslam.maps.pieces`) is resampled on the world lattice once per pose: every world voxel gets the
value of the piece's voxel at its centre, as in `EvidenceGrid.merge`. The map is the sum of the resampled pieces
(SegSLAM A12: maps are merged by adding their log-odds), **clamped once at the end**. Therefore the map does not depend
on the order of the pieces; clamping after each piece, as repeated merging does, would. A piece cannot be subtracted
from a clamped sum: if a piece moves, all bricks that it touched before or touches now are summed again from all their
pieces.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import ConfigError, DataError, GridError
from graphslam.core.geometry import Array
from graphslam.core.interrupt import defer_interrupts
from graphslam.core.poses import SE2, SE3
from graphslam.evidence.batch import write_packed
from graphslam.evidence.beams import BeamModel
from graphslam.evidence.compact import compact_grids
from graphslam.evidence.contents import entropy_of_counts
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.layout import BRICK_EDGE, BRICK_VOXELS, MAX_LEVELS, half_edge
from graphslam.evidence.pool import GridPool
from graphslam.evidence.scan import pose_rows
from graphslam.maps.coarse import pool_levels
from graphslam.maps.fuse_kernels import count_changes, find_bricks
from graphslam.maps.pieces import MARGIN, Piece, PieceId, checked_poses
from graphslam.maps.transformed_piece import PieceTransformer, TransformedPiece

Ints = npt.NDArray[np.int64]
Names = Iterable[PieceId]

TOLERANCE = 0.25
"""Default of :class:`FusedMap` [voxels]: half of the largest rounding error of the lattice along an axis."""
_NONE = np.zeros(0, np.int64)


@dataclass(frozen=True, slots=True)
class MapChange:
    """Result of a change of a fused map.

    Parameters
    ----------
    added, removed, moved : int
        Number of pieces.
    held : int
        Pieces that stay because their move is smaller than the tolerance.
    summed : int
        Bricks that were summed again.
    written : int
        Of these, bricks that changed.
    """

    added: int
    removed: int
    moved: int
    held: int
    summed: int
    written: int


class FusedMap:
    """Pieces with their poses, and their fused evidence grid. Not thread-safe.

    Parameters
    ----------
    voxel_size : float
        Of the pieces and of the map [m].
    dim : {3, 2}
    model : BeamModel, optional
        Its clamp limits the sums; its threshold defines occupied voxels.
    tolerance : float
        A piece stays until a point of it would move by more than this [voxels]. The distance is from its pose in the
        map, so small moves cannot accumulate. 0 follows every move.
    pool : GridPool, optional
        Storage of the grid. Its levels limit the size of the map; the default is a new pool, which gets more levels
        when pieces need them, up to ± 13 km with 0.2 m voxels.
    threads : int
        Threads for resampling; they do not change the map.

    Examples
    --------
    >>> import numpy as np
    >>> from graphslam.evidence.grid import EvidenceGrid
    >>> from graphslam.maps.pieces import piece_of_grid
    >>> grid = EvidenceGrid(0.1)
    >>> _ = grid.insert_scan([[2.0, 0.0, 0.0], [2.0, 0.5, 0.0]])
    >>> fused = FusedMap(0.1)
    >>> at = np.array([0.0, 0, 0, 0, 0, 0, 1])
    >>> _ = fused.add({"a": piece_of_grid(grid)}, {"a": at})
    >>> fused.move({"a": at + [1.0, 0, 0, 0, 0, 0, 0]}).moved
    1
    """

    def __init__(
        self,
        voxel_size: float,
        *,
        dim: int = 3,
        model: BeamModel | None = None,
        tolerance: float = TOLERANCE,
        pool: GridPool | None = None,
        threads: int = 1,
    ) -> None:
        if not (np.isfinite(tolerance) and tolerance >= 0):
            raise ConfigError(f"tolerance of a fused map is {tolerance} voxels; wanted ≥ 0")
        self._grid = EvidenceGrid(voxel_size, model=model, pool=pool, dim=dim)
        self._grows = pool is None
        self.tolerance = float(tolerance)
        if not (isinstance(threads, int) and threads >= 1):
            raise ConfigError(f"a fused map of {threads} threads; wanted ≥ 1")
        self._posers = [PieceTransformer(self._grid.voxel_size, dim, self._grid.pool.half) for _ in range(threads)]
        self._pieces: dict[PieceId, Piece] = {}
        self._posed: dict[PieceId, TransformedPiece] = {}
        self._wanted: dict[PieceId, Array] = {}
        # histogram of voxel values at the last call, and the bricks written since then
        self._counts = np.zeros(65536, np.int64)
        self._counted = self._grid.copy()
        self._uncounted: list[Ints] = []
        self._empty = 0

    # --- reading ---------------------------------------------------------------------------------------------

    @property
    def voxel_size(self) -> float:
        """[m]."""
        return self._grid.voxel_size

    @property
    def dim(self) -> int:
        """2 or 3."""
        return self._grid.dim

    @property
    def grid(self) -> EvidenceGrid:
        """The current map, in constant time; later changes do not affect it."""
        return self._grid.copy()

    @property
    def pieces(self) -> Mapping[PieceId, Piece]:
        """All pieces by name."""
        return MappingProxyType(self._pieces)

    @property
    def poses(self) -> dict[PieceId, Array]:
        """``T_world_node`` of all pieces, as used in the map."""
        return {name: p.T_world_node.copy() for name, p in self._posed.items()}

    @property
    def wanted(self) -> dict[PieceId, Array]:
        """``T_world_node`` of all pieces as last requested; within the tolerance of :attr:`poses`."""
        return {name: T.copy() for name, T in self._wanted.items()}

    def entropy(self) -> float:
        """Entropy of the map (A11) [nat m³; 2-D: nat m²], bitwise equal to that of ``grid``.

        Only bricks that changed since the last call are evaluated.
        """
        return entropy_of_counts(self._count()) * self.voxel_size**self.dim

    def known_volume(self) -> float:
        """Volume of the voxels that are known [m³], in 2-D their area [m²]."""
        return float(self._count().sum()) * self.voxel_size**self.dim

    @property
    def nbytes(self) -> int:
        """Memory of pieces, resampled bricks and the grid [bytes]; memory shared by copies is counted in each."""
        held = sum(p.nbytes for p in self._pieces.values()) + sum(p.nbytes for p in self._posed.values())
        return held + 2 * BRICK_VOXELS * len(self._grid.brick_coordinates())

    def __len__(self) -> int:
        return len(self._pieces)

    def __repr__(self) -> str:
        return f"FusedMap({self.voxel_size:g} m, {self.dim}-D, {len(self)} pieces, {self.known_volume():.0f} known)"

    def copy(self) -> FusedMap:
        """A copy for another hypothesis; it shares the unchanged data."""
        twin = FusedMap.__new__(FusedMap)
        twin._grid, twin._grows = self._grid.copy(), self._grows
        twin.tolerance = self.tolerance
        twin._posers = [PieceTransformer(self.voxel_size, self.dim, self._grid.pool.half) for _ in self._posers]
        twin._pieces, twin._posed, twin._wanted = dict(self._pieces), dict(self._posed), dict(self._wanted)
        twin._counts, twin._counted = self._counts, self._counted.copy()
        twin._uncounted, twin._empty = list(self._uncounted), self._empty
        return twin

    def release_scratch(self) -> None:
        """Free the scratch memory; the next change allocates it again."""
        for poser in self._posers:
            poser.release()

    # --- changing --------------------------------------------------------------------------------------------

    def add(self, pieces: Mapping[PieceId, Piece], poses: Mapping[PieceId, Any]) -> MapChange:
        """Add pieces at ``T_world_node``; see :meth:`update`."""
        return self.update(add=pieces, poses=poses)

    def remove(self, names: Names) -> MapChange:
        """Remove pieces; see :meth:`update`."""
        return self.update(remove=names)

    def move(self, poses: Mapping[PieceId, Any], *, tolerance: float | None = None) -> MapChange:
        """Move pieces to ``T_world_node``; see :meth:`update`. The other pieces stay."""
        return self.update(poses=poses, tolerance=tolerance)

    def update(
        self,
        *,
        add: Mapping[PieceId, Piece] | None = None,
        remove: Names = (),
        poses: Mapping[PieceId, Any] | None = None,
        tolerance: float | None = None,
    ) -> MapChange:
        """Add, remove and move pieces in one step; after an error the map is unchanged.

        Parameters
        ----------
        add : mapping of name to Piece
        remove : names
            A name can be removed and added in one change, which replaces the piece.
        poses : mapping of name to (7,) or (3,)
            ``T_world_node`` of all added and moved pieces. Unknown names are refused.
        tolerance : float, optional
            In place of the map's tolerance [voxels]. ``move(map.wanted, tolerance=0)`` moves every piece exactly to its
            last requested pose.
        """
        add, poses = dict(add or {}), dict(poses or {})
        limit = self.tolerance if tolerance is None else float(tolerance)
        if not limit >= 0:
            raise ConfigError(f"tolerance of a move is {tolerance} voxels; wanted ≥ 0")
        removed = list(dict.fromkeys(remove))
        self._check(add, removed, poses)
        wanted = dict(zip(poses, self._checked(poses)))
        movers = [name for name in wanted if name not in add]
        moved = self._beyond(movers, wanted, limit)
        self._make_room(add, wanted)
        with self._grid.pool.lock:
            fresh = self._pose({**{n: self._pieces[n] for n in moved}, **add}, wanted)
            old = [self._posed[name] for name in (*removed, *moved)]
            left = set(removed)
            posed = {n: p for n, p in self._posed.items() if n not in left} | fresh
            keys = np.unique(np.concatenate([_NONE, *(p.keys for p in (*old, *fresh.values()))]))
            work, written, empty = self._grid.copy(), [_NONE], 0  # the grid itself changes at the end
            for some, values, emptied in self._posers[0].sums(
                keys, list(posed.values()), self._grid.root, self._grid.pool, self._grid.model.clamp_steps
            ):
                if len(some):
                    write_packed(work, some, values)
                written.append(some)
                empty += emptied
            changed = np.concatenate(written)
            with defer_interrupts():
                self._grid.replace_contents(work)
                self._posed = posed
                for name in removed:
                    del self._pieces[name], self._wanted[name]
                self._pieces |= add
                self._wanted |= wanted
                self._uncounted.append(changed)
        self._tidy(empty)
        return MapChange(len(add), len(removed), len(moved), len(movers) - len(moved), len(keys), len(changed))

    # --- inside ----------------------------------------------------------------------------------------------

    def _check(self, add: Mapping[PieceId, Piece], removed: list[PieceId], poses: Mapping[PieceId, Any]) -> None:
        for name in removed:
            if name not in self._pieces:
                raise DataError(f"there is no piece {name!r} in this map", wanted="the name of a piece")
        left = self._pieces.keys() - set(removed)
        for name, piece in add.items():
            if name in left:
                raise DataError(f"piece {name!r} is in this map already", wanted="another name, or remove it as well")
            if name not in poses:
                raise DataError(f"piece {name!r} is added without a pose", wanted="T_world_node")
            if piece.voxel_size != self.voxel_size or piece.dim != self.dim:
                raise GridError(
                    f"piece {name!r} is of another voxel size or dimension",
                    got=f"{piece.voxel_size} m, {piece.dim}-D",
                    wanted=f"{self.voxel_size} m, {self.dim}-D",
                )
        for name in poses:
            if name not in left and name not in add:
                raise DataError(f"there is no piece {name!r} to be moved in this map", wanted="the name of a piece")

    def _checked(self, poses: Mapping[PieceId, Any]) -> Array:
        """Validated poses ``(n, 7)`` or ``(n, 3)``, in order."""
        size = 7 if self.dim == 3 else 3
        for name, T in poses.items():
            if np.shape(T) != (size,):
                raise DataError(f"pose of piece {name!r} has the wrong shape", got=np.shape(T), wanted=f"({size},)")
        return checked_poses(np.array([np.asarray(T) for T in poses.values()]).reshape(-1, size), self.dim)

    def _beyond(self, names: list[PieceId], wanted: Mapping[PieceId, Array], limit: float) -> list[PieceId]:
        """Names of the pieces with a point that would move by more than the limit [voxels].

        The displacement is a convex function of the point, so it is largest at a corner of the box.
        """
        names = [n for n in names if self._pieces[n].known]
        if not names:
            return []
        corners = np.stack([self._pieces[n].corners for n in names])  # (n, corners, dim)
        step = pose_rows(np.array([wanted[n] for n in names]), self.dim)
        step = step - pose_rows(np.array([self._posed[n].T_world_node for n in names]), self.dim)
        d = self.dim
        R, t = step[:, :9].reshape(-1, 3, 3)[:, :d, :d], step[:, 9 : 9 + d]
        far = np.linalg.norm(corners @ R.transpose(0, 2, 1) + t[:, None], axis=2).max(axis=1)
        return [n for n, f in zip(names, far.tolist()) if f > limit * self.voxel_size]

    def _make_room(self, add: Mapping[PieceId, Piece], wanted: Mapping[PieceId, Array]) -> None:
        """Rebuild the map in a pool with more levels if pieces would exceed this one."""
        reach = max((reach_of(add.get(n) or self._pieces[n], T) for n, T in wanted.items()), default=0.0)
        levels = pool_levels(reach)
        if not self._grows or levels <= self._grid.pool.levels or reach > half_edge(MAX_LEVELS):
            return
        larger = FusedMap(
            self.voxel_size, dim=self.dim, model=self._grid.model, pool=GridPool(levels), threads=len(self._posers)
        )
        larger.add(self._pieces, {n: p.T_world_node for n, p in self._posed.items()})
        self._grid, self._posers, self._posed = larger._grid, larger._posers, larger._posed
        self._counts, self._counted = larger._counts, larger._counted
        self._uncounted, self._empty = larger._uncounted, 0

    def _pose(
        self, pieces: Mapping[PieceId, Piece], wanted: Mapping[PieceId, Array]
    ) -> dict[PieceId, TransformedPiece]:
        """Resample pieces on the world lattice."""
        if not pieces:
            return {}
        group = SE3 if self.dim == 3 else SE2
        at = np.array([wanted[n] for n in pieces])
        inner = np.array([p.T_base_node for p in pieces.values()])
        T = pose_rows(group.compose(at, group.inverse(inner)), self.dim)
        work = list(zip(pieces.items(), T, at))
        if len(self._posers) == 1 or len(work) < 2:
            return {n: self._posers[0].pose(piece, row, pose) for (n, piece), row, pose in work}
        # balanced loads: pieces sorted by size, dealt in turn; each thread has its own scratch memory
        by_size = sorted(range(len(work)), key=lambda k: -work[k][0][1].known)
        shares = [by_size[i :: len(self._posers)] for i in range(len(self._posers))]

        def run(poser: PieceTransformer, share: list[int]) -> list[TransformedPiece]:
            return [poser.pose(work[k][0][1], work[k][1], work[k][2]) for k in share]

        with ThreadPoolExecutor(len(self._posers)) as executor:
            done = list(executor.map(run, self._posers, shares))
        made = {k: posed for share, found in zip(shares, done) for k, posed in zip(share, found)}
        return {work[k][0][0]: made[k] for k in range(len(work))}

    def _tidy(self, empty: int) -> None:
        """Occasionally remove bricks without known voxels, and duplicate notes of changes."""
        self._empty += empty
        if self._empty > 1000 and 2 * self._empty > len(self._grid.brick_coordinates()):
            compact_grids(self._grid)
            self._empty = 0
        if sum(map(len, self._uncounted[1:])) > 2 * len(self._uncounted[0]) + 100_000:
            self._uncounted = [np.unique(np.concatenate(self._uncounted))]

    def _count(self) -> Ints:
        """Updated histogram of voxel values."""
        if self._uncounted:
            keys = np.unique(np.concatenate(self._uncounted))
            pool = self._grid.pool
            with pool.lock:
                before, after = np.empty(len(keys), np.int64), np.empty(len(keys), np.int64)
                find_bricks(self._counted.root, keys, pool.levels, pool.tree.children, before)
                find_bricks(self._grid.root, keys, pool.levels, pool.tree.children, after)
                counts = self._counts.copy()  # the array may be shared with a copy
                count_changes(before, after, pool.tree.bricks, counts)
            counts[0] = 0  # the unknown
            self._counts, self._counted, self._uncounted = counts, self._grid.copy(), []
        return self._counts


def reach_of(piece: Piece, T_world_node: Array) -> float:
    """Upper bound of the distance of a piece's voxels from the origin, for any rotation [voxels]."""
    if not piece.known:
        return 0.0
    far = np.linalg.norm(T_world_node[: piece.dim]) + np.linalg.norm(piece.corners, axis=1).max()
    return float(far) / piece.voxel_size + MARGIN * BRICK_EDGE


def fuse_pieces(
    pieces: Mapping[PieceId, Piece],
    poses: Mapping[PieceId, Any],
    *,
    model: BeamModel | None = None,
    tolerance: float = TOLERANCE,
    threads: int = 1,
) -> FusedMap:
    """A new fused map of pieces at ``T_world_node``."""
    if not pieces:
        raise DataError("a fused map of no pieces has no voxel size", wanted="a FusedMap, and pieces later")
    first = next(iter(pieces.values()))
    fused = FusedMap(first.voxel_size, dim=first.dim, model=model, tolerance=tolerance, threads=threads)
    fused.add(pieces, {name: poses[name] for name in pieces if name in poses})
    return fused
