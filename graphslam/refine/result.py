"""Results of a refinement, and of the check of a path with its scans."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from graphslam.core.geometry import Array
from graphslam.refine.fixes import FixReport
from graphslam.refine.nodes import StepsBetweenNodes, path_between
from graphslam.refine.problem import LinearisedProblem
from graphslam.refine.scans import Scans

Index = npt.NDArray[np.int64]

AGREEMENT_NOISE = 0.01
"""Two shares of agreeing points that differ by less are considered equal."""


@dataclass(frozen=True, slots=True)
class RefinementRound:
    """One association with its Gauss–Newton steps.

    Parameters
    ----------
    distance : float
        Largest distance of a pair [m].
    range_sigma, surface_sigma : float
        σ of a range and of the surfaces [m].
    pairs, passes : int
        Number of pairs of points, and of those between different traversals.
    spread : float
        1.48 × the median absolute residual [m].
    moved : float
        RMS by which positions changed [m].
    """

    distance: float
    range_sigma: float
    surface_sigma: float
    pairs: int
    passes: int
    spread: float
    moved: float


@dataclass(frozen=True, slots=True)
class AttemptComparison:
    """Comparison of two refinements, from the initial path and from the odometry alone.

    Parameters
    ----------
    apart : float
        RMS distance between their paths [m].
    kept, left : float
        Agreement of the scans along the path that was kept, and along the other, with the same noise.
    swapped : bool
        The one from the odometry was kept.
    """

    apart: float
    kept: float
    left: float
    swapped: bool


@dataclass(frozen=True, slots=True)
class ScanCheck:
    """Agreement of the scans with a path, before a refinement.

    Parameters
    ----------
    odometry, start : float
        Share of the points that are on the surfaces of other traversals and neighbours, along the path of the odometry
        and along the checked path, with the same noise.
    refused : (m, 2)
        Steps that the path brings together although the scans in between contradict it.
    """

    odometry: float
    start: float
    refused: Index

    @property
    def contradicted(self) -> bool:
        """Do the scans agree better along the odometry, or does the path bring steps together wrongly?"""
        return len(self.refused) > 0 or self.odometry > self.start + AGREEMENT_NOISE


@dataclass(frozen=True)
class Refinement:
    """A refined path with its uncertainty, and other results of the refinement.

    Parameters
    ----------
    times : (n,)
    poses : (n, 7) or (n, 3)
        In the frame of the initial path, whose first position and heading are fixed.
    covariances : (n, d, d)
        Right tangent, first position and heading fixed.
    start : (n, 7) or (n, 3)
    yaw_bias : (k, 2)
        Time [s] and bias of the yaw rate [rad/s] at the knots.
    constants : dict of str to (value, σ)
        ``scale``, ``side``, ``rise``, ``clock``, ``roll``, ``pitch``; ``bend``, ``turn``.
    parts : dict of str to float
        Objective by kind of factor at the end.
    refused : (m, 2)
        Steps that the initial path brings together although the scans in between contradict it.
    agreement : (start, refined)
        Share of the points that are on the surfaces of other traversals and neighbours, at both paths.
    reckoned : float
        The same share at the path of the odometry alone.
    other : AttemptComparison or None
        A second refinement, from the odometry, if scans contradict the initial path or agree better with odometry.
    scales : (c,)
        Estimated factors on the σ of the odometry's components, ≥ 1.
    walk : float
        The same for the random walk of the yaw bias.
    motion : float
        χ² of the yaw-bias random walk per degree of freedom: far above 1 if the scans of several traversals contradict
        the motion.
    solved : LinearisedProblem
        The last linearisation, for joint covariances.
    nodes : (m,)
        Steps that are nodes of the problem; between them the path follows the odometry.
    between : StepsBetweenNodes
        Steps between nodes, with their own covariance.
    fixes : FixReport or None
        Report on fixes; None: there were none, or their path is too short to determine the heading.
    alike : float
        Ratio of the variance of sums of residuals of one scan to that of independent errors, ≥ 1; the covariance is
        scaled by it.
    left : float or None
        Agreement at the refined path, if the path of the odometry is the result because scans agree better there.
    """

    times: Array
    poses: Array
    covariances: Array
    start: Array
    yaw_bias: Array
    constants: dict[str, tuple[float, float]]
    rounds: tuple[RefinementRound, ...]
    parts: dict[str, float]
    refused: Index
    agreement: tuple[float, float]
    reckoned: float
    other: AttemptComparison | None
    scales: Array
    walk: float
    motion: float
    solved: LinearisedProblem
    nodes: Index
    between: StepsBetweenNodes
    fixes: FixReport | None = None
    alike: float = 1.0
    left: float | None = None

    @property
    def better(self) -> bool:
        """Is the scan agreement at the refined path at least as good as at the initial path?"""
        return self.agreement[1] >= self.agreement[0]

    @property
    def input_better(self) -> bool:
        """Is it better at the path of the odometry than at the initial path and at the refined path?"""
        return self.reckoned > max(self.agreement)

    def joint(self, steps: npt.ArrayLike, J: Array | None = None) -> Array:
        """Joint covariance C of some steps ``(k·d, k·d)``, right tangents; with ``J (k·d, m)`` ``Jᵀ C J``, faster."""
        d, m = self.covariances.shape[1], self.between
        k = np.asarray(steps, np.int64)
        rows, at = np.unique(np.concatenate([m.a[k], m.b[k]]), return_inverse=True)
        by = np.zeros((len(k), d, len(rows), d))
        every = np.arange(len(k))
        by[every, :, at[: len(k)]] += m.by_a[k]
        by[every, :, at[len(k) :]] += m.by_b[k]
        J = np.eye(len(k) * d) if J is None else J
        some = (rows[:, None] * d + np.arange(d)).ravel()
        C = self.solved.factor.inverse_block(some, by.reshape(len(k) * d, -1).T @ J)
        J = J.reshape(len(k), d, -1)
        return np.asarray(C + np.sum(np.swapaxes(J, 1, 2) @ m.own[k] @ J, axis=0))

    def at_all_steps(self, steps: Scans, start: Array, nodes: Index) -> Refinement:
        """Extend a refinement of some steps to the steps between them, along the odometry."""
        if len(nodes) == len(steps):
            return self
        poses, covariances, between = path_between(steps, nodes, self.poses, self.covariances, self.scales)
        return replace(
            self,
            times=steps.times,
            poses=poses,
            covariances=covariances,
            start=start,
            refused=nodes[self.refused],
            nodes=nodes,
            between=between,
        )
