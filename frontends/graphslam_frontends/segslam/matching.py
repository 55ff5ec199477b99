"""Loop detection: candidates, search, registration, and the draw (A2, A9, A10).

Drift at a loop closure is far beyond the convergence range of registration, so a correlative search over the range
allowed by the path length comes first, and all of its modes are registered: if the true place is missing, a similar one
is accepted. Particles with the same map share the results; particles with another map of the same place share starts.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Generator
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.poses import heading_of
from graphslam.core.random import SeedTree
from graphslam.registration.config import LEAST_POINTS
from graphslam.registration.register import Registration, distinct_registrations, register
from graphslam.registration.search import last_value, search_in_slices
from graphslam.registration.search_field import SearchField
from graphslam.registration.target import Target
from graphslam_frontends.segslam.candidate_selection import CandidateSelection, SegmentCandidates, select_candidates
from graphslam_frontends.segslam.config import STARTS, SegSlamConfig
from graphslam_frontends.segslam.localisation import localise_in_map
from graphslam_frontends.segslam.match_posterior import NULL, Proposal, match_posterior
from graphslam_frontends.segslam.sampling import draw_weights, grow_sample, root_of_particle
from graphslam_frontends.segslam.segmap import NEW, SegMap, SegmentEntry
from graphslam_frontends.segslam.window import LookAheadScan

K = TypeVar("K")
V = TypeVar("V")

KEPT_BYTES = 200_000_000
"""Memory limit of the cache of search fields, and of that of registration targets [bytes]."""
POINT_BYTES = 1250
"""Memory of one point of a registration target, with covariance and search trees [bytes]."""
LEAST_SCORE = 0.7
"""Modes with a lower search score are not registered. Matches accepted later had scores of 0.85 to 0.97, unvisited
places 0.54 to 0.63, with a few up to 0.84 …"""
SCORE_MARGIN = 0.15
"""… nor those worse than the best by more than this."""
CLOUD_LEVEL = 1
"""The occupied voxels of a map are averaged for matching in cells of 2**level voxels."""
SAME_START = 1.0
"""Particles with the same map and predictions closer than about this share one search [m]."""
SLICE_PARTICLES = 5
"""Particles whose candidates are selected, or entries drawn, in one slice."""
RIVALS = 0.15
"""In the maps of other particles of the same steps only those modes are tried that in the first map were worse by at
most this share of the points, or by ``choice.margin`` if that is larger, so that second modes are not missed."""


class RecentCache(dict[K, V]):
    """Least-recently-used cache with a memory limit.

    Parameters
    ----------
    size : callable
        Bytes of a value.
    """

    def __init__(self, size: Callable[[V], int]) -> None:
        super().__init__()
        self._size = size

    def of(self, key: K, make: Callable[[], V]) -> V:
        """The value of a key, made if it is missing."""
        value = self[key] = self.pop(key) if key in self else make()
        size = sum(map(self._size, self.values()))
        for oldest in list(self)[:-1]:
            if size <= KEPT_BYTES:
                break
            size -= self._size(self.pop(oldest))
        return value

    def keep(self, alive: Callable[[K], bool]) -> None:
        """Delete all other values."""
        for key in [k for k in self if not alive(k)]:
            del self[key]


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchAttempt:
    """Result of one attempt at one step.

    Parameters
    ----------
    entries : tuple of N (SegmentEntry or None)
        Entry of each particle into an older map; None: no match.
    candidates : tuple of int
        Candidate segments of any particle.
    searches, registrations : int
        Their numbers.
    accepted : int
        Number of particles with at least one accepted proposal.
    fitness : float
        Of the best registration; NaN without any.
    why : mapping of str to int
        Counts of gates that proposals failed.
    """

    step: int
    entries: tuple[SegmentEntry | None, ...]
    candidates: tuple[int, ...] = ()
    searches: int = 0
    registrations: int = 0
    accepted: int = 0
    fitness: float = float("nan")
    why: dict[str, int] = field(default_factory=dict)

    @property
    def matched(self) -> int:
        """Number of particles that enter an older map."""
        return sum(e is not None for e in self.entries)

    def describe(self) -> dict[str, Any]:
        """Ready for JSON."""
        return {
            "step": self.step,
            "candidates": list(self.candidates),
            "searches": self.searches,
            "registrations": self.registrations,
            "accepted": self.accepted,
            "matched": self.matched,
            "fitness": None if np.isnan(self.fitness) else self.fitness,
            "why": self.why,
        }


class Matcher:
    """Finds and registers re-entries into older maps.

    Parameters
    ----------
    max_range : float
        Of the beams [m].
    """

    def __init__(self, segmap: SegMap, config: SegSlamConfig, max_range: float, *, threads: int = 1) -> None:
        self.segmap, self.config, self.max_range, self.threads = segmap, config, max_range, threads
        self.winnowed = CandidateSelection()
        # registration targets of closed maps, made at first use
        self._targets: RecentCache[int, Target | None] = RecentCache(lambda t: 0 if t is None else POINT_BYTES * len(t))
        # fine (1) and coarse (2), of one map of all particles' maps of the same steps
        self._fields: RecentCache[tuple[int, int, int], SearchField] = RecentCache(lambda field: field.nbytes)

    def attempt(self, step: int, poses: Array, ahead: LookAheadScan, seed: SeedTree) -> MatchAttempt:
        """Try to match all particles, and draw.

        Parameters
        ----------
        poses : (N, 7) or (N, 3)
            ``T_segment_body``.
        ahead : LookAheadScan
            The window of this step; an incomplete window gives no matches.
        seed : SeedTree
            Of this attempt alone.
        """
        return last_value(self.attempt_in_slices(step, poses, ahead, seed))

    def attempt_in_slices(
        self, step: int, poses: Array, ahead: LookAheadScan, seed: SeedTree
    ) -> Generator[None, None, MatchAttempt]:
        """:meth:`attempt` in slices of bounded work; the result is the same."""
        nothing = MatchAttempt(step=step, entries=(None,) * len(poses))
        segmap, config = self.segmap, self.config
        alive = segmap.alive
        ended = segmap.times[segmap.table.end[alive]]
        if not ahead.full or not np.any(segmap.times[step] - ended >= config.winnowing.gap):
            return nothing
        source = ahead.source(config.search.source_points, config.search.source_radius)
        if len(source) < LEAST_POINTS:
            return nothing
        yield
        asked = yield from self._candidates(step, poses, seed)
        if not any(map(len, asked)):
            return nothing
        results, searches, registrations = yield from self._register(source, asked)
        posteriors = []
        for i, c in enumerate(asked):
            if i % SLICE_PARTICLES == 0 or config.choice.method != "registration":
                yield
            proposals = self._proposals(c, results, ahead, seed.child("localise", i))
            posteriors.append(match_posterior(proposals, config.choice, config.registration))
        uniform = seed.child("draw").generator().random(len(poses))
        entries: list[SegmentEntry | None] = []
        why: Counter[str] = Counter()
        for j, u in zip(posteriors, uniform.tolist()):
            k = j.draw(u) if len(j.proposals) else NULL
            entries.append(None if k == NULL else j.entry(k, config.choice))
            why.update({name: n for name, n in j.counts().items() if name != "accepted"})
        best = [r.best_fitness for found in results.values() for r in found]
        return MatchAttempt(
            step=step,
            entries=tuple(self._spread(entries, seed)),
            candidates=tuple(sorted({int(s) for c in asked for s in c.segments})),
            searches=searches,
            registrations=registrations,
            accepted=sum(len(j.accepted) > 0 for j in posteriors),
            fitness=max(best, default=float("nan")),
            why=dict(sorted(why.items())),
        )

    # --- candidates ------------------------------------------------------------------------------------------

    def _candidates(self, step: int, poses: Array, seed: SeedTree) -> Generator[None, None, list[SegmentCandidates]]:
        """Candidates of each particle. Particles with the same history share a map sample."""
        segmap, config = self.segmap, self.config
        groups: dict[tuple[int, int, int], list[int]] = {}
        for i, entry in enumerate(segmap.entries):
            groups.setdefault((id(entry), int(segmap.start[i]), int(segmap.previous[i])), []).append(i)
        weights = draw_weights(segmap)
        out: dict[int, SegmentCandidates] = {}
        for number, members in enumerate(groups.values()):
            rng = seed.child("sample", number).generator()
            sample = grow_sample(
                segmap, root_of_particle(segmap, members[0], step), rng, weights=weights,
            )  # fmt: skip
            entry = segmap.entries[members[0]]
            held = self._held(-1 if entry is None or entry.kind == NEW else entry.source)
            for k in range(0, len(members), SLICE_PARTICLES):
                some = members[k : k + SLICE_PARTICLES]
                found = select_candidates(
                    segmap, sample, poses[some], step, config.winnowing, exclude=held, tally=self.winnowed
                )  # fmt: skip
                out.update(zip(some, found))
                if len(out) // SLICE_PARTICLES > (len(out) - len(some)) // SLICE_PARTICLES:
                    yield
        return [out[i] for i in range(len(poses))]

    def _held(self, source: int) -> frozenset[int]:
        """Segments with all their scans already in the map of ``source``."""
        if source < 0:
            return frozenset()
        t, scans = self.segmap.table, self.segmap.maps.scans
        mine = scans[int(t.map[source])]
        return frozenset(int(i) for i in self.segmap.alive if scans[int(t.map[i])] <= mine)

    # --- search and registration -----------------------------------------------------------------------------

    def _register(
        self, source: Array, asked: list[SegmentCandidates]
    ) -> Generator[None, None, tuple[dict[int, list[Registration]], int, int]]:
        """Results by map, and the numbers of searches and registrations."""
        s, gates = self.config.search, self.config.registration.gates
        # the body may be tilted: tilt relative to the prediction is checked later
        rules = replace(self.config.registration, gates=replace(gates, tilt=math.pi))
        planar = self.segmap.group.dim == 2
        cloud: Target | None = None
        results: dict[int, list[Registration]] = {}
        done: set[tuple[int, ...]] = set()
        modes: dict[int, list[tuple[Array, float, list[Array]]]] = {}  # of maps that begin at one step
        searches = registrations = 0
        for c in asked:
            for segment, T, sigma, length in zip(c.segments.tolist(), c.T_map_body, c.sigma, c.travelled):
                m = int(self.segmap.table.map[segment])
                key = (m, *np.rint(T[:2] / SAME_START).astype(int).tolist(), round(float(heading_of(T)) / 0.1))
                if key in done or len(done) >= s.most_searches:
                    continue
                target = self._target(m, segment)
                if target is None:
                    continue
                done.add(key)
                yield
                cloud = Target(source, neighbours=target.neighbours) if cloud is None else cloud
                radius = min(s.max_radius, 2.5 * float(sigma))
                # maps that begin at one step share a start pose: the modes of the first are starts in the others
                alike = modes.setdefault(self._begin(segment), [])
                starts = next((f for at, r, f in alike if np.linalg.norm((T - at)[:2]) <= 0.25 * min(r, radius)), None)
                first = starts is None
                if starts is None:
                    height = [] if planar else [s.height + self.config.winnowing.rise(float(length))]
                    half = [radius, radius, *height, s.yaw_width(float(length))]
                    starts = yield from self._search(source, segment, T, half)
                    searches += 1
                found = []
                for start in starts:
                    yield
                    found.append(register(cloud, target, start, rules))
                found = distinct_registrations(found)
                registrations += len(starts)
                if first:
                    top = found[0].best_fitness if found else 0.0
                    near = [
                        r.T_target_source
                        for r in found
                        if r.best_fitness >= top - max(RIVALS, self.config.choice.margin)
                    ]
                    alike.append((T, radius, near))
                results[m] = distinct_registrations(results.get(m, []) + found)
                yield
        return results, searches, registrations

    def _begin(self, segment: int) -> int:
        """First step of the map that a segment uses."""
        t = self.segmap.table
        while t.source[segment] >= 0:
            segment = int(t.source[segment])
        return int(t.start[segment])

    def _target(self, m: int, segment: int) -> Target | None:
        """Registration target of the map; None if it has too few points."""

        def made() -> Target | None:
            points = self.segmap.map_of(segment).binned_cloud(CLOUD_LEVEL).points
            return Target(points) if len(points) >= LEAST_POINTS else None

        return self._targets.of(m, made)

    def _search(self, source: Array, segment: int, T: Array, half: list[float]) -> Generator[None, None, list[Array]]:
        """Starts for registration: the best distinct modes, if any score is high enough."""
        s = self.config.search
        known = (self._begin(segment), int(self.segmap.table.end[segment]))

        def field(scale: int) -> Generator[None, None, SearchField]:
            found = self._fields.get((*known, scale))
            if found is None:
                occupied, cell = self.segmap.map_of(segment).occupied_cloud(), scale * s.grid / 4.0
                yield
                found = yield from SearchField.in_slices(occupied, cell=cell, sigma=scale * s.sigma)
            return self._fields.of((*known, scale), lambda: found)

        fine = yield from field(1)
        yield
        coarse = yield from field(2)
        yield
        steps = [*[s.grid] * self.segmap.group.dim, s.yaw_step]
        found = yield from search_in_slices(source, fine, T, half, steps, STARTS, coarse=coarse)
        best = max((p.score for p in found), default=0.0)
        return [p.T for p in found if p.score >= max(LEAST_SCORE, best - SCORE_MARGIN)]

    def forget(self) -> None:
        """Delete the cached data of maps that are gone."""
        segmap = self.segmap
        self._targets.keep(lambda m: segmap.maps.grids[m] is not None)
        ends = set(segmap.table.end[segmap.alive].tolist())
        self._fields.keep(lambda known: known[1] in ends)

    # --- proposals -------------------------------------------------------------------------------------------

    def _proposals(
        self, c: SegmentCandidates, results: dict[int, list[Registration]], ahead: LookAheadScan, seed: SeedTree
    ) -> list[Proposal]:
        out: list[Proposal] = []
        for k, segment in enumerate(c.segments.tolist()):
            for r in results.get(int(self.segmap.table.map[segment]), []):
                local = None
                if self.config.choice.method != "registration" and r.accepted:
                    local = localise_in_map(
                        self.segmap.map_of(segment), r.T_target_source, ahead.window, self.max_range,
                        seed.child(len(out)).generator(), threads=self.threads,
                    )  # fmt: skip
                out.append(
                    Proposal(
                        segment=segment,
                        registration=r,
                        T_prior=c.T_map_body[k],
                        sigma=float(c.sigma[k]),
                        rise=self.config.winnowing.rise(float(c.travelled[k])),
                        localisation=local,
                    )
                )
        return out

    def _spread(self, entries: list[SegmentEntry | None], seed: SeedTree) -> list[SegmentEntry | None]:
        """Sample the entry poses of particles from the covariance of their match."""
        group, n = self.segmap.group, len(entries)
        if n == 1:
            return entries
        normal = seed.child("entry").generator().standard_normal((n, group.dof))
        out: list[SegmentEntry | None] = []
        for e, x in zip(entries, normal):
            if e is None or e.covariance is None:
                out.append(e)
                continue
            moved = group.compose(e.T_entry, group.exp(np.linalg.cholesky(e.covariance) @ x))
            out.append(
                SegmentEntry(T_entry=moved, kind=e.kind, source=e.source, covariance=e.covariance, fitness=e.fitness)
            )
        return out
