"""The joined map in information form, its construction from submaps, and the result of a join."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array, wrap_angle
from graphslam.core.submap import LandmarkMap, Submap
from graphslam.join import kernels
from graphslam.join.submap_blocks import (
    SubmapProblem,
    check_identified,
    dense_information,
    fuse_repeated,
    landmark_map_of,
)
from graphslam.join.submap_pattern import csc_of_blocks
from graphslam.join.submap_solver import SubmapEstimate
from graphslam.linear.block_cholesky import BlockFactor, BlockSymbolic

Index = npt.NDArray[np.intp]
Ids = npt.NDArray[np.int64]
Nodes = npt.NDArray[np.int64]


@dataclass
class JoinTimes:
    """CPU seconds of this process, as in Table 1 of Combined SLAM; ``recovery`` is factorisation and mean."""

    parts: dict[str, float] = field(default_factory=lambda: dict.fromkeys(("association", "update", "recovery"), 0.0))
    wall: float = 0.0

    @contextmanager
    def measure(self, part: str) -> Iterator[None]:
        """Add the run time of the block to ``part``, and to the wall time."""
        cpu, start = time.process_time(), time.perf_counter()
        try:
            yield
        finally:
            self.parts[part] = self.parts.get(part, 0.0) + time.process_time() - cpu
            self.wall += time.perf_counter() - start


class JoinedMapView(Protocol):
    """Interface of a map for association and evaluation, in information or covariance form.

    The state ``x`` ``(n,)`` is in the frame of the map's first base, headings not wrapped. ``pose_at`` ``(m,)`` and
    ``landmark_at`` ``(L,)`` are the offsets of each end pose (x, y, θ) and landmark (x, y) in ``x``; landmarks are in
    the order of first observation. ``ids`` ``(L,)`` int64 are the given ids, -1 if landmarks are associated by the
    filter.
    """

    x: Array
    pose_at: Index
    landmark_at: Index
    ids: Ids

    @property
    def entries(self) -> tuple[Index, ...]:
        """For every submap, the landmark ``(n_k,)`` of each of its entries."""
        ...

    def covariance_block(self, indices: Index) -> Array:
        """Joint covariance of the scalars ``indices`` of ``x``."""
        ...

    def pose(self) -> Array:
        """Last end pose ``(3,)`` as a vector (x, y, θ), heading in [-π, π)."""
        ...

    def pose_covariance(self) -> Array:
        """Covariance ``(3, 3)`` of the last end pose as a vector (not a right tangent)."""
        ...

    def landmark_marginals(self) -> Array:
        """Covariance ``(L, 2, 2)`` of each landmark."""
        ...


class DenseJoinedView(JoinedMapView, Protocol):
    """A map with its whole covariance ``(n, n)``."""

    @property
    def covariance(self) -> Array:
        """Covariance of ``x``."""
        ...


OnJoin = Callable[[int, JoinedMapView], None]
"""Called with k and the map after submap k (from 0) was joined. The view is valid only during the call."""


def last_pose(view: JoinedMapView) -> Array:
    """Last end pose ``(3,)`` of a map, heading in [-π, π)."""
    pose = view.x[view.pose_at[-1] : view.pose_at[-1] + 3].copy()
    pose[2] = wrap_angle(pose[2])
    return pose


def pose_scalars(at: Index) -> Index:
    """State indices ``(m, 3)`` of the poses that begin at ``at`` ``(m,)``."""
    return at[:, None] + np.arange(3)


def landmark_scalars(at: Index) -> Index:
    """State indices ``(L, 2)`` of the landmarks that begin at ``at`` ``(L,)``."""
    return at[:, None] + np.arange(2)


def check_chain(submaps: Sequence[Submap], *, identified: bool) -> None:
    """Refuse an empty chain, and landmarks without an id if ids are used."""
    if identified:
        check_identified(submaps)
    elif not submaps:
        raise DataError("there are no submaps", got=0, wanted="at least one")


def in_group_chart(submaps: Sequence[Submap]) -> bool:
    """Whether all submaps that have landmarks are Gaussian in the group chart."""
    return all(s.landmarks is None or s.landmarks.chart == "group" for s in submaps)


def distinct_landmarks(submap: Submap, *, identified: bool) -> tuple[LandmarkMap, Index]:
    """The landmark map of a submap with each landmark once, and the landmark of each entry.

    With ``identified``, entries with the same id are fused; otherwise ids are ignored and every entry is a landmark.
    """
    original = landmark_map_of(submap)
    if not identified:
        return original, np.arange(len(original), dtype=np.intp)
    fused = fuse_repeated(original, what=f"submap {submap.key}")
    place = {int(j): i for i, j in enumerate(fused.ids)}
    return fused, np.array([place[int(j)] for j in original.ids], dtype=np.intp)


@dataclass
class JoinedMap:
    """A map in sparse information form, in the frame of its first base, which is not part of the state.

    The information matrix consists of node blocks: poses with 3 scalars, landmarks with 2.

    Parameters
    ----------
    x : (n,)
        Mean: the scalars of all nodes in order.
    width : (N,)
        Scalars of each node.
    ptr : (N + 1,)
    neighbours : (nb,)
        Neighbours of every node, including itself; every pair is in both lists.
    block : (nb,)
        Offset of the block of each pair in ``values``: rows of the list's node, row-major.
    values : (k,)
    pose_node : (m,)
        Node of end pose k.
    landmark_node : (L,)
        Node of landmark j, in the order of first observation.
    ids : (L,) int64
    entry_landmark : (E,)
        Landmark of each entry of the joined submaps, submap by submap.
    entry_count : (m,)
        Entries of each submap.
    order : (N,)
        Elimination order of the nodes.
    fill : float
        Entries of the factor per entry of the matrix with the last new order.
    anchor : (N,), optional
        In the group chart (:mod:`graphslam.core.charts`): anchor of each node, the end pose of the submap that observed
        it first; of a pose itself. None: the chart is Cartesian.
    rank : (N,), optional
        Elimination rank of each node in an order for the complete map; then no new order is computed.
    """

    x: Array
    width: Nodes
    ptr: Nodes
    neighbours: Nodes
    block: Nodes
    values: Array
    pose_node: Nodes
    landmark_node: Nodes
    ids: Ids
    entry_landmark: Index
    entry_count: Nodes
    order: Nodes
    fill: float
    anchor: Nodes | None = None
    rank: Nodes | None = None
    _symbolic: BlockSymbolic | None = field(default=None, init=False, repr=False)
    _factor: BlockFactor | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        at = np.cumsum(self.width) - self.width
        self.pose_at: Index = at[self.pose_node]
        self.landmark_at: Index = at[self.landmark_node]

    def __getstate__(self) -> dict[str, Any]:
        # Factors are cheap to recompute and expensive to send.
        kept = {k: v for k, v in self.__dict__.items() if k != "entries"}
        return {**kept, "_symbolic": None, "_factor": None}

    @cached_property
    def entries(self) -> tuple[Index, ...]:
        """For every submap, the landmark of each of its entries."""
        return tuple(np.split(self.entry_landmark, np.cumsum(self.entry_count)[:-1]))

    def symbolic(self) -> BlockSymbolic:
        """Symbolic factorisation with the current order, cached."""
        if self._symbolic is None:
            self._symbolic = BlockSymbolic(self.order, self.width, self.ptr, self.neighbours)
        return self._symbolic

    def factor(self) -> BlockFactor:
        """Factorisation of the information matrix, cached."""
        if self._factor is None:
            self._factor = self.symbolic().factor(self.block, self.values)
        return self._factor

    def reorder(self, order: Nodes) -> None:
        """Use a new elimination order ``(N,)``."""
        self.order = order
        self._symbolic = self._factor = None
        self.fill = self.symbolic().nnz / len(self.values)

    def take_values(self, x: Array, values: Array) -> None:
        """Set another mean and other blocks with the same pattern."""
        self.x, self.values, self._factor = x, values, None

    def covariance_block(self, indices: Index) -> Array:
        """Joint covariance of the scalars ``indices`` by sparse solves (Algorithm 1)."""
        return self.factor().inverse_block(indices)

    def pose(self) -> Array:
        """Last end pose ``(3,)``."""
        return last_pose(self)

    def pose_covariance(self) -> Array:
        """Covariance ``(3, 3)`` of the last end pose as a vector."""
        return self.covariance_block(self.pose_at[-1] + np.arange(3))

    def landmark_marginals(self) -> Array:
        """Covariance ``(L, 2, 2)`` of each landmark."""
        return self.factor().inverse_diagonal_blocks(self.landmark_at, 2)

    def information(self, nodes: Nodes | None = None) -> sp.csc_matrix:
        """Information matrix ``(n, n)``, both triangles, its nodes in the order ``nodes`` (default: that of ``x``)."""
        nodes = np.arange(len(self.width)) if nodes is None else nodes
        return csc_of_blocks(
            nodes, self.width, self.ptr, self.neighbours, self.block, np.zeros_like(self.block), self.values
        )

    @classmethod
    def leaf(cls, submap: Submap, *, identified: bool) -> JoinedMap:
        """A single submap as a joined map.

        Parameters
        ----------
        identified : bool
            Entries with the same id are fused. Otherwise ids are ignored and every entry is a separate landmark.
        """
        return cls.leaves([submap], identified=identified)[0][0]

    @classmethod
    def leaves(
        cls, submaps: Sequence[Submap], *, identified: bool, classical: bool = False
    ) -> tuple[list[JoinedMap], list[Array] | None]:
        """Every submap as a joined map, and the original information matrices of all submaps.

        The latter is None if entries with the same id were fused. The group chart is used if all submaps with landmarks
        use it, except for a ``classical`` filter.
        """
        group = not classical and in_group_chart(submaps)
        maps: list[JoinedMap] = []
        matrices: list[Array] | None = []
        for submap in submaps:
            fused, entries = distinct_landmarks(submap, identified=identified)
            matrix = dense_information(fused, what=f"submap {submap.key}")
            maps.append(cls.of_landmarks(fused, entries, matrix, identified=identified, group=group))
            if len(fused) < len(entries):
                matrices = None
            elif matrices is not None:
                matrices.append(matrix)
        return maps, matrices

    @classmethod
    def of_landmarks(
        cls, landmarks: LandmarkMap, entries: Index, information: Array, *, identified: bool, group: bool = False
    ) -> JoinedMap:
        """A map from landmarks (each once), the landmark of each entry, and the information matrix."""
        n = len(landmarks)
        width = np.full(n + 1, 2, dtype=np.int64)
        width[0] = 3
        nodes = np.arange(n + 1)
        # The blocks of one row of nodes are consecutive: the matrix is divided by rows, then by columns.
        size = np.outer(width, width).ravel()
        return cls(
            x=landmarks.mean,
            width=width,
            ptr=(n + 1) * np.arange(n + 2),
            neighbours=np.tile(nodes, n + 1),
            block=np.cumsum(size) - size,
            values=kernels.cut_into_blocks(np.ascontiguousarray(information), width),
            pose_node=np.zeros(1, dtype=np.int64),
            landmark_node=nodes[1:],
            ids=landmarks.ids if identified else np.full(n, -1, dtype=np.int64),
            entry_landmark=entries,
            entry_count=np.array([len(entries)]),
            order=nodes,
            fill=0.5,
            anchor=np.zeros(n + 1, dtype=np.int64) if group else None,
        )


@dataclass(frozen=True)
class JoinResult(SubmapEstimate):
    """Result of a map-joining method.

    ``objective`` is that of the joined map before polishing; poses, landmarks and uncertainty are those of the polished
    map if there is one.

    Parameters
    ----------
    times : mapping of str to float
        CPU seconds: association, update, recovery, and polish, if done. (``seconds`` is wall time.) Neither includes
        the evaluation of the unpolished objective.
    submap_ids : tuple of (n_k,) int64
        The landmark ids of every submap: given, or from association.
    problem : SubmapProblem or None
        The least-squares problem of the same submaps, for a polish; not pickled.
    """

    method: str = ""
    times: Mapping[str, float] = field(default_factory=dict)
    submap_ids: tuple[Ids, ...] = ()
    problem: SubmapProblem | None = field(default=None, repr=False, compare=False)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "problem": None}


def landmark_labels(view: JoinedMapView, ids: Ids, *, identified: bool) -> Ids:
    """Ids ``(L,)`` of the landmarks of a finished map: the given ones, or their rank by first observation."""
    return ids if identified else np.arange(len(view.landmark_at), dtype=np.int64)


def finish_map(
    submaps: Sequence[Submap],
    view: JoinedMap | DenseJoinedView,
    *,
    identified: bool,
    method: str,
    times: JoinTimes,
    information: Sequence[Array] | None = None,
) -> JoinResult:
    """Convert a joined map to the common layout ``[poses, landmarks by first observation]``, evaluate its objective.

    ``information``: information matrices of the submaps, if available and no submap repeats an id.
    """
    labels = landmark_labels(view, view.ids, identified=identified)
    submap_ids = tuple(labels[e] for e in view.entries)
    problem = SubmapProblem(submaps, ids=submap_ids, information=information)
    by_id = np.argsort(labels)
    rank = by_id[np.searchsorted(labels[by_id], problem.ids)]
    m = len(view.pose_at)
    order = np.concatenate([pose_scalars(view.pose_at).ravel(), landmark_scalars(view.landmark_at[rank]).ravel()])
    x = view.x[order].copy()
    x[2 : 3 * m : 3] = wrap_angle(x[2 : 3 * m : 3])
    matrix: sp.csc_matrix | None = None
    covariance: Array | None = None
    if isinstance(view, JoinedMap):
        matrix = view.information(np.concatenate([view.pose_node, view.landmark_node[rank]]))
    else:
        covariance = view.covariance[np.ix_(order, order)]
    return JoinResult(
        poses=np.vstack([np.zeros((1, 3)), x[: 3 * m].reshape(-1, 3)]),
        landmark_ids=problem.ids,
        landmarks=x[3 * m :].reshape(-1, 2),
        information=matrix,
        covariance=covariance,
        objective=problem.objective(x),
        objective_polished=None,
        iterations=0,
        converged=False,
        seconds=times.wall,
        method=method,
        times=dict(times.parts),
        submap_ids=submap_ids,
        problem=problem,
        chart="group" if isinstance(view, JoinedMap) and view.anchor is not None else "cartesian",
        anchors=problem.anchors,
    )
