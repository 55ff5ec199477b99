"""NEES of submaps against a known truth: is the Gaussian that a front end hands over the right one?"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from graphslam.core import se3
from graphslam.core.charts import map_difference
from graphslam.core.errors import DataError
from graphslam.core.geometry import Array, se2_between, se2_inverse, se2_transform
from graphslam.core.log import Truth
from graphslam.core.submap import Submap
from graphslam.evaluate.consistency import Consistency, joint_nees, nees, pose_error


@dataclass(frozen=True, slots=True, kw_only=True)
class SubmapNees:
    """NEES of one submap in its own frame (its first base is fixed, so nothing is aligned).

    Parameters
    ----------
    exit : float
        Of the exit pose, 3 or 6 degrees of freedom.
    landmark_ids : (n,) int64
        Landmarks whose truth is known.
    landmarks : (n,)
        Of each landmark, 2 or 3 degrees of freedom.
    joint : float
        Of exit and landmarks together, in the map's own chart.
    joint_plain : float
        The same of the plain vector: larger where the map is right about a bent world.
    without_truth : int
        Landmarks left out because their identity is unknown or not in the truth.
    """

    key: int
    exit: float
    landmark_ids: np.ndarray
    landmarks: Array
    joint: float
    joint_plain: float
    joint_dof: int
    without_truth: int


def true_submap(submap: Submap, truth: Truth) -> tuple[Array, np.ndarray, Array]:
    """What the submap should have said: true exit pose, mask of landmarks with known truth, their true positions.

    Everything in the submap's base frame.
    """
    if truth.trajectory.dim != submap.dim:
        raise DataError(f"truth is {truth.trajectory.dim}-D", where=f"submap {submap.key}", wanted=f"{submap.dim}-D")
    base, end = truth.trajectory.interpolate(np.asarray(submap.interval))
    exit_pose = se2_between(base, end) if submap.dim == 2 else se3.se3_between(base, end)
    ids = submap.landmarks.ids if submap.landmarks is not None else np.zeros(0, dtype=np.int64)
    order = np.argsort(truth.landmark_ids)
    sorted_ids = truth.landmark_ids[order]
    at = np.searchsorted(sorted_ids, ids)
    at = np.minimum(at, max(len(sorted_ids) - 1, 0))
    known = (sorted_ids[at] == ids) & (ids >= 0) if len(sorted_ids) else np.zeros(len(ids), dtype=bool)
    world = truth.landmarks[order[at[known]]] if len(sorted_ids) else np.zeros((0, submap.dim))
    if submap.dim == 2:
        return exit_pose, known, se2_transform(se2_inverse(base), world)
    return exit_pose, known, se3.se3_transform(se3.se3_inverse(base), world)


def submap_nees(submap: Submap, truth: Truth) -> SubmapNees:
    """NEES of exit, landmarks and both together.

    A landmark submap is judged in its own chart, and beside it as a plain vector, that of Combined SLAM eq. 15 in the
    plane; a submap without landmarks by its exit alone. Landmarks by themselves are judged plainly.
    """
    exit_true, known, landmarks_true = true_submap(submap, truth)
    d = 3 if submap.dim == 2 else 6
    if submap.landmarks is None:
        d2 = float(nees(pose_error(submap.exit_pose, exit_true), submap.exit_covariance))
        none = np.zeros(0)
        return SubmapNees(
            key=submap.key,
            exit=d2,
            landmark_ids=none.astype(np.int64),
            landmarks=none,
            joint=d2,
            joint_plain=d2,
            joint_dof=d,
            without_truth=0,
        )
    m = submap.landmarks.subset(known)
    P = m.dense_covariance()
    true = np.concatenate([exit_true, landmarks_true.ravel()])
    e, e_plain = m.difference(true), map_difference(true, m.mean, "cartesian", space=submap.dim == 3)
    e_landmarks = landmarks_true - m.positions
    k = d + submap.dim * np.arange(len(m))[:, None] + np.arange(submap.dim)
    blocks = P[k[:, :, None], k[:, None, :]]
    return SubmapNees(
        key=submap.key,
        exit=float(nees(e[:d], P[:d, :d])),
        landmark_ids=m.ids,
        landmarks=nees(e_landmarks, blocks),
        joint=joint_nees(e, covariance=P),
        joint_plain=joint_nees(e_plain, covariance=P),
        joint_dof=len(P),
        without_truth=int(np.sum(~known)),
    )


def submaps_consistency(submaps: Iterable[Submap], truth: Truth, *, confidence: float = 0.95) -> dict[str, Consistency]:
    """Consistency of a chain of local maps: ``joint`` and ``exit`` over all of them.

    Local maps of one run use different data, so each is an independent unit and even one run judges them well.
    """
    results = [submap_nees(s, truth) for s in submaps]
    if not results:
        raise DataError("no submaps to judge")
    dof = 3 if truth.trajectory.dim == 2 else 6
    gauge = "submap's first base fixed"
    return {
        "joint": Consistency(
            quantity="submap joint",
            nees=np.array([[r.joint for r in results]]),
            dof=np.array([[r.joint_dof for r in results]]),
            gauge=gauge,
            confidence=confidence,
            unit="value",
        ),
        "exit": Consistency(
            quantity="submap exit",
            nees=np.array([[r.exit for r in results]]),
            dof=np.array(dof),
            gauge=gauge,
            confidence=confidence,
            unit="value",
        ),
    }
