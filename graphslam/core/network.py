"""Pose networks: poses, relative measurements with information, and (in 2-D) landmarks, as plain arrays.

A network is the content of a pose-graph file. Its conventions are those of :mod:`graphslam.core.geometry`: information
is the inverse covariance of ``Log(z⁻¹ x_i⁻¹ x_j)`` in GTSAM's tangent order (2-D: x, y, θ; 3-D: rotation first, then
translation), for any order in the file.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import CovarianceError, DataError, GeometryError
from graphslam.core.geometry import Array, ArrayLike
from graphslam.core.poses import Group
from graphslam.core.reading import finite_mask

Index = npt.NDArray[np.intp]
Ids = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]
ObservationKind = Literal["cartesian", "bearing-range"]

# An eigenvalue below -ROUNDING · (largest) is not caused by rounding of printed numbers: the matrix is indefinite.
ROUNDING = 1e-9
# Least eigenvalue of a repaired matrix relative to its largest, so that it is invertible.
REPAIR_FLOOR = 1e-9
# Number of matrices per chunk of a check.
_PART = 1 << 15


class Labels(Sequence[str]):
    """Names made lazily for error messages (a network can have a million edges)."""

    def __init__(self, name: Callable[[int], str]) -> None:
        self._name = name

    def __getitem__(self, k: Any) -> Any:
        return self._name(int(k))

    def __len__(self) -> int:
        return 0


def all_positive_definite(matrices: Array) -> bool:
    """Whether every one of ``(m, d, d)`` symmetric matrices has a Cholesky factor; five times cheaper than eigenvalues.

    False is not conclusive: a positive semi-definite matrix has none either.
    """
    try:
        np.linalg.cholesky(matrices)
    except np.linalg.LinAlgError:
        return False
    return True


def _eigen_floor(information: Array) -> tuple[Array, Array]:
    """Smallest eigenvalue of every matrix and its scale for the test, ``(m,)`` each."""
    w = np.linalg.eigvalsh(information)
    return np.asarray(w[:, 0], dtype=np.float64), np.maximum(np.abs(w).max(axis=1), np.finfo(float).tiny)


def _names(labels: Sequence[str], bad: Index, extra: Sequence[str] | None = None) -> str:
    shown = [labels[k] + (f" ({extra[i]})" if extra else "") for i, k in enumerate(bad[:5])]
    more = f" and {len(bad) - 5} more" if len(bad) > 5 else ""
    return ", ".join(shown) + more


def check_informations(information: ArrayLike, labels: Sequence[str], *, what: str, where: str | None = None) -> Array:
    """Return ``(m, d, d)`` information matrices, made exactly symmetric, or raise an error with the invalid ones.

    Positive *semi*-definite is accepted: a direction that was not measured has information zero.

    Parameters
    ----------
    labels : sequence of str
        Name of matrix k in an error, for example ``"3 -> 7"``.
    """
    info = np.array(information, dtype=np.float64)
    bad = _where(info, lambda part: ~finite_mask(part).all(axis=(1, 2)))
    if len(bad):
        raise CovarianceError(
            f"{len(bad)} of {len(info)} {what} are not finite: {_names(labels, bad)}", where=where, wanted="finite"
        )
    bad = _where(info, _asymmetric)
    if len(bad):
        raise CovarianceError(
            f"{len(bad)} of {len(info)} {what} are not symmetric: {_names(labels, bad)}",
            where=where,
            wanted="symmetric matrices",
        )
    for k in range(0, len(info), _PART):
        part = info[k : k + _PART]
        part[...] = 0.5 * (part + np.swapaxes(part, 1, 2))
    bad = _where(info, _indefinite)
    if len(bad):
        low, _ = _eigen_floor(info[bad[:5]])
        values = [f"smallest eigenvalue {v:.3g}" for v in low]
        raise CovarianceError(
            f"{len(bad)} of {len(info)} {what} are indefinite: {_names(labels, bad, values)}",
            where=where,
            wanted="positive semi-definite matrices; --repair (repair=True) replaces them by the nearest valid ones",
        )
    return info


def _where(matrices: Array, test: Callable[[Array], Mask]) -> Index:
    """Indices of the matrices for which ``test`` is true, processed in chunks to limit memory."""
    found = [k + np.flatnonzero(test(matrices[k : k + _PART])) for k in range(0, len(matrices), _PART)]
    return np.concatenate(found) if found else np.zeros(0, dtype=np.intp)


def _asymmetric(matrices: Array) -> Mask:
    scale = np.sqrt(np.abs(np.diagonal(matrices, axis1=1, axis2=2)))
    bound = 1e-6 * np.maximum(scale[:, :, None] * scale[:, None, :], np.finfo(float).tiny)
    return np.asarray((np.abs(matrices - np.swapaxes(matrices, 1, 2)) > bound).any(axis=(1, 2)))


def _indefinite(matrices: Array) -> Mask:
    if all_positive_definite(matrices):
        return np.zeros(len(matrices), dtype=np.bool_)
    low, top = _eigen_floor(matrices)
    return np.asarray(low < -ROUNDING * top)


def repair_informations(information: ArrayLike) -> tuple[Array, Index]:
    """Project indefinite information matrices to the nearest positive definite ones.

    Negative eigenvalues become a small positive floor (``1e-9`` of the largest); that is the nearest positive
    semi-definite matrix in Frobenius norm (Higham 1988) up to the floor. Valid matrices are returned unchanged.

    Parameters
    ----------
    information : (m, d, d)
        Finite. The symmetric part is used.

    Returns
    -------
    information : (m, d, d)
    repaired : (k,)
        Indices of the matrices that were changed.
    """
    info = np.array(information, dtype=np.float64)
    if len(info) == 0:
        return info, np.zeros(0, dtype=np.intp)
    if not finite_mask(info).all():
        bad = np.flatnonzero(~finite_mask(info).all(axis=(1, 2)))
        raise CovarianceError(
            f"{len(bad)} information matrices are not finite and cannot be repaired", got=f"first: number {bad[0]}"
        )
    symmetric = 0.5 * (info + np.swapaxes(info, 1, 2))
    asymmetric = np.flatnonzero((info != symmetric).any(axis=(1, 2)))
    low, top = _eigen_floor(symmetric)
    bad = np.union1d(np.flatnonzero(low < -ROUNDING * top), asymmetric).astype(np.intp)
    if len(bad):
        w, V = np.linalg.eigh(symmetric[bad])
        if (w[:, -1] <= 0.0).any():
            k = int(bad[np.flatnonzero(w[:, -1] <= 0.0)[0]])
            raise CovarianceError(f"information matrix number {k} has no positive eigenvalue, nothing to repair")
        w = np.maximum(w, REPAIR_FLOOR * w[:, -1:])
        info[bad] = np.einsum("kij,kj,klj->kil", V, w, V)
    return info, bad


@dataclass(frozen=True, slots=True)
class PoseNetwork:
    """A pose network, immutable; every array is checked on construction.

    Parameters
    ----------
    dim : int
        2 or 3.
    ids : (n,) int64
        Vertex names of the file, unique. Everything else counts vertices 0 … n-1.
    poses : (n, 3) or (n, 7)
        ``T_world_vertex`` if the file gives one, otherwise identity.
    has_initial : (n,) bool
        Whether the file gives the pose.
    edges : (m, 2)
        Vertex index pairs (i, j).
    measurements : (m, 3) or (m, 7)
        ``T_i_j``.
    information : (m, d, d)
        Inverse covariance of ``Log(z⁻¹ x_i⁻¹ x_j)``, GTSAM's tangent order, positive semi-definite.
    fixed : (n,) bool
        Vertices fixed at their given pose. If none: the first vertex is fixed (gauge).
    position_priors : (m,) bool
        Edges that measure only the position of their second vertex, ``t_j - z``, for example by GPS. They are the last
        ones; their first vertex is fixed at the origin, and measurement and information have no rotation.
    landmark_ids : (l,) int64
        Disjoint from ``ids``. 2-D only, as all following fields.
    landmarks : (l, 2)
        World positions, zero where unknown.
    has_landmark : (l,) bool
    observations : (k, 2)
        (vertex index, landmark index).
    observation_values : (k, 2)
        ``observation_kind`` "cartesian": x forward, y left in the vertex frame [m]; "bearing-range": bearing [rad],
        range [m].
    observation_information : (k, 2, 2)
        In the order of the values.
    observation_kind : {"cartesian", "bearing-range"}
    repaired : int
        Number of matrices that were projected to positive definite while reading.
    noise : str
        Description of how the noise columns were read.
    source : str
        Source file, for errors.
    """

    dim: int
    ids: Ids
    poses: Array
    has_initial: Mask
    edges: Index
    measurements: Array
    information: Array
    fixed: Mask = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    position_priors: Mask = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    landmark_ids: Ids = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    landmarks: Array = field(default_factory=lambda: np.zeros((0, 2)))
    has_landmark: Mask = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    observations: Index = field(default_factory=lambda: np.zeros((0, 2), dtype=np.intp))
    observation_values: Array = field(default_factory=lambda: np.zeros((0, 2)))
    observation_information: Array = field(default_factory=lambda: np.zeros((0, 2, 2)))
    observation_kind: ObservationKind = "cartesian"
    repaired: int = 0
    noise: str = "information"
    source: str = "network"

    def __post_init__(self) -> None:
        if self.dim not in (2, 3):
            raise DataError("a pose network is two- or three-dimensional", where=self.source, got=self.dim)
        n, m, l, k = len(self.ids), len(self.edges), len(self.landmark_ids), len(self.observations)
        width, d = (3, 3) if self.dim == 2 else (7, 6)
        if len(self.fixed) == 0:
            object.__setattr__(self, "fixed", np.zeros(n, dtype=np.bool_))
        if not np.any(self.position_priors):
            object.__setattr__(self, "position_priors", np.zeros(m, dtype=np.bool_))
        shapes: dict[str, tuple[tuple[int, ...], Any]] = {
            "ids": ((n,), np.int64),
            "poses": ((n, width), np.float64),
            "has_initial": ((n,), np.bool_),
            "edges": ((m, 2), np.intp),
            "measurements": ((m, width), np.float64),
            "information": ((m, d, d), np.float64),
            "fixed": ((n,), np.bool_),
            "position_priors": ((m,), np.bool_),
            "landmark_ids": ((l,), np.int64),
            "landmarks": ((l, 2), np.float64),
            "has_landmark": ((l,), np.bool_),
            "observations": ((k, 2), np.intp),
            "observation_values": ((k, 2), np.float64),
            "observation_information": ((k, 2, 2), np.float64),
        }
        for name, (shape, kind) in shapes.items():
            a = np.ascontiguousarray(getattr(self, name), dtype=kind)
            if a.shape != shape:
                raise GeometryError(f"{name} has the wrong shape", where=self.source, got=a.shape, wanted=shape)
            object.__setattr__(self, name, a)
        if n == 0:
            raise DataError("the network has no vertices", where=self.source)
        if self.dim == 3 and (l or k):
            raise DataError("landmarks are supported in two dimensions only", where=self.source)
        self._check_topology()
        self._check_values()

    def _check_topology(self) -> None:
        names, counts = np.unique(np.concatenate([self.ids, self.landmark_ids]), return_counts=True)
        if (counts > 1).any():
            raise DataError("vertex given twice", where=self.source, got=int(names[counts > 1][0]), wanted="unique ids")
        for pairs, sizes, what in (
            (self.edges, (len(self.ids), len(self.ids)), "edge"),
            (self.observations, (len(self.ids), len(self.landmark_ids)), "observation"),
        ):
            bad = np.flatnonzero((pairs < 0).any(1) | (pairs[:, 0] >= sizes[0]) | (pairs[:, 1] >= sizes[1]))
            if len(bad):
                raise DataError(f"{what} {bad[0]} names a vertex that is not there", where=self.source)
        loops = np.flatnonzero(self.edges[:, 0] == self.edges[:, 1])
        if len(loops):
            raise DataError("an edge joins a vertex to itself", where=self.source, got=self.edge_name(int(loops[0])))
        if (self.fixed & ~self.has_initial).any():
            k = int(np.flatnonzero(self.fixed & ~self.has_initial)[0])
            raise DataError("a fixed vertex has no pose in the file", where=self.source, got=f"vertex {self.ids[k]}")
        priors = np.flatnonzero(self.position_priors)
        origin = self.edges[priors, 0]
        if (np.diff(self.position_priors.astype(int)) < 0).any() or not (
            self.fixed[origin].all() and (self.poses[origin] == np.eye(self.poses.shape[1])[-1] * (self.dim == 3)).all()
        ):
            raise DataError("position priors are the last edges, from a vertex fixed at the origin", where=self.source)
        turn = slice(2, 3) if self.dim == 2 else slice(0, 3)
        identity = [0.0] if self.dim == 2 else [0.0, 0.0, 0.0, 1.0]
        if self.information[priors, turn].any() or (self.measurements[priors, self.dim :] != identity).any():
            raise DataError("a position prior has no rotation", where=self.source)

    def _check_values(self) -> None:
        for name, values, label in (
            ("pose", self.poses, lambda k: f"vertex {self.ids[k]}"),
            ("measurement", self.measurements, lambda k: f"edge {self.edge_name(k)}"),
            ("landmark", self.landmarks, lambda k: f"landmark {self.landmark_ids[k]}"),
            ("observation", self.observation_values, self.observation_name),
        ):
            bad = np.flatnonzero(~finite_mask(values).all(axis=1))
            if len(bad):
                raise GeometryError(f"{name} is not finite: {label(int(bad[0]))}", where=self.source)
        if self.dim == 3:
            for name, values in (("pose", self.poses), ("measurement", self.measurements)):
                off = np.abs(np.linalg.norm(values[:, 3:], axis=1) - 1.0) > 1e-6
                if off.any():
                    raise GeometryError(
                        f"{name} {int(off.argmax())} has no unit quaternion", where=self.source, got=values[off][0, 3:]
                    )
        if self.observation_kind not in ("cartesian", "bearing-range"):
            raise DataError("unknown observation kind", where=self.source, got=self.observation_kind)
        if self.observation_kind == "bearing-range" and (self.observation_values[:, 1] <= 0.0).any():
            k = int((self.observation_values[:, 1] <= 0.0).argmax())
            raise DataError(f"range is not positive: {self.observation_name(k)}", where=self.source)
        checked = check_informations(
            self.information,
            Labels(self.edge_name),
            what="edge information matrices",
            where=self.source,
        )
        object.__setattr__(self, "information", checked)
        checked = check_informations(
            self.observation_information,
            Labels(self.observation_name),
            what="landmark information matrices",
            where=self.source,
        )
        object.__setattr__(self, "observation_information", checked)
        for a in (self.ids, self.poses, self.edges, self.measurements, self.information, self.landmarks):
            a.setflags(write=False)

    def edge_name(self, k: int) -> str:
        """``"3 -> 7"``, in the file's ids; ``"position of 7"``."""
        i, j = self.edges[k]
        if self.position_priors[k]:
            return f"position of {self.ids[j]}"
        return f"{self.ids[i]} -> {self.ids[j]}"

    def observation_name(self, k: int) -> str:
        """``"3 sees 7"``, in the file's ids."""
        i, j = self.observations[k]
        return f"{self.ids[i]} sees {self.landmark_ids[j]}"

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def tangent_dim(self) -> int:
        """3 or 6."""
        return 3 if self.dim == 2 else 6

    @property
    def anchors(self) -> Index:
        """Fixed vertices, or the first if none is fixed. ``(a,)``."""
        held = np.flatnonzero(self.fixed)
        return held if len(held) else np.zeros(1, dtype=np.intp)

    @property
    def states(self) -> int:
        """Number of free scalars."""
        return (len(self.ids) - len(self.anchors)) * self.tangent_dim + 2 * len(self.landmark_ids)

    @property
    def residuals(self) -> int:
        """Number of measured scalars."""
        positions = int(np.count_nonzero(self.position_priors))
        return (len(self.edges) - positions) * self.tangent_dim + positions * self.dim + 2 * len(self.observations)

    @property
    def relative(self) -> Mask:
        """Edges between two poses ``(m,)``: not position priors, and not what else fixes directions of their datum
        (:func:`graphslam.core.position_priors.complete_datum`)."""
        out = ~self.position_priors
        if not out.all():
            held = np.flatnonzero(out & self.fixed[self.edges[:, 0]])
            w = np.linalg.eigvalsh(self.information[held])
            out[held] = w[:, 0] > 1e-12 * w[:, -1]
        return out

    def with_poses(self, poses: ArrayLike, landmarks: ArrayLike | None = None) -> PoseNetwork:
        """The same measurements with other values, e.g. a solution for writing to a file."""
        marks = self.landmarks if landmarks is None else np.asarray(landmarks, dtype=np.float64)
        return replace(
            self,
            poses=np.array(poses, dtype=np.float64),
            has_initial=np.ones(len(self.ids), dtype=np.bool_),
            landmarks=np.array(marks, dtype=np.float64),
            has_landmark=np.ones(len(self.landmark_ids), dtype=np.bool_)
            if landmarks is not None
            else self.has_landmark,
        )

    def steps_along_numbers(self, group: Group) -> Array:
        """Relative pose ``(n - 1, 3|7)`` from each vertex to the next, by the first edge between them."""
        near = np.flatnonzero((np.abs(np.diff(self.edges, axis=1).ravel()) == 1) & self.relative)
        node, at = np.unique(self.edges[near].min(axis=1), return_index=True)
        bare = np.setdiff1d(np.arange(len(self) - 1), node)
        if len(bare):
            raise DataError(
                f"nodes {bare[0]} and {bare[0] + 1} are not tied to each other, and submaps are chains",
                where=self.source, got=f"{len(bare)} gaps", wanted="a relative pose between any two neighbours",
            )  # fmt: skip
        edge = near[at]
        T = self.measurements[edge]
        return np.where((self.edges[edge, 0] > self.edges[edge, 1])[:, None], group.inverse(T), T)

    def only(self, used: Mask) -> PoseNetwork:
        """The network with only the edges and observations of ``used`` ``(m + k,)``."""
        m = len(self.edges)
        e, o = np.flatnonzero(used[:m]), np.flatnonzero(used[m:])
        return replace(
            self,
            edges=self.edges[e],
            measurements=self.measurements[e],
            information=self.information[e],
            position_priors=self.position_priors[e],
            observations=self.observations[o],
            observation_values=self.observation_values[o],
            observation_information=self.observation_information[o],
        )

    def __repr__(self) -> str:
        marks = f", {len(self.landmark_ids)} landmarks seen {len(self.observations)} times"
        return (
            f"PoseNetwork({self.source}: {self.dim}-D, {len(self.ids)} poses ({int(self.has_initial.sum())} with an "
            f"initial value), {len(self.edges)} edges{marks if len(self.landmark_ids) else ''})"
        )
