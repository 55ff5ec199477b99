"""Relative poses of revisited places in the initial path of a refinement, checked with the scans in between.

Scans of consecutive steps constrain the path much better than a filter, so an initial path in which a wrong loop
brought two places together contradicts them by many σ. Relative poses between traversals in the initial path are used
as guides with a robust kernel (graduated non-convexity), only to bring the scans of the traversals within reach of each
other. They are no measurements, and are removed before the covariance is computed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag
from scipy.spatial import cKDTree

from graphslam.core.geometry import Array
from graphslam.core.poses import Group, group_of
from graphslam.refine.motion import MotionTerms
from graphslam.refine.problem import LinearisedProblem
from graphslam.refine.surfaces import NEIGHBOURS, ScanReturns

Index = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

POSITION, ANGLE = 0.15, 0.015
"""σ of the initial relative pose of two traversals [m], [rad]: small enough for the matching of the first round."""
DOUBT = 4.0
"""Factor on the covariance of a path that only scans of consecutive chunks constrain."""
FAR = 1.0, 0.1
"""A guide with a larger difference to the refined path is a wrong loop of the initial path [m], [rad]."""
ACCEPTED = 16.8
"""χ² of six degrees of freedom at 99 %: above it a guide contradicts the scans in between."""
TOGETHER = 8
"""Guides whose covariances are computed in one pass over the factor."""


@dataclass(frozen=True, slots=True)
class RevisitConstraints:
    """Relative poses between traversals in the initial path.

    Parameters
    ----------
    steps : (m, 2)
        Earlier and later step.
    poses : (m, 7|3)
        ``T_earlier_later`` in the initial path.
    """

    steps: Index
    poses: Array

    def __len__(self) -> int:
        return len(self.steps)

    def terms(self, path: Array, weights: Array) -> MotionTerms:
        """Factors at a path, weighted ``(m,)``."""
        g = group_of(path)
        a, b = self.steps.T
        step = g.between(path[a], path[b])
        e = g.log(g.between(self.poses, step))
        Jr = g.right_jacobian_inverse(e)
        J = np.concatenate([-Jr @ g.adjoint(g.inverse(step)), Jr], axis=2)
        W = np.sqrt(weights)[:, None] / _sigmas(g)
        return MotionTerms(W * e, W[..., None] * J, self.steps, (g.dof, g.dof), "guides")

    def squared(self, path: Array) -> Array:
        """χ² of each ``(m,)``."""
        g = group_of(path)
        a, b = self.steps.T
        e = g.log(g.between(self.poses, g.between(path[a], path[b])))
        return np.asarray(np.sum((e / _sigmas(g)) ** 2, axis=1))

    def far(self, path: Array) -> Flags:
        """Mask of guides with a difference to the path above :data:`FAR`, which scans could not bridge."""
        g = group_of(path)
        a, b = self.steps.T
        off, turned = tangent_lengths(g.log(g.between(self.poses, g.between(path[a], path[b]))), g)
        return np.asarray((off > FAR[0]) | (turned > FAR[1]), dtype=np.bool_)

    def distances(self, path: Array, solved: LinearisedProblem, width: int) -> Array:
        """Squared Mahalanobis distances ``(m,)`` of the guides from a path with known covariance.

        The covariance from scans of consecutive chunks alone may be too small by up to :data:`DOUBT`.
        """
        g = group_of(path)
        step = g.between(path[self.steps[:, 0]], path[self.steps[:, 1]])
        e = g.log(g.between(self.poses, step))
        A = -g.adjoint(g.inverse(step))
        own = np.diag(_sigmas(g) ** 2)
        out, rows = np.empty(len(self)), (self.steps[:, :, None] * width + np.arange(width)).reshape(-1, 2 * width)
        for first in range(0, len(self), TOGETHER):
            some = range(first, min(first + TOGETHER, len(self)))
            # Jᵀ of each guide on the diagonal
            J = block_diag(*(np.concatenate([A[k], np.eye(width)], axis=1).T for k in some))
            C = solved.factor.inverse_block(rows[some].ravel(), J).reshape(len(some), width, len(some), width)
            for i, k in enumerate(some):
                out[k] = e[k] @ np.linalg.solve(DOUBT * C[i, :, i] + own, e[k])
        return out


def tangent_lengths(e: Array, g: Group) -> tuple[Array, Array]:
    """Translation [m] and rotation [rad] of tangents ``(m, d)``, each ``(m,)``."""
    turn = np.delete(e, np.r_[g.position], axis=1)
    return np.linalg.norm(e[:, g.position], axis=1), np.linalg.norm(turn, axis=1)


def _sigmas(g: Group) -> Array:
    s = np.full(g.dof, ANGLE)
    s[g.position] = POSITION
    return s


def find_revisit_constraints(cloud: ScanReturns, start: Array, reach: float) -> RevisitConstraints:
    """The nearest chunk of every other traversal within ``reach`` [m] of each chunk, at the path ``(n, 7|3)``."""
    d, C = cloud.points.shape[1], cloud.chunks
    first = np.searchsorted(cloud.chunk, np.arange(C))
    last = np.append(first[1:], len(cloud.chunk)) - 1
    middle = (first + last) // 2
    at = start[middle, :d]
    pairs = cKDTree(at).query_pairs(reach, output_type="ndarray").astype(np.int64)
    pairs = np.sort(pairs, axis=1)
    pairs = pairs[pairs[:, 1] - pairs[:, 0] > NEIGHBOURS]
    if not len(pairs):
        return RevisitConstraints(np.zeros((0, 2), np.int64), np.zeros((0, start.shape[1])))
    distance = np.linalg.norm(at[pairs[:, 1]] - at[pairs[:, 0]], axis=1)
    order = np.lexsort((pairs[:, 0], pairs[:, 1]))
    pairs, distance = pairs[order], distance[order]
    # consecutive partners of the later chunk are one traversal: its nearest one is used
    new = (np.diff(pairs[:, 1], prepend=-1) != 0) | (np.diff(pairs[:, 0], prepend=-9) > 1)
    group = np.cumsum(new) - 1
    best = np.lexsort((distance, group))
    chosen = best[np.unique(group[best], return_index=True)[1]]
    steps = middle[pairs[chosen]]
    g = group_of(start)
    return RevisitConstraints(steps, g.between(start[steps[:, 0]], start[steps[:, 1]]))
