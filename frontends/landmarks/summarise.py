"""From particles to one Gaussian: common features (B4), moment matching (B3), and smoothing under the winner.

A moment-matched set of 40 particles is over-confident by itself (finite sample), so the default hand-over smooths the
submap once under the winning particle's association and gives the optimum with its Laplace covariance; the
moment-matched Gaussian stays as the paper's mode and as a figure of honesty beside every map.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from frontends.landmarks.filter import ParticleSet
from frontends.landmarks.smoothing_kernels import smooth_kernel, smoothed_covariances, smoothing_cost
from graphslam.core.errors import CovarianceError
from graphslam.core.gaussian import Gaussian, moment_match
from graphslam.core.geometry import Array, rotation2

Ints = npt.NDArray[np.int64]
_HUBER2 = 1.345**2


@dataclass(frozen=True, slots=True)
class Association:
    """The winning association of a submap: which observation saw which landmark, landmarks in order of sighting.

    Parameters
    ----------
    slots : (L,)
        Slot of each landmark in the winning particle.
    observation : (q,)
        Index of each used observation inside the submap.
    landmark : (q,)
        Its landmark, 0 … L-1.
    """

    slots: Ints
    observation: Ints
    landmark: Ints


def winning_association(particles: ParticleSet, min_hits: int) -> Association:
    """Association of the standard particle, restricted to landmarks seen at least ``min_hits`` times."""
    a = particles.assoc[particles.best, : particles.observations].astype(np.int64)
    used = np.flatnonzero(a >= 0)
    slots, first, counts = np.unique(a[used], return_index=True, return_counts=True)
    keep = counts >= min_hits
    order = np.argsort(first[keep])
    slots = slots[keep][order]
    rank = np.full(int(a.max(initial=0)) + 1, -1, dtype=np.int64)
    rank[slots] = np.arange(len(slots))
    lm = rank[a[used]]
    return Association(slots, used[lm >= 0], lm[lm >= 0])


def common_features(particles: ParticleSet, association: Association) -> tuple[Ints, Ints]:
    """Order every particle's features as the standard particle has them (eq. 9–11).

    A feature of another particle corresponds to a common feature if it holds the majority of the observations (unique
    indices) of that feature. A particle that lacks one, or maps two to the same, is dropped.

    Returns
    -------
    kept : (k,)
        Particles kept.
    slots : (k, L)
        Their slot of each common feature.
    """
    kept, rows = [], []
    L = len(association.slots)
    first = np.searchsorted(np.sort(association.landmark), np.arange(L))
    by_landmark = association.observation[np.argsort(association.landmark, kind="stable")]
    groups = np.split(by_landmark, first[1:]) if L else []
    for i in range(len(particles.pose)):
        row = np.full(L, -1, dtype=np.int64)
        for f, members in enumerate(groups):
            held = particles.assoc[i, members]
            held = held[held >= 0]
            if 2 * len(held) > len(members):
                values, counts = np.unique(held, return_counts=True)
                if 2 * counts.max() > len(members):
                    row[f] = values[counts.argmax()]
        if np.all(row >= 0) and len(np.unique(row)) == L:
            kept.append(i)
            rows.append(row)
    return np.array(kept, dtype=np.int64), np.array(rows, dtype=np.int64).reshape(len(kept), L)


def moment_matched(particles: ParticleSet, association: Association, *, inflate: bool = False) -> tuple[Gaussian, int]:
    """Mixture → Gaussian over ``[exit pose, landmarks]`` (eq. 5–8) and the number of particles dropped.

    Parameters
    ----------
    inflate : bool
        Multiply the between-particle part by 1 + 40/N (finite-sample repair for poor sensors).
    """
    kept, slots = common_features(particles, association)
    n = 3 + 2 * slots.shape[1]
    rows = np.arange(len(kept))[:, None]
    means = np.concatenate([particles.pose[kept], particles.mean[kept[:, None], slots].reshape(len(kept), -1)], axis=1)
    # eq. 6: Q^j = blkdiag(0, Σ_1, …)
    cov = particles.cov[kept[:, None], slots]
    within = np.zeros((len(kept), n, n))
    ix = 3 + 2 * np.arange(slots.shape[1])
    within[rows, ix, ix], within[rows, ix, ix + 1] = cov[..., 0], cov[..., 1]
    within[rows, ix + 1, ix], within[rows, ix + 1, ix + 1] = cov[..., 1], cov[..., 2]
    w = particles.weights[kept]
    mean_within = np.einsum("m,mij->ij", w / w.sum(), within)
    # a single particle, or identical ones, has no spread: the regulariser keeps the matrix invertible and is negligible
    # beside any measurement
    floor = 1e-9 * np.eye(n)
    g = moment_match(w, means, floor, angular=(2,))
    between = g.covariance - floor
    if inflate:
        between = between * (1.0 + 40.0 / len(particles.pose))
    return Gaussian(g.mean, mean_within + between + floor, (2,)), len(particles.pose) - len(kept)


@dataclass(frozen=True, slots=True)
class Smoothed:
    """Result of smoothing a submap.

    Parameters
    ----------
    gaussian : Gaussian
        ``[exit pose, landmarks]`` as the plain vector of eq. 15 in the base frame.
    poses, pose_covariances : (T, 3), (T, 3, 3)
        Smoothed path and right-tangent marginals.
    kept : (q,) bool
        Observations that survived the trimming.
    landmark_kept : (L,) bool
        Landmarks that still have ``min_hits`` of them; the Gaussian holds these, in order.
    chi2, dof : float
        Objective at the optimum and its degrees of freedom.
    parts : (3,)
        Shares of the objective: odometry, range, bearing.
    converged : bool
    """

    gaussian: Gaussian
    poses: Array
    pose_covariances: Array
    kept: npt.NDArray[np.bool_]
    landmark_kept: npt.NDArray[np.bool_]
    chi2: float
    dof: int
    parts: Array
    converged: bool


def smooth(
    poses: Array,
    landmarks: Array,
    increments: Array,
    covariances: Array,
    ob_pose: Ints,
    ob_landmark: Ints,
    observations: Array,
    sensor: Array,
    *,
    trim: float = 0.0,
    min_hits: int = 1,
    max_iterations: int = 50,
) -> Smoothed:
    """One Gauss-Newton smoothing of a submap: all poses and landmarks, base fixed at identity.

    Parameters
    ----------
    poses, landmarks : (T, 3), (L, 2)
        Starting values.
    increments, covariances : (T, 3), (T, 3, 3)
        Dead reckoning from each pose to the next, the first from the base.
    ob_pose, ob_landmark : (q,)
        Pose and landmark of each observation.
    observations : (q, 4)
        Range, bearing, variances.
    sensor : (3,)
        ``T_base_sensor``.
    trim : float
        If positive: one Huber pass, then observations with d² above ``trim`` are dropped, then plain least squares.
    min_hits : int
        A landmark left with fewer observations after the trimming goes, with them.

    Raises
    ------
    CovarianceError
        If the smoothed system is singular.
    """
    p, l = poses.copy(), landmarks.copy()
    W = np.linalg.inv(covariances)
    weight = np.ones(len(observations))
    d2, parts = np.zeros(len(observations)), np.zeros(3)
    args = (increments, W, ob_pose, ob_landmark, observations)
    if trim > 0.0 and len(observations):
        smooth_kernel(p, l, *args, weight, sensor, 6, 1e-3)
        for _ in range(3):  # Huber by reweighting; few passes, it only has to unmask the outliers
            smoothing_cost(p, l, *args, weight, sensor, d2, parts)
            weight = np.minimum(1.0, np.sqrt(_HUBER2 / np.maximum(d2, 1e-12)))
            smooth_kernel(p, l, *args, weight, sensor, 3, 1e-3)
        smoothing_cost(p, l, *args, weight, sensor, d2, parts)
        weight = (d2 <= trim).astype(np.float64)
    left = np.bincount(ob_landmark, weights=weight, minlength=len(l)) >= min_hits
    kept = (weight > 0.0) & left[ob_landmark]
    l = l[left]
    args = (increments, W, ob_pose[kept], (np.cumsum(left) - 1)[ob_landmark[kept]], observations[kept])
    weight = np.ones(int(kept.sum()))
    d2 = np.zeros(len(weight))
    chi2, _, converged = smooth_kernel(p, l, *args, weight, sensor, max_iterations, 1e-9)
    joint, marginals = smoothed_covariances(p, l, *args, weight, sensor)
    smoothing_cost(p, l, *args, weight, sensor, d2, parts)
    if not np.all(np.isfinite(joint)):
        raise CovarianceError(
            "smoothed submap is singular", got=f"{len(l)} landmarks, {int(weight.sum())} observations"
        )
    G = np.eye(3 + 2 * len(l))
    G[:2, :2] = rotation2(p[-1, 2])  # right tangent → plain vector of eq. 15
    gaussian = Gaussian(np.concatenate([p[-1], l.ravel()]), G @ joint @ G.T, (2,))
    dof = 2 * len(weight) - 2 * len(l)
    return Smoothed(gaussian, p, marginals, kept, left, float(chi2), dof, parts, bool(converged))
