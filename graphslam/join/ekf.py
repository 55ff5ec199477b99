"""Dense baseline: an extended Kalman filter over all poses and landmarks, submap by submap.

The model and the single linearisation are those of the information filter, so both agree up to rounding. The covariance
is kept symmetric and positive definite by the square-root form of the update: with ``S = L Lᵀ`` and ``W = L⁻¹ H P`` it
is ``P ← P - Wᵀ W``. (``P - K (P Hᵀ)ᵀ`` loses definiteness after a loop closure.)

Known landmarks are an ordinary measurement ``z_o`` with noise ``Q_oo``. The end pose and the new landmarks ``z_n`` have
noise that is correlated with it; given the known part, ``v_n = G v_o + w`` with ``G = Q_no Q_oo⁻¹`` and
``w ~ N(0, Q_nn - G Q_on)``, so they are appended with their exact covariance.

The square-root form costs O(n²) per join. The textbook form ``P ← (I - K H) P``, a product of two dense ``n × n``
matrices, costs O(n³); it is included (``form="naive"``) to reproduce published run times of the Kalman filter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import numpy.typing as npt
import scipy.linalg as la

from graphslam.core.errors import ConfigError, CovarianceError, DataError
from graphslam.core.geometry import Array, rotation2
from graphslam.core.progress import Bar
from graphslam.core.submap import LandmarkMap, Submap
from graphslam.join.association import MapAssociationConfig, match_landmarks
from graphslam.join.joined_map import (
    Ids,
    JoinedMap,
    JoinResult,
    JoinTimes,
    OnJoin,
    check_chain,
    distinct_landmarks,
    finish_map,
    landmark_scalars,
    last_pose,
)
from graphslam.join.submap_blocks import landmark_map_of

Index = npt.NDArray[np.intp]
Form = Literal["square", "naive"]


class DenseMap:
    """A map in moment form (see :class:`~graphslam.join.joined_map.JoinedMapView`); grows in place.

    Parameters
    ----------
    first : LandmarkMap
        Each landmark once; id -1 if unknown.
    entries : (n,)
        Landmark of each entry of the submap.
    capacity : int
        Number of scalars to allocate.
    form : "square" or "naive"
        Covariance update: ``P - Wᵀ W``, or ``(I - K H) P``. The latter is for timing only: the covariance does not stay
        symmetric, and is not positive definite after a long loop.
    """

    def __init__(self, first: LandmarkMap, entries: Index, capacity: int, form: Form = "square") -> None:
        if form not in ("square", "naive"):
            raise ConfigError(f"unknown form {form!r} of the covariance update; wanted 'square' or 'naive'")
        self._form = form
        n = 3 + 2 * len(first)
        self._x = np.zeros(capacity)
        self._P = np.zeros((capacity, capacity))
        self._x[:n] = first.mean
        self._P[:n, :n] = first.dense_covariance()
        self._n = n
        self.pose_at: Index = np.zeros(1, dtype=np.intp)
        self.landmark_at: Index = 3 + 2 * np.arange(len(first), dtype=np.intp)
        self.ids: Ids = first.ids
        self.entries: tuple[Index, ...] = (entries,)

    @property
    def x(self) -> Array:
        """Mean ``(n,)``."""
        return self._x[: self._n]

    @x.setter
    def x(self, value: Array) -> None:
        self._x[: self._n] = value

    @property
    def covariance(self) -> Array:
        """Covariance ``(n, n)``."""
        return self._P[: self._n, : self._n]

    def covariance_block(self, indices: Index) -> Array:
        """Joint covariance of the scalars ``indices``."""
        return self._P[np.ix_(indices, indices)]

    def pose(self) -> Array:
        """Last end pose ``(3,)``."""
        return last_pose(self)

    def pose_covariance(self) -> Array:
        """Covariance ``(3, 3)`` of the last end pose as a vector."""
        return self.covariance_block(self.pose_at[-1] + np.arange(3))

    def landmark_marginals(self) -> Array:
        """Covariance ``(L, 2, 2)`` of each landmark."""
        at = landmark_scalars(self.landmark_at)
        return self._P[at[:, :, None], at[:, None, :]]

    def join(self, submap: LandmarkMap, entries: Index, match: Index) -> None:
        """One measurement update and one augmentation.

        Parameters
        ----------
        submap : LandmarkMap
            Each landmark once.
        entries : (n,)
            Landmark of each entry of the original submap.
        match : (L,)
            Landmark of the map for each of them, or -1.
        """
        n, Q, z = self._n, submap.dense_covariance(), submap.mean
        old, new = np.flatnonzero(match >= 0), np.flatnonzero(match < 0)
        known = landmark_scalars(self.landmark_at[match[old]])
        start = self.pose_at[-1] + np.arange(3)
        columns = np.concatenate([start, known.ravel()])  # all that H touches
        p_s, heading = self._x[start[:2]], self._x[start[2]]
        Rt = rotation2(heading).T
        rows_o = (3 + landmark_scalars(2 * old)).ravel()
        rows_n = np.concatenate([np.arange(3), (3 + landmark_scalars(2 * new)).ravel()])

        # New variables: z_n = A δ_start + B δ_new + v_n with B orthogonal, linearised at their values from the submap.
        seen = np.concatenate([z[None, :2], z[3 + landmark_scalars(2 * new)]])  # end position, new landmarks
        positions = seen @ Rt + p_s
        x_new = np.concatenate([positions[0], [heading + z[2]], positions[1:].ravel()])
        around = _about_start(seen, Rt)
        A = np.vstack([around[:2], [[0.0, 0.0, -1.0]], around[2:]])
        B = la.block_diag(Rt, 1.0, np.kron(np.eye(len(new)), Rt))
        F = np.zeros((len(rows_n), len(columns)))  # δ_new = F δ_columns - Bᵀ (G ν + w)
        F[:, :3] = -B.T @ A
        Q_w = Q[np.ix_(rows_n, rows_n)]

        P = self._P[:n, :n]
        if len(old):
            q = (self._x[known] - p_s) @ Rt.T
            H = np.hstack([_about_start(q, Rt), np.kron(np.eye(len(old)), Rt)])
            innovation = z[rows_o] - q.ravel()
            HP = H @ P[columns]
            S = HP[:, columns] @ H.T + Q[np.ix_(rows_o, rows_o)]
            try:
                L = la.cholesky(0.5 * (S + S.T), lower=True)
                L_o = la.cholesky(Q[np.ix_(rows_o, rows_o)], lower=True)
            except la.LinAlgError:
                raise CovarianceError("innovation covariance of the EKF is not positive definite") from None
            V = la.solve_triangular(L_o, Q[np.ix_(rows_o, rows_n)], lower=True)
            G = la.solve_triangular(L_o, V, lower=True, trans="T").T  # Q_no Q_oo⁻¹
            Q_w = Q_w - V.T @ V
            F += B.T @ G @ H
            shift = HP[:, columns].T @ la.cho_solve((L, True), innovation)  # of the columns, by the update
            x_new = x_new + F @ shift - B.T @ (G @ innovation)
            if self._form == "square":
                W = la.solve_triangular(L, HP, lower=True)
                self._x[:n] += W.T @ la.solve_triangular(L, innovation, lower=True)
                P -= W.T @ W  # a symmetric rank update: numpy calls BLAS syrk
            else:
                K = la.cho_solve((L, True), HP).T  # P Hᵀ S⁻¹
                H_all = np.zeros((len(H), n))
                H_all[:, columns] = H
                self._x[:n] += K @ innovation
                P[:] = (np.eye(n) - K @ H_all) @ P
        self._append(x_new, F @ P[columns], F, columns, B.T @ Q_w @ B, len(new))
        place = np.where(match >= 0, match, len(self.landmark_at) - len(new) + np.cumsum(match < 0) - 1)
        self.entries = self.entries + (place[entries].astype(np.intp),)
        self.ids = np.concatenate([self.ids, submap.ids[new]])

    def _append(self, x_new: Array, P_new_old: Array, F: Array, columns: Index, Q_new: Array, landmarks: int) -> None:
        n, k = self._n, len(x_new)
        if n + k > len(self._x):
            raise DataError("the dense map has no room left", got=n + k, wanted=f"≤ {len(self._x)}")
        self._x[n : n + k] = x_new
        self._P[n : n + k, :n] = P_new_old
        self._P[:n, n : n + k] = P_new_old.T
        corner = P_new_old[:, columns] @ F.T + Q_new
        self._P[n : n + k, n : n + k] = 0.5 * (corner + corner.T)
        self._n = n + k
        self.pose_at = np.append(self.pose_at, n)
        self.landmark_at = np.append(self.landmark_at, n + 3 + 2 * np.arange(landmarks))


def _about_start(q: Array, Rt: Array) -> Array:
    """Jacobian ``(2N, 3)`` of points ``q`` ``(N, 2)`` seen from a pose, with respect to that pose (eq. 15)."""
    J = np.empty((len(q), 2, 3))
    J[:, :, :2] = -Rt
    J[:, 0, 2], J[:, 1, 2] = q[:, 1], -q[:, 0]
    return J.reshape(-1, 3)


def join_ekf(
    submaps: Sequence[Submap],
    *,
    association: MapAssociationConfig | None = None,
    form: Form = "square",
    on_join: OnJoin | None = None,
    progress: bool = False,
) -> JoinResult:
    """Join submaps in sequence with a dense extended Kalman filter.

    Parameters
    ----------
    association : MapAssociationConfig, optional
        Data association; default: by the landmark ids.
    form : "square" or "naive"
        Covariance update ``P - Wᵀ W``, O(n²) per join; or ``(I - K H) P`` with dense products, O(n³), for timing only.
    on_join : callable, optional
        See :func:`~graphslam.join.order.join_sequential`.
    progress : bool
        Show a progress bar.
    """
    identified = association is None
    check_chain(submaps, identified=identified)
    times = JoinTimes()
    known: dict[int, int] = {}
    dense: DenseMap | None = None
    capacity = sum(3 + 2 * len(landmark_map_of(s)) for s in submaps) if not identified else _scalars(submaps)
    for k, submap in enumerate(Bar(submaps, name="join", unit="submap", shown=progress)):
        with times.measure("update"):
            fused, entries = distinct_landmarks(submap, identified=identified)
            if not identified:
                fused = replace(fused, ids=np.full(len(fused), -1, dtype=np.int64))
        with times.measure("association"):
            if dense is None:
                match = np.full(len(fused), -1, dtype=np.intp)
            elif association is None:
                match = np.array([known.get(int(j), -1) for j in fused.ids], dtype=np.intp)
            else:
                leaf = JoinedMap.leaf(submap, identified=False)
                match = match_landmarks(dense, leaf, association)
            if identified:
                for j in fused.ids[match < 0]:
                    known.setdefault(int(j), len(known))
        with times.measure("update"):
            if dense is None:
                dense = DenseMap(fused, entries, capacity, form)
            else:
                dense.join(fused, entries, match)
        if on_join is not None:
            on_join(k, dense)
    assert dense is not None
    return finish_map(submaps, dense, identified=identified, method="ekf", times=times)


def _scalars(submaps: Sequence[Submap]) -> int:
    """Number of scalars of the whole map if ids are given."""
    ids = np.concatenate([landmark_map_of(s).ids for s in submaps])
    return 3 * len(submaps) + 2 * len(np.unique(ids))
