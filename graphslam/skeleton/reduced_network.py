"""The explicit reduced network, as in the paper: all landmarks marginalised out, a block for every pair of poses."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from graphslam.core.errors import SolverError
from graphslam.core.geometry import Array
from graphslam.skeleton import block_table_kernels
from graphslam.skeleton import reduction_kernels as kernels
from graphslam.skeleton.problem import SkeletonProblem
from graphslam.skeleton.schur import Network

_ORDER = tuple[np.ndarray, np.ndarray, np.ndarray]


def _by_landmark(problem: SkeletonProblem) -> _ORDER:
    ptr = np.zeros(problem.landmarks + 1, np.int64)
    pose, measurement = np.empty(problem.measurements, np.int32), np.empty(problem.measurements, np.int32)
    kernels.order_by_landmark(problem.landmark, problem.first, ptr, pose, measurement)
    return ptr, pose, measurement


def blocks_per_pose(problem: SkeletonProblem, samples: int = 2_000, order: _ORDER | None = None) -> float:
    """Blocks on and right of the diagonal per row of the reduced network, mean over sampled poses."""
    ptr, pose, _ = order or _by_landmark(problem)
    step = max(1, problem.poses // samples)
    mark = np.full(problem.poses, -1, np.int32)
    count = kernels.count_blocks(problem.landmark, problem.first, ptr, pose, step, mark)
    return float(count) / len(range(0, problem.poses, step))


class ReducedNetwork:
    """Schur complement of all landmarks as a block matrix.

    Parameters
    ----------
    limit : float
        Memory limit of the blocks [bytes].
    """

    def __init__(self, network: Network, limit: float) -> None:
        problem, N = network.layout.problem, network.layout.problem.poses
        order = _by_landmark(problem)
        per_pose = blocks_per_pose(problem, order=order)
        # the blocks of one triangle, both triangles for the product, and the table of the pairs
        bytes_ = N * per_pose * (3 * 288 + 24)
        if bytes_ > limit:
            raise SolverError(
                f"the thinned network of {N} poses has {per_pose:.0f} blocks a pose: about {bytes_ / 1e9:.1f} GB; "
                f"wanted at most {limit / 1e9:.1f} GB. The method 'gn' applies the same matrix without forming it"
            )
        table = block_table_kernels.make_block_table(int(1.3 * N * (per_pose + 2)) + 64)
        kernels.eliminate_landmarks(
            problem.detections, network.poses, (network.landmarks, network.inverse), order, table
        )
        keys = block_table_kernels.sorted_block_keys(table)
        blocks = table.block[: len(keys)]
        diagonal, upper = network.chain_blocks()
        i = np.arange(N, dtype=np.int64)
        row = np.concatenate([keys // N, i, i[:-1]])
        column = np.concatenate([keys % N, i, i[1:]])
        values = np.concatenate([blocks, diagonal, upper])
        del table, blocks
        off = row != column
        self.blocks = int(np.count_nonzero(keys // N != keys % N)) + N
        rows, columns = np.concatenate([row, column[off]]), np.concatenate([column, row[off]])
        values = np.concatenate([values, values[off].swapaxes(1, 2)])
        at = np.lexsort((columns, rows))
        ptr = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=N))])
        self.matrix = sp.bsr_matrix((values[at], columns[at], ptr), shape=(6 * N, 6 * N))
        self.matrix.sum_duplicates()

    def product(self, v: Array) -> Array:
        """The matrix times ``v (N, 6)``."""
        return np.asarray(self.matrix @ v.ravel()).reshape(v.shape)
