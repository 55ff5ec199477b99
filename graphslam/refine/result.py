"""What a refinement and the check of a path by its scans result in."""

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
"""Shares of agreeing points of two paths that differ by less than this do not rank the paths."""


@dataclass(frozen=True, slots=True)
class RefinementRound:
    """One association and what followed.

    Parameters
    ----------
    distance : float
        Greatest distance of a pair [m].
    range_sigma, surface_sigma : float
        σ of a range and of the surfaces themselves [m].
    pairs, passes : int
        Pairs of points, and how many of them between different passes.
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
    """Two attempts, from the start and from the odometry alone.

    Parameters
    ----------
    apart : float
        RMS distance between their paths [m].
    kept, left : float
        Agreement of the scans at the path that was kept, and at the other, to the same noise.
    taken : bool
        That from the odometry was kept.
    """

    apart: float
    kept: float
    left: float
    taken: bool


@dataclass(frozen=True, slots=True)
class ScanCheck:
    """Do the scans contradict a path? Measured before anything is refined.

    Parameters
    ----------
    odometry, start : float
        Share of the points of passes and neighbours that lie on the surfaces of the others, along the path of the
        odometry and along the path that was checked, to the same noise.
    refused : (m, 2)
        Steps that the path draws together although the scans between contradict it.
    """

    odometry: float
    start: float
    refused: Index

    @property
    def contradicted(self) -> bool:
        """Do the scans agree better along the odometry, or does the path draw steps together wrongly?"""
        return len(self.refused) > 0 or self.odometry > self.start + AGREEMENT_NOISE


@dataclass(frozen=True)
class Refinement:
    """A refined path with its uncertainty, and what was found on the way.

    Parameters
    ----------
    times : (n,)
    poses : (n, 7) or (n, 3)
        In the frame of the start, whose first position and heading are held.
    covariances : (n, d, d)
        Right tangent, first position and heading held.
    start : (n, 7) or (n, 3)
    yaw_bias : (k, 2)
        Time [s] and bias of the yaw rate [rad/s] at the knots.
    constants : dict of str to (value, σ)
        ``scale``, ``side``, ``rise``, ``clock``, ``roll``, ``pitch``; ``bend``, ``turn``.
    parts : dict of str to float
        Objective by kind of factor at the end.
    refused : (m, 2)
        Steps that the start drew together although the scans between contradict it.
    agreement : (start, refined)
        Share of the points of passes and neighbours that lie on the surfaces of the others, at both paths.
    reckoned : float
        The same share at the path of the odometry alone.
    other : AttemptComparison or None
        The second attempt, from the odometry, where the start contradicts the scans or the odometry agrees better.
    scales : (c,)
        By which the σ of the odometry's components were widened, since the scans show more.
    walk : float
        The same of the walk of the yaw bias.
    motion : float
        χ² of the walk of the yaw bias by its degrees of freedom: far above 1 where the scans of passes and the motion
        contradict each other.
    solved : LinearisedProblem
        The last linearisation, for joint covariances.
    nodes : (m,)
        Steps that are nodes of the problem; between them the path follows the odometry.
    between : StepsBetweenNodes
        How the steps lie between nodes, and what they do not share with any.
    fixes : FixReport or None
        What fixes did; None: there were none, or their way is too short to say where north is.
    alike : float
        By how much sums of residuals of one scan vary more than independent errors would, for which covariances are
        larger; 1: no more.
    left : float or None
        Agreement at the refined path where that of the odometry was taken instead, since scans agree better there.
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
        """Do the scans agree with each other at the refined path at least as well as at the start?"""
        return self.agreement[1] >= self.agreement[0]

    @property
    def input_better(self) -> bool:
        """Do they agree better at the path of the odometry than at the start and at the refined path?"""
        return self.reckoned > max(self.agreement)

    def joint(self, steps: npt.ArrayLike) -> Array:
        """Joint covariance of some steps ``(k·d, k·d)``."""
        d, m = self.covariances.shape[1], self.between
        k = np.asarray(steps, np.int64)
        rows, at = np.unique(np.concatenate([m.a[k], m.b[k]]), return_inverse=True)
        P = self.solved.factor.inverse_block((rows[:, None] * d + np.arange(d)).ravel())
        J = np.zeros((len(k), d, len(rows), d))
        every = np.arange(len(k))
        J[every, :, at[: len(k)]] += m.by_a[k]
        J[every, :, at[len(k) :]] += m.by_b[k]
        rows_of = J.reshape(len(k) * d, -1)
        C = (rows_of @ P @ rows_of.T).reshape(len(k), d, len(k), d)
        C[every, :, every] += m.own[k]
        return np.asarray(C.reshape(len(k) * d, -1))

    def at_all_steps(self, steps: Scans, start: Array, nodes: Index) -> Refinement:
        """A refinement of some steps, with the steps between them along the odometry."""
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
