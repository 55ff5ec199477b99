"""Construction of a :class:`~graphslam.core.network.PoseNetwork` from the records of a file."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from graphslam.core.errors import CovarianceError, FormatError, GeometryError
from graphslam.core.geometry import Array
from graphslam.core.network import (
    Ids,
    Labels,
    Mask,
    ObservationKind,
    PoseNetwork,
    all_positive_definite,
    check_informations,
    repair_informations,
)
from graphslam.core.poses import SE2, SE3
from graphslam.core.position_priors import complete_datum
from graphslam.core.se3 import quat_normalize

log = logging.getLogger(__name__)


def upper_triangle(values: Array, size: int) -> Array:
    """Symmetric ``(m, size, size)`` from row-wise upper triangles ``(m, size (size + 1) / 2)``."""
    out = np.empty((len(values), size, size))
    rows, columns = np.triu_indices(size)
    out[:, rows, columns] = values
    out[:, columns, rows] = values
    return out


def _none(*shape: int) -> Array:
    return np.zeros(shape)


def _no_ids(*shape: int) -> Ids:
    return np.zeros(shape, dtype=np.int64)


@dataclass
class NetworkBuilder:
    """Collects the content of a file as arrays; :meth:`build` sorts vertices by id and checks the network.

    Parameters
    ----------
    source : str
        File name for errors.
    dim : int
        2 or 3.
    where : callable
        Line number → location for error messages.
    repair : bool
        Project indefinite matrices instead of raising an error.
    create_missing : bool
        Create vertices that occur only in edges; they have no initial pose.
    """

    source: str
    dim: int
    where: Callable[[int], str]
    repair: bool = False
    create_missing: bool = False
    vertices: tuple[Ids, Array] = field(default_factory=lambda: (_no_ids(0), _none(0, 7)))
    marks: tuple[Ids, Array] = field(default_factory=lambda: (_no_ids(0), _none(0, 2)))
    fixed: tuple[Ids, Ids] = field(default_factory=lambda: (_no_ids(0), _no_ids(0)))
    edges: tuple[Ids, Array, Array] | None = None
    positions: int = 0
    detections: tuple[Ids, Array, Array] | None = None
    edge_lines: Ids = field(default_factory=lambda: _no_ids(0))
    observation_lines: Ids = field(default_factory=lambda: _no_ids(0))
    kind: ObservationKind = "cartesian"
    noise: str = "information"
    repaired: int = 0

    def add_vertices(self, ids: Ids, poses: Array, lines: Ids) -> None:
        """Poses ``(n, 3 | 7)``; 3-D quaternions are normalised here."""
        self._unique(ids, lines, "vertex given twice", "vertex ")
        self.vertices = ids, self._unit(poses, lines)

    def add_landmarks(self, ids: Ids, positions: Array, lines: Ids) -> None:
        """Landmark positions ``(l, 2)``."""
        self._unique(ids, lines, "landmark given twice", "")
        self.marks = ids, positions

    def _unique(self, ids: Ids, lines: Ids, what: str, name: str) -> None:
        _, first = np.unique(ids, return_index=True)
        if len(first) < len(ids):
            k = int(np.setdiff1d(np.arange(len(ids)), first)[0])
            raise FormatError(what, where=self.where(int(lines[k])), got=f"{name}{ids[k]}")

    def _unit(self, poses: Array, lines: Ids) -> Array:
        if self.dim == 2:
            return poses
        length = np.linalg.norm(poses[:, 3:], axis=1)
        # rounding of printed quaternions is tolerated; more than 5 % is an error
        bad = np.flatnonzero(np.abs(length - 1.0) > 5e-2)
        if len(bad):
            raise FormatError(
                "not a unit quaternion", where=self.where(int(lines[bad[0]])), got=poses[bad[0], 3:], wanted="length 1"
            )
        if len(poses) and (most := float(np.abs(length - 1.0).max())) > 1e-3:
            log.warning("%s: quaternions of a length up to %.1f %% off 1 are normalised", self.source, 100.0 * most)
        return np.concatenate([poses[:, :3], quat_normalize(poses[:, 3:])], axis=1)

    def add_edges(self, pairs: Ids, measurements: Array, information: Array, lines: Ids) -> None:
        """Edges ``(m, 2)`` between vertex ids; information matrices in the order of GTSAM (3-D: rotation first)."""
        loops = np.flatnonzero(pairs[:, 0] == pairs[:, 1])
        if len(loops):
            raise FormatError(
                "an edge joins a vertex to itself",
                where=self.where(int(lines[loops[0]])),
                got=f"vertex {pairs[loops[0], 0]}",
            )
        information = self.sound(information, edge_labels(pairs), "edge information matrices")
        self.edges, self.edge_lines = (pairs, self._unit(measurements, lines), information), lines

    def add_positions(self, pairs: Ids, positions: Array, information: Array, lines: Ids) -> None:
        """Position priors, after the edges: (origin, vertex) ``(p, 2)``, ``(p, dim)`` and ``(p, dim, dim)``."""
        labels = Labels(lambda k: f"position of {pairs[k, 1]}, {self.where(int(lines[k]))}")
        information = self.sound(information, labels, "information matrices of positions")
        silent = np.flatnonzero(~information.any(axis=(1, 2)))
        if len(silent):
            raise FormatError("a position has information zero", where=self.where(int(lines[silent[0]])), wanted="> 0")
        group, p = (SE2 if self.dim == 2 else SE3), len(pairs)
        z, omega = np.tile(group.identity, (p, 1)), np.zeros((p, group.dof, group.dof))
        z[:, : self.dim], omega[:, group.position, group.position] = positions, information
        before, values, matrices = self.edges or (_no_ids(0, 2), z[:0], omega[:0])
        self.edges = np.vstack([before, pairs]), np.vstack([values, z]), np.concatenate([matrices, omega])
        self.edge_lines, self.positions = np.concatenate([self.edge_lines, lines]), p

    def add_observations(self, pairs: Ids, values: Array, information: Array, lines: Ids) -> None:
        """Landmark observations; ``pairs`` ``(k, 2)`` = (vertex id, landmark id)."""
        information = self.sound(information, observation_labels(pairs), "landmark information matrices")
        self.detections, self.observation_lines = (pairs, values, information), lines

    def sound(self, matrices: Array, labels: Labels, what: str) -> Array:
        """Check matrices; with ``repair``, indefinite ones are projected and counted, otherwise an error is raised."""
        if self.repair:
            matrices, changed = repair_informations(matrices)
            if len(changed):
                log.warning("%s: repaired %d of %d %s", self.source, len(changed), len(matrices), what)
            self.repaired += len(changed)
        return check_informations(matrices, labels, what=what, where=self.source)

    def invert(self, covariances: Array, labels: Labels, what: str) -> Array:
        """Information matrices from covariances; :class:`CovarianceError` for singular ones."""
        covariances = self.sound(covariances, labels, what)
        if not all_positive_definite(covariances):
            w = np.linalg.eigvalsh(covariances)
            bad = np.flatnonzero(w[:, 0] <= 0.0)
            if len(bad):
                raise CovarianceError(
                    f"{len(bad)} of {len(w)} {what} are not positive definite: {labels[bad[0]]}",
                    where=self.source,
                    got=f"smallest eigenvalue {w[bad[0], 0]:.3g}",
                    wanted="> 0",
                )
        return np.asarray(np.linalg.inv(covariances))

    def build(self) -> PoseNetwork:
        """The network, with vertices sorted by id."""
        width, d = (3, 3) if self.dim == 2 else (7, 6)
        pairs, measurements, information = self.edges or (_no_ids(0, 2), _none(0, width), _none(0, d, d))
        seen, values, seen_information = self.detections or (_no_ids(0, 2), _none(0, 2), _none(0, 2, 2))
        given, poses_given = self.vertices
        self._check_named(pairs, seen)
        ids = np.unique(np.concatenate([given, pairs.ravel(), seen[:, 0]]))
        marks = np.unique(np.concatenate([self.marks[0], seen[:, 1]]))
        both = np.intersect1d(ids, marks)
        if len(both):
            raise FormatError("an id is used for a pose and for a landmark", where=self.source, got=int(both[0]))
        if len(ids) == 0 or len(pairs) + len(seen) == 0:
            raise FormatError("no edges in the file", where=self.source, wanted="a pose network")
        poses = np.zeros((len(ids), width))
        poses[:, -1] = 0.0 if self.dim == 2 else 1.0
        has = np.zeros(len(ids), dtype=np.bool_)
        if len(given):
            at = np.searchsorted(ids, given)
            poses[at], has[at] = poses_given, True
        landmarks = np.zeros((len(marks), 2))
        has_mark = np.zeros(len(marks), dtype=np.bool_)
        at = np.searchsorted(marks, self.marks[0])
        landmarks[at], has_mark[at] = self.marks[1], True
        try:
            network = PoseNetwork(
                dim=self.dim,
                ids=ids,
                poses=poses,
                has_initial=has,
                edges=np.searchsorted(ids, pairs),
                measurements=measurements,
                information=information,
                fixed=self._held(ids, has),
                position_priors=np.arange(len(pairs)) >= len(pairs) - self.positions,
                landmark_ids=marks,
                landmarks=landmarks,
                has_landmark=has_mark,
                observations=np.stack([np.searchsorted(ids, seen[:, 0]), np.searchsorted(marks, seen[:, 1])], axis=1),
                observation_values=values,
                observation_information=seen_information,
                observation_kind=self.kind,
                repaired=self.repaired,
                noise=self.noise,
                source=self.source,
            )
        except GeometryError as error:
            raise FormatError(str(error)) from None
        return complete_datum(network)

    def _check_named(self, pairs: Ids, seen: Ids) -> None:
        """Every vertex of a measurement must be given, unless no vertex is or ``create_missing`` is set."""
        if len(self.vertices[0]) == 0 or self.create_missing:
            return
        named = np.concatenate([pairs.ravel(), seen[:, 0]])
        lines = np.concatenate([np.repeat(self.edge_lines, 2), self.observation_lines])
        lost = np.flatnonzero(~np.isin(named, self.vertices[0]))
        if len(lost):
            others = len(np.unique(named[lost])) - 1
            more = f" and {others} more" if others else ""
            raise FormatError(
                f"an edge names vertex {named[lost[0]]}, which is not in the file{more}",
                where=self.where(int(lines[lost[0]])),
                wanted="a record of every vertex (or of none); --create-missing or create_missing=True makes them",
            )

    def _held(self, ids: Ids, has: Mask) -> Mask:
        held, lines = self.fixed
        at = np.minimum(np.searchsorted(ids, held), len(ids) - 1)
        lost = np.flatnonzero((ids[at] != held) | ~has[at])
        if len(lost):
            raise FormatError(
                "FIX names a vertex without a pose",
                where=self.where(int(lines[lost[0]])),
                got=f"vertex {held[lost[0]]}",
            )
        fixed = np.zeros(len(ids), dtype=np.bool_)
        fixed[at] = True
        return fixed


def edge_labels(pairs: Ids) -> Labels:
    """Names of edges for error messages, created on demand."""
    return Labels(lambda k: f"{pairs[k, 0]} -> {pairs[k, 1]}")


def observation_labels(pairs: Ids) -> Labels:
    """Names of landmark observations for error messages, created on demand."""
    return Labels(lambda k: f"{pairs[k, 0]} sees {pairs[k, 1]}")
