"""Initial poses: the chain of odometry with tilt and GPS, then one pass against older landmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphslam.core.errors import IndeterminateError
from graphslam.core.geometry import Array
from graphslam.skeleton import chain_kernels as kernels
from graphslam.skeleton.landmark_kernels import Poses
from graphslam.skeleton.problem import SkeletonProblem
from graphslam.skeleton.schur import add_fixes, add_start, step_poses
from graphslam.skeleton.start_kernels import forward_pass_kernel


def chain_start(problem: SkeletonProblem, iterations: int = 6) -> Poses:
    """Optimum of odometry, tilt, GPS and prior only: Gauss-Newton from dead reckoning, block-tridiagonal.

    A step that increases the objective is halved. It ends when a step gains less than 0.1 %, or after ``iterations``.
    """
    poses = problem.dead_reckoning()
    N = problem.poses
    blocks = np.empty((N, 6, 6)), np.empty((N - 1, 6, 6))
    objective, g = _linearised(problem, poses, *blocks)
    for _ in range(iterations):
        step = -g
        # on a long path without GPS the information of its end can be below the rounding error of the odometry
        np.einsum("nii->ni", blocks[0])[:] *= 1.0 + 1e-12
        bad = kernels.solve_chain(*blocks, step)
        if bad >= 0:
            raise IndeterminateError(f"pose {bad} of the chain is not constrained", (f"x{bad}",))
        scale = 1.0
        while True:
            there = step_poses(poses, step, scale)
            after, g = _linearised(problem, there, *blocks)
            if after <= objective or scale < 1e-3:
                break
            scale *= 0.5
        if after > objective:
            break
        poses, gain, objective = there, objective - after, after
        if gain < 1e-3 * after + 1e-9 * N:
            break
    return poses


def _linearised(problem: SkeletonProblem, poses: Poses, diagonal: Array, upper: Array) -> tuple[float, Array]:
    """Objective and half the gradient of the chain; its blocks overwrite ``diagonal`` and ``upper``."""
    g = np.zeros((problem.poses, 6))
    diagonal[:] = 0.0
    upper[:] = 0.0
    total = kernels.linearise_chain(problem.chain, poses, (0, problem.poses), True, diagonal, upper, g)
    total += add_fixes(problem, poses, g, diagonal) + add_start(problem, poses, g, diagonal)
    return float(total), g


@dataclass(frozen=True)
class ForwardPass:
    """Result of :func:`forward_pass`.

    Parameters
    ----------
    aligned : int
        Number of poses that were aligned with landmarks of an earlier traversal.
    refused : int
        Number of rejected observations of such landmarks.
    """

    poses: Poses
    aligned: int
    refused: int


TURN_SIGMA, DISTANCE_SIGMA = 2e-3, 0.03
"""Prior σ of a pose around its prediction [rad, m]."""
GATE = 16.27
"""99.9 % quantile of χ² with three degrees of freedom."""


def forward_pass(
    problem: SkeletonProblem,
    chain: Poses,
    *,
    ago: int = 50,
) -> ForwardPass:
    """Process the poses in order and align each with landmarks first observed more than ``ago`` poses before.

    A pose is predicted by the chain's increment. If at least three old landmarks are in view, three Gauss-Newton steps
    align it with their running means; a landmark with a χ² above :data:`GATE` and above nine times the median of those
    in view is excluded in the second and third. An observation that is then above the gate is *refused*: it is not
    added to the mean of its landmark, so a false correspondence affects neither this pose nor a later one.
    """
    N, L = problem.poses, problem.landmarks
    out = Poses(np.empty((N, 3, 3)), np.empty((N, 3)))
    seen, D, b = np.full(L, -1, dtype=np.int32), problem.room((L, 6)), problem.room((L, 3))
    rules = (int(ago), TURN_SIGMA**-2, DISTANCE_SIGMA**-2, GATE)
    aligned = refused = 0
    for span in problem.chunks(0, N):
        t, r = forward_pass_kernel(problem.observations_of(*span), chain, span, rules, seen, D, b, out)
        aligned, refused = aligned + int(t), refused + int(r)
    return ForwardPass(out, aligned, refused)
