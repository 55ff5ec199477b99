"""Many landmark submaps as one sparse least-squares problem, assembled without a Python loop per factor.

The unknowns are ``[x_1 … x_m, l_1 … l_L]``: the end poses (x, y, θ) of the submaps, then the landmarks (x, y), all in
the frame of the first base, which is fixed. Submap k measures ``x_{k+1}`` and its landmarks from ``x_k`` (Combined SLAM
eq. 15) with its full joint covariance, and the objective is ``Σ rᵀ P⁻¹ r`` (no half).

Why it is fast: the Jacobian of a landmark is a rotation ``Rᵀ``, so a 2×2 block ``W`` of a submap's information enters
the normal equations as ``R W Rᵀ``. Written as ``W = p 1 + q J + deviator(u, v)``, only (u, v) change, by a rotation of
2θ. Refreshing the matrix costs a few vector operations on the stored blocks instead of two dense products a submap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.linalg import lapack

from graphslam.core.errors import CovarianceError, DataError, GeometryError
from graphslam.core.geometry import Array, ArrayLike, tangent_to_vector_covariance, wrap_angle
from graphslam.core.submap import LandmarkMap, Submap
from graphslam.graph.submap_model import predict_points
from graphslam.graph.submap_pattern import BlockPattern, Entries

Index = npt.NDArray[np.intp]


def landmark_map_of(submap: Submap) -> LandmarkMap:
    """The landmark map of a 2-D submap; one without landmarks measures its end pose alone.

    Raises
    ------
    DataError
        If the submap is not two-dimensional.
    """
    if submap.dim != 2:
        raise DataError(f"submap {submap.key} has the wrong dimension", got=submap.dim, wanted="2 (landmark joining)")
    if submap.landmarks is not None:
        return submap.landmarks
    return LandmarkMap(
        ids=np.zeros(0, dtype=np.int64),
        exit_pose=submap.exit_pose,
        positions=np.zeros((0, 2)),
        covariance=tangent_to_vector_covariance(submap.exit_pose, submap.exit_covariance),
    )


def dense_information(landmarks: LandmarkMap, *, what: str) -> Array:
    """Information matrix ``(3 + 2n, 3 + 2n)``, proven positive definite on the way.

    Raises
    ------
    CovarianceError
        Naming ``what``.
    """
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
    """One entry per landmark: entries of a submap that bear the same id are fused.

    Entries of one landmark measure the same quantity in the same frame, so fusing them is linear and exact: every
    least-squares problem keeps its minimum, and its objective falls by a constant. A map without repetitions comes
    back as it is; ids of -1 are never fused.
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
            first[-2 - i] = len(first)  # an id that is nobody's
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
    return LandmarkMap(ids=ids[kept], exit_pose=y[:3], positions=y[3:].reshape(-1, 2), covariance=0.5 * (P + P.T))


def check_identified(submaps: Sequence[Submap]) -> None:
    """Refuse an empty chain and landmarks that nobody has identified.

    Raises
    ------
    DataError
    """
    if not submaps:
        raise DataError("there are no submaps", got=0, wanted="at least one")
    for s in submaps:
        ids = landmark_map_of(s).ids
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
        In order: submap k+1 starts where submap k ends. Landmarks carry global ids; an id may stand twice in a submap.
    scale : (m,) or float, optional
        Factor on the covariance of each submap (default 1).

    Attributes
    ----------
    ids : (L,) int64
        Global ids in the order of first sighting.
    size : int
        Free scalars, ``3 m + 2 L``.
    measurements : int
        Rows of the residual; ``measurements - size`` are the degrees of freedom of the objective.

    Raises
    ------
    DataError
        No submap, an id of -1, a 3-D submap, or a scale that is not positive.
    CovarianceError
        A submap whose information is not positive definite.
    """

    def __init__(self, submaps: Sequence[Submap], *, scale: ArrayLike | None = None) -> None:
        check_identified(submaps)
        maps = [landmark_map_of(s) for s in submaps]
        self.m = m = len(maps)
        weights = 1.0 / _check_scale(1.0 if scale is None else scale, m)
        all_ids = np.concatenate([a.ids for a in maps])
        unique, first, inverse = np.unique(all_ids, return_index=True, return_inverse=True)
        by_sighting = np.argsort(first, kind="stable")
        rank = np.empty(len(unique), dtype=np.intp)
        rank[by_sighting] = np.arange(len(unique))
        self.ids = unique[by_sighting]
        self.size = 3 * m + 2 * len(self.ids)

        # Pairs: for every submap its end position, then its landmarks. Nodes: pose k is node k, landmark j node m + j.
        counts = np.array([1 + len(a) for a in maps])
        self._owner = np.repeat(np.arange(m), counts)
        first_pair = np.concatenate([[0], np.cumsum(counts)[:-1]])
        is_landmark = np.ones(len(self._owner), dtype=bool)
        is_landmark[first_pair] = False
        self._node = self._owner.copy()
        self._node[is_landmark] = m + rank[inverse.ravel()]
        self._z = np.concatenate([np.vstack([a.exit_pose[:2], a.positions]) for a in maps])
        self._z_heading = np.array([a.exit_pose[2] for a in maps])
        # Rows of submap k: its heading, then its pairs.
        first_row = np.concatenate([[0], np.cumsum(1 + 2 * counts)[:-1]])
        self._row_heading = first_row
        self._row_pair = (first_row[self._owner] + 1 + 2 * (np.arange(len(self._owner)) - first_pair[self._owner]))[
            :, None
        ] + np.arange(2)
        self._row_owner = np.repeat(np.arange(m), 1 + 2 * counts)
        self.measurements = len(self._row_owner)
        self._first_sighting = np.flatnonzero(is_landmark)[first[by_sighting]]
        self._gather_information(submaps, maps, weights, first_pair)

    def _gather_information(
        self, submaps: Sequence[Submap], maps: list[LandmarkMap], weights: Array, first_pair: Index
    ) -> None:
        """Flatten the information matrices and lay out the sparse pattern of the normal equations."""
        data, indices, blocks, left, right, to_pair, to_itself = [], [], [], [], [], [], []
        for k, (submap, landmarks) in enumerate(zip(submaps, maps)):
            W = weights[k] * dense_information(landmarks, what=f"submap {submap.key}")
            n = len(landmarks) + 1
            heading_first = np.concatenate([[2, 0, 1], np.arange(3, len(W))])
            W = W[np.ix_(heading_first, heading_first)]
            data.append(W.ravel())
            to_itself.append(W[0, 0])
            to_pair.append(W[0, 1:].reshape(-1, 2))
            indices.append(np.tile(np.arange(len(W)) + self._row_heading[k], len(W)))
            blocks.append(W[1:, 1:].reshape(n, 2, n, 2).swapaxes(1, 2).reshape(-1, 2, 2))
            left.append(np.repeat(np.arange(n), n) + first_pair[k])
            right.append(np.tile(np.arange(n), n) + first_pair[k])
        lengths = np.diff(np.append(self._row_heading, self.measurements))
        indptr = np.concatenate([[0], np.cumsum(np.repeat(lengths, lengths))])
        self._omega = sp.csr_matrix(
            (np.concatenate(data), np.concatenate(indices), indptr), shape=(self.measurements,) * 2
        )
        W, a, b = np.concatenate(blocks), np.concatenate(left), np.concatenate(right)
        self._heading_pair = np.concatenate(to_pair)  # Ω between a submap's heading and its pairs, (N, 2)
        self._heading_heading = np.array(to_itself)
        self._column_sums = np.stack(  # Σ_a W_ab for every pair b: what the start position feels of it
            [np.bincount(b, W[:, i, j], len(self._owner)) for i in (0, 1) for j in (0, 1)], -1
        )
        self._build_pattern(W, a, b)

    def _build_pattern(self, W: Array, a: Index, b: Index) -> None:
        m, node, owner = self.m, self._node, self._owner
        moved = np.flatnonzero(owner > 0)  # pairs of submaps whose start is not the fixed first base
        later = np.arange(1, m)
        sizes = np.concatenate([np.full(m, 3), np.full(len(self.ids), 2)])
        order_rows = np.concatenate([node[a], owner[moved] - 1])
        order_columns = np.concatenate([node[b], node[moved]])
        pattern = BlockPattern(sizes, order_rows, order_columns)
        keep = pattern.upper(node[a], node[b])
        self._W = np.stack(
            [
                0.5 * (W[keep, 0, 0] + W[keep, 1, 1]),
                0.5 * (W[keep, 1, 0] - W[keep, 0, 1]),
                0.5 * (W[keep, 0, 0] - W[keep, 1, 1]),
                0.5 * (W[keep, 0, 1] + W[keep, 1, 0]),
            ]
        )
        self._W_owner = owner[a[keep]]
        a, b = a[keep], b[keep]
        two = [(i, j) for i in (0, 1) for j in (0, 1)]
        every = np.arange(len(owner))
        first_pair = np.searchsorted(owner, np.arange(m))
        entries: list[Entries] = [(node[a], i, node[b], j) for i, j in two]
        entries += [(owner[every], 2, node, j) for j in (0, 1)]
        entries += [(node[first_pair], j, np.arange(m), 2) for j in (0, 1)]  # same block: the other triangle
        entries += [(np.arange(m), 2, np.arange(m), 2)]
        entries += [(owner[moved] - 1, i, node[moved], j) for i, j in two]
        entries += [(owner[moved] - 1, 2, node[moved], j) for j in (0, 1)]
        entries += [(later - 1, i, later, 2) for i in (0, 1, 2)]
        entries += [(later - 1, i, later - 1, j) for i in (0, 1, 2) for j in (0, 1, 2)]
        pattern.place(entries)
        self.pattern = pattern
        self._moved, self._first_pair = moved, first_pair

    # ---------------------------------------------------------------- values

    def starts(self, x: Array) -> Array:
        """Base poses ``(m, 3)`` of the submaps at the values ``x`` ``(size,)``."""
        return np.vstack([np.zeros((1, 3)), x[: 3 * self.m - 3].reshape(-1, 3)])

    def initial(self, poses: ArrayLike | None = None, landmarks: ArrayLike | None = None) -> Array:
        """Values to start from: the chain of end poses, each landmark where it was first sighted.

        Parameters
        ----------
        poses : (m, 3), optional
            End poses in the frame of the first base, instead of the chain.
        landmarks : (L, 2), optional
            In the order of :attr:`ids`, instead of the first sighting.
        """
        if poses is None:
            heading = np.cumsum(self._z_heading)
            before = np.concatenate([[0.0], heading[:-1]])
            z = self._z[self._first_pair]
            c, s = np.cos(before), np.sin(before)
            step = np.stack([c * z[:, 0] - s * z[:, 1], s * z[:, 0] + c * z[:, 1]], -1)
            P = np.column_stack([np.cumsum(step, axis=0), wrap_angle(heading)])
        else:
            P = np.asarray(poses, dtype=np.float64)
            if P.shape != (self.m, 3) or not np.all(np.isfinite(P)):
                raise GeometryError("initial poses do not fit the submaps", got=P.shape, wanted=(self.m, 3))
        x = np.concatenate([P.ravel(), np.zeros(2 * len(self.ids))])
        if landmarks is None:
            owner, z = self._owner[self._first_sighting], self._z[self._first_sighting]
            s0 = self.starts(x)[owner]
            c, s = np.cos(s0[:, 2]), np.sin(s0[:, 2])
            x[3 * self.m :: 2] = s0[:, 0] + c * z[:, 0] - s * z[:, 1]
            x[3 * self.m + 1 :: 2] = s0[:, 1] + s * z[:, 0] + c * z[:, 1]
        else:
            l = np.asarray(landmarks, dtype=np.float64)
            if l.shape != (len(self.ids), 2) or not np.all(np.isfinite(l)):
                raise GeometryError("initial landmarks do not fit the ids", got=l.shape, wanted=(len(self.ids), 2))
            x[3 * self.m :] = l.ravel()
        return x

    def _predict(self, x: Array) -> tuple[Array, Array, Array]:
        """Start poses, predicted pairs ``(N, 2)`` and residual ``(measurements,)`` (eq. 15)."""
        starts, ends = self.starts(x), x[: 3 * self.m].reshape(-1, 3)
        points = np.vstack([ends[:, :2], x[3 * self.m :].reshape(-1, 2)])
        q = predict_points(starts, points[self._node], self._owner)
        r = np.empty(self.measurements)
        r[self._row_heading] = wrap_angle(ends[:, 2] - starts[:, 2] - self._z_heading)
        r[self._row_pair] = q - self._z
        return starts, q, r

    def residual(self, x: Array) -> Array:
        """``H(X) - z``, submap by submap: heading first, then end position and landmarks ``(measurements,)``."""
        return self._predict(x)[2]

    def objective(self, x: Array) -> float:
        """``Σ rᵀ P⁻¹ r`` at the values ``x`` ``(size,)``."""
        r = self.residual(x)
        return float(r @ (self._omega @ r))

    def objective_per_submap(self, x: Array) -> Array:
        """The share ``(m,)`` of every submap in the objective: which of them disagrees with the rest."""
        r = self.residual(x)
        return np.asarray(np.bincount(self._row_owner, r * (self._omega @ r), self.m), dtype=np.float64)

    def linearise(self, x: Array) -> tuple[float, Array, Array]:
        """Objective, ``JᵀΩr`` ``(size,)``, and the values of ``JᵀΩJ`` in :attr:`pattern` (elimination order)."""
        m, owner, node, moved = self.m, self._owner, self._node, self._moved
        starts, q, r = self._predict(x)
        c, s = np.cos(starts[:, 2]), np.sin(starts[:, 2])
        d = np.empty_like(r)  # the column of J that belongs to the start heading
        d[self._row_heading] = -1.0
        d[self._row_pair] = np.stack([q[:, 1], -q[:, 0]], -1)
        omega_rd = self._omega @ np.stack([r, d], -1)
        cp, sp_ = c[owner], s[owner]

        def to_world(v: Array) -> Array:
            return np.stack([cp * v[:, 0] - sp_ * v[:, 1], sp_ * v[:, 0] + cp * v[:, 1]])

        def per_submap(v: Array) -> Array:
            return np.stack([np.bincount(owner, row, m) for row in v])

        force = to_world(omega_rd[self._row_pair, 0])
        g_point = np.stack([np.bincount(node, row, m + len(self.ids)) for row in force])
        total = per_submap(force)
        g_pose = np.column_stack([g_point[:, :m].T, omega_rd[self._row_heading, 0]])
        g_pose[:-1, :2] -= total[:, 1:].T
        g_pose[:-1, 2] += np.bincount(self._row_owner, d * omega_rd[:, 0], m)[1:]
        g = np.concatenate([g_pose.ravel(), g_point[:, m:].T.ravel()])

        c2, s2 = c * c - s * s, 2.0 * c * s
        blocks = _rotate_blocks(self._W, c2[self._W_owner], s2[self._W_owner])
        p = self._column_sums
        sums = np.stack([0.5 * (p[:, 0] + p[:, 3]), 0.5 * (p[:, 2] - p[:, 1]), 0.5 * (p[:, 0] - p[:, 3])])
        sums = np.vstack([sums, 0.5 * (p[:, 1] + p[:, 2])[None]])
        pull = _rotate_blocks(sums, c2[owner], s2[owner])  # R (Σ_a W_ab) Rᵀ
        turn = to_world(omega_rd[self._row_pair, 1])
        heading_pair = to_world(self._heading_pair)
        ss = per_submap(pull)[:, 1:]
        st = per_submap(turn)[:, 1:]
        tt = np.bincount(self._row_owner, d * omega_rd[:, 1], m)[1:]
        values = [blocks, heading_pair, heading_pair[:, self._first_pair], self._heading_heading]
        values += [-pull[:, moved], turn[:, moved], -per_submap(heading_pair)[:, 1:]]
        values += [omega_rd[self._row_heading, 1][1:], ss[0], ss[1], -st[0], ss[2], ss[3], -st[1], -st[0], -st[1], tt]
        return float(r @ omega_rd[:, 0]), g, self.pattern.assemble(np.concatenate([v.ravel() for v in values]))


def _rotate_blocks(parts: Array, c2: Array, s2: Array) -> Array:
    """``R W Rᵀ`` from the parts ``(p, q, u, v)`` of W, as rows w00, w01, w10, w11."""
    p, q, u, v = parts
    ur, vr = c2 * u - s2 * v, s2 * u + c2 * v
    return np.stack([p + ur, vr - q, vr + q, p - ur])


def relabel(submaps: Sequence[Submap], ids: Sequence[npt.ArrayLike]) -> list[Submap]:
    """The same submaps with other landmark ids; those without landmarks stay as they are."""
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
    """The same submaps with their covariances multiplied by ``factor`` (one number, or one a submap).

    Raises
    ------
    DataError
        If a factor is not a positive number.
    """
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
