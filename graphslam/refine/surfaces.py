"""Points of steps as surfaces, and matching of source points to surfaces of other steps."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from graphslam.core.geometry import Array
from graphslam.core.poses import rotation_matrices
from graphslam.core.spill_cache import SPILL_CACHE, CacheEntry
from graphslam.core.workers import cores, run_tasks
from graphslam.refine.scans import Scans
from graphslam.registration.plane_kernels import PlanePairs
from graphslam.registration.surfaces import SurfaceFitConfig, fit_places, thin_places

Index = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


SAME_SIDE = 0.85
"""Minimum cosine between the two normals of a pair. Normals point to the origin of the beam, so the two sides of a wall
or of a ceiling are never matched."""
BLOCK = 1 << 16
"""Rows that are processed together: a matrix for each point of a long log would take gigabytes."""


def row_blocks(n: int) -> Iterator[slice]:
    """Slices of ``0 … n`` with at most :data:`BLOCK` rows."""
    return (slice(k, min(k + BLOCK, n)) for k in range(0, n, BLOCK))


def over_rows(work: Callable[[slice], Any], n: int) -> None:
    """``work(s)`` for blocks of ``n`` rows, on all cores."""
    run_tasks(work, ((s,) for s in row_blocks(n)))


def rotate_by_step(R: Array, step: Index, x: Array, t: Array | None = None) -> Array:
    """``R_step x + t_step`` of vectors ``(q, d)``, each by the pose ``(n, d, d)``, ``(n, d)`` of its own step."""
    out = np.empty(x.shape)

    def turn(s: slice) -> None:
        out[s] = _rotated(R, step[s], x[s], t)

    over_rows(turn, len(x))
    return out


def _rotated(R: Array, step: Index, x: Array, t: Array | None = None) -> Array:
    """:func:`rotate_by_step` in one block."""
    turned = np.einsum("kij,kj->ki", R[step], x)
    return turned if t is None else turned + t[step]


@dataclass(frozen=True, slots=True)
class ScanReturns:
    """Returns of all steps, and the chunks of the path in which neighbours are searched.

    Parameters
    ----------
    points : (q, d)
        Each in the frame of its own step, placed by the odometry.
    origins : (q, d)
        Of the beams, same frames.
    step : (q,)
    age : (q,)
        Time from the beam to the stamp as a share of the step's time.
    chunk : (n,)
        Chunk of each step, ascending from 0.
    rows : (c + 1,)
        Points of chunk k are rows ``rows[k]:rows[k + 1]``.
    """

    points: Array
    origins: Array
    step: Index
    age: Array
    chunk: Index
    rows: Index

    @classmethod
    def of(cls, steps: Scans, *, chunk_length: float, chunk_time: float, chunk_turn: float = np.inf) -> ScanReturns:
        """The returns of steps, in chunks of limited length [m], time [s] and heading rotation [rad]."""
        n = len(steps)
        step = np.repeat(np.arange(n), np.diff(steps.offsets))
        hit = steps.returns
        along, t = steps.path_length, steps.times
        turned = np.cumsum(np.abs(steps.group.log(steps.odometry.increments)[:, steps.group.heading]))
        chunk = np.zeros(n, np.int64)
        c, first = 0, 0
        for k in range(1, n):
            longer = along[k] - along[first] > chunk_length or t[k] - t[first] > chunk_time
            if longer or turned[k] - turned[first] > chunk_turn:
                c, first = c + 1, k
            chunk[k] = c
        s = step[hit]
        rows = np.searchsorted(chunk[s], np.arange(c + 2)).astype(np.int64)
        dt = np.diff(t, prepend=t[0])
        dt[0] = dt[1] if n > 1 else 1.0
        return cls(
            steps.points[hit].astype(np.float64),
            steps.origins[hit].astype(np.float64),
            s.astype(np.int64),
            np.zeros(len(s)) if steps.ages is None else np.clip(steps.ages[hit] / dt[s], 0.0, 1.0),
            chunk,
            rows,
        )

    def corrected(self, corrections: Array) -> ScanReturns:
        """The cloud with corrected beams, for errors ``(n, dof)`` of the increments of their steps.

        An error of the increment grew linearly over the time of the step: a beam of age α was misplaced by the share α
        of it.
        """

        if not np.any(self.age):  # all beams of a scan have the same time
            return self

        def moved(x: Array) -> Array:
            out = np.empty(x.shape)

            def move(s: slice) -> None:
                c = -self.age[s, None] * corrections[self.step[s]]  # small, so first order suffices
                y = x[s]
                if x.shape[1] == 3:
                    out[s] = y + np.cross(c[:, :3], y) + c[:, 3:]
                else:
                    out[s] = y + c[:, :2] + c[:, 2:] * np.column_stack([-y[:, 1], y[:, 0]])

            over_rows(move, len(x))
            return out

        return replace(self, points=moved(self.points), origins=moved(self.origins))

    def bridge(self) -> Array:
        """Share ``(n,)`` of an increment's variance that remains in the beams of its step, mean of α (1 − α)."""
        n = len(self.chunk)
        part = np.bincount(self.step, weights=self.age * (1.0 - self.age), minlength=n)
        return np.asarray(part / np.maximum(np.bincount(self.step, minlength=n), 1))

    @property
    def chunks(self) -> int:
        """Number of chunks."""
        return len(self.rows) - 1

    def world(self, poses: Array) -> Array:
        """Points ``(q, d)`` in the world, at a path ``(n, 7|3)``."""
        return rotate_by_step(rotation_matrices(poses), self.step, self.points, poses[:, : self.points.shape[1]])


@dataclass(frozen=True, slots=True, weakref_slot=True)
class Surfaces:
    """Neighbourhoods of points as planes (in 2-D lines), each in the frame of its own step.

    Parameters
    ----------
    normals : (q, d)
        Towards the origin of the beam; zero without a surface.
    flat : (q,) bool
        Is it a surface? Only for representative points.
    stands : (q,) int
        Row of the point that represents this one: the first of the points of one chunk within the spacing.
    tilts : (q, d - 1, d)
        Axes of the surface, scaled to the σ of the normal's error towards them [rad], single precision.
    """

    normals: Array
    flat: Flags
    stands: Index
    tilts: npt.NDArray[np.float32]

    def put_aside(self) -> CacheEntry[Surfaces]:
        """Put the surfaces into the spill cache of the process until they are used again at the end."""
        parts = [self.normals, self.flat, self.stands, self.tilts]
        size = sum(a.nbytes for a in parts)
        return SPILL_CACHE.put(self, size, lambda s: [s.normals, s.flat, s.stands, s.tilts], lambda a: Surfaces(*a))


def find_surfaces(cloud: ScanReturns, poses: Array, config: SurfaceFitConfig) -> Surfaces:
    """Surfaces of all representative points, from those of their own and the two neighbouring chunks, at a path.

    Only neighbours in time: points of other traversals are offset before the traversals agree, and would tilt the
    normals. A surface goes through its own point, not through the mean of its neighbours: otherwise it would depend on
    points of the next chunk, which are compared with it, and the rounds would converge slowly.
    """
    W, R = cloud.world(poses), rotation_matrices(poses)
    q, d = W.shape
    normals, flat = np.zeros((q, d)), np.zeros(q, bool)
    tilts = np.zeros((q, d - 1, d), np.float32)
    stands = np.arange(q)
    rows = cloud.rows
    places = run_tasks(lambda a, b: thin_places(W, a, b, config.spacing, stands), pairwise(rows.tolist()))

    def tasks() -> Iterator[tuple[Index, Index, cKDTree]]:
        for c, own in enumerate(places):
            near = np.concatenate(places[max(c - 1, 0) : c + 2])
            if not len(own):
                continue
            tree = cKDTree(W[near])
            for some in np.array_split(own, cores()):
                yield some, near, tree

    def fit(own: Index, near: Index, tree: cKDTree) -> None:
        origins = _rotated(R, cloud.step[own], cloud.origins[own], poses[:, :d])
        normals[own], tilts[own], flat[own] = fit_places(W, origins, own, near, config, tree)

    run_tasks(fit, tasks())
    back = np.swapaxes(R, 1, 2)
    for a in range(d - 1):
        tilts[:, a] = rotate_by_step(back, cloud.step, tilts[:, a])
    return Surfaces(rotate_by_step(back, cloud.step, normals), flat, stands, tilts)


@dataclass(frozen=True, slots=True)
class ChunkPairs:
    """Pairs of chunks that may observe the same surfaces.

    Parameters
    ----------
    a, b : (m,)
        Chunks, a ≥ b: points of a on surfaces of b.
    """

    a: Index
    b: Index

    @property
    def passes(self) -> Flags:
        """Are they different traversals of the same place, not neighbours along the path?"""
        return self.a - self.b > NEIGHBOURS


ALIKE = 0.5
"""Share of its variance in which the motion moves all beams of a step together: a Brownian bridge over a unit of time
has the variance 1/6 at a random time, and its mean 1/12."""
NEXT = 1
"""Chunks with an index difference up to this are compared with each other."""
NEIGHBOURS = 5
"""Chunks with an index difference up to this are neighbours along the path; others are different traversals."""
PASSES = 2
"""A chunk is compared with at most this multiple of ``most`` chunks of earlier traversals."""


def chunk_pairs(cloud: ScanReturns, poses: Array, reach: float, most: int, *, passes: bool) -> ChunkPairs:
    """Consecutive chunks; with ``passes`` also those whose centres are within ``reach`` [m].

    A chunk is paired with at most ``most`` chunks of one traversal, and ``PASSES`` times as many of all earlier ones:
    the nearest. If a place was observed ten times, not all pairs are needed to connect them, and each additional one
    would widen the separators of the elimination.
    """
    C, d = cloud.chunks, cloud.points.shape[1]
    first = np.searchsorted(cloud.chunk, np.arange(C))
    centres = np.add.reduceat(poses[:, :d], first) / np.diff(np.append(first, len(cloud.chunk)))[:, None]
    a = np.arange(C)
    pairs = [np.column_stack([a[k:], a[: C - k]]) for k in range(1, min(NEXT, C - 1) + 1)]
    if passes and C > 2:
        near = cKDTree(centres).query_pairs(reach, output_type="ndarray").astype(np.int64)
        near = np.sort(near, axis=1)[:, ::-1]
        pairs.append(_nearest(near[near[:, 0] - near[:, 1] > NEXT], centres, most))
    every = np.concatenate(pairs)
    every = every[np.lexsort((every[:, 1], every[:, 0]))]
    return ChunkPairs(np.ascontiguousarray(every[:, 0]), np.ascontiguousarray(every[:, 1]))


def _nearest(pairs: Index, centres: Array, most: int) -> Index:
    """The nearest partners of each chunk: at most ``most`` per traversal (consecutive partners)."""
    a, b = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].T
    group = np.cumsum((np.diff(a, prepend=-1) != 0) | (np.diff(b, prepend=-9) > 1))
    order = np.lexsort((np.linalg.norm(centres[a] - centres[b], axis=1), group))
    first = np.searchsorted(group[order], group[order])
    chosen = order[np.arange(len(order)) - first < most]
    chosen = chosen[np.lexsort((np.linalg.norm(centres[a[chosen]] - centres[b[chosen]], axis=1), a[chosen]))]
    first = np.searchsorted(a[chosen], a[chosen])
    chosen = chosen[np.arange(len(chosen)) - first < PASSES * most]
    return np.column_stack([a, b])[chosen]


@dataclass(frozen=True, slots=True)
class SurfacePairs:
    """Pairs of points on surfaces, with the variances of their residuals.

    Parameters
    ----------
    whose : (k,)
        Number of the chunk pair of each.
    once : (k, 3)
        Variance of the residual per unit of (σ² of a range, σ² of the surfaces, the motion's own share): the
        sum of squared cosines of incidence of the two beams; 1; the variance by the motion between beam and stamp [m²].
    spent : (k, 3)
        The same, each part multiplied by the number of pairs that share its error: those that use the same point,
        those that use the same step. Independent errors with these variances are in no direction smaller than the
        correlated ones (diagonal dominance: row sums bound the covariance of the pairs), so no measurement is used
        twice.
    """

    pairs: PlanePairs
    whose: Index
    once: Array
    spent: Array


def match_surfaces(
    cloud: ScanReturns,
    surfaces: Surfaces,
    poses: Array,
    chunks: ChunkPairs,
    *,
    distance: float,
    every: int,
    within: Array | None = None,
    least_share: float = 0.10,
) -> SurfacePairs:
    """Nearest surface in each chunk for every ``every``-th point of its partner.

    Parameters
    ----------
    distance : float
        Largest distance of a pair [m].
    within : (n, d, d), optional
        Covariance of the motion between the beams of each step and its pose, right tangents.
    least_share : float
        Pairs of traversals with a smaller share of paired points are not used.
    """
    W, R = cloud.world(poses), rotation_matrices(poses)
    N = rotate_by_step(R, cloud.step, surfaces.normals)
    p, q, w = _nearest_surfaces(cloud, surfaces, W, N, chunks, distance, every, least_share)
    mp, mq = (np.bincount(k, minlength=len(cloud.points))[k] for k in (p, q))
    i, j = cloud.step[p], cloud.step[q]
    shared = None if within is None else [ALIKE * np.bincount(k, minlength=len(within)) for k in (i, j)]
    once, spent = np.zeros((len(p), 3)), np.zeros((len(p), 3))

    def incidence(rows: Index, n: Array) -> Array:
        """Squared cosine of the angle between beams and normals."""
        beams = _rotated(R, cloud.step[rows], cloud.origins[rows], poses[:, : W.shape[1]]) - W[rows]
        length = np.linalg.norm(beams, axis=1)
        return np.asarray((np.einsum("ki,ki->k", n, beams) / np.where(length == 0, 1.0, length)) ** 2)

    def fill(s: slice) -> None:
        a, b, n = p[s], q[s], N[q[s]]
        cp, cq = incidence(a, n), incidence(b, n)
        once[s, 0], once[s, 1] = cp + cq, 1.0
        spent[s, 0], spent[s, 1] = mp[s] * cp + mq[s] * cq, 0.5 * (mp[s] + mq[s])
        if within is None or shared is None:
            return
        own = np.einsum("kji,kj->ki", R[i[s]], n), surfaces.normals[b]
        for rows, k, m, times, alike_steps in zip((a, b), (i[s], j[s]), own, (mp[s], mq[s]), shared):
            lever = _lever(cloud.points[rows], m)
            v = np.einsum("ki,kij,kj->k", lever, within[k], lever)
            once[s, 2] += v
            spent[s, 2] += v * np.maximum(times, alike_steps[k])

    over_rows(fill, len(p))
    return SurfacePairs(PlanePairs(p, q, i, j), w, once, spent)


def _nearest_surfaces(
    cloud: ScanReturns,
    surfaces: Surfaces,
    W: Array,
    N: Array,
    chunks: ChunkPairs,
    distance: float,
    every: int,
    least_share: float,
) -> tuple[Index, Index, Index]:
    """Rows of source points, rows of their surfaces, and indices of their chunk pairs ``(k,)``."""
    trees: dict[int, tuple[cKDTree, Index]] = {}
    last = dict(zip(chunks.b.tolist(), range(len(chunks.b))))  # a tree is freed after its last use

    def tree(c: int) -> tuple[cKDTree, Index]:
        if c not in trees:
            rows = np.arange(cloud.rows[c], cloud.rows[c + 1])
            rows = rows[surfaces.flat[rows]]
            trees[c] = (cKDTree(W[rows]) if len(rows) else None, rows)
        return trees[c]

    def tasks() -> Iterator[tuple[int, Index, cKDTree, Index]]:
        for m, (a, b) in enumerate(zip(chunks.a.tolist(), chunks.b.tolist())):
            t, rows = tree(b)
            if last[b] == m:
                del trees[b]
            p = np.arange(cloud.rows[a], cloud.rows[a + 1], every)
            yield m, p[surfaces.flat[surfaces.stands[p]]], t, rows

    passes, none = chunks.passes, np.zeros(0, np.int64)

    def nearest(m: int, p: Index, t: cKDTree, rows: Index) -> tuple[Index, Index, Index]:
        if t is None or len(p) == 0:
            return none, none, none
        _, at = t.query(W[p], k=1, distance_upper_bound=distance)
        some, tried = at < len(rows), len(p)
        q, p = rows[at[some]], p[some]
        good = np.einsum("ki,ki->k", N[surfaces.stands[p]], N[q]) > SAME_SIDE
        p, q = p[good], q[good]
        if passes[m] and len(p) < least_share * tried:
            return none, none, none
        return p, q, np.full(len(p), m)

    found = [(none, none, none), *run_tasks(nearest, tasks())]
    p, q, whose = (np.concatenate([f[k] for f in found]) for k in range(3))
    return p, q, whose


def _lever(points: Array, normals: Array) -> Array:
    """Derivative ``(k, 6|3)`` of the distance of points from planes by the right tangent of their pose."""
    if points.shape[1] == 3:
        return np.concatenate([np.cross(points, normals), normals], axis=1)
    turn = points[:, 0] * normals[:, 1] - points[:, 1] * normals[:, 0]
    return np.column_stack([normals, turn])
