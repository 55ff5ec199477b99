"""The skeleton network at given poses: objective, gradient, and matrix-free products with the Schur complement."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np

from graphslam.core.errors import IndeterminateError
from graphslam.core.geometry import Array
from graphslam.core.se3 import matrix_to_quat, so3_left_jacobian_inverse, so3_log
from graphslam.core.workers import run_tasks
from graphslam.skeleton import chain_kernels as chains
from graphslam.skeleton import landmark_kernels as kernels
from graphslam.skeleton.landmark_kernels import Detections, Poses
from graphslam.skeleton.problem import SkeletonProblem

PARTS = 2
"""Ranges of poses with separate sums over landmarks, added in order; results depend on it, not on threads."""


class Workers:
    """Run a kernel over ranges on several threads; the ranges, and so the results, do not depend on their number."""

    def __init__(self, threads: int) -> None:
        self.threads = threads

    def over(self, work: Callable[..., Any], ranges: Any) -> list[Any]:
        """``[work(*r) for r in ranges]``, in that order."""
        return run_tasks(work, ranges, self.threads)


class WorkRanges:
    """Ranges of poses and landmarks, and the arrays for the sums of each range of poses.

    Landmarks are numbered by first observation, so the first range of poses observes the first landmarks only.
    """

    def __init__(self, problem: SkeletonProblem, workers: Workers, parts: int = PARTS) -> None:
        self.problem, self.workers = problem, workers
        N, M = problem.poses, problem.measurements
        cuts = np.searchsorted(problem.first, [M * k // parts for k in range(parts + 1)]).astype(np.int64)
        cuts[0], cuts[-1] = 0, N
        self.ranges = [(int(a), int(b)) for a, b in pairwise(cuts)]
        self.reach: list[int] = []
        self.counts = np.zeros(problem.landmarks, dtype=np.int32)
        for a, b in self.ranges:
            high = self.reach[-1] if self.reach else 0
            for c, e in problem.chunks(a, b):
                sight = problem.observations_of(c, e)
                label = sight.landmark[problem.first[c] - sight.base : problem.first[e] - sight.base]
                high = max(high, int(label.max(initial=-1)) + 1)
                kernels.count_observations(label, self.counts)
            self.reach.append(high)

    def over_landmarks(self, work: Callable[[int, int], None]) -> None:
        """``work(begin, end)`` for ranges of landmarks."""
        self.workers.over(work, self.problem.pieces(self.problem.landmarks))

    def over_poses(self, work: Callable[[int, int], Any]) -> list[Any]:
        """``work(begin, end)`` for ranges of poses, without the measurements."""
        return self.workers.over(work, (c for r in self.ranges for c in self.problem.chunks(*r)))

    def over(self, work: Callable[..., None]) -> None:
        """``work(k, detections, begin, end)`` for the chunks of each range k of poses, in order within a range."""

        def walk(k: int) -> None:
            for a, b in self.problem.chunks(*self.ranges[k]):
                work(k, self.problem.observations_of(a, b), a, b)

        self.workers.over(walk, [(k,) for k in range(len(self.ranges))])

    def sums(self, width: int) -> list[Array]:
        """A zero array ``(landmarks in reach, width)`` per range of poses; the last one has all landmarks."""
        return [self.problem.room((r, width)) for r in self.reach]

    def total(self, sums: list[Array]) -> Array:
        """Sum over the ranges, in order, written to the last array."""
        out = sums[-1]

        def add(a: int, b: int) -> None:
            for part in sums[:-1]:
                out[a : min(b, len(part))] += part[a:b]

        self.over_landmarks(add)
        return out


class Network:
    """Landmarks, objective and gradient of a skeleton network at some poses.

    Attributes
    ----------
    landmarks : (L, 3)
        Optimal landmark positions, given the poses.
    objective : float
        Sum of squared normalised residuals.
    gradient : (N, 6)
        Half its derivative by the poses (rotation, then translation, in the world frame), with optimal landmarks.
    """

    def __init__(self, layout: WorkRanges, poses: Poses) -> None:
        self.layout, self.poses = layout, poses
        problem = layout.problem
        D, b = layout.sums(6), layout.sums(3)
        layout.over(lambda k, sight, a, e: kernels.sum_landmarks(sight, poses, a, e, D[k], b[k]))
        self.inverse, self.landmarks = layout.total(D), layout.total(b)
        layout.over_landmarks(lambda a, e: kernels.solve_landmarks(self.inverse, self.landmarks, a, e))
        N = problem.poses
        g, each = np.empty((N, 6)), np.empty(N)
        layout.over(lambda k, sight, a, e: kernels.pose_gradients(sight, poses, self.landmarks, a, e, g, each))
        self.objective = float(np.sum(each)) + self._add_chain(g, None, None)
        self.gradient = g
        self._blocks: tuple[Array, Array] | None = None

    def _add_chain(self, g: Array, diagonal: Array | None, upper: Array | None) -> float:
        """Add odometry, tilt and priors; returns their objective."""
        problem, poses = self.layout.problem, self.poses
        none = np.empty((0, 6, 6))
        total = 0.0
        for span in [(0, problem.poses)] if diagonal is None else problem.pieces(problem.poses):
            total += chains.linearise_chain(
                problem.chain,
                poses,
                span,
                diagonal is not None,
                none if diagonal is None else diagonal,
                none if upper is None else upper,
                g,
            )
        return float(total) + add_fixes(problem, poses, g, diagonal) + add_start(problem, poses, g, diagonal)

    def chain_blocks(self) -> tuple[Array, Array]:
        """Blocks ``(N, 6, 6)`` and ``(N - 1, 6, 6)`` of odometry, tilt and priors."""
        if self._blocks is None:
            N = self.layout.problem.poses
            diagonal, upper = self.layout.problem.room((N, 6, 6)), self.layout.problem.room((N - 1, 6, 6))
            self._add_chain(np.zeros((N, 6)), diagonal, upper)
            self._blocks = diagonal, upper
        return self._blocks

    def diagonal(self) -> Array:
        """Diagonal blocks ``(N, 6, 6)`` of the Schur complement."""
        layout = self.layout
        chain, blocks = self.chain_blocks()[0], layout.problem.room((layout.problem.poses, 6, 6))
        landmarks = (self.landmarks, self.inverse)

        def fill(_: int, sight: Detections, a: int, e: int) -> None:
            blocks[a:e] = chain[a:e]
            kernels.schur_diagonal(sight, self.poses, landmarks, a, e, blocks)

        layout.over(fill)
        return blocks

    def product(self, v: Array) -> Array:
        """Schur complement times ``v (N, 6)``."""
        layout = self.layout
        parts = layout.sums(3)
        layout.over(
            lambda k, sight, a, e: kernels.gather_landmarks(sight, self.poses, self.landmarks, v, a, e, parts[k])
        )
        t = layout.total(parts)
        layout.over_landmarks(lambda a, e: kernels.solve_landmark_sums(self.inverse, t, a, e))
        diagonal, upper = self.chain_blocks()
        out = np.empty_like(v)

        def spread(_: int, sight: Detections, a: int, e: int) -> None:
            chains.chain_product(diagonal, upper, v, a, e, out)
            kernels.scatter_to_poses(sight, self.poses, (self.landmarks, t), v, a, e, out)

        layout.over(spread)
        return out


def add_fixes(problem: SkeletonProblem, poses: Poses, g: Array, diagonal: Array | None) -> float:
    """Add GPS to gradient and blocks; returns its objective."""
    if not problem.fixes:
        return 0.0
    at = problem.gps_pose
    r = poses.position[at] - problem.gps_position
    info = np.broadcast_to(problem.gps_information, (len(r), 3, 3))
    f = np.einsum("nij,nj->ni", info, r)
    rows = np.zeros((len(r), 6))
    rows[:, 3:] = f
    np.add.at(g, at, rows)
    if diagonal is not None:
        wide = np.zeros((len(r), 6, 6))
        wide[:, 3:, 3:] = info
        np.add.at(diagonal, at, wide)
    return float(np.einsum("ni,ni->", r, f))


def add_start(problem: SkeletonProblem, poses: Poses, g: Array, diagonal: Array | None) -> float:
    """Add the prior on the first pose to gradient and blocks; returns its objective."""
    w = so3_log(matrix_to_quat(poses.rotation[0] @ problem.start_rotation.T))
    r = np.concatenate([w, poses.position[0] - problem.start_position])
    J = np.eye(6)
    J[:3, :3] = so3_left_jacobian_inverse(w)
    f = problem.start_information @ r
    g[0] += J.T @ f
    if diagonal is not None:
        diagonal[0] += J.T @ problem.start_information @ J
    return float(r @ f)


def step_poses(poses: Poses, step: Array, scale: float = 1.0) -> Poses:
    """Poses after a step ``(N, 6)``."""
    R, p = np.empty_like(poses.rotation), np.empty_like(poses.position)
    chains.move_chain(poses.rotation, poses.position, step, scale, R, p)
    return Poses(R, p)


def inverse_of(blocks: Array, over: Callable[..., list[Any]], what: str) -> Array:
    """Replace blocks ``(n, 6, 6)`` by their inverses; ``over(work)`` calls ``work(begin, end)`` for ranges of them."""
    bad = [k for k in over(lambda a, b: chains.invert_blocks(blocks, a, b)) if k >= 0]
    if bad:
        raise IndeterminateError(f"{what} {min(bad)} of the skeleton network is not constrained", (f"x{min(bad)}",))
    return blocks
