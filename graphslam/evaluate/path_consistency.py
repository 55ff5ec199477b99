"""Errors and NEES of every pose of a path against ground truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graphslam.core.charts import check_chart
from graphslam.core.errors import DataError
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array, rotation2
from graphslam.core.poses import group_of
from graphslam.core.se3 import quat_to_matrix
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.consistency import nees, pose_error, vector_pose_error
from graphslam.evaluate.trajectory_error import match_stamps

SAME_INSTANT = 1e-6
"""Stamps of ground truth and path that differ by at most this are equal [s]."""
SINGULAR = 1e-12
"""Least eigenvalue of the correlation matrix of a tested pose; below it the covariance is singular."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PathConsistency:
    """Poses of a path with known truth, in the frame of the first base, which is fixed.

    Parameters
    ----------
    rows : (k,)
        Indices of the tested poses in the path.
    errors, sigmas : (k, 3) or (k, 4)
        True minus estimated ``x, y, heading`` or ``x, y, z, heading``, along the axes of the map, and their σ [m, rad].
    nees : (k,)
        NEES of the whole pose.
    dof : int
        Degrees of freedom of each NEES: 3 or 6.
    certain : int
        Poses that are left out because their covariance is singular, as that of the first base is.
    """

    rows: npt.NDArray[np.intp]
    errors: Array
    sigmas: Array
    nees: Array
    dof: int
    certain: int

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns of :attr:`errors`."""
        return ("x", "y", "heading") if self.dof == 3 else ("x", "y", "z", "heading")


def map_errors(poses: Array, covariances: Array, true_poses: Array, chart: str) -> tuple[Array, Array]:
    """Errors ``(n, d)`` of poses along the axes of the map, and their covariances ``(n, d, d)``.

    With ``chart="group"``, and always in 3-D, the error is the right tangent ``Log(T_est⁻¹ T_true)``, rotated to the
    axes of the map (NEES unchanged); with ``"cartesian"`` the difference of the vectors (x, y, θ). Order: ``(x, y,
    heading)``, in 3-D ``(rotation about x, y, z; x, y, z)``.

    Parameters
    ----------
    poses, true_poses : (n, 3) or (n, 7)
    covariances : (n, 3, 3) or (n, 6, 6)
        Of right tangents.
    chart : {"group", "cartesian"}
        Parametrisation of 2-D poses.
    """
    check_chart(chart)
    if poses.shape[-1] == 3:
        A = np.zeros((len(poses), 3, 3))
        A[:, :2, :2], A[:, 2, 2] = rotation2(poses[:, 2]), 1.0
    else:
        A = np.zeros((len(poses), 6, 6))
        A[:, :3, :3] = A[:, 3:, 3:] = quat_to_matrix(poses[:, 3:])
    if poses.shape[-1] == 3 and chart == "cartesian":
        e = vector_pose_error(poses, true_poses)
    else:
        e = np.einsum("kij,kj->ki", A, pose_error(poses, true_poses))
    return e, A @ covariances @ np.swapaxes(A, 1, 2)


def path_consistency(path: Trajectory, truth: Trajectory, *, chart: str) -> PathConsistency:
    """Errors and NEES of every pose of a path with known ground truth.

    Parameters
    ----------
    path : Trajectory
        With covariances, in the frame of the first base.
    truth : Trajectory
        In the same frame, at stamps of the path.
    chart : {"group", "cartesian"}
        See :func:`map_errors`.
    """
    if path.covariances is None:
        raise DataError("the path has no covariances", wanted="covariances")
    if path.dim != truth.dim:
        raise DataError("path and truth differ in dimension", got=truth.dim, wanted=path.dim)
    i, rows = match_stamps(truth.times, path.times, max_diff=SAME_INSTANT)
    if not len(rows):
        raise DataError("no stamps of path and truth agree", got=f"{len(path)} and {len(truth)} poses")
    P = path.covariances[rows]
    judged = _uncertain(P)
    i, rows, P, certain = i[judged], rows[judged], P[judged], int(np.sum(~judged))
    e, P = map_errors(path.poses[rows], P, truth.poses[i], chart)
    shown = [0, 1, 2] if path.dim == 2 else [3, 4, 5, 2]
    return PathConsistency(
        rows=rows,
        errors=e[:, shown],
        sigmas=np.sqrt(P[:, shown, shown]),
        nees=nees(e, P),
        dof=P.shape[-1],
        certain=certain,
    )


def path_nees(estimate: Trajectory, reference: Trajectory, *, max_diff: float) -> dict[str, float]:
    """NEES of an estimated path in the frame of its first pose that the reference has.

    Parameters
    ----------
    estimate : Trajectory
        With covariances relative to its first pose.
    reference : Trajectory
        In any frame.
    max_diff : float
        Largest difference of associated stamps [s].

    Returns
    -------
    dict
        ``poses``, ``dof``, mean ``nees``, ``nees_per_dof`` (1 if the covariances are right), and ``inside_95``: the
        share of the poses inside their 95 % region (0.95 if the covariances are right).
    """
    if estimate.dim != reference.dim:
        raise DataError("the paths differ in dimension", got=estimate.dim, wanted=reference.dim)
    i, j = match_stamps(reference.times, estimate.times, max_diff=max_diff)
    if len(i) < 2:
        raise DataError("too few associated poses", got=len(i), wanted="at least 2")
    group = group_of(estimate.poses)
    true = reference.interpolate(np.clip(estimate.times[j], *reference.times[[0, -1]]))
    T = group.compose(estimate.poses[j[0]], group.inverse(true[0]))
    true = group.compose(np.broadcast_to(T, true.shape), true)
    found = path_consistency(estimate, Trajectory(estimate.times[j], true), chart="group")
    if not len(found.nees):
        raise DataError("every covariance of the path is singular", wanted="poses that are uncertain")
    mean = float(found.nees.mean())
    inside = float(np.mean(found.nees <= chi2_quantile(0.95, found.dof)))
    return {
        "poses": len(found.nees), "dof": found.dof, "nees": mean, "nees_per_dof": mean / found.dof, "inside_95": inside
    }  # fmt: skip


def _uncertain(P: Array) -> npt.NDArray[np.bool_]:
    """Mask of the covariances that are not singular."""
    sigma = np.sqrt(np.maximum(np.diagonal(P, axis1=1, axis2=2), 0.0))
    some = np.all(sigma > 0.0, axis=1)
    scale = np.where(some[:, None], sigma, 1.0)
    return np.asarray(some & (np.linalg.eigvalsh(P / scale[:, :, None] / scale[:, None, :])[:, 0] > SINGULAR))
