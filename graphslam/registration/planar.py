"""Generalised ICP in 2-D (Segal, Haehnel and Thrun 2009, eq. 2), vectorised over all pairs.

A 3-D matcher does not work for points in the plane z = 0, because their surface is that plane. Here the local shape of
a point is a line.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphslam.core import geometry as se2
from graphslam.core.geometry import Array
from graphslam.registration.plane_kernels import line_alignment
from graphslam.registration.target import FLATNESS, Target


@dataclass(frozen=True, slots=True)
class PlanarAlignment:
    """Result of an iterative matcher.

    Parameters
    ----------
    T : (3,) or (7,)
        ``T_target_source``.
    hessian : (d, d)
        Of half the sum of the squared distances, in the right tangent.
    error : float
        That half sum.
    pairs : int
        Source points that were paired in the last step.
    """

    T: Array
    hessian: Array
    error: float
    pairs: int


def linearise_alignment(source: Target, target: Target, T: Array, radius: float) -> tuple[Array, Array, float, int]:
    """Hessian ``(3, 3)``, gradient ``(3,)``, half squared error and number of pairs nearer than ``radius`` at ``T``.

    ``e = ½ Σ dᵀ M d`` with ``d = T p - q`` and ``M = (C_q + R C_p Rᵀ)⁻¹``; ``M`` is constant.
    """
    moved = se2.se2_transform(T, source.points)
    _, which = target.tree.query(moved, distance_upper_bound=radius)
    lines = (source.points, source.lines[0], target.points, target.lines[0])
    return line_alignment(*lines, T, which, FLATNESS)


def align_planar(
    source: Target,
    target: Target,
    T: Array,
    radius: float,
    iterations: int,
    rotation_epsilon: float,
    translation_epsilon: float,
) -> PlanarAlignment:
    """Gauss-Newton steps from ``T (3,)`` with new pairs at each step; ends at a singular matrix."""
    H, b, error, pairs = linearise_alignment(source, target, T, radius)
    for _ in range(iterations):
        if not pairs:
            break
        # slight damping: undetermined directions do not move
        step = -np.linalg.solve(H + 1e-9 * np.trace(H) * np.eye(3), b)
        T = se2.se2_compose(T, se2.se2_exp(step))
        H, b, error, pairs = linearise_alignment(source, target, T, radius)
        if np.hypot(step[0], step[1]) < translation_epsilon and abs(step[2]) < rotation_epsilon:
            break
    return PlanarAlignment(T, H, error, pairs)
