"""Summary of particles as one Gaussian: common features (B4), moment matching (B3), and smoothing.

Moments of 40 particles are overconfident (finite sample), so by default the submap is smoothed once under the winning
particle's association; the result is the optimum with its Laplace covariance. The moment-matched Gaussian is kept as
the paper's mode and as a consistency check of every map.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import CovarianceError
from graphslam.core.gaussian import Gaussian, equal_tail_gate
from graphslam.core.geometry import Array, circular_mean, rotation2, wrap_angle
from graphslam_frontends.landmarks.filter import ParticleSet
from graphslam_frontends.landmarks.sensitivity_kernels import bias_sensitivities
from graphslam_frontends.landmarks.smoothing_kernels import (
    SmoothingMeasurements,
    second_order_bias,
    smooth_kernel,
    smoothed_covariances,
    smoothing_cost,
)

Ints = npt.NDArray[np.int64]
_HUBER2 = 1.345**2
REGULARISER = 1e-9
"""Added to the diagonal of every covariance from particles [m², rad²]: a single particle, or identical ones, have no
spread. It keeps the matrix invertible and is negligible compared with any measurement; the NEES of such a set is
meaningless."""


@dataclass(frozen=True, slots=True)
class LandmarkAssociation:
    """The winning association of a submap: landmark of each observation, landmarks in order of first observation.

    Parameters
    ----------
    slots : (L,)
        Slot of each landmark in the winning particle.
    observation : (q,)
        Index in the submap of each observation used.
    landmark : (q,)
        Its landmark, 0 … L-1.
    """

    slots: Ints
    observation: Ints
    landmark: Ints


def winning_association(particles: ParticleSet, min_hits: int) -> LandmarkAssociation:
    """Association of the standard particle, restricted to landmarks observed at least ``min_hits`` times."""
    a = particles.assoc[particles.best, : particles.observations].astype(np.int64)
    used = np.flatnonzero(a >= 0)
    slots, first, counts = np.unique(a[used], return_index=True, return_counts=True)
    keep = counts >= min_hits
    order = np.argsort(first[keep])
    slots = slots[keep][order]
    rank = np.full(int(a.max(initial=0)) + 1, -1, dtype=np.int64)
    rank[slots] = np.arange(len(slots))
    lm = rank[a[used]]
    return LandmarkAssociation(slots, used[lm >= 0], lm[lm >= 0])


def common_features(particles: ParticleSet, association: LandmarkAssociation) -> tuple[Ints, Ints]:
    """Slots of every particle's features in the order of the standard particle (eq. 9–11).

    A feature of another particle corresponds to a common feature if it has the majority of its observations (unique
    indices). A particle without one, or with one feature for two, is dropped.

    Returns
    -------
    kept : (k,)
        Indices of the particles kept.
    slots : (k, L)
        Their slot of each common feature.
    """
    table = particles.assoc[:, association.observation].astype(np.int64)
    return majority_slots(table, association.landmark, len(association.slots))


def majority_slots(table: Ints, landmark: Ints, count: int) -> tuple[Ints, Ints]:
    """Slot of each common feature in each particle: the one with the majority of the feature's observations.

    Parameters
    ----------
    table : (n, q)
        Slot of each observation in each particle; negative if it has none.
    landmark : (q,)
        Common feature of each observation, 0 … count-1.

    Returns
    -------
    kept : (k,)
        Particles with every feature, each in a different slot.
    slots : (k, count)
    """
    size = np.bincount(landmark, minlength=count)
    width = int(table.max(initial=0)) + 1
    kept, rows = [], []
    for i, held in enumerate(table):
        there = held >= 0
        votes = np.bincount(landmark[there] * width + held[there], minlength=count * width).reshape(count, width)
        row = votes.argmax(axis=1)
        if np.all(2 * votes[np.arange(count), row] > size) and len(np.unique(row)) == count:
            kept.append(i)
            rows.append(row)
    return np.array(kept, dtype=np.int64), np.array(rows, dtype=np.int64).reshape(len(kept), count)


@dataclass(frozen=True, slots=True)
class Moments:
    """First two moments of a particle set over ``[pose, landmark_1, …]``, within and between particles (eq. 7–8).

    Parameters
    ----------
    mean : (3 + 2 L,)
        Heading averaged on the circle.
    within : (L, 3)
        Mean of the particles' own landmark covariances: xx, xy, yy.
    weights : (k,)
        Of the particles, normalised.
    deviations : (k, 3 + 2 L)
        Of the particles from the mean.
    """

    mean: Array
    within: Array
    weights: Array
    deviations: Array

    @classmethod
    def of(cls, particles: ParticleSet, kept: Ints, slots: Ints) -> Moments:
        """Of the particles ``kept`` with the common features in ``slots`` ``(k, L)``."""
        w = particles.weights[kept]
        if not w.sum() > 0.0:
            raise CovarianceError("no particle holds the common features, nothing to moment-match")
        w = w / w.sum()
        features = particles.mean[kept[:, None], slots].reshape(len(kept), -1)
        X = np.concatenate([particles.pose[kept], features], axis=1)
        mean = w @ X
        mean[2] = circular_mean(X[:, 2], w)  # eq. 7 on the circle
        D = X - mean
        D[:, 2] = wrap_angle(D[:, 2])
        # eq. 6: Q^j = blkdiag(0, Σ_1, …)
        return cls(mean, np.einsum("k,klc->lc", w, particles.cov[kept[:, None], slots]), w, D)

    def pose_covariance(self) -> Array:
        """Of the plain vector x, y, θ ``(3, 3)``, regularised."""
        d = self.deviations[:, :3]
        return np.asarray((self.weights[:, None] * d).T @ d + REGULARISER * np.eye(3))

    def landmark_covariances(self) -> Array:
        """Marginals ``(L, 2, 2)``, regularised."""
        d = self.deviations[:, 3:].reshape(len(self.weights), -1, 2)
        between = np.einsum("kla,klb->lab", self.weights[:, None, None] * d, d)
        return np.asarray(self.within[:, [[0, 1], [1, 2]]] + between + REGULARISER * np.eye(2))

    def joint(self, *, inflation: float = 1.0) -> Gaussian:
        """The Gaussian of all variables (eq. 8), with the between-particle part times ``inflation``."""
        floor = REGULARISER * np.eye(len(self.mean))
        between = (self.weights[:, None] * self.deviations).T @ self.deviations
        within = np.zeros_like(floor)
        ix = 3 + 2 * np.arange(len(self.within))
        within[ix, ix], within[ix + 1, ix + 1] = self.within[:, 0], self.within[:, 2]
        within[ix, ix + 1] = within[ix + 1, ix] = self.within[:, 1]
        return Gaussian(self.mean, within + 0.5 * (between + between.T) * inflation + floor, (2,))


def gaussian_of_particles(
    particles: ParticleSet, association: LandmarkAssociation, *, inflate: bool = False
) -> tuple[Gaussian, int]:
    """Mixture → Gaussian over ``[exit pose, landmarks]`` (eq. 5–8) and the number of particles dropped.

    Parameters
    ----------
    inflate : bool
        Multiply the between-particle part by 1 + 40/N (finite-sample correction for imprecise sensors).
    """
    kept, slots = common_features(particles, association)
    n = len(particles.pose)
    return Moments.of(particles, kept, slots).joint(inflation=1.0 + 40.0 / n if inflate else 1.0), n - len(kept)


@dataclass(frozen=True, slots=True)
class SmoothingResult:
    """Result of smoothing a submap.

    Parameters
    ----------
    gaussian : Gaussian
        ``[exit pose, landmarks]`` as the plain vector of eq. 15 in the base frame.
    poses, pose_covariances : (T, 3), (T, 3, 3)
        Smoothed path and right-tangent marginals.
    kept : (q,) bool
        Observations kept by the trimming.
    landmark_kept : (L,) bool
        Landmarks that still have ``min_hits`` of them; the Gaussian contains these, in order.
    chi2, dof : float
        Objective at the optimum and its degrees of freedom.
    parts : (3,)
        Shares of the objective: odometry, range, bearing.
    landmarks : (L, 2)
        Landmarks kept.
    evidence : SmoothingMeasurements
        The measurements used.
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
    landmarks: Array
    evidence: SmoothingMeasurements

    def report(self) -> dict[str, Any]:
        """Fit of the submap to its measurements, for its report."""
        return {
            "chi2": self.chi2,
            "dof": self.dof,
            "chi2_odometry": float(self.parts[0]),
            "chi2_range": float(self.parts[1]),
            "chi2_bearing": float(self.parts[2]),
            "converged": self.converged,
            "nonlinearity": self.nonlinearity() / len(self.gaussian.mean),
            "unknowns": len(self.gaussian.mean),
        }

    def nonlinearity(self) -> float:
        """Squared Mahalanobis norm, under its own covariance, of the curvature bias of the optimum; 0 if linear.

        An observation constrains a landmark to an arc, a Gaussian to the tangent. If bearings are imprecise compared
        with ranges, the arc deviates by more than the map's σ across it. This is the squared norm of the bias of
        nonlinear least squares (Box 1971), with the curvature of ranges and bearings only.
        """
        if not len(self.landmarks):
            return 0.0
        odometry = np.zeros((len(self.poses), 3, 1))
        mean = second_order_bias(self.poses, self.landmarks, self.evidence)
        moved, shifted, _, _ = bias_sensitivities(self.poses, self.landmarks, self.evidence, odometry, mean[:, :, None])
        by = moved[-1, :, 0]
        step = np.concatenate([rotation2(self.poses[-1, 2]) @ by[:2], by[2:], shifted[:, 0]])
        return float(step @ np.linalg.solve(self.gaussian.covariance, step))


@dataclass(frozen=True, slots=True)
class SmoothingProblem:
    """Odometry and observations of a submap, for smoothing with the base fixed at identity.

    Parameters
    ----------
    increments, covariances : (T, 3), (T, 3, 3)
        Dead reckoning from each pose to the next, the first from the base.
    ob_pose, ob_landmark : (q,)
        Pose and landmark of each observation.
    observations : (q, 4)
        Range, bearing, variances; an infinite variance of the bearing means no bearing.
    sensor : (3,)
        ``T_base_sensor``.
    trim : float
        If positive: a robust (Huber) iteration, then observations with d² above ``trim`` (2 dof; same tail probability
        with one channel) are dropped, then plain least squares.
    min_hits : int
        Landmarks with fewer observations after the trimming are removed, with these.
    """

    increments: Array
    covariances: Array
    ob_pose: Ints
    ob_landmark: Ints
    observations: Array
    sensor: Array
    trim: float = 0.0
    min_hits: int = 1

    def smooth(self, poses: Array, landmarks: Array) -> SmoothingResult:
        """One Gauss-Newton smoothing of all poses and landmarks from a start ``(T, 3)``, ``(L, 2)``."""
        observations = self.observations
        p, l = poses.copy(), landmarks.copy()
        W = np.linalg.inv(self.covariances)
        weight = np.ones(len(observations))
        d2, parts = np.zeros(len(observations)), np.zeros(3)
        args = (self.increments, W, self.ob_pose, self.ob_landmark, observations)
        if self.trim > 0.0 and len(observations):
            smooth_kernel(p, l, SmoothingMeasurements(*args, weight, self.sensor), 6, 1e-3)
            for _ in range(3):  # Huber by reweighting; few iterations, because it only has to reveal the outliers
                smoothing_cost(p, l, SmoothingMeasurements(*args, weight, self.sensor), d2, parts)
                weight = np.minimum(1.0, np.sqrt(_HUBER2 / np.maximum(d2, 1e-12)))
                smooth_kernel(p, l, SmoothingMeasurements(*args, weight, self.sensor), 3, 1e-3)
            smoothing_cost(p, l, SmoothingMeasurements(*args, weight, self.sensor), d2, parts)
            gates = np.where(np.isinf(observations[:, 3]), equal_tail_gate(self.trim, 2, 1), self.trim)
            weight = (d2 <= gates).astype(np.float64)
        left = np.bincount(self.ob_landmark, weights=weight, minlength=len(l)) >= self.min_hits
        kept = (weight > 0.0) & left[self.ob_landmark]
        l = l[left]
        landmark = (np.cumsum(left) - 1)[self.ob_landmark[kept]]
        args = (self.increments, W, self.ob_pose[kept], landmark, observations[kept])
        weight = np.ones(int(kept.sum()))
        d2 = np.zeros(len(weight))
        evidence = SmoothingMeasurements(*args, weight, self.sensor)
        chi2, _, converged = smooth_kernel(p, l, evidence, 50, 1e-9)
        joint, marginals = smoothed_covariances(p, l, evidence)
        smoothing_cost(p, l, evidence, d2, parts)
        if not np.all(np.isfinite(joint)):
            raise CovarianceError(
                "smoothed submap is singular", got=f"{len(l)} landmarks, {int(weight.sum())} observations"
            )
        G = np.eye(3 + 2 * len(l))
        G[:2, :2] = rotation2(p[-1, 2])  # right tangent → plain vector of eq. 15
        gaussian = Gaussian(np.concatenate([p[-1], l.ravel()]), G @ joint @ G.T, (2,))
        channels = int(kept.sum() + np.isfinite(observations[kept, 3]).sum())
        dof = channels - 2 * len(l)
        return SmoothingResult(
            gaussian, p, marginals, kept, left, float(chi2), dof, parts, bool(converged), l, evidence
        )

    def restricted(self, observations: npt.NDArray[np.bool_], landmarks: npt.NDArray[np.bool_]) -> SmoothingProblem:
        """The problem with a subset of observations and landmarks, without trimming."""
        rank = np.cumsum(landmarks) - 1
        keep = observations & landmarks[self.ob_landmark]
        return replace(
            self,
            ob_pose=self.ob_pose[keep],
            ob_landmark=rank[self.ob_landmark[keep]],
            observations=self.observations[keep],
            trim=0.0,
            min_hits=1,
        )
