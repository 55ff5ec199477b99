"""Pieces resampled on the world lattice, and sums of their bricks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import GridError
from graphslam.core.geometry import Array
from graphslam.core.spill_cache import SPILL_CACHE, CacheEntry, pack_array, unpack_array
from graphslam.evidence.layout import BRICK_EDGE, BRICK_VOXELS
from graphslam.evidence.pool import GridPool
from graphslam.maps.fuse_kernels import find_bricks, list_marked, meet_bricks, sample_piece, sum_bricks
from graphslam.maps.pieces import MARGIN, Piece

Ints = npt.NDArray[np.int64]
Entries = npt.NDArray[np.uint32]


PART = 1 << 24
"""Most entries in one sum [64 MB] …"""
PART_BRICKS = 1 << 16
"""… and most bricks [64 MB]."""


class TransformedPiece:
    """A piece resampled at one pose; immutable, so that maps can share it. Its entries are in the spill cache.

    Parameters
    ----------
    T_world_node : (7,) or (3,)
    keys : (n,)
        Packed offset coordinates of bricks, ascending.
    starts : (n + 1,)
        Start of each brick in ``entries``.
    entries : (m,) uint32
        Known voxels: ``voxel << 16 | value`` (:mod:`fuse_kernels`).
    """

    __slots__ = ("T_world_node", "_entries", "keys", "starts")

    def __init__(self, T_world_node: Array, keys: Ints, starts: Ints, entries: Entries) -> None:
        self.T_world_node, self.keys, self.starts = T_world_node, keys, starts
        self._entries: CacheEntry[Entries] = SPILL_CACHE.put(entries, entries.nbytes, pack_array, unpack_array)

    @property
    def entries(self) -> Entries:
        """All entries."""
        return self._entries.get()

    def between(self, first: int, last: int) -> Entries:
        """Entries of bricks ``first … last - 1``."""
        return self._entries.rows(int(self.starts[first]), int(self.starts[last]))

    @property
    def nbytes(self) -> int:
        """Memory when the entries are loaded [bytes]."""
        return self.keys.nbytes + self.starts.nbytes + self._entries.nbytes


class PieceTransformer:
    """Resamples pieces on the lattice of one world. Contains scratch memory only.

    Parameters
    ----------
    voxel_size : float
        [m].
    dim : {2, 3}
    half : int
        Voxels from the centre of the addressable cube to its faces.
    """

    def __init__(self, voxel_size: float, dim: int, half: int) -> None:
        self.voxel_size, self.dim, self.half = voxel_size, dim, half
        self.release()

    def release(self) -> None:
        """Free the scratch memory; it is allocated again when needed."""
        self._entries = np.empty(0, np.uint32)
        self._sources = np.empty(0, np.uint32)
        self._sums = np.empty((0, BRICK_VOXELS), np.int16)

    def pose(self, piece: Piece, T: Array, T_world_node: Array) -> TransformedPiece:
        """Resample a piece at ``T`` ``(12,)``, which is T_world_base: rotation row by row, then translation [m]."""
        R, t = np.ascontiguousarray(T[:9].reshape(3, 3)), T[9:] / self.voxel_size
        keys = self._met(piece, R, t)
        if len(self._entries) < BRICK_VOXELS * len(keys) + 1:  # one extra entry, overwritten by unknown voxels
            self._entries = np.empty(BRICK_VOXELS * 5 * len(keys) // 4 + 1, np.uint32)
        into = np.empty(12)  # from world voxels to voxels of the box around the piece
        into[:9] = R.T.ravel()
        into[9:] = -R.T @ t - BRICK_EDGE * piece.first
        starts = np.empty(len(keys) + 1, np.int64)
        layers = BRICK_EDGE if self.dim == 3 else 1
        sample_piece(keys, into, self.half, layers, piece.table, piece.lookup, self._entries, starts)
        some = np.diff(starts) > 0
        return TransformedPiece(
            T_world_node, keys[some], np.append(starts[:-1][some], starts[-1]), self._entries[: starts[-1]].copy()
        )

    def _met(self, piece: Piece, R: Array, t: Array) -> Ints:
        """Keys of the world bricks that the rotated bricks of a piece may overlap, ascending; ``t`` in voxels."""
        if not piece.known:
            return np.zeros(0, np.int64)
        half = self.half // BRICK_EDGE
        box = np.array([piece.first + MARGIN, piece.first + piece.table.shape[::-1] - MARGIN], np.float64)
        centre, size = 0.5 * box.sum(axis=0) @ R.T + t / BRICK_EDGE, 0.5 * np.abs(R) @ (box[1] - box[0])
        low, high = np.floor(centre - size).astype(np.int64), np.floor(centre + size).astype(np.int64)
        if self.dim == 2:
            low[2] = high[2] = 0
        if low.min() < -half or high.max() >= half:
            raise GridError(
                "a piece would reach out of the addressable cube of the map",
                got=f"bricks {low.tolist()} … {high.tolist()}",
                wanted=f"[{-half}, {half}), or a pool of more levels",
            )
        marks = np.zeros((high - low + 1)[::-1], np.uint8)
        n = meet_bricks(piece.coordinates, piece.extents, R, t, self.dim == 2, low, marks)
        keys = np.empty(n, np.int64)
        list_marked(low + half, marks, keys)
        return keys

    def sums(
        self, keys: Ints, posed: Sequence[TransformedPiece], root: int, pool: GridPool, clamp: tuple[int, int]
    ) -> Iterator[tuple[Ints, npt.NDArray[np.int16], int]]:
        """:meth:`sum` in parts of the keys, with limited memory."""
        ends = parts_of(keys, posed)
        for first, last in pairwise(ends):
            yield self.sum(keys[first:last], posed, root, pool, clamp)

    def sum(
        self, keys: Ints, posed: Sequence[TransformedPiece], root: int, pool: GridPool, clamp: tuple[int, int]
    ) -> tuple[Ints, npt.NDArray[np.int16], int]:
        """Bricks of ``keys`` (ascending) that differ from the tree ``root``, their values, and how many have no known
        voxel any more.

        The values are in scratch memory and valid until the next sum. The caller must hold the pool's lock.
        """
        nothing = np.zeros(0, np.int64)
        if not len(keys):
            return nothing, self._sums[:0], 0
        between = [np.searchsorted(p.keys, (keys[0], keys[-1] + 1)).tolist() for p in posed]
        near = [(p, a, b) for p, (a, b) in zip(posed, between) if a < b]
        every = np.concatenate([nothing, *(p.keys[a:b] for p, a, b in near)])
        whose = np.repeat(np.arange(len(near)), [b - a for _, a, b in near])
        at = np.searchsorted(keys, every)
        hit = np.flatnonzero(keys[np.minimum(at, len(keys) - 1)] == every)
        hit = hit[np.argsort(at[hit], kind="stable")]
        starts = np.zeros(len(keys) + 1, np.int64)
        np.cumsum(np.bincount(at[hit], minlength=len(keys)), out=starts[1:])
        # entries of the pieces that touch one of the bricks, in one array
        used = np.bincount(whose[hit], minlength=len(near)) > 0
        sizes = np.array([p.starts[b] - p.starts[a] if u else 0 for (p, a, b), u in zip(near, used)], np.int64)
        total = int(sizes.sum())
        if len(self._sources) < total:
            self._sources = np.empty(5 * total // 4, np.uint32)
        ends = np.cumsum(sizes)
        for (p, a, b), u, end, size in zip(near, used, ends.tolist(), sizes.tolist()):
            if u:
                self._sources[end - size : end] = p.between(a, b)
        offset = np.repeat(ends - sizes - [p.starts[a] for p, a, _ in near], [b - a for _, a, b in near])[hit]
        begins = offset + np.concatenate([nothing, *(p.starts[a:b] for p, a, b in near)])[hit]
        after = offset + np.concatenate([nothing, *(p.starts[a + 1 : b + 1] for p, a, b in near)])[hit]
        ids = np.empty(len(keys), np.int64)
        find_bricks(root, keys, pool.levels, pool.tree.children, ids)
        if len(self._sums) < len(keys) + 1:
            self._sums = np.empty((5 * len(keys) // 4 + 1, BRICK_VOXELS), np.int16)
        changed = np.empty(len(keys) + 1, np.int64)
        n = sum_bricks((starts, begins, after), self._sources, clamp, ids, pool.tree.bricks, self._sums, changed)
        empty = changed[:n] < 0
        return keys[np.where(empty, ~changed[:n], changed[:n])], self._sums[:n], int(empty.sum())


def parts_of(keys: Ints, posed: Sequence[TransformedPiece]) -> list[int]:
    """Indices at which to split ``keys`` (ascending) so that no part is too large: 0 first, the end last."""
    entries = np.zeros(len(keys))
    for p in posed:
        at = np.minimum(np.searchsorted(keys, p.keys), len(keys) - 1)
        hit = keys[at] == p.keys if len(keys) else np.zeros(0, np.bool_)
        entries += np.bincount(at[hit], weights=np.diff(p.starts)[hit], minlength=len(keys))
    until = np.concatenate([[0.0], np.cumsum(entries)])
    cuts = [0]
    while cuts[-1] < len(keys):
        k = cuts[-1]
        fits = int(np.searchsorted(until, until[k] + PART, side="right")) - 1
        cuts.append(min(max(fits, k + 1), k + PART_BRICKS, len(keys)))
    return cuts
