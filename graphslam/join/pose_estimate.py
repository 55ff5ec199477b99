"""The map of poses that a joiner of dense submaps hands over, and its way to the least-squares optimum."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from graphslam.core.errors import UnknownNameError
from graphslam.core.geometry import Array
from graphslam.core.poses import SE3
from graphslam.graph.variables import Values
from graphslam.join.joined_map import JoinResult, JoinTimes
from graphslam.join.pose_map import PoseMap, level_step
from graphslam.join.pose_problem import PoseProblem
from graphslam.solve.batch import LevenbergConfig, optimise_problem
from graphslam.solve.sparse import SparseProblem

Index = npt.NDArray[np.int64]

POLISH = LevenbergConfig(max_iterations=200, tolerance=1e-12)


@dataclass(frozen=True)
class PoseEstimate(JoinResult):
    """A joined map of dense submaps: a pose for every node, and the information of all of them.

    The state vector is ``[ξ_1 … ξ_n, τ]``: the right tangent of every node but the first base, which is held (2-D:
    x, y, θ of its own axes; 3-D: rotation, then translation); and, where bases are levelled, two turns of the
    direction up. ``landmarks`` are none.

    Parameters
    ----------
    exits : (m,) int64
        Row of ``poses`` at the exit of each submap.
    tilt : (2,) or None
        Where up is in the frame of the first base (:mod:`graphslam.graph.factors.attitude`).
    dof : int
        Scalars measured, less free ones.
    """

    exits: Index = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    tilt: Array | None = None
    dof: int = 0

    @property
    def width(self) -> int:
        """Scalars of a pose: 3 or 6."""
        return 3 if self.poses.shape[1] == 3 else 6

    @property
    def states(self) -> int:
        """Free scalars; the first base is not among them."""
        return self.width * (len(self.poses) - 1) + 2 * (self.tilt is not None)

    @property
    def vector(self) -> Array:
        """Tangents have no vector of values; see ``poses``."""
        raise UnknownNameError("state vector of poses in tangents", "vector", ("poses",))

    def pose_indices(self, k: int) -> npt.NDArray[np.intp]:
        """Where the tangent of ``poses[k]`` stands in the state vector (k ≥ 1)."""
        if not 1 <= k < len(self.poses):
            raise UnknownNameError("pose", str(k), (f"1 … {len(self.poses) - 1} (pose 0 is fixed)",))
        return self.width * (k - 1) + np.arange(self.width)


def up_direction(up: Array | None) -> Array | None:
    """Where up is in the frame of the base, of a level frame seen from there."""
    return None if up is None else level_step(SE3.identity, up)


def evaluate_map(
    problem: PoseProblem,
    poses: Array,
    tilt: Array | None,
    *,
    method: str,
    seconds: float,
    information: sp.csc_matrix | None = None,
    covariance: Array | None = None,
    times: JoinTimes | None = None,
    iterations: int = 0,
) -> PoseEstimate:
    """A map as it comes out of a joiner, with the objective of all measurements there."""
    return PoseEstimate(
        poses=poses,
        landmark_ids=np.zeros(0, dtype=np.int64),
        landmarks=np.zeros((0, problem.dim)),
        information=information,
        covariance=covariance,
        objective=problem.flat.objective(problem.values(poses, tilt)),
        objective_polished=None,
        iterations=iterations,
        converged=False,
        seconds=seconds,
        method=method,
        times={} if times is None else dict(times.parts),
        submap_ids=tuple(np.zeros(0, dtype=np.int64) for _ in problem.keys),
        exits=problem.bases[1:],
        tilt=tilt if problem.levelled else None,
        dof=problem.dof,
    )


def estimate_of_map(problem: PoseProblem, found: PoseMap, *, method: str, times: JoinTimes) -> PoseEstimate:
    """A joined map in information form."""
    return evaluate_map(
        problem, found.poses, up_direction(found.up), method=method, seconds=times.wall, times=times,
        information=found.matrix(),
    )  # fmt: skip


def optimise_poses(problem: PoseProblem, joined: PoseEstimate) -> PoseEstimate:
    """Linearise all measurements afresh at the joined map, again and again, until the objective is at its minimum.

    Returns
    -------
    PoseEstimate
        Poses and information of the optimum; ``objective`` stays that of the joined map.
    """
    start, cpu = time.perf_counter(), time.process_time()
    best = optimise_problem(SparseProblem(problem.flat), problem.values(joined.poses, joined.tilt), POLISH)
    values: Values = best.values
    system = problem.flat.evaluate(values, dense=False)
    cpu = time.process_time() - cpu
    return replace(
        joined,
        poses=values.poses,
        tilt=values.tilt,
        information=sp.csc_matrix(system.A),
        covariance=None,
        objective_polished=best.objective,
        iterations=best.iterations,
        converged=best.converged,
        seconds=joined.seconds + time.perf_counter() - start,
        times={**joined.times, "polish": cpu},
    )
