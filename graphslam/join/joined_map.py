"""What a joiner carries along, how it ends, and what it hands over."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array, wrap_angle
from graphslam.core.submap import LandmarkMap, Submap
from graphslam.graph.submap_blocks import (
    SubmapProblem,
    check_identified,
    dense_information,
    fuse_repeated,
    landmark_map_of,
    relabel,
)
from graphslam.graph.submap_solver import SubmapEstimate
from graphslam.graph.symmetric_factor import SymmetricFactor

Index = npt.NDArray[np.intp]
Ids = npt.NDArray[np.int64]


@dataclass
class JoinTimes:
    """Seconds of wall time, split as in Table 1 of the paper; ``recovery`` is factorisation and mean."""

    parts: dict[str, float] = field(default_factory=lambda: dict.fromkeys(("association", "update", "recovery"), 0.0))

    @contextmanager
    def measure(self, part: str) -> Iterator[None]:
        """Add the time spent inside to ``part``."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.parts[part] = self.parts.get(part, 0.0) + time.perf_counter() - start

    @property
    def total(self) -> float:
        """Sum of the parts [s]."""
        return sum(self.parts.values())


class MapView(Protocol):
    """What association and scoring need of a map, in information or in covariance form.

    The state ``x`` ``(n,)`` is in the frame of the map's first base, headings not wrapped. ``pose_at`` ``(m,)`` and
    ``landmark_at`` ``(L,)`` say where each end pose (x, y, θ) and landmark (x, y) begins in it; landmarks stand in the
    order of first sighting. ``ids`` ``(L,)`` int64 are the ids they were joined by, -1 where they were recognised
    instead. ``entries[k]`` ``(n_k,)`` says which landmark each entry of submap k became.
    """

    x: Array
    pose_at: Index
    landmark_at: Index
    ids: Ids
    entries: tuple[Index, ...]

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
        """Covariance ``(L, 2, 2)`` of every landmark by itself."""
        ...


OnJoin = Callable[[int, MapView], None]
"""Called with k and the map once submap k (from 0) is in. The view is valid during the call only."""


def last_pose(view: MapView) -> Array:
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
    """Refuse an empty chain, and landmarks without an id where ids are to be trusted.

    Raises
    ------
    DataError
    """
    if identified:
        check_identified(submaps)
    elif not submaps:
        raise DataError("there are no submaps", got=0, wanted="at least one")


def distinct_landmarks(submap: Submap, *, identified: bool) -> tuple[LandmarkMap, Index]:
    """The landmark map of a submap with each landmark once, and which of them each entry became.

    With ``identified``, entries of one id are fused; otherwise ids are ignored and every entry is a landmark.
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

    Parameters
    ----------
    x : (n,)
        Mean. The order of its parts is free: it doubles as the elimination order.
    information : csc_matrix (n, n)
    pose_at : (m,)
        Where end pose k begins in ``x``.
    landmark_at : (L,)
        Where landmark j begins, landmarks in the order of first sighting.
    ids : (L,) int64
    entries : tuple of (n_k,)
        For every submap inside, the landmark each of its entries became.
    ordered : bool
        Unknowns are eliminated in the order of ``x``; otherwise every factorisation looks for its own order.
    fill : float
        Fill-in of the last fresh order: entries of the factors per entry of the matrix.
    """

    x: Array
    information: sp.csc_matrix
    pose_at: Index
    landmark_at: Index
    ids: Ids
    entries: tuple[Index, ...]
    ordered: bool = True
    fill: float = 1.0
    _factor: SymmetricFactor | None = field(default=None, init=False, repr=False)

    def factor(self) -> SymmetricFactor:
        """Factorisation of the information matrix, made once."""
        if self._factor is None:
            self._factor = SymmetricFactor(self.information, ordered=self.ordered)
        return self._factor

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
        """Covariance ``(L, 2, 2)`` of every landmark by itself."""
        return self.factor().inverse_diagonal_blocks(self.landmark_at, 2)

    def reordered(self) -> JoinedMap:
        """The same map in a fresh elimination order; the scalars of a pose or landmark stay together."""
        fresh = SymmetricFactor(self.information)
        rank = np.argsort(fresh.order)  # when each scalar would be eliminated
        begin = np.concatenate([self.pose_at, self.landmark_at])
        width = np.repeat([3, 2], [len(self.pose_at), len(self.landmark_at)])
        parts = np.argsort(rank[begin])
        begin, width = begin[parts], width[parts]
        order = np.repeat(begin - (np.cumsum(width) - width), width) + np.arange(len(self.x))
        where = np.empty_like(order)
        where[order] = np.arange(len(order))
        return JoinedMap(
            x=self.x[order],
            information=sp.csc_matrix(self.information[order][:, order]),
            pose_at=where[self.pose_at],
            landmark_at=where[self.landmark_at],
            ids=self.ids,
            entries=self.entries,
            ordered=self.ordered,
            fill=fresh.nnz / self.information.nnz,
        )

    @classmethod
    def leaf(cls, submap: Submap, *, identified: bool, ordered: bool = True) -> JoinedMap:
        """A single submap as a joined map.

        Parameters
        ----------
        submap : Submap
        identified : bool
            Entries of one id are fused. Otherwise ids are ignored and every entry is a landmark of its own.
        ordered : bool
            See :class:`JoinedMap`.
        """
        fused, entries = distinct_landmarks(submap, identified=identified)
        return cls(
            x=fused.mean,
            information=sp.csc_matrix(dense_information(fused, what=f"submap {submap.key}")),
            pose_at=np.zeros(1, dtype=np.intp),
            landmark_at=3 + 2 * np.arange(len(fused), dtype=np.intp),
            ids=fused.ids if identified else np.full(len(fused), -1, dtype=np.int64),
            entries=(entries,),
            ordered=ordered,
        )


@dataclass(frozen=True)
class JoinResult(SubmapEstimate):
    """The map a joiner hands over.

    ``objective`` is that of the joined map before polishing; poses, landmarks and uncertainty are those of the
    polished map where there was a polish.

    Parameters
    ----------
    method : str
    times : mapping of str to float
        Seconds: association, update, recovery, and polish where there was one. ``seconds`` is their sum; evaluating
        the objective of the unpolished map is not in it.
    submap_ids : tuple of (n_k,) int64
        The landmark ids of every submap as joined: those given, or those association found.
    """

    method: str = ""
    times: Mapping[str, float] = field(default_factory=dict)
    submap_ids: tuple[Ids, ...] = ()


def landmark_labels(view: MapView, ids: Ids, *, identified: bool) -> Ids:
    """Ids ``(L,)`` of the landmarks of a finished map: those given, or their rank by first sighting."""
    return ids if identified else np.arange(len(view.landmark_at), dtype=np.int64)


def finish(
    submaps: Sequence[Submap],
    view: MapView,
    labels: Ids,
    *,
    method: str,
    times: JoinTimes,
    information: sp.csc_matrix | None = None,
    covariance: Array | None = None,
) -> JoinResult:
    """Bring a joined map into the common layout ``[poses, landmarks by first sighting]`` and evaluate its objective."""
    submap_ids = tuple(labels[e] for e in view.entries)
    problem = SubmapProblem(relabel(submaps, submap_ids))
    place = {int(j): i for i, j in enumerate(labels)}
    at = view.landmark_at[[place[int(j)] for j in problem.ids]] if len(problem.ids) else view.landmark_at[:0]
    order = np.concatenate([pose_scalars(view.pose_at).ravel(), landmark_scalars(at).ravel()])
    x = view.x[order].copy()
    m = len(view.pose_at)
    x[2 : 3 * m : 3] = wrap_angle(x[2 : 3 * m : 3])
    return JoinResult(
        poses=np.vstack([np.zeros((1, 3)), x[: 3 * m].reshape(-1, 3)]),
        landmark_ids=problem.ids,
        landmarks=x[3 * m :].reshape(-1, 2),
        information=None if information is None else sp.csc_matrix(information[order][:, order]),
        covariance=None if covariance is None else covariance[np.ix_(order, order)],
        objective=problem.objective(x),
        objective_polished=None,
        iterations=0,
        converged=False,
        seconds=times.total,
        method=method,
        times=dict(times.parts),
        submap_ids=submap_ids,
    )
