"""Landmark SLAM without submaps: every scan pose and every landmark of a log in one least-squares problem.

It is the floor that submap methods are measured against: their optimum can be no better informed than this one, and a
submap that loses something loses it here.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError, SolverError
from graphslam.core.geometry import Array, ArrayLike, rotation2, se2_adjoint, se2_compose, se2_inverse
from graphslam.core.records import LandmarkObservations
from graphslam.graph.covariance import JointCovariance
from graphslam.graph.factor_arrays import FactorArrays
from graphslam.graph.factors.between import BetweenBatch
from graphslam.graph.factors.observation import ObservationBatch
from graphslam.graph.noise import whiteners
from graphslam.graph.variables import Values
from graphslam.solve.descent import descend_to_minimum, limits_of
from graphslam.solve.sparse import SparseProblem

Ids = npt.NDArray[np.int64]


@dataclass(frozen=True)
class FullBatch:
    """The optimum over all scan poses and landmarks.

    Parameters
    ----------
    poses : (n + 1, 3)
        Bases at the start and at every scan, in the frame of the first.
    landmark_ids : (l,) int64
    landmarks : (l, 2)
    objective : float
        Σ rᵀ Ω r at the optimum.
    dof : int
        Measured minus free scalars.
    covariance : JointCovariance
        The poses are those of the *sensor* where it is not at the base.
    """

    poses: Array
    landmark_ids: Ids
    landmarks: Array
    objective: float
    dof: int
    covariance: JointCovariance
    iterations: int
    converged: bool
    seconds: float
    sensor: Array

    def pose_covariances(self, indices: ArrayLike) -> Array:
        """Covariances ``(k, 3, 3)`` of bases ``indices`` ``(k,)`` ≥ 1, as plain vectors x, y, θ of the first frame."""
        k = np.atleast_1d(np.asarray(indices, dtype=np.intp))
        if np.any(k < 1) or np.any(k >= len(self.poses)):
            raise DataError("no such free pose", got=k.tolist(), wanted=f"1 … {len(self.poses) - 1}")
        P = np.array([self.covariance.marginal(f"x{i}") for i in k])
        R = np.zeros((len(k), 3, 3))
        R[:, :2, :2], R[:, 2, 2] = rotation2(self.poses[k, 2]), 1.0
        G = R @ se2_adjoint(self.sensor)  # tangent at the sensor → tangent at the base → plain vector
        return np.asarray(G @ P @ G.swapaxes(1, 2))

    def landmark_covariance(self) -> Array:
        """Joint covariance ``(2 l, 2 l)`` of all landmarks."""
        lay = self.covariance.layout
        return self.covariance.columns(np.arange(lay.start("l"), lay.stop("l")))


def full_batch(
    increments: ArrayLike,
    covariances: ArrayLike,
    observations: LandmarkObservations,
    *,
    initial_poses: ArrayLike,
    initial_landmarks: Mapping[int, ArrayLike],
    max_iterations: int = 100,
) -> FullBatch:
    """Least squares over a whole log with known association.

    Parameters
    ----------
    increments, covariances : (n, 3), (n, 3, 3)
        Dead reckoning into every scan (right tangent at the later pose); the first from the base.
    observations : LandmarkObservations
        n scans; observations without an id (-1) are not used.
    initial_poses : (n, 3)
        Bases at the scans in the frame of the first base. Dead reckoning over kilometres is too poor a start: give the
        path of a solved submap graph.
    initial_landmarks : mapping of id to (2,)
    """
    start = time.perf_counter()
    u, Q = np.asarray(increments, dtype=np.float64), np.asarray(covariances, dtype=np.float64)
    x0, n = np.asarray(initial_poses, dtype=np.float64), len(observations.times)
    if observations.ids is None:
        raise DataError("full batch needs identities", got="none", wanted="landmark ids")
    if len(u) != n or len(x0) != n:
        raise DataError("there must be one increment and one initial pose a scan", got=(len(u), len(x0)), wanted=n)
    rows = np.flatnonzero(observations.ids >= 0)
    scan = np.searchsorted(observations.offsets, rows, side="right") - 1
    ids, landmark = np.unique(observations.ids[rows], return_inverse=True)
    missing = [int(i) for i in ids if int(i) not in initial_landmarks]
    if missing:
        raise DataError(f"{len(missing)} landmarks have no start", got=missing[:5], wanted="an initial position each")
    # Landmarks are seen from the nodes, so the nodes are the sensor's poses: x_s = x ∘ T_base_sensor.
    sensor = observations.T_base_sensor
    back = se2_adjoint(se2_inverse(sensor))
    measured = se2_compose(se2_inverse(sensor), se2_compose(u, sensor))
    marks = np.array([initial_landmarks[int(i)] for i in ids], dtype=np.float64).reshape(-1, 2)
    values = Values(2, {"x": se2_compose(np.vstack([np.zeros((1, 3)), x0]), sensor), "l": marks}, ids.astype(np.int64))
    layout, steps = values.layout(), np.arange(n)
    z = np.column_stack([observations.bearings[rows], observations.ranges[rows]])
    sigma = observations.sigmas[rows, ::-1]
    seen = np.column_stack([scan + 1, landmark])
    W = whiteners(np.asarray(np.linalg.inv(back @ Q @ back.T), dtype=np.float64))
    batches = [
        BetweenBatch.of_arrays(np.column_stack([steps, steps + 1]), measured, W, layout),
        ObservationBatch.of_arrays(seen, z, True, (1.0 / sigma)[:, :, None] * np.eye(2), layout),
    ]
    flat = FactorArrays((), layout, batches)
    problem = SparseProblem(flat)
    best = descend_to_minimum(problem, values, max_iterations=max_iterations)
    if not np.isfinite(best.objective):
        raise SolverError(f"full batch diverged: objective {best.objective}; wanted a finite one")
    return FullBatch(
        poses=se2_compose(best.values.poses, se2_inverse(sensor)),
        landmark_ids=ids,
        landmarks=best.values.landmarks,
        objective=best.objective,
        dof=flat.measurements - layout.size,
        covariance=JointCovariance(layout, flat.evaluate(best.values).A),
        iterations=best.iterations,
        converged=limits_of(flat.measurements).reached(best.objective, problem.decrement(best.values)),
        seconds=time.perf_counter() - start,
        sensor=np.asarray(sensor, dtype=np.float64),
    )
