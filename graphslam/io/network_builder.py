"""From records of a file to a :class:`~graphslam.core.network.PoseNetwork`."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field

import numpy as np

from graphslam.core.errors import CovarianceError, FormatError, GeometryError
from graphslam.core.geometry import Array
from graphslam.core.network import Ids, ObservationKind, PoseNetwork, check_informations, repair_informations
from graphslam.core.se3 import quat_normalize

log = logging.getLogger(__name__)


def upper_triangle(values: Array, size: int) -> Array:
    """Symmetric ``(m, size, size)`` from row-wise upper triangles ``(m, size (size + 1) / 2)``."""
    out = np.zeros((len(values), size, size))
    rows, columns = np.triu_indices(size)
    out[:, rows, columns] = values
    out[:, columns, rows] = values
    return out


@dataclass
class NetworkBuilder:
    """Collects what a file says; :meth:`build` orders it by vertex id and checks it.

    Parameters
    ----------
    source : str
        File name for errors.
    dim : int
        2 or 3.
    repair : bool
        Project impossible matrices instead of refusing them.
    create_missing : bool
        Make vertices that only edges name, where others are given; they have no initial pose.
    """

    source: str
    dim: int
    repair: bool = False
    create_missing: bool = False
    named: dict[int, str] = field(default_factory=dict)
    vertices: dict[int, Array] = field(default_factory=dict)
    marks: dict[int, Array | None] = field(default_factory=dict)
    fixed: dict[int, str] = field(default_factory=dict)
    edges: list[tuple[Ids, Array, Array]] = field(default_factory=list)
    sightings: list[tuple[Ids, Array, Array]] = field(default_factory=list)
    kind: ObservationKind = "cartesian"
    noise: str = "information"
    repaired: int = 0

    def add_vertex(self, vertex: int, pose: list[float], where: str) -> None:
        """One pose; 3-D quaternions are normalised here.

        Raises
        ------
        FormatError
            Given twice, or with a quaternion of length zero.
        """
        if vertex in self.vertices:
            raise FormatError("vertex given twice", where=where, got=f"vertex {vertex}")
        self.vertices[vertex] = self._unit(np.array([pose]), [where])[0]

    def _unit(self, poses: Array, where: list[str]) -> Array:
        if self.dim == 2:
            return poses
        length = np.linalg.norm(poses[:, 3:], axis=1)
        # a printed unit quaternion is off by its digits; one that is off by more than 1 % is something else
        bad = np.flatnonzero(np.abs(length - 1.0) > 1e-2)
        if len(bad):
            raise FormatError("not a unit quaternion", where=where[bad[0]], got=poses[bad[0], 3:], wanted="length 1")
        return np.concatenate([poses[:, :3], quat_normalize(poses[:, 3:])], axis=1)

    def add_edges(self, pairs: Ids, measurements: Array, information: Array, where: list[str]) -> None:
        """Edges ``(m, 2)`` between vertex ids; information in GTSAM's order."""
        loops = np.flatnonzero(pairs[:, 0] == pairs[:, 1])
        if len(loops):
            raise FormatError(
                "an edge joins a vertex to itself", where=where[loops[0]], got=f"vertex {pairs[loops[0], 0]}"
            )
        for (i, j), line in zip(pairs.tolist(), where, strict=True):
            self.named.setdefault(i, line)
            self.named.setdefault(j, line)
        labels = [f"{i} -> {j}" for i, j in pairs]
        information = self.sound(information, labels, "edge information matrices")
        self.edges.append((pairs, self._unit(measurements, where), information))

    def add_observations(self, pairs: Ids, values: Array, information: Array, where: list[str]) -> None:
        """Landmark sightings ``(k, 2)`` = (vertex id, landmark id)."""
        for i, line in zip(pairs[:, 0].tolist(), where, strict=True):
            self.named.setdefault(i, line)
        labels = [f"{i} sees {j}" for i, j in pairs]
        self.sightings.append((pairs, values, self.sound(information, labels, "landmark information matrices")))
        for j in pairs[:, 1]:
            self.marks.setdefault(int(j), None)

    def sound(self, matrices: Array, labels: list[str], what: str) -> Array:
        """Matrices as they are, repaired and counted, or an error that names the impossible ones."""
        if self.repair:
            matrices, changed = repair_informations(matrices)
            if len(changed):
                log.warning("%s: repaired %d of %d %s", self.source, len(changed), len(matrices), what)
            self.repaired += len(changed)
        return check_informations(matrices, labels, what=what, where=self.source)

    def invert(self, covariances: Array, labels: list[str], what: str) -> Array:
        """Information of covariances, or an error that names the singular ones."""
        covariances = self.sound(covariances, labels, what)
        w = np.linalg.eigvalsh(covariances)
        bad = np.flatnonzero(w[:, 0] <= 0.0) if len(w) else np.zeros(0, dtype=np.intp)
        if len(bad):
            raise CovarianceError(
                f"{len(bad)} of {len(w)} {what} are not positive definite: {labels[bad[0]]}",
                where=self.source,
                got=f"smallest eigenvalue {w[bad[0], 0]:.3g}",
                wanted="> 0",
            )
        return np.asarray(np.linalg.inv(covariances))

    def build(self) -> PoseNetwork:
        """The network, vertices in order of their ids.

        Raises
        ------
        FormatError
            No records, an id that is both a pose and a landmark, or an edge to a vertex that is not there.
        """
        missing = [v for v in self.named if v not in self.vertices] if self.vertices else []
        if missing and not self.create_missing:
            more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
            raise FormatError(
                f"an edge names vertex {missing[0]}, which is not in the file{more}",
                where=self.named[missing[0]],
                wanted="a record of every vertex (or of none); --create-missing or create_missing=True makes them",
            )
        pairs = _stack([e[0] for e in self.edges], (0, 2), np.int64)
        seen = _stack([s[0] for s in self.sightings], (0, 2), np.int64)
        ids = np.unique(np.concatenate([np.array(list(self.vertices), dtype=np.int64), pairs.ravel(), seen[:, 0]]))
        marks = np.array(sorted(self.marks), dtype=np.int64)
        both = np.intersect1d(ids, marks)
        if len(both):
            raise FormatError("an id is used for a pose and for a landmark", where=self.source, got=int(both[0]))
        if len(ids) == 0 or len(pairs) + len(seen) == 0:
            raise FormatError("no edges in the file", where=self.source, wanted="a pose network")
        width, d = (3, 3) if self.dim == 2 else (7, 6)
        poses = np.zeros((len(ids), width))
        poses[:, -1] = 0.0 if self.dim == 2 else 1.0
        known = np.array(sorted(self.vertices), dtype=np.int64)
        at = np.searchsorted(ids, known)
        if len(known):
            poses[at] = np.stack([self.vertices[int(v)] for v in known])
        has = np.zeros(len(ids), dtype=np.bool_)
        has[at] = True
        fixed = np.zeros(len(ids), dtype=np.bool_)
        for vertex, where in self.fixed.items():
            k = int(np.searchsorted(ids, vertex))
            if k == len(ids) or ids[k] != vertex or not has[k]:
                raise FormatError("FIX names a vertex without a pose", where=where, got=f"vertex {vertex}")
            fixed[k] = True
        landmarks = np.zeros((len(marks), 2))
        has_mark = np.zeros(len(marks), dtype=np.bool_)
        for k, mark in enumerate(marks):
            position = self.marks[int(mark)]
            if position is not None:
                landmarks[k], has_mark[k] = position, True
        observations = np.stack([np.searchsorted(ids, seen[:, 0]), np.searchsorted(marks, seen[:, 1])], axis=1)
        try:
            return PoseNetwork(
                dim=self.dim,
                ids=ids,
                poses=poses,
                has_initial=has,
                edges=np.searchsorted(ids, pairs),
                measurements=_stack([e[1] for e in self.edges], (0, width), np.float64),
                information=_stack([e[2] for e in self.edges], (0, d, d), np.float64),
                fixed=fixed,
                landmark_ids=marks,
                landmarks=landmarks,
                has_landmark=has_mark,
                observations=observations,
                observation_values=_stack([s[1] for s in self.sightings], (0, 2), np.float64),
                observation_information=_stack([s[2] for s in self.sightings], (0, 2, 2), np.float64),
                observation_kind=self.kind,
                repaired=self.repaired,
                noise=self.noise,
                source=self.source,
            )
        except GeometryError as error:
            raise FormatError(str(error)) from None


def _stack(parts: list[Array] | list[Ids], empty: tuple[int, ...], kind: type) -> Array:
    return np.concatenate(parts).astype(kind) if parts else np.zeros(empty, dtype=kind)
