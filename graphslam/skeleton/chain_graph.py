"""Pose graphs of one long chain with loops: poses between loop ends are eliminated exactly, along the chain.

Poses at the ends of loops are kept, and the first and last one; the links between two of them are combined to one. The
reduced network is factorised by a sparse block Cholesky. Time and memory are linear in the number of poses, and depend
on the loops by the fill-in of a network with twice their number of nodes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError, IndeterminateError, SolverError
from graphslam.core.geometry import Array
from graphslam.skeleton import chain_kernels as chains
from graphslam.skeleton import segment_kernels as kernels
from graphslam.skeleton.landmark_kernels import Poses
from graphslam.skeleton.preconditioner import KeyframePattern
from graphslam.skeleton.problem import inverse_covariance
from graphslam.skeleton.schur import step_poses
from graphslam.skeleton.segment_kernels import SegmentLinks


@dataclass(frozen=True, eq=False)
class ChainGraph:
    """Odometry between consecutive poses, and loops between any two. The first pose is fixed at the origin.

    Parameters
    ----------
    rotation, translation : (N - 1, 3, 3), (N - 1, 3)
        From each pose to the next, in the body frame.
    covariance : (6, 6) or (N - 1, 6, 6)
        Rotation vector [rad], then translation [m].
    ends : (L, 2)
        Poses i and j of each loop.
    loop_rotation, loop_translation : (L, 3, 3), (L, 3)
        From i to j, in the frame of i.
    loop_covariance : (6, 6) or (L, 6, 6)
    """

    rotation: Array
    translation: Array
    covariance: Array
    ends: npt.NDArray[np.int64]
    loop_rotation: Array
    loop_translation: Array
    loop_covariance: Array

    def __post_init__(self) -> None:
        put = object.__setattr__
        N, L = len(self.translation) + 1, len(self.ends)
        put(self, "ends", np.ascontiguousarray(self.ends, dtype=np.int64).reshape(L, 2))
        shapes = {
            "rotation": (N - 1, 3, 3),
            "translation": (N - 1, 3),
            "loop_rotation": (L, 3, 3),
            "loop_translation": (L, 3),
        }
        for name, shape in shapes.items():
            value = np.ascontiguousarray(getattr(self, name), dtype=np.float64)
            if value.shape != shape or not np.isfinite(value).all():
                raise DataError(f"{name} of a chain graph", got=value.shape, wanted=f"{shape}, finite")
            put(self, name, value)
        if N < 2:
            raise DataError("a chain graph of fewer than two poses", got=N)
        if L and (self.ends.min() < 0 or self.ends.max() >= N or (self.ends[:, 0] == self.ends[:, 1]).any()):
            raise DataError("loop of a chain graph", wanted=f"two different poses of 0 … {N - 1}")
        for name, n in (("covariance", N - 1), ("loop_covariance", L)):
            value = np.asarray(getattr(self, name), dtype=np.float64).reshape(-1, 6, 6)
            if len(value) not in (1, n):
                raise DataError(f"{name} of a chain graph", got=len(value), wanted=f"1 or {n}")
            put(self, name, value)
        _ = self.information

    @property
    def poses(self) -> int:
        """Number of poses N."""
        return len(self.translation) + 1

    @cached_property
    def information(self) -> tuple[Array, Array]:
        """Inverse covariances of odometry and loops."""
        return (
            inverse_covariance(self.covariance, "covariance"),
            inverse_covariance(self.loop_covariance, "loop_covariance"),
        )

    def links(self, stay: npt.ArrayLike = ()) -> tuple[SegmentLinks, SegmentLinks]:
        """Odometry in segments between kept poses, and loops, as input of the kernels.

        Kept poses: ends of loops, first and last pose, and those in ``stay``.
        """
        N, L, info = self.poses, len(self.ends), self.information
        k = np.arange(N, dtype=np.int64)
        kept = np.unique(np.concatenate([k[[0, -1]], self.ends.ravel(), np.asarray(stay, dtype=np.int64)]))
        steps = np.column_stack([k[:-1], k[1:]])
        return (
            SegmentLinks(steps, kept, self.rotation, self.translation, self.covariance, info[0]),
            SegmentLinks(
                self.ends, np.arange(L + 1), self.loop_rotation, self.loop_translation, self.loop_covariance, info[1]
            ),
        )

    def dead_reckoning(self) -> Poses:
        """Poses from odometry only."""
        R, p = np.empty((self.poses, 3, 3)), np.empty((self.poses, 3))
        R[0], p[0] = np.eye(3), 0.0
        chains.compose_odometry(self.rotation, self.translation, R, p)
        return Poses(R, p)


class ReducedChain:
    """A chain with loops after elimination of the poses between the kept ones.

    Attributes
    ----------
    kept : (K,)
    keys : (nb,)
        ``row · K + column`` of each block, row ≤ column.
    """

    def __init__(self, graph: ChainGraph, stay: npt.ArrayLike = ()) -> None:
        self._odometry, self._loops = graph.links(stay)
        self.poses, self.kept = graph.poses, self._odometry.first
        K = len(self.kept)
        # segments of the odometry, then loops
        c = np.arange(K)
        loops = np.searchsorted(self.kept, graph.ends)
        self._ends = np.concatenate([np.column_stack([c[:-1], c[1:]]), loops]).astype(np.int64)
        self.keys, place = block_keys(self._ends, K)
        self._place = place[:K], place[K:]

    def join(self, poses: Poses) -> JoinedLinks:
        """All links, combined at given poses."""
        S, n = len(self.kept) - 1, len(self._ends)
        covariance, misfit = np.empty((n, 6, 6)), np.empty((n, 6))
        total = kernels.join_links(self._odometry, poses, covariance[:S], misfit[:S])
        total += kernels.join_links(self._loops, poses, covariance[S:], misfit[S:])
        blocks, g = np.zeros((len(self.keys), 6, 6)), np.zeros((S + 1, 6))
        energy, bad = kernels.add_end_blocks(
            self._ends, poses.position[self.kept], covariance, misfit, self._place, blocks, g
        )
        if bad >= 0:
            i, j = self.kept[self._ends[bad]]
            raise IndeterminateError(f"no factor connects pose {i} of the chain with pose {j}", (f"x{i}", f"x{j}"))
        return JoinedLinks(poses, float(total), float(energy), blocks, g, covariance, misfit)

    def follow(self, joined: JoinedLinks, solved: Array) -> Array:
        """Steps ``(N, 6)`` of all poses from those ``(K, 6)`` of the kept ones."""
        S = len(self.kept) - 1
        x = np.empty((self.poses, 6))
        x[self.kept] = solved
        kernels.follow_links(self._odometry, joined.poses, joined.information[:S], joined.misfit[:S], x)
        return x


class JoinedLinks(NamedTuple):
    """Links combined at given poses."""

    poses: Poses
    total: float
    """Σ rᵀ Ω r over all links …"""
    energy: float
    """… and its minimum over the poses between the kept ones."""
    blocks: Array
    """(nb, 6, 6): matrix of the kept poses."""
    gradient: Array
    """(K, 6): half the gradient."""
    information: Array
    """(S, 6, 6): covariances of the combined links …"""
    misfit: Array
    """… and their residuals (S, 6)."""


def block_keys(ends: npt.NDArray[np.int64], frames: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Keys of the diagonal blocks of a network and of its links, and the index of each among the sorted keys."""
    c = np.arange(frames)
    keys, place = np.unique(
        np.concatenate([c * frames + c, ends.min(axis=1) * frames + ends.max(axis=1)]), return_inverse=True
    )
    return keys.astype(np.int64), place.astype(np.int64)


HELD = 1e12 * np.eye(6)
"""Added information of the first pose: weaker than the rounding of its moves, stronger than any measurement."""


@dataclass(frozen=True, eq=False)
class RelaxedChain:
    """A relaxed chain with loops.

    Parameters
    ----------
    objective : float
        Σ rᵀ Ω r; residuals are rotation vector and translation in the frame of the first pose of each link.
    history : list of float
        The objective before the first step and after each.
    predicted, largest_move : float
        Predicted decrease of the last step, and its largest move of a pose [m].
    """

    poses: Poses
    objective: float
    history: list[float]
    predicted: float
    largest_move: float
    converged: bool


def relax_chain(
    graph: ChainGraph,
    poses: Poses | None = None,
    *,
    iterations: int = 30,
    gain: float = 1e-6,
    progress: Callable[[float], None] | None = None,
) -> RelaxedChain:
    """Gauss-Newton with exact linear solves.

    Parameters
    ----------
    poses : Poses, optional
        Default: dead reckoning.
    gain : float
        It ends when the predicted decrease is below this share of the objective (at least 1e-9).
    progress : callable, optional
        Called with the objective after every step.
    """
    network = ReducedChain(graph)
    K = len(network.kept)
    pattern = KeyframePattern(network.keys, K)
    joined = network.join(graph.dead_reckoning() if poses is None else poses)
    history, predicted, far, converged = [joined.total], np.inf, np.inf, False
    for _ in range(iterations):
        if not np.isfinite(joined.total):
            raise SolverError("objective of the chain graph is not finite")
        joined.blocks[0] += HELD  # key 0
        solved = pattern.factor(joined.blocks).solve(-joined.gradient.ravel()).reshape(K, 6)
        predicted = joined.total - joined.energy - float(np.einsum("ij,ij->", solved, joined.gradient))
        x = network.follow(joined, solved)
        scale = 1.0
        while True:
            there = network.join(step_poses(joined.poses, x, scale))
            if there.total <= joined.total * (1.0 + 1e-12) or scale < 1e-4:
                break
            scale *= 0.5
        if there.total > joined.total * (1.0 + 1e-12):
            break
        joined = there
        history.append(joined.total)
        far = float(np.sqrt(np.max(np.sum(x[:, 3:] ** 2, axis=1)))) * scale
        if progress is not None:
            progress(joined.total)
        if scale == 1.0 and predicted < max(gain * joined.total, 1e-9):
            converged = True
            break
    return RelaxedChain(joined.poses, joined.total, history, predicted, far, converged)
