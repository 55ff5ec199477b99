"""Data association of the next map's landmarks with those of the map (Combined SLAM B7, Algorithm 1).

Candidates are found by geometry: earlier submaps whose start is near, then their landmarks that are near. Only the
covariance of the last pose and the candidates is recovered, by sparse solves. There are two rules: the nearest
neighbour by Mahalanobis distance, or the largest jointly compatible set, searched from many starts; every accepted pair
conditions the rest. Both are exclusive: one landmark, one entry.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from graphslam.association.compatibility import (
    joint_limits,
    mahalanobis2,
    most_pairings,
    nearest_neighbour_pairs,
    search_compatible_sets,
)
from graphslam.core.config import check_options
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array, se2_compose
from graphslam.join.joined_map import JoinedMapView, landmark_scalars, pose_scalars

logger = logging.getLogger(__name__)
Index = npt.NDArray[np.intp]

# Limit of candidate pairs after a long drift: the joint covariance of 2,000 pairs takes 128 MB, and a search among more
# would be unreliable.
_MOST_PAIRS = 2_000


@dataclass(frozen=True)
class MapAssociationConfig:
    """Configuration of the data association.

    Parameters
    ----------
    rule : "nearest" or "joint"
        Nearest neighbour, or joint compatibility.
    sensor_range : float
        TH1 of Algorithm 1 [m]: submaps whose starts are within twice this can share landmarks.
    radius : float
        TH2 of Algorithm 1 [m]: largest distance of a candidate from its prediction, in addition to ``margin`` standard
        deviations of the prediction.
    margin : float
        Standard deviations of the pose added to both radii, so that a loop is found after a long drift.
    confidence : float
        Probability of the chi-square gates.
    starts : int
        Number of starts of the joint search.
    """

    rule: Literal["nearest", "joint"] = "joint"
    sensor_range: float = 45.0
    radius: float = 3.0
    margin: float = 3.0
    confidence: float = 0.9973
    starts: int = 25

    def __post_init__(self) -> None:
        ranges = {
            "> 0 or inf": "sensor_range radius",
            "≥ 0 or inf": "margin",
            "≥ 1": "starts",
            "in (0, 1)": "confidence",
        }
        check_options(self, "association: ", ranges)


def match_landmarks(a: JoinedMapView, b: JoinedMapView, options: MapAssociationConfig) -> Index:
    """Match the landmarks of B, which starts where A ends, to those of A.

    Returns
    -------
    (L_b,)
        Landmark of A, or -1.
    """
    match = np.full(len(b.landmark_at), -1, dtype=np.intp)
    near_b, near_a = _candidate_pairs(a, b, options)
    if len(near_b) == 0:
        return match
    own, i = np.unique(near_b, return_inverse=True)  # landmarks of B at stake
    known, j = np.unique(near_a, return_inverse=True)  # landmarks of A at stake
    start = a.pose_at[-1] + np.arange(3)
    P = a.covariance_block(np.concatenate([start, landmark_scalars(a.landmark_at[known]).ravel()]))
    Q = b.covariance_block(landmark_scalars(b.landmark_at[own]).ravel())
    pairs = CandidatePairs.predict(
        a.x[start], a.x[landmark_scalars(a.landmark_at[known])], P, b.x[landmark_scalars(b.landmark_at[own])], Q, i, j
    )
    gate = chi2_quantile(options.confidence, 2)
    pairs = pairs.subset(pairs.mahalanobis2() <= gate)  # individual compatibility
    chosen = pairs.nearest() if options.rule == "nearest" else pairs.joint(options.confidence, options.starts)
    match[own[pairs.i[chosen]]] = known[pairs.j[chosen]]
    return match


def _candidate_pairs(a: JoinedMapView, b: JoinedMapView, options: MapAssociationConfig) -> tuple[Index, Index]:
    """Pairs (landmark of B, landmark of A) that are close enough: Algorithm 1, TH1 and TH2."""
    none = np.zeros(0, dtype=np.intp)
    if len(a.landmark_at) == 0 or len(b.landmark_at) == 0:
        return none, none
    last = a.x[a.pose_at[-1] : a.pose_at[-1] + 3]
    P = a.covariance_block(a.pose_at[-1] + np.arange(3))

    def spread(local: Array) -> Array:  # standard deviation of where a point at `local`, seen from the last pose, is
        return np.sqrt(np.linalg.eigvalsh(P[:2, :2])[-1] + P[2, 2] * np.sum(local**2, axis=-1))

    # B's inner starts drift too, relative to its own base.
    starts_a = np.vstack([np.zeros((1, 2)), a.x[landmark_scalars(a.pose_at[:-1])]])
    local = np.vstack([np.zeros((1, 3)), b.x[pose_scalars(b.pose_at[:-1])]])
    sigma = spread(local[:, :2])
    if len(local) > 1:
        inner = b.pose_at[:-1]
        C = b.covariance_block(landmark_scalars(inner).ravel())
        sigma[1:] = np.sqrt(sigma[1:] ** 2 + np.diag(C).reshape(-1, 2).sum(axis=1))
    starts_b = se2_compose(last, local)[:, :2]
    distance = np.linalg.norm(starts_b[:, None] - starts_a[None], axis=-1)
    near = distance <= 2.0 * options.sensor_range + options.margin * sigma[:, None]
    from_b = np.unique(np.concatenate([none, *(b.entries[k] for k in np.flatnonzero(near.any(axis=1)))]))
    from_a = np.unique(np.concatenate([none, *(a.entries[k] for k in np.flatnonzero(near.any(axis=0)))]))
    if len(from_a) == 0 or len(from_b) == 0:
        return none, none
    z = b.x[landmark_scalars(b.landmark_at[from_b])]
    c, s = np.cos(last[2]), np.sin(last[2])
    expected = last[:2] + z @ np.array([[c, s], [-s, c]])
    sigma_z = spread(z)
    if len(local) > 1:
        C = b.covariance_block(landmark_scalars(b.landmark_at[from_b]).ravel())
        sigma_z = np.sqrt(sigma_z**2 + np.diag(C).reshape(-1, 2).sum(axis=1))
    tree = cKDTree(a.x[landmark_scalars(a.landmark_at[from_a])])
    hits = tree.query_ball_point(expected, options.radius + options.margin * sigma_z, return_sorted=True)
    count = np.array([len(h) for h in hits], dtype=np.intp)
    j = np.concatenate([none, *(np.asarray(h, dtype=np.intp) for h in hits)])
    return from_b[np.repeat(np.arange(len(hits)), count)], from_a[j]


@dataclass(frozen=True)
class CandidatePairs:
    """Innovations of candidate pairs with the parts of their joint covariance.

    Parameters
    ----------
    i, j : (p,)
        Observation and known landmark of each pair.
    innovation : (p, 2)
        ``z_i - R(θ)ᵀ (f_j - p)``.
    jacobian : (p, 2, 5)
        With respect to the pose (3) and the known landmark (2).
    P : (3 + 2c, 3 + 2c)
        Covariance of the pose and the known landmarks.
    Q : (2o, 2o)
        Covariance of the observations.
    """

    i: Index
    j: Index
    innovation: Array
    jacobian: Array
    P: Array
    Q: Array

    @classmethod
    def predict(
        cls, pose: Array, known: Array, P: Array, observed: Array, Q: Array, i: Index, j: Index
    ) -> CandidatePairs:
        """Innovations of the pairs ``(i, j)``; ``known`` ``(c, 2)`` in the frame of ``pose``, ``observed`` from it."""
        c, s = np.cos(pose[2]), np.sin(pose[2])
        Rt = np.array([[c, s], [-s, c]])
        q = (known[j] - pose[:2]) @ Rt.T
        J = np.empty((len(i), 2, 5))
        J[:, :, :2], J[:, :, 3:] = -Rt, Rt
        J[:, 0, 2], J[:, 1, 2] = q[:, 1], -q[:, 0]
        return cls(i, j, observed[i] - q, J, P, Q)

    def subset(self, keep: npt.ArrayLike) -> CandidatePairs:
        """The pairs ``keep`` (mask or indices)."""
        k = np.arange(len(self.i))[np.asarray(keep)]
        return CandidatePairs(self.i[k], self.j[k], self.innovation[k], self.jacobian[k], self.P, self.Q)

    def _own_scalars(self) -> tuple[Index, Index]:
        state = np.concatenate([np.tile(np.arange(3), (len(self.j), 1)), 3 + landmark_scalars(2 * self.j)], axis=1)
        return state, landmark_scalars(2 * self.i)

    def covariances(self) -> Array:
        """Innovation covariance of each pair ``(p, 2, 2)``."""
        state, obs = self._own_scalars()
        P = self.P[state[:, :, None], state[:, None, :]]
        return self.jacobian @ P @ self.jacobian.swapaxes(1, 2) + self.Q[obs[:, :, None], obs[:, None, :]]

    def joint_covariance(self) -> Array:
        """Innovation covariance of all pairs together ``(2p, 2p)``."""
        p = len(self.i)
        state, obs = self._own_scalars()
        J = np.zeros((2 * p, len(self.P)))
        rows = landmark_scalars(2 * np.arange(p))
        J[rows[:, :, None], state[:, None, :]] = self.jacobian
        return J @ self.P @ J.T + self.Q[np.ix_(obs.ravel(), obs.ravel())]

    def mahalanobis2(self) -> Array:
        """Squared Mahalanobis distance of each pair ``(p,)``."""
        return mahalanobis2(self.innovation, self.covariances())

    def nearest(self) -> Index:
        """Exclusive nearest neighbours: pairs are accepted in the order of their Mahalanobis distance."""
        return nearest_neighbour_pairs(self.mahalanobis2(), self.i, self.j)

    def joint(self, confidence: float, starts: int) -> Index:
        """Largest jointly compatible set that a search from ``starts`` pairs finds.

        From every start, the likeliest pair that is compatible *given* the accepted ones is added repeatedly, as long
        as the whole set is inside its chi-square gate. Of two sets of the same size the likelier one is used.
        """
        if len(self.i) == 0:
            return np.zeros(0, dtype=np.intp)
        # The best pairs of every observation come first, so that a cluttered area does not use all starts.
        d2 = self.mahalanobis2()
        order = np.lexsort((d2, self.i))
        rank = np.empty(len(order), dtype=np.intp)
        rank[order] = np.arange(len(order)) - np.searchsorted(self.i[order], self.i[order])
        best_first = np.lexsort((d2, rank))
        if len(order) > _MOST_PAIRS:
            logger.warning(
                "%d candidate pairs of %d landmarks are too many for a joint search; the nearest %d are tried",
                len(order), len(np.unique(self.i)), _MOST_PAIRS,
            )  # fmt: skip
            few = self.subset(np.sort(best_first[:_MOST_PAIRS]))
            return np.sort(best_first[:_MOST_PAIRS])[few.joint(confidence, starts)]
        limits = joint_limits(confidence, most_pairings(self.i, self.j))
        found = search_compatible_sets(
            self.i, self.j, self.innovation, self.joint_covariance(), best_first[:starts], limits[1], limits,
            persistent=True,
        )  # fmt: skip
        return found.of(int(np.lexsort((found.cost, -found.count))[0]))
