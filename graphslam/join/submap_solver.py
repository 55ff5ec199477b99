"""Damped Gauss–Newton over submaps: the least-squares optimum, the reference of all methods.

The batch solver starts it from the chain of submaps; map-joining methods use it for the polish of a joined map.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt
import scipy.linalg as la
import scipy.sparse as sp

from graphslam.core.charts import apply_inverse_left_jacobian
from graphslam.core.errors import SolverError, UnknownNameError
from graphslam.core.geometry import Array, ArrayLike, wrap_angle
from graphslam.core.markup import html_element, join_parts
from graphslam.core.submap import Submap
from graphslam.join.submap_blocks import SubmapProblem
from graphslam.linear.symmetric_factor import SymmetricFactor

logger = logging.getLogger(__name__)
Index = npt.NDArray[np.intp]


def dense_inverse(matrix: sp.csc_matrix) -> Array:
    """Dense inverse of a sparse symmetric positive-definite matrix."""
    A = matrix.toarray()
    factor, info = la.lapack.dpotrf(A, lower=1, overwrite_a=1)
    if info == 0:
        A, info = la.lapack.dpotri(factor, lower=1, overwrite_c=1)
    if info != 0:
        raise SolverError(f"information matrix is not positive definite (LAPACK info {info})")
    lower = np.tril(A, -1)
    return np.asarray(lower + lower.T + np.diag(np.diag(A)))


@dataclass(frozen=True)
class SubmapEstimate:
    """A joined map: poses, landmarks, and their joint information, with the first base fixed.

    The state vector is ``[x_1 … x_m, l_1 … l_L]``, poses as (x, y, θ) *vectors* in the frame of the first base (not
    right tangents), landmarks as (x, y).

    Parameters
    ----------
    poses : (m + 1, 3)
        Bases in the frame of the first, which is ``poses[0] = 0``; ``poses[k + 1]`` is the end of submap k.
    landmark_ids : (L,) int64
    landmarks : (L, 2)
    information : csc_matrix (3m + 2L, 3m + 2L) or None
        None if the method has a dense covariance instead (the EKF).
    objective : float
        ``Σ rᵀ P⁻¹ r`` of this map, before a polish.
    objective_polished : float or None
        The same at the least-squares optimum, if computed.
    converged : bool
        Whether the map is at its least-squares optimum.
    seconds : float
        Wall time of the solution, polish included.
    covariance : (3m + 2L, 3m + 2L) or None
        Exactly one of ``information`` and ``covariance`` is given.
    chart : str
        Parametrisation in which it is Gaussian about its mean (:mod:`graphslam.core.charts`).
    anchors : (L,) or None
        End pose (0 for ``poses[1]``) of the submap that observed each landmark first: its anchor in the group chart.
    """

    poses: Array
    landmark_ids: npt.NDArray[np.int64]
    landmarks: Array
    information: sp.csc_matrix | None
    objective: float
    objective_polished: float | None
    iterations: int
    converged: bool
    seconds: float
    covariance: Array | None = None
    chart: str = "cartesian"
    anchors: npt.NDArray[np.int64] | None = None

    def difference(self, poses: Array, landmarks: Array, *, chart: str | None = None) -> Array:
        """Difference of other values from these ``(states,)``, in the chart of this map or in another.

        Parameters
        ----------
        poses : (m, 3)
            End poses in the frame of the first base.
        landmarks : (L, 2)
            In the order of :attr:`landmark_ids`.
        """
        e = poses - self.poses[1:]
        e[:, 2] = wrap_angle(e[:, 2])
        f = landmarks - self.landmarks
        if (chart or self.chart) == "group":
            if self.anchors is None:
                raise SolverError("the map has no anchors of its landmarks")
            e[:, :2] = apply_inverse_left_jacobian(e[:, :2], e[:, 2])
            f = apply_inverse_left_jacobian(f, e[self.anchors, 2])
        return np.concatenate([e.ravel(), f.ravel()])

    @property
    def states(self) -> int:
        """Number of free scalars, without the fixed first base."""
        return 3 * (len(self.poses) - 1) + 2 * len(self.landmark_ids)

    @property
    def nnz(self) -> int:
        """Stored entries of the information or covariance matrix, both triangles."""
        return self.states**2 if self.information is None else int(self.information.nnz)

    @property
    def vector(self) -> Array:
        """The state vector ``(states,)``."""
        return np.concatenate([self.poses[1:].ravel(), self.landmarks.ravel()])

    @cached_property
    def _factor(self) -> SymmetricFactor:
        assert self.information is not None
        return SymmetricFactor(self.information)

    def map_information(self) -> sp.csc_matrix | None:
        """Information of poses and landmarks, which are all variables."""
        return self.information

    def map_covariance(self) -> Array | None:
        """Covariance of poses and landmarks, for methods in covariance form."""
        return self.covariance

    def pose_indices(self, k: int) -> Index:
        """Indices of ``poses[k]`` in the state vector (k ≥ 1)."""
        if not 1 <= k < len(self.poses):
            raise UnknownNameError("pose", str(k), (f"1 … {len(self.poses) - 1} (pose 0 is fixed)",))
        return 3 * (k - 1) + np.arange(3)

    def landmark_indices(self, landmark_id: int) -> Index:
        """Indices of the landmark with this id in the state vector."""
        at = np.flatnonzero(self.landmark_ids == landmark_id)
        if len(at) == 0:
            raise UnknownNameError("landmark", str(landmark_id), (f"{len(self.landmark_ids)} ids",))
        return 3 * (len(self.poses) - 1) + 2 * int(at[0]) + np.arange(2)

    def covariance_block(self, indices: npt.ArrayLike) -> Array:
        """Joint covariance of the scalars ``indices`` of the state vector, by sparse solves."""
        if self.covariance is not None:
            return self.covariance[np.ix_(np.asarray(indices), np.asarray(indices))]
        return self._factor.inverse_block(indices)

    def pose_covariance(self, k: int) -> Array:
        """Covariance ``(3, 3)`` of ``poses[k]`` as a vector (x, y, θ)."""
        return self.covariance_block(self.pose_indices(k))

    def landmark_covariance(self, landmark_id: int) -> Array:
        """Covariance ``(2, 2)`` of a landmark."""
        return self.covariance_block(self.landmark_indices(landmark_id))

    def joint_covariance(self) -> Array:
        """The whole covariance ``(states, states)``: dense, O(states³), for evaluation."""
        if self.covariance is not None:
            return self.covariance
        assert self.information is not None
        return dense_inverse(self.information)

    def _repr_html_(self) -> str:
        polished = "" if self.objective_polished is None else f", polished {self.objective_polished:.4f}"
        summary = (
            f": {len(self.poses)} bases, {len(self.landmark_ids)} landmarks, {self.states} scalars, "
            f"objective {self.objective:.4f}{polished}, {self.iterations} iterations, {self.seconds:.3f} s"
        )
        return join_parts([html_element("b", "Joined map"), summary])


# Shortest fraction of a step before damping is used.
_SHORTEST = 0.05


@dataclass(frozen=True)
class MinimisationResult:
    """Result of :func:`minimise_submaps`.

    Parameters
    ----------
    x : (n,)
        Values in the order of :class:`~graphslam.join.submap_blocks.SubmapProblem`.
    iterations : int
        Number of linearisations with a tested step.
    data : (nnz,)
        Values of ``JᵀΩJ`` at ``x`` in the problem's pattern.
    history : list of float
        Objective before every iteration, and at the end."""

    x: Array
    objective: float
    iterations: int
    converged: bool
    data: Array
    history: list[float] = field(default_factory=list)


def minimise_submaps(
    problem: SubmapProblem, x: Array, *, rtol: float = 1e-12, max_iterations: int = 50
) -> MinimisationResult:
    """Damped Gauss–Newton.

    A step is tried as a straight line and along the chain (:meth:`SubmapProblem.bent`), and the lower objective is
    used: after a long loop, the correction of one heading moves kilometres of map along a circle, not along its
    tangent. A step that does not lower the objective is halved a few times; if that does not help, Levenberg–Marquardt
    damping on the diagonal grows until one does. The search ends when the predicted decrease of the linear model,
    ``gᵀ H⁻¹ g``, is below ``rtol · max(objective, 1)``.

    Parameters
    ----------
    x : (n,)
        Initial values.
    """
    x = np.array(x, dtype=np.float64)
    headings = np.arange(2, 3 * problem.m, 3)
    pattern = problem.pattern
    damping, converged, iterations = 0.0, False, 0
    f, g, data = problem.linearise(x)
    history = [f]
    if not np.isfinite(f):
        raise SolverError(f"objective is {f} at the start; wanted a finite number")
    while iterations < max_iterations:
        iterations += 1
        step = -pattern.factor(data, damping).solve(g)
        promised = float(-(g @ step))  # = gᵀ H⁻¹ g, the decrease of the linear model, when there is no damping
        small = promised <= rtol * max(f, 1.0)
        f_trial, trial = _lowest(problem, x, step)
        shorter = 0.5
        while not small and f_trial > f and shorter > _SHORTEST:  # needs no factorisation
            f_trial, trial = _lowest(problem, x, shorter * step)
            shorter *= 0.5
        trial[headings] = wrap_angle(trial[headings])
        if np.isfinite(f_trial) and f_trial <= f + (rtol * max(f, 1.0) if small else 0.0):
            x = trial
            damping = 0.0 if damping < 1e-6 else damping / 10.0
            f, g, data = problem.linearise(x)
            history.append(f)
            if small and damping == 0.0:
                converged = True
                break
        elif small and damping == 0.0:
            converged = True  # the predicted decrease is below the rounding error of the objective
            break
        else:
            damping = max(10.0 * damping, 1e-5)
            if damping > 1e12:
                break
        logger.debug("iteration %d: objective %.9g, promised %.3g, damping %.1g", iterations, f, promised, damping)
    if not converged:
        logger.warning("no convergence after %d iterations: objective %.9g", iterations, f)
    return MinimisationResult(x, f, iterations, converged, data, history)


def _lowest(problem: SubmapProblem, x: Array, step: Array) -> tuple[float, Array]:
    """The better end of a step, straight or along the chain, and its objective (infinite if not finite)."""
    ends = [(problem.objective(t), t) for t in (x + step, problem.bent(x, step))]
    return min(((f if np.isfinite(f) else np.inf, t) for f, t in ends), key=lambda end: end[0])


def solve_submaps(
    submaps: Sequence[Submap],
    *,
    initial_poses: ArrayLike | None = None,
    max_iterations: int = 50,
) -> SubmapEstimate:
    """Least-squares optimum of a chain of landmark submaps (see :class:`SubmapProblem` and :func:`minimise_submaps`).

    Parameters
    ----------
    submaps : sequence of Submap
        With global landmark ids.
    initial_poses : (m, 3), optional
        Initial end poses; default the chain.
    max_iterations : int
        See :func:`minimise_submaps`.
    """
    start = time.perf_counter()
    problem = SubmapProblem(submaps)
    best = minimise_submaps(problem, problem.initial(initial_poses), max_iterations=max_iterations)
    return SubmapEstimate(
        poses=np.vstack([np.zeros((1, 3)), best.x[: 3 * problem.m].reshape(-1, 3)]),
        landmark_ids=problem.ids,
        landmarks=best.x[3 * problem.m :].reshape(-1, 2).copy(),
        information=problem.pattern.matrix(best.data),
        objective=best.objective,
        objective_polished=best.objective,
        iterations=best.iterations,
        converged=best.converged,
        seconds=time.perf_counter() - start,
        chart=problem.chart,
        anchors=problem.anchors,
    )
