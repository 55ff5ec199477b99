"""Points of steps as surfaces, and which source points lie on which surfaces of other steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from graphslam.core.geometry import Array
from graphslam.refine.scans import Scans
from graphslam.registration.plane_kernels import Pairs
from graphslam.registration.surfaces import SurfaceConfig, fit_places, rotations, thin_places

Index = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Cloud:
    """Returns of all steps, and the chunks of the path in which neighbours are searched.

    Parameters
    ----------
    points : (q, d)
        Each in the frame of its own step.
    origins : (q, d)
        Of the beams, same frames.
    step : (q,)
    chunk : (n,)
        Of each step, ascending from 0.
    rows : (c + 1,)
        Points of chunk k are rows ``rows[k]:rows[k + 1]``.
    """

    points: Array
    origins: Array
    step: Index
    chunk: Index
    rows: Index

    @classmethod
    def of(cls, steps: Scans, *, chunk_length: float, chunk_time: float, chunk_turn: float = np.inf) -> Cloud:
        """The returns of steps in chunks of a length [m], at most of a time [s] and of a turn of the heading [rad]."""
        n = len(steps)
        step = np.repeat(np.arange(n), np.diff(steps.offsets))
        hit = steps.returns
        way, t = steps.path_length, steps.times
        turned = np.cumsum(np.abs(steps.group.log(steps.odometry.increments)[:, steps.group.heading]))
        chunk = np.zeros(n, np.int64)
        c, first = 0, 0
        for k in range(1, n):
            longer = way[k] - way[first] > chunk_length or t[k] - t[first] > chunk_time
            if longer or turned[k] - turned[first] > chunk_turn:
                c, first = c + 1, k
            chunk[k] = c
        s = step[hit]
        rows = np.searchsorted(chunk[s], np.arange(c + 2)).astype(np.int64)
        return cls(
            steps.points[hit].astype(np.float64), steps.origins[hit].astype(np.float64), s.astype(np.int64), chunk, rows
        )

    @property
    def chunks(self) -> int:
        """Number of chunks."""
        return len(self.rows) - 1

    def world(self, poses: Array) -> tuple[Array, Array]:
        """Points and origins ``(q, d)`` in the world, at a path ``(n, 7|3)``."""
        R, t = rotations(poses)[self.step], poses[:, : self.points.shape[1]][self.step]
        move = np.einsum
        return move("kij,kj->ki", R, self.points) + t, move("kij,kj->ki", R, self.origins) + t


@dataclass(frozen=True, slots=True)
class Surfaces:
    """Neighbourhoods of points as planes (in 2-D lines), each in the frame of its own step.

    Parameters
    ----------
    normals : (q, d)
        Towards where the beam came from; zero where there is no surface.
    flat : (q,) bool
        Is it one? Only of points that stand for themselves.
    stands : (q,) int
        Row of the point that stands for this one: of points of one chunk nearer together than the spacing the first.
    """

    normals: Array
    flat: Flags
    stands: Index


def find_surfaces(cloud: Cloud, poses: Array, config: SurfaceConfig) -> Surfaces:
    """Surfaces of all places among those of their own and the two neighbouring chunks, at a path.

    Neighbours in time only: points of other passes lie beside these ones before the passes agree, and would turn the
    normals. A surface goes through its own point, not through the mean of its neighbours: with points of the next
    chunk in it, it would follow those that are compared with it, and the rounds would creep.
    """
    W, O = cloud.world(poses)
    q, d = W.shape
    normals, flat = np.zeros((q, d)), np.zeros(q, bool)
    stands = np.arange(q)
    places = [thin_places(W, cloud.rows[c], cloud.rows[c + 1], config.spacing, stands) for c in range(cloud.chunks)]
    for c, own in enumerate(places):
        if not len(own):
            continue
        normals[own], flat[own] = fit_places(W, O, own, np.concatenate(places[max(c - 1, 0) : c + 2]), config)
    return Surfaces(np.einsum("kji,kj->ki", rotations(poses)[cloud.step], normals), flat, stands)


@dataclass(frozen=True, slots=True)
class ChunkPairs:
    """Which chunks see the same surfaces.

    Parameters
    ----------
    a, b : (m,)
        Chunks, a ≥ b: points of a on surfaces of b.
    """

    a: Index
    b: Index

    @property
    def passes(self) -> Flags:
        """Of different passes of the same place, not of neighbours on the way."""
        return self.a - self.b > NEIGHBOURS


NEXT = 1
"""Chunks that follow each other so closely are compared with each other."""
NEIGHBOURS = 5
"""Chunks that follow each other so closely are neighbours on the way; others are passes of the same place."""


def chunk_pairs(cloud: Cloud, poses: Array, reach: float, *, passes: bool) -> ChunkPairs:
    """Chunks next to each other on the way; with ``passes`` also those whose centres are within ``reach`` [m]."""
    C, d = cloud.chunks, cloud.points.shape[1]
    first = np.searchsorted(cloud.chunk, np.arange(C))
    centres = np.add.reduceat(poses[:, :d], first) / np.diff(np.append(first, len(cloud.chunk)))[:, None]
    a = np.arange(C)
    pairs = [np.column_stack([a[k:], a[: C - k]]) for k in range(1, min(NEXT, C - 1) + 1)]
    if passes and C > 2:
        near = cKDTree(centres).query_pairs(reach, output_type="ndarray").astype(np.int64)
        near = np.sort(near, axis=1)[:, ::-1]
        pairs.append(_nearest(near[near[:, 0] - near[:, 1] > NEXT], centres))
    every = np.concatenate(pairs)
    every = every[np.lexsort((every[:, 1], every[:, 0]))]
    return ChunkPairs(np.ascontiguousarray(every[:, 0]), np.ascontiguousarray(every[:, 1]))


def _nearest(pairs: Index, centres: Array) -> Index:
    """Of the partners of a chunk that follow each other, and so are one pass, the :data:`MOST` nearest."""
    a, b = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].T
    group = np.cumsum((np.diff(a, prepend=-1) != 0) | (np.diff(b, prepend=-9) > 1))
    order = np.lexsort((np.linalg.norm(centres[a] - centres[b], axis=1), group))
    first = np.searchsorted(group[order], group[order])
    chosen = order[np.arange(len(order)) - first < MOST]
    return np.column_stack([a, b])[chosen]


MOST = 3
"""Chunks of one other pass that a chunk is compared with."""


def associate(
    cloud: Cloud,
    surfaces: Surfaces,
    poses: Array,
    chunks: ChunkPairs,
    *,
    distance: float,
    every: int,
    alike: float = 0.85,
    least_share: float = 0.10,
) -> tuple[Pairs, Index]:
    """Nearest surface in each chunk for every ``every``-th point of its partner.

    Parameters
    ----------
    distance : float
        Greatest distance of a pair [m].
    alike : float
        Least cosine between the two normals, which point to where the beams came from, so that the two sides of a wall
        or of a ceiling never meet.
    least_share : float
        Pairs of passes whose share of paired points is below it are left out.

    Returns
    -------
    pairs : Pairs
    whose : (k,)
        Number of the chunk pair of each.
    """
    W, _ = cloud.world(poses)
    N = np.einsum("kij,kj->ki", rotations(poses)[cloud.step], surfaces.normals)
    trees: dict[int, tuple[cKDTree, Index]] = {}
    sources: dict[int, Index] = {}

    def tree(c: int) -> tuple[cKDTree, Index]:
        if c not in trees:
            rows = np.arange(cloud.rows[c], cloud.rows[c + 1])
            rows = rows[surfaces.flat[rows]]
            trees[c] = (cKDTree(W[rows]) if len(rows) else None, rows)
        return trees[c]

    def source(c: int) -> Index:
        if c not in sources:
            rows = np.arange(cloud.rows[c], cloud.rows[c + 1], every)
            sources[c] = rows[surfaces.flat[surfaces.stands[rows]]]
        return sources[c]

    found_p, found_q, whose = [], [], []
    passes = chunks.passes
    for m, (a, b) in enumerate(zip(chunks.a.tolist(), chunks.b.tolist())):
        t, rows = tree(b)
        p = source(a)
        if t is None or len(p) == 0:
            continue
        _, at = t.query(W[p], k=1, distance_upper_bound=distance)
        some, tried = at < len(rows), len(p)
        q, p = rows[at[some]], p[some]
        good = np.einsum("ki,ki->k", N[surfaces.stands[p]], N[q]) > alike
        p, q = p[good], q[good]
        if passes[m] and len(p) < least_share * tried:
            continue
        found_p.append(p)
        found_q.append(q)
        whose.append(np.full(len(p), m))
    none = np.zeros(0, np.int64)
    p, q = np.concatenate([none, *found_p]), np.concatenate([none, *found_q])
    w = np.concatenate([none, *whose]).astype(np.int64)
    times = np.bincount(p, minlength=len(cloud.points))
    return Pairs(p, q, cloud.step[p], cloud.step[q], 1.0 / times[p]), w
