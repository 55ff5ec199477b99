"""Sparse least-squares problem of many landmark submaps, assembled without a Python loop per factor.

The unknowns are ``[x_1 … x_m, l_1 … l_L]``: the end poses (x, y, θ) of the submaps, then the landmarks (x, y), all in
the frame of the first base, which is fixed. Submap k measures ``x_{k+1}`` and its landmarks from ``x_k`` (Combined SLAM
eq. 15) with its full joint covariance, and the objective is ``Σ rᵀ P⁻¹ r`` (no half).

It is fast because the Jacobian of a landmark is a rotation ``Rᵀ`` (in the group chart a scaled one), so a 2×2 block
``W`` of a submap's information enters the normal equations as ``R W Rᵀ``. The matrix is updated by one compiled pass
over the information matrices, without dense products.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.linalg import lapack

from graphslam.core.errors import CovarianceError, DataError, GeometryError
from graphslam.core.geometry import Array, ArrayLike, tangent_to_vector_covariance, wrap_angle
from graphslam.core.submap import LandmarkMap, Submap
from graphslam.join import submap_kernels as kernels
from graphslam.join.submap_pattern import BlockPattern

Index = npt.NDArray[np.int64]


def landmark_map_of(submap: Submap) -> LandmarkMap:
    """The landmark map of a 2-D submap; without landmarks it measures only its end pose."""
    if submap.dim != 2:
        raise DataError(f"submap {submap.key} has the wrong dimension", got=submap.dim, wanted="2 (landmark joining)")
    if submap.landmarks is not None:
        return submap.landmarks
    return LandmarkMap(
        ids=np.zeros(0, dtype=np.int64),
        exit_pose=submap.exit_pose,
        positions=np.zeros((0, 2)),
        covariance=tangent_to_vector_covariance(submap.exit_pose, submap.exit_covariance),
        chart="group",  # for an exit only, this is its right tangent
    )


def dense_information(landmarks: LandmarkMap, *, what: str) -> Array:
    """Information matrix ``(3 + 2n, 3 + 2n)``, checked for positive definiteness."""
    P = landmarks.covariance
    M = landmarks.dense_information() if P is None else P
    factor, info = lapack.dpotrf(M, lower=1)
    if info != 0:
        raise CovarianceError(f"information of {what} is not positive definite", wanted="positive definite")
    if P is None:
        return M
    inverse, info = lapack.dpotri(factor, lower=1)
    if info != 0 or not np.all(np.isfinite(np.diag(inverse))):
        raise CovarianceError(f"covariance of {what} cannot be inverted", got=f"LAPACK info {info}")
    lower = np.tril(inverse, -1)
    return np.asarray(lower + lower.T + np.diag(np.diag(inverse)))


def fuse_repeated(landmarks: LandmarkMap, *, what: str = "submap") -> LandmarkMap:
    """Fuse the entries of a submap that have the same id.

    Entries of one landmark measure the same quantity in the same frame, so fusing them is linear and exact: every
    least-squares problem keeps its minimum, and its objective falls by a constant. A map without repetitions is
    returned unchanged; ids of -1 are never fused.
    """
    ids = landmarks.ids
    known = ids[ids >= 0]
    if len(np.unique(known)) == len(known):
        return landmarks
    group = np.empty(len(ids), dtype=np.intp)
    first: dict[int, int] = {}
    for i, j in enumerate(ids):
        group[i] = len(first)
        if j >= 0:
            group[i] = first.setdefault(int(j), len(first))
        else:
            first[-2 - i] = len(first)  # a unique dummy id
    n = len(first)
    columns = np.concatenate([np.arange(3), (3 + 2 * group[:, None] + np.arange(2)).ravel()])
    C = np.zeros((3 + 2 * len(ids), 3 + 2 * n))
    C[np.arange(len(columns)), columns] = 1.0
    I_z = dense_information(landmarks, what=what)
    I_y = C.T @ I_z @ C
    kept = np.array([int(np.flatnonzero(group == g)[0]) for g in range(n)], dtype=np.intp)
    y = np.concatenate([landmarks.exit_pose, landmarks.positions[kept].ravel()])
    y = y + np.linalg.solve(I_y, C.T @ I_z @ (landmarks.mean - C @ y))
    P = np.linalg.inv(I_y)
    y[2] = wrap_angle(y[2])
    return LandmarkMap(
        ids=ids[kept],
        exit_pose=y[:3],
        positions=y[3:].reshape(-1, 2),
        covariance=0.5 * (P + P.T),
        chart=landmarks.chart,
    )


def check_identified(submaps: Sequence[Submap]) -> None:
    """Refuse an empty chain, and landmarks without an id."""
    if not submaps:
        raise DataError("there are no submaps", got=0, wanted="at least one")
    for s in submaps:
        ids = np.zeros(0) if s.landmarks is None else s.landmarks.ids
        if np.any(ids < 0):
            raise DataError(
                f"submap {s.key} has landmarks without an identity",
                got=f"{int(np.sum(ids < 0))} ids of -1",
                wanted="ids ≥ 0, or a method with association",
            )


class SubmapProblem:
    """Sparse least squares over a chain of landmark submaps.

    Parameters
    ----------
    submaps : sequence of Submap
        In order: submap k+1 starts where submap k ends. Landmarks have global ids; a submap may repeat an id.
    scale : (m,) or float, optional
        Factor on the covariance of each submap (default 1).
    ids : sequence of (n_k,), optional
        Global ids of the entries of every submap, in place of those in the submaps.
    information : sequence of (3 + 2 n_k, 3 + 2 n_k), optional
        Their information matrices (before ``scale``), if known.

    Attributes
    ----------
    ids : (L,) int64
        Global ids in the order of first observation.
    size : int
        Free scalars, ``3 m + 2 L``.
    chart : str
        Of all submaps; "cartesian" if they differ.
    measurements : int
        Rows of the residual; ``measurements - size`` are the degrees of freedom of the objective.
    """

    def __init__(
        self,
        submaps: Sequence[Submap],
        *,
        scale: ArrayLike | None = None,
        ids: Sequence[npt.NDArray[np.int64]] | None = None,
        information: Sequence[Array] | None = None,
    ) -> None:
        if ids is None:
            check_identified(submaps)
        maps = [landmark_map_of(s) for s in submaps]
        self._submaps = tuple(submaps)
        self.m = m = len(maps)
        weights = 1.0 / _check_scale(1.0 if scale is None else scale, m)
        all_ids = np.concatenate([a.ids for a in maps] if ids is None else list(ids))
        unique, first, inverse = np.unique(all_ids, return_index=True, return_inverse=True)
        by_observation = np.argsort(first, kind="stable")
        rank = np.empty(len(unique), dtype=np.int64)
        rank[by_observation] = np.arange(len(unique))
        self.ids = unique[by_observation]
        self.size = 3 * m + 2 * len(self.ids)

        # Entries: the end of every submap, then its landmarks. Nodes: pose k is node k, landmark j node m + j.
        counts = np.array([1 + len(a) for a in maps], dtype=np.int64)
        self._entry_ptr = _offsets(counts)
        owner = np.repeat(np.arange(m), counts)
        is_landmark = np.ones(len(owner), dtype=bool)
        is_landmark[self._entry_ptr[:-1]] = False
        self._node = owner.astype(np.int64)
        self._node[is_landmark] = m + rank[inverse.ravel()]
        self._width = np.repeat([3, 2], [m, len(self.ids)]).astype(np.int64)
        self._node_at = _offsets(self._width)[:-1]
        rows = 1 + 2 * counts
        self._row_ptr = _offsets(rows)
        self.measurements = int(self._row_ptr[-1])
        self._z = np.concatenate([a.mean for a in maps])
        self._group = np.array([a.chart == "group" for a in maps])
        self._omega_ptr = _offsets(rows * rows)
        self._omega = np.empty(self._omega_ptr[-1])
        for k, (submap, landmarks) in enumerate(zip(submaps, maps)):
            W = dense_information(landmarks, what=f"submap {submap.key}") if information is None else information[k]
            self._omega[self._omega_ptr[k] : self._omega_ptr[k + 1]] = (weights[k] * W).ravel()
        observation = first[by_observation]  # among the landmark entries of all submaps
        self._first_owner = owner[is_landmark][observation]
        self._first_row = self._row_ptr[self._first_owner] + 3
        self.chart = "group" if bool(np.all(self._group)) else "cartesian"
        self._first_row += 2 * (np.flatnonzero(is_landmark)[observation] - self._entry_ptr[self._first_owner] - 1)

    @property
    def anchors(self) -> Index:
        """Anchor of every landmark ``(L,)``: k is the end of submap k, the first that observed it."""
        return np.asarray(self._first_owner, dtype=np.int64)

    def is_of(self, submaps: Sequence[Submap]) -> bool:
        """Whether it was made from these submap objects."""
        return len(submaps) == self.m and all(a is b for a, b in zip(submaps, self._submaps))

    @cached_property
    def pattern(self) -> BlockPattern:
        """Pattern of ``JᵀΩJ`` and its factorisation; cached."""
        ptr, neighbours = kernels.adjacency(len(self._width), self._entry_ptr, self._node)
        return BlockPattern(self._width, ptr, neighbours)

    @cached_property
    def _slots(self) -> tuple[Index, Index]:
        """Offset of the block of every two entries of a submap, including its start."""
        p = self.pattern
        pair_ptr = _offsets((1 + np.diff(self._entry_ptr)) ** 2)
        slots = kernels.entry_slots(
            len(self._width), self._entry_ptr, self._node, pair_ptr, p.ptr, p.neighbours, p.block, p.flip
        )
        return pair_ptr, slots

    # ---------------------------------------------------------------- values

    def starts(self, x: Array) -> Array:
        """Base poses ``(m, 3)`` of the submaps at the values ``x`` ``(size,)``."""
        return np.vstack([np.zeros((1, 3)), x[: 3 * self.m - 3].reshape(-1, 3)])

    def initial(self, poses: ArrayLike | None = None, landmarks: ArrayLike | None = None) -> Array:
        """Initial values: the chain of end poses, each landmark at its first observation.

        Parameters
        ----------
        poses : (m, 3), optional
            End poses in the frame of the first base, in place of the chain.
        landmarks : (L, 2), optional
            In the order of :attr:`ids`, in place of the first observation.
        """
        if poses is None:
            z = self._z[self._row_ptr[:-1, None] + np.arange(3)]
            heading = np.cumsum(z[:, 2])
            before = np.concatenate([[0.0], heading[:-1]])
            c, s = np.cos(before), np.sin(before)
            step = np.stack([c * z[:, 0] - s * z[:, 1], s * z[:, 0] + c * z[:, 1]], -1)
            P = np.column_stack([np.cumsum(step, axis=0), wrap_angle(heading)])
        else:
            P = np.asarray(poses, dtype=np.float64)
            if P.shape != (self.m, 3) or not np.all(np.isfinite(P)):
                raise GeometryError("initial poses do not fit the submaps", got=P.shape, wanted=(self.m, 3))
        x = np.concatenate([P.ravel(), np.zeros(2 * len(self.ids))])
        if landmarks is None:
            zx, zy = self._z[self._first_row], self._z[self._first_row + 1]
            s0 = self.starts(x)[self._first_owner]
            c, s = np.cos(s0[:, 2]), np.sin(s0[:, 2])
            x[3 * self.m :: 2] = s0[:, 0] + c * zx - s * zy
            x[3 * self.m + 1 :: 2] = s0[:, 1] + s * zx + c * zy
        else:
            l = np.asarray(landmarks, dtype=np.float64)
            if l.shape != (len(self.ids), 2) or not np.all(np.isfinite(l)):
                raise GeometryError("initial landmarks do not fit the ids", got=l.shape, wanted=(len(self.ids), 2))
            x[3 * self.m :] = l.ravel()
        return x

    def _split(self, x: Array) -> tuple[Array, Array]:
        """End poses ``(m, 3)`` and landmarks ``(L, 2)``."""
        return x[: 3 * self.m].reshape(-1, 3), x[3 * self.m :].reshape(-1, 2)

    def bent(self, x: Array, step: Array) -> Array:
        """Apply a step along the chain, not along a straight line ``(size,)``.

        ``x + step`` moves everything after a corrected heading along a tangent, which is wrong over kilometres. Here
        the step is applied to relative quantities: every end pose relative to its start, and every landmark relative to
        the start of the submap that observed it first, change by ``step`` to first order, and the chain is composed
        again. Both results agree to first order.
        """
        ends, marks = self._split(x)
        d_ends, d_marks = self._split(step)
        starts, d_starts = self.starts(x), self.starts(step)
        turned = starts[:, 2] + d_starts[:, 2]
        moves = _turn(turned, _seen(starts, d_starts, ends[:, :2], d_ends[:, :2]))
        bent = np.empty_like(x)
        new_ends, new_marks = self._split(bent)
        new_ends[:, :2] = np.cumsum(moves, axis=0)
        new_ends[:, 2] = ends[:, 2] + d_ends[:, 2]
        o = self._first_owner
        local = _seen(starts[o], d_starts[o], marks, d_marks)
        new_marks[:] = self.starts(bent)[o, :2] + _turn(turned[o], local)
        return bent

    def residual(self, x: Array) -> Array:
        """``H(X) - z``, submap by submap ``(measurements,)`` (eq. 15), each in its chart."""
        r = self._difference(x)
        kernels.chart_residuals(self._row_ptr, self._group, r)
        return r

    def _difference(self, x: Array) -> Array:
        poses, points = self._split(np.ascontiguousarray(x, dtype=np.float64))
        r = np.empty(self.measurements)
        kernels.predict_submaps(poses, points, self.m, self._entry_ptr, self._node, self._z, r)
        return r

    def objective_per_submap(self, x: Array) -> Array:
        """Contribution ``(m,)`` of every submap to the objective."""
        out = np.empty(self.m)
        kernels.submap_chi2(self._row_ptr, self._omega, self._omega_ptr, self.residual(x), out)
        return out

    def objective(self, x: Array) -> float:
        """``Σ rᵀ P⁻¹ r`` at the values ``x`` ``(size,)``."""
        return float(np.sum(self.objective_per_submap(x)))

    def linearise(self, x: Array) -> tuple[float, Array, Array]:
        """Objective, ``JᵀΩr`` ``(size,)``, and the values of ``JᵀΩJ`` in :attr:`pattern`."""
        x = np.ascontiguousarray(x, dtype=np.float64)
        r, poses = self._difference(x), self._split(x)[0]
        g, values = np.zeros(self.size), np.zeros(self.pattern.entries)
        pair_ptr, slots = self._slots
        submaps = kernels.SubmapChainArrays(
            self._entry_ptr, self._node, self._row_ptr, self._z, self._omega, self._omega_ptr, self._group
        )
        f = kernels.linearise_submaps(poses, submaps, kernels.SystemSlots(self._node_at, pair_ptr, slots), r, g, values)
        return float(f), g, values


def _turn(heading: Array, q: Array) -> Array:
    """Rotate points ``q`` ``(n, 2)`` by ``heading`` ``(n,)``."""
    c, s = np.cos(heading), np.sin(heading)
    return np.stack([c * q[:, 0] - s * q[:, 1], s * q[:, 0] + c * q[:, 1]], -1)


def _seen(starts: Array, d_starts: Array, points: Array, d_points: Array) -> Array:
    """Points ``(n, 2)`` in the frames of poses ``(n, 3)``, plus their change to first order."""
    q = _turn(-starts[:, 2], points - starts[:, :2])
    dq = _turn(-starts[:, 2], d_points - d_starts[:, :2])
    return q + dq + d_starts[:, 2:] * np.stack([q[:, 1], -q[:, 0]], -1)


def _offsets(counts: npt.NDArray[np.int64]) -> Index:
    """``[0, c_0, c_0 + c_1, …]``."""
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


def relabel(submaps: Sequence[Submap], ids: Sequence[npt.ArrayLike]) -> list[Submap]:
    """The submaps with other landmark ids; those without landmarks are unchanged."""
    return [
        s if s.landmarks is None else replace(s, landmarks=replace(s.landmarks, ids=np.asarray(i, dtype=np.int64)))
        for s, i in zip(submaps, ids, strict=True)
    ]


def _check_scale(scale: ArrayLike, m: int) -> Array:
    factors = np.broadcast_to(np.asarray(scale, dtype=np.float64), (m,))
    if not np.all(np.isfinite(factors) & (factors > 0)):
        raise DataError("covariance scale is not a positive number", got=scale, wanted="> 0")
    return factors


def scale_covariances(submaps: Sequence[Submap], factor: ArrayLike) -> list[Submap]:
    """The submaps with covariances multiplied by ``factor`` (one number, or one per submap)."""
    factors = _check_scale(factor, len(submaps))
    scaled = []
    for s, f in zip(submaps, factors):
        landmarks = s.landmarks
        if landmarks is not None and landmarks.information is not None:
            landmarks = replace(landmarks, information=landmarks.information / f)
        elif landmarks is not None:
            landmarks = replace(landmarks, covariance=f * landmarks.dense_covariance())
        scaled.append(replace(s, landmarks=landmarks, exit_covariance=f * s.exit_covariance))
    return scaled
