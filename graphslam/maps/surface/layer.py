"""Surface of pieces that move with the nodes of the graph: a loop closure does not need the scans again.

Each world voxel has the integer sum over all pieces. A piece that moves is subtracted at its old pose and added at its
new one; then the level set is evolved again around the changed bricks only. Integer sums do not depend on their order,
and a fixed number of steps reaches a fixed number of voxels, so the surface is bitwise equal to one made from scratch
at the same poses.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.errors import DataError, GridError
from graphslam.core.geometry import Array
from graphslam.evidence.layout import BRICK_VOXELS
from graphslam.maps.surface.field_kernels import (
    FULL,
    evolve_level_set,
    make_target,
    pose_piece,
    reach_bricks,
    redistance,
)
from graphslam.maps.surface.piece import Scan, SurfaceConfig, SurfacePiece, piece_of_scans

PieceId: TypeAlias = Hashable
Ints = npt.NDArray[np.int64]
_ROUND = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)[:, ::-1]
"""Offsets ``(27, 3)`` of a brick's neighbourhood, x fastest."""
_BIAS = 1 << 20


class SurfaceLayer:
    """Surface pieces with poses, and their signed distance field."""

    def __init__(self, config: SurfaceConfig | None = None) -> None:
        self.config = config or SurfaceConfig()
        self.pieces: dict[PieceId, SurfacePiece] = {}
        self.poses: dict[PieceId, Array] = {}
        self._keys = np.zeros(0, np.int64)  # keys of bricks, ascending …
        self._rows = np.zeros(0, np.int64)  # … and their rows in the arrays
        self._sums = np.zeros((0, BRICK_VOXELS, 4), np.int32)
        self._pieces_in = np.zeros(0, np.int32)
        self._target = np.zeros((0, BRICK_VOXELS, 2), np.float32)
        self._known = np.zeros((0, BRICK_VOXELS), np.uint8)
        self._phi = np.zeros((0, BRICK_VOXELS), np.float32)
        self._changed: set[int] = set()
        self.evolved = 0
        """Number of bricks that the last :meth:`update` evolved."""

    # --- pieces ----------------------------------------------------------------------------------------------

    def read(self, name: PieceId, scans: Iterable[Scan], pose: Array) -> SurfacePiece:
        """Make the piece of a node at ``pose`` ``(7,)`` from scans in the world frame."""
        piece = piece_of_scans(scans, pose, self.config)
        self.add(name, piece, pose)
        return piece

    def add(self, name: PieceId, piece: SurfacePiece, pose: Array) -> None:
        """Add a piece at a pose ``(7,)``."""
        if name in self.pieces:
            raise DataError(f"the surface of node {name!r} is there already")
        T = np.array(pose, dtype=np.float64)
        self._put(piece, T, 1)
        self.pieces[name], self.poses[name] = piece, T

    def move(self, poses: Mapping[PieceId, Array]) -> int:
        """Move pieces to other poses ``(7,)``; returns the number of moved pieces."""
        strange = [name for name in poses if name not in self.pieces]
        if strange:
            raise DataError("no surface was read at this node", got=strange[0])
        moved = {n: np.array(T, dtype=np.float64) for n, T in poses.items() if not np.array_equal(T, self.poses[n])}
        for name, T in moved.items():
            self._put(self.pieces[name], self.poses[name], -1)
            self._put(self.pieces[name], T, 1)
            self.poses[name] = T
        return len(moved)

    # --- the signed distance ---------------------------------------------------------------------------------

    def update(self) -> Ints:
        """Evolve the changed parts; returns the coordinates ``(n, 3)`` of the bricks with new distances.

        Bricks without any value are freed.
        """
        c = self.config
        changed = np.array(sorted(self._changed), np.int64)
        self._changed.clear()
        rows = self._find(changed)
        beams = c.carve_beams if c.carving else 1 << 40
        figures = (round(FULL * c.enough), beams, c.carve_ratio)
        make_target(rows, self._sums, figures, self._target, self._known)
        empty = self._pieces_in[rows] == 0
        reached = _around(changed, c.halo)
        if np.any(empty):
            self._drop(changed[empty])
        anew = reached[self._find(reached) >= 0]
        inputs = _around(anew, c.halo)
        inputs = inputs[self._find(inputs) >= 0]
        self.evolved = len(inputs)
        rows_in = self._find(inputs)
        near = self._find((_keys_to(inputs)[:, None, :] + _ROUND).reshape(-1, 3)).reshape(-1, 27)
        inside = np.zeros(len(self._sums) + 1, np.bool_)
        inside[rows_in] = True
        near = np.where(inside[near], near, -1)
        phi = np.zeros_like(self._phi)
        phi[rows_in] = self._target[rows_in, :, 0]
        other = phi.copy()
        for _ in range(c.steps):
            evolve_level_set(near, phi, other, self._target, self._known, rows_in, (c.dt, c.smoothing))
            phi, other = other, phi
        start = phi.copy()
        for _ in range(c.redistance_steps):
            redistance(near, phi, other, start, self._known, rows_in, 0.3)
            phi, other = other, phi
        done = self._find(anew)
        self._phi[done] = phi[done]
        return np.concatenate([_keys_to(reached)])

    def bricks(self) -> tuple[Ints, Array, npt.NDArray[np.bool_]]:
        """Coordinates ``(n, 3)`` in ascending order, distances ``(n, 512)`` [voxels], and mask of known voxels."""
        if self._changed:
            self.update()
        rows = self._rows
        return _keys_to(self._keys), self._phi[rows].astype(np.float64), self._known[rows].astype(np.bool_)

    def __len__(self) -> int:
        return len(self._keys)

    @property
    def nbytes(self) -> int:
        """Memory of the pieces and the world [bytes]."""
        own = (self._sums, self._target, self._known, self._phi)
        return sum(p.nbytes for p in self.pieces.values()) + sum(a.nbytes for a in own)

    # --- bricks ----------------------------------------------------------------------------------------------

    def _put(self, piece: SurfacePiece, T: Array, sign: int) -> None:
        if not len(piece):
            return
        R = np.ascontiguousarray(se3.quat_to_matrix(T[3:]))
        t = np.ascontiguousarray(T[:3] / self.config.voxel)
        found = np.empty((len(piece) * 64, 3), np.int64)
        count = reach_bricks(piece.coordinates, R, t, found)
        if count > len(found):
            raise GridError("bricks of a piece reach too far", got=count, wanted=len(found))
        keys = np.unique(_to_keys(found[:count]))
        self._make(keys)
        rows, touched = self._find(keys), np.zeros(len(keys), np.uint8)
        parts = (piece.first, piece.table, piece.distance, piece.normal, piece.counts)
        pose_piece(_keys_to(keys), rows, R, t, parts, sign, self._sums, touched)
        self._pieces_in[rows[touched > 0]] += sign
        empty = (touched == 0) & (self._pieces_in[rows] == 0)
        self._changed.update(keys[touched > 0].tolist())
        self._drop(np.array([k for k in keys[empty].tolist() if k not in self._changed], np.int64))

    def _find(self, keys: Ints) -> Ints:
        """Rows of bricks given by keys or coordinates ``(n, 3)``; −1 if there is none."""
        wanted = _to_keys(keys) if keys.ndim == 2 else keys
        if not len(self._keys):
            return np.full(len(wanted), -1, np.int64)
        at = np.minimum(np.searchsorted(self._keys, wanted), len(self._keys) - 1)
        return np.where(self._keys[at] == wanted, self._rows[at], -1)

    def _make(self, keys: Ints) -> None:
        fresh = keys[self._find(keys) < 0]
        if not len(fresh):
            return
        free = np.setdiff1d(np.arange(len(self._sums)), self._rows)[: len(fresh)]
        more = len(fresh) - len(free)
        if more:
            have, grown = len(self._sums), max(more, len(self._sums) // 2)
            for name in ("_sums", "_pieces_in", "_target", "_known", "_phi"):
                a = getattr(self, name)
                setattr(self, name, np.concatenate([a, np.zeros((grown, *a.shape[1:]), a.dtype)]))
            free = np.concatenate([free, np.arange(have, have + more)])
        order = np.argsort(np.concatenate([self._keys, fresh]), kind="stable")
        self._rows = np.concatenate([self._rows, free])[order]
        self._keys = np.concatenate([self._keys, fresh])[order]

    def _drop(self, keys: Ints) -> None:
        if not len(keys):
            return
        rows = self._find(keys)
        for a in (self._sums, self._pieces_in, self._target, self._known, self._phi):
            a[rows] = 0
        kept = ~np.isin(self._keys, keys)
        self._keys, self._rows = self._keys[kept], self._rows[kept]


def _to_keys(coordinates: Ints) -> Ints:
    """Integer keys that sort bricks by z, y, x."""
    c = coordinates + _BIAS
    if len(c) and (c.min() < 0 or c.max() >= 2 * _BIAS):
        raise GridError("a surface reaches too far from its origin", got=f"{8 * np.abs(coordinates).max()} voxels")
    return (c[:, 2] << 42) + (c[:, 1] << 21) + c[:, 0]


def _keys_to(keys: Ints) -> Ints:
    mask = 2 * _BIAS - 1
    return np.column_stack([keys & mask, (keys >> 21) & mask, keys >> 42]) - _BIAS


def _around(keys: Ints, reach: int) -> Ints:
    """Keys of bricks and their neighbours within ``reach``, ascending."""
    for _ in range(reach):
        keys = np.unique(_to_keys((_keys_to(keys)[:, None, :] + _ROUND).reshape(-1, 3)))
    return keys
