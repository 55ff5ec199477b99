"""Additive preconditioner of the Schur complement: block Jacobi on poses and keyframes, factorised keyframe network."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from graphslam.core.geometry import Array
from graphslam.linear.block_cholesky import BlockFactor, BlockSymbolic
from graphslam.linear.symmetric_factor import elimination_order
from graphslam.skeleton import chain_kernels as chains
from graphslam.skeleton import coarse_kernels as kernels
from graphslam.skeleton.block_table_kernels import add_block_table, make_block_table, sorted_block_keys
from graphslam.skeleton.landmark_kernels import Detections
from graphslam.skeleton.schur import PARTS, Network, inverse_of

Index = npt.NDArray[np.int64]


@dataclass(frozen=True)
class PreconditionerLevels:
    """Keyframe levels of the preconditioner.

    Parameters
    ----------
    jacobi : int
        Poses per keyframe for block Jacobi; 0: none.
    factored : int
        Poses per keyframe for the factorised network; 0: none.
    """

    jacobi: int = 0
    factored: int = 0


def preconditioner_levels(poses: int) -> PreconditionerLevels:
    """Default levels: one factorised network up to 2·10⁴ poses, above it a sparser one with block Jacobi between."""
    if poses < 40:
        return PreconditionerLevels()
    if poses <= 20_000:
        return PreconditionerLevels(0, 20)
    return PreconditionerLevels(10, 80)


class KeyframePattern:
    """Block pattern and elimination order of a keyframe network, independent of the pose values."""

    def __init__(self, keys: Index, frames: int) -> None:
        self.keys, self.frames = keys, frames
        row, column = keys // frames, keys % frames
        order = elimination_order(row.astype(np.intp), column.astype(np.intp), frames).astype(np.int64)
        when = np.empty(frames, np.int64)
        when[order] = np.arange(frames)
        # each pair is stored with the keyframe that is eliminated first, its block transposed if needed
        self._turned = when[row] > when[column]
        node, other = np.where(self._turned, column, row), np.where(self._turned, row, column)
        self._sorted = np.lexsort((other, node))
        ptr = np.concatenate([[0], np.cumsum(np.bincount(node, minlength=frames))]).astype(np.int64)
        self._symbolic = BlockSymbolic(order, np.full(frames, 6, np.int64), ptr, other[self._sorted])

    def factor(self, blocks: Array) -> BlockFactor:
        """Factorise the matrix of ``blocks (nb, 6, 6)``, in the order of the keys."""
        value = np.where(self._turned[:, None, None], blocks.swapaxes(1, 2), blocks)
        return self._symbolic.factor(36 * self._sorted, value.ravel())


class KeyframeNetwork:
    """``Pᵀ S P``, factorised.

    Parameters
    ----------
    k : int
        Poses per keyframe.
    pattern : KeyframePattern, optional
        Of an earlier network of the same problem and k.
    """

    def __init__(self, network: Network, k: int, pattern: KeyframePattern | None = None) -> None:
        problem, poses = network.layout.problem, network.poses
        self.k, self.frames, self.position = k, keyframes_of(problem.poses, k), poses.position
        count = network.layout.counts.copy()
        size = max(1024, 4 * self.frames if pattern is None else len(pattern.keys) + 3)
        landmarks = network.landmarks, network.inverse
        parts = [(kernels.make_pending(problem.landmarks), make_block_table(size)) for _ in range(PARTS)]

        def add(part: int, a: int, b: int, sight: Detections) -> None:
            span = a, b, part, PARTS
            parts[part] = kernels.keyframe_network(sight, poses, landmarks, k, span, count, *parts[part])

        for a, b in _interval_chunks(network, k, 0, self.frames - 1):
            sight = problem.observations_of(*_poses_of(problem.poses, k, a, b))
            network.layout.workers.over(add, [(p, a, b, sight) for p in range(PARTS)])
        table = parts[0][1]
        for _, other in parts[1:]:
            table = add_block_table(table, other)
        keys = sorted_block_keys(table)
        self.blocks = table.block[: len(keys)]
        diagonal, upper = keyframe_chain_blocks(network, k)
        c = np.arange(self.frames, dtype=np.int64)
        order = np.argsort(keys)
        at = order[np.searchsorted(keys, c * self.frames + c, sorter=order)]
        self.blocks[at] += diagonal
        at = order[np.searchsorted(keys, (c * self.frames + c + 1)[:-1], sorter=order)]
        self.blocks[at] += upper
        self.pattern = pattern or KeyframePattern(keys, self.frames)
        self.factor = self.pattern.factor(self.blocks)

    def solve(self, x: Array) -> Array:
        """``(Pᵀ S P)⁻¹ x`` for ``x (K, 6)``."""
        return self.factor.solve(x.ravel()).reshape(-1, 6)

    def matrix(self) -> sp.csr_matrix:
        """``Pᵀ S P``, both triangles."""
        keys, n = self.pattern.keys, self.frames
        i, j = np.divmod(keys, n)
        order = np.lexsort((j, i))
        ptr = np.concatenate([[0], np.cumsum(np.bincount(i, minlength=n))])
        upper = sp.bsr_matrix((self.blocks[order], j[order], ptr), shape=(6 * n, 6 * n)).tocsr()
        diagonal = sp.block_diag(list(self.blocks[order][ptr[:-1]]), format="csr")
        return sp.csr_matrix(upper + upper.T - diagonal)

    def restricted(self, r: Array) -> Array:
        """``(Pᵀ S P)⁻¹ Pᵀ r``"""
        x = np.empty((self.frames, 6))
        kernels.restrict_residual(self.position, self.k, r, x)
        return self.solve(x)

    def apply(self, r: Array, out: Array) -> None:
        """Add ``P (Pᵀ S P)⁻¹ Pᵀ r`` to ``out (N, 6)``."""
        kernels.prolong_step(self.position, self.k, self.restricted(r), out)


def keyframes_of(poses: int, k: int) -> int:
    """Keyframes: poses 0, k, 2k … and the last one."""
    return (poses - 2) // k + 2


def _poses_of(poses: int, k: int, begin: int, end: int) -> tuple[int, int]:
    """Poses of the intervals ``begin … end - 1``."""
    return begin * k, poses if end * k >= poses - 1 else end * k


def _interval_chunks(network: Network, k: int, begin: int, end: int) -> Iterator[tuple[int, int]]:
    """Ranges of intervals to process at once: all if in memory, about a tile if on disk."""
    problem = network.layout.problem
    size = end - begin if problem.tiles is None else max(1, problem.tiles.size // k)
    for a in range(begin, end, max(1, size)):
        if problem.tiles is not None:
            problem.tiles.release()
        yield a, min(a + size, end)


def keyframe_chain_blocks(network: Network, k: int) -> tuple[Array, Array]:
    """Blocks of ``Pᵀ A P`` of odometry, tilt and priors: diagonal and upper."""
    K = keyframes_of(network.layout.problem.poses, k)
    diagonal, upper = np.zeros((K, 6, 6)), np.zeros((K - 1, 6, 6))
    kernels.keyframe_chain(network.poses.position, *network.chain_blocks(), k, diagonal, upper)
    return diagonal, upper


class Preconditioner:
    """``M⁻¹ r``: the sum of block Jacobi on poses, block Jacobi on keyframes, and a factorised keyframe network.

    Parameters
    ----------
    pattern : KeyframePattern, optional
        Of an earlier preconditioner.
    """

    def __init__(self, network: Network, levels: PreconditionerLevels, pattern: KeyframePattern | None = None) -> None:
        self.layout, self.levels, self.position = network.layout, levels, network.poses.position
        workers = self.layout.workers
        self.inverse = inverse_of(network.diagonal(), self.layout.over_poses, "pose")
        self.keyframes: Array | None = None
        self.network: KeyframeNetwork | None = None
        if levels.jacobi:
            blocks = keyframe_chain_blocks(network, levels.jacobi)[0]
            half, k = len(blocks) // 2, levels.jacobi
            ranges = [(0, half), (half, len(blocks))]
            landmarks = (network.landmarks, network.inverse)

            def fill(first: int, last: int) -> None:
                for a, b in _interval_chunks(network, k, first, last):
                    # a keyframe also belongs to the interval before it
                    sight = network.layout.problem.observations_of(*_poses_of(len(self.position), k, max(0, a - 1), b))
                    kernels.keyframe_diagonal(sight, network.poses, landmarks, k, a, b, blocks)

            workers.over(fill, ranges)
            self.keyframes = inverse_of(blocks, lambda work: workers.over(work, ranges), "keyframe")
        if levels.factored:
            self.network = KeyframeNetwork(network, levels.factored, pattern)

    @property
    def pattern(self) -> KeyframePattern | None:
        """Pattern that a later preconditioner of the same problem can reuse."""
        return None if self.network is None else self.network.pattern

    def __call__(self, r: Array) -> Array:
        """``M⁻¹ r`` for ``r (N, 6)``."""
        out = np.empty_like(r)

        def fine() -> None:
            for a, b in self.layout.problem.chunks(0, len(r)):
                chains.multiply_blocks(self.inverse, r, a, b, out)
            if self.keyframes is not None:
                k, n = self.levels.jacobi, len(self.keyframes)
                x, y = np.empty((n, 6)), np.empty((n, 6))
                kernels.restrict_residual(self.position, k, r, x)
                chains.multiply_blocks(self.keyframes, x, 0, n, y)
                kernels.prolong_step(self.position, k, y, out)

        network = self.network
        if network is None:
            fine()
            return out
        tasks = [(lambda: network.restricted(r),), (fine,)]
        coarse = self.layout.workers.over(lambda task: task(), tasks)[0]
        kernels.prolong_step(self.position, network.k, coarse, out)
        return out
