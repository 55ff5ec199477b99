"""Pose graphs that are one long chain with loops: everything between loop ends is eliminated exactly, along the chain.

Poses at which a loop begins or ends stay, with the first and the last one; the links of a segment between two of them
are joined to one. The reduced network is factored by the sparse block Cholesky. Time and memory are linear in the
poses, and depend on the loops by the fill of a network of twice their number.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError, IndeterminateError, SolverError
from graphslam.core.geometry import Array
from graphslam.skeleton import chain_kernels as chains
from graphslam.skeleton import segment_kernels as kernels
from graphslam.skeleton.landmark_kernels import Poses
from graphslam.skeleton.preconditioner import KeyframePattern
from graphslam.skeleton.problem import inverse_covariance
from graphslam.skeleton.schur import moved
from graphslam.skeleton.segment_kernels import Links


@dataclass(frozen=True, eq=False)
class ChainGraph:
    """Odometry from pose to pose, and loops between any two. The first pose is held at the origin.

    Parameters
    ----------
    rotation, translation : (N - 1, 3, 3), (N - 1, 3)
        From each pose to the next, in the body frame.
    covariance : (6, 6) or (N - 1, 6, 6)
        Rotation vector [rad], then way [m].
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
        _ = self.links

    @property
    def poses(self) -> int:
        """Number of poses N."""
        return len(self.translation) + 1

    @cached_property
    def links(self) -> tuple[Links, Links]:
        """Odometry, in segments between the ends of loops, and loops, as the kernels take them."""
        N, L = self.poses, len(self.ends)
        info = inverse_covariance(self.covariance, "covariance")
        more = inverse_covariance(self.loop_covariance, "loop_covariance")
        k = np.arange(N, dtype=np.int64)
        kept = np.unique(np.concatenate([k[[0, -1]], self.ends.ravel()]))
        steps = np.column_stack([k[:-1], k[1:]])
        return (
            Links(steps, kept, self.rotation, self.translation, self.covariance, info),
            Links(self.ends, np.arange(L + 1), self.loop_rotation, self.loop_translation, self.loop_covariance, more),
        )

    def dead_reckoning(self) -> Poses:
        """Poses from the odometry alone."""
        R, p = np.empty((self.poses, 3, 3)), np.empty((self.poses, 3))
        R[0], p[0] = np.eye(3), 0.0
        chains.reckon(self.rotation, self.translation, R, p)
        return Poses(R, p)


@dataclass(frozen=True, eq=False)
class RelaxedChain:
    """A relaxed chain with loops.

    Parameters
    ----------
    poses : Poses
    objective : float
        Σ rᵀ Ω r; residuals are the rotation vector and the way in the frame of the first pose of each link.
    history : list of float
        The objective before the first step and after each.
    predicted, largest_move : float
        What the last step was predicted to gain, and how far it moved a pose [m].
    converged : bool
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
    """Gauss-Newton, each system solved exactly.

    Parameters
    ----------
    graph : ChainGraph
    poses : Poses, optional
        Default: dead reckoning.
    iterations : int
    gain : float
        It ends when a step is predicted to gain less than this share of the objective (and 1e-9 at least).
    progress : callable, optional
        Called with the objective after every step.

    Raises
    ------
    IndeterminateError
        Nothing holds a pose.
    SolverError
        The objective is not finite.
    """
    odometry, loops = graph.links
    N, kept = graph.poses, odometry.first
    K = len(kept)
    # the reduced network: segments of the odometry, then loops
    c = np.arange(K)
    ends = np.concatenate([np.column_stack([c[:-1], c[1:]]), np.searchsorted(kept, graph.ends)]).astype(np.int64)
    keys, place = np.unique(np.concatenate([c * K + c, ends.min(axis=1) * K + ends.max(axis=1)]), return_inverse=True)
    pattern = KeyframePattern(keys.astype(np.int64), K)

    def joined(poses: Poses) -> tuple[float, Array, Array]:
        covariance, misfit = np.empty((len(ends), 6, 6)), np.empty((len(ends), 6))
        total = kernels.join_links(odometry, poses, covariance[: K - 1], misfit[: K - 1])
        total += kernels.join_links(loops, poses, covariance[K - 1 :], misfit[K - 1 :])
        return float(total), covariance, misfit

    here = graph.dead_reckoning() if poses is None else poses
    total, stiffness, misfit = joined(here)
    history, predicted, far, converged = [total], np.inf, np.inf, False
    for _ in range(iterations):
        if not np.isfinite(total):
            raise SolverError("objective of the chain graph is not finite")
        blocks, g = np.zeros((len(keys), 6, 6)), np.zeros((K, 6))
        energy, bad = kernels.tie_ends(ends, here.position[kept], stiffness, misfit, (place[:K], place[K:]), blocks, g)
        if bad >= 0:
            i, j = kept[ends[bad]]
            raise IndeterminateError(f"nothing ties pose {i} of the chain to pose {j}", (f"x{i}", f"x{j}"))
        blocks[place[0]] += 1e12 * np.eye(6)  # held: softer than the rounding of its moves, harder than any measurement
        x = np.empty((N, 6))
        x[kept] = pattern.factor(blocks).solve(-g.ravel()).reshape(K, 6)
        predicted = total - energy - float(np.einsum("ij,ij->", x[kept], g))
        kernels.follow_links(odometry, here, stiffness[: K - 1], misfit[: K - 1], x)
        scale = 1.0
        while True:
            there = moved(here, x, scale)
            after, stiffness, misfit = joined(there)
            if after <= total * (1.0 + 1e-12) or scale < 1e-4:
                break
            scale *= 0.5
        if after > total * (1.0 + 1e-12):
            break
        here, total = there, after
        history.append(total)
        far = float(np.sqrt(np.max(np.sum(x[:, 3:] ** 2, axis=1)))) * scale
        if progress is not None:
            progress(total)
        if scale == 1.0 and predicted < max(gain * total, 1e-9):
            converged = True
            break
    return RelaxedChain(here, total, history, predicted, far, converged)
