"""Has a particle come back to an older segment? Candidates, search, registration, and the draw (A2, A9, A10).

Drift at a closure is far beyond what registration can capture, so a correlative search over what the path length allows
comes first, and all of its modes are tried: the true place must be among them, or an alias wins. Particles that ask for
the same map share the results; those whose map is another one share them as starts.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from frontends.segslam.choice import NULL, Proposal, judge
from frontends.segslam.config import SegSlamConfig
from frontends.segslam.localisation import localise
from frontends.segslam.sampling import MapSample, grow, root_of_particle
from frontends.segslam.segmap import NEW, Entry, SegMap
from frontends.segslam.window import Ahead
from frontends.segslam.winnowing import Candidates, Winnowed, winnow
from graphslam.core.geometry import Array
from graphslam.core.poses import heading_of
from graphslam.core.random import SeedTree
from graphslam.registration.register import Registration, distinct, register_starts
from graphslam.registration.search import correlative_search
from graphslam.registration.search_field import SearchField
from graphslam.registration.target import Target

Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Attempt:
    """What one attempt at one step came to.

    Parameters
    ----------
    step : int
    entries : tuple of N (Entry or None)
        How each particle enters an older map; None: not at all.
    candidates : tuple of int
        Segments that were asked for, by any particle.
    searches, registrations : int
        Made.
    accepted : int
        Particles that had something to draw besides no match.
    fitness : float
        Of the best registration; NaN without any.
    why : mapping of str to int
        Gates that proposals failed.
    """

    step: int
    entries: tuple[Entry | None, ...]
    candidates: tuple[int, ...] = ()
    searches: int = 0
    registrations: int = 0
    accepted: int = 0
    fitness: float = float("nan")
    why: dict[str, int] = field(default_factory=dict)

    @property
    def matched(self) -> int:
        """Particles that enter an older map."""
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


@dataclass(slots=True)
class _Map:
    """What a closed map is matched by: made when it is first asked for."""

    target: Target | None
    field: SearchField | None


class Matcher:
    """Looks for re-entries.

    Parameters
    ----------
    segmap : SegMap
    config : SegSlamConfig
    max_range : float
        Of the beams [m].
    threads : int
    """

    def __init__(self, segmap: SegMap, config: SegSlamConfig, max_range: float, *, threads: int = 1) -> None:
        self.segmap, self.config, self.max_range, self.threads = segmap, config, max_range, threads
        self.winnowed = Winnowed()
        self.seconds = 0.0
        self._maps: dict[int, _Map] = {}

    def attempt(self, step: int, poses: Array, ahead: Ahead, seed: SeedTree) -> Attempt:
        """Try to match all particles, and draw.

        Parameters
        ----------
        step : int
        poses : (N, 7) or (N, 3)
            ``T_segment_body``.
        ahead : Ahead
            The window of this step; with one that is not full, nothing is matched.
        seed : SeedTree
            Of this attempt alone.
        """
        begin = time.perf_counter()
        try:
            return self._attempt(step, poses, ahead, seed)
        finally:
            self.seconds += time.perf_counter() - begin

    def _attempt(self, step: int, poses: Array, ahead: Ahead, seed: SeedTree) -> Attempt:
        nothing = Attempt(step=step, entries=(None,) * len(poses))
        segmap, config = self.segmap, self.config
        alive = segmap.alive
        ended = segmap.times[segmap.table.end[alive]]
        if not ahead.full or not np.any(segmap.times[step] - ended >= config.winnowing.gap):
            return nothing
        source = ahead.source(config.search.source_points, config.search.source_radius)
        if len(source) < config.registration.least_points:
            return nothing
        asked = self._candidates(step, poses, seed)
        if not any(map(len, asked)):
            return nothing
        results, searches, registrations = self._register(source, asked)
        proposals = [self._proposals(c, results, ahead, seed.child("localise", i)) for i, c in enumerate(asked)]
        judged = [judge(p, config.choice, config.registration) for p in proposals]
        uniform = seed.child("draw").generator().random(len(poses))
        entries: list[Entry | None] = []
        why: Counter[str] = Counter()
        for j, u in zip(judged, uniform.tolist()):
            k = j.draw(u) if len(j.proposals) else NULL
            entries.append(None if k == NULL else j.entry(k, config.choice))
            why.update({name: n for name, n in j.counts().items() if name != "accepted"})
        best = [r.best_fitness for found in results.values() for r in found]
        return Attempt(
            step=step,
            entries=tuple(self._spread(entries, seed)),
            candidates=tuple(sorted({int(s) for c in asked for s in c.segments})),
            searches=searches,
            registrations=registrations,
            accepted=sum(len(j.accepted) > 0 for j in judged),
            fitness=max(best, default=float("nan")),
            why=dict(sorted(why.items())),
        )

    # --- candidates ------------------------------------------------------------------------------------------

    def _candidates(self, step: int, poses: Array, seed: SeedTree) -> list[Candidates]:
        """What each particle asks for. Particles that came the same way share a map sample."""
        segmap, config = self.segmap, self.config
        samples: dict[tuple[int, int, int], MapSample] = {}
        held: dict[int, frozenset[int]] = {}
        weights = segmap.table.weight[: len(segmap)]
        out = []
        for i, pose in enumerate(poses):
            entry = segmap.entries[i]
            key = (id(entry), int(segmap.start[i]), int(segmap.previous[i]))
            if key not in samples:
                rng = seed.child("sample", len(samples)).generator()
                samples[key] = grow(
                    segmap, root_of_particle(segmap, i, step), rng, weights=weights,
                    local_length=config.winnowing.local_length,
                )  # fmt: skip
            origin = -1 if entry is None or entry.kind == NEW else entry.source
            if origin not in held:
                held[origin] = self._held(origin)
            out.append(
                winnow(
                    segmap, samples[key], pose, step, config.winnowing, exclude=held[origin], tally=self.winnowed
                )
            )  # fmt: skip
        return out

    def _held(self, source: int) -> frozenset[int]:
        """Segments of whose scans every one is in the map of ``source`` already."""
        if source < 0:
            return frozenset()
        t, scans = self.segmap.table, self.segmap.maps.scans
        mine = scans[int(t.map[source])]
        return frozenset(int(i) for i in self.segmap.alive if scans[int(t.map[i])] <= mine)

    # --- search and registration -----------------------------------------------------------------------------

    def _register(self, source: Array, asked: list[Candidates]) -> tuple[dict[int, list[Registration]], int, int]:
        """Results by map, and how many searches and registrations they took."""
        s, gates = self.config.search, self.config.registration.gates
        # the body may be tilted: what tilts against the prediction is refused later
        rules = replace(self.config.registration, gates=replace(gates, tilt=math.pi))
        planar = self.segmap.group.dim == 2
        cloud: Target | None = None
        results: dict[int, list[Registration]] = {}
        done: set[tuple[int, ...]] = set()
        good: list[Array] = []  # accepted in some map: starts for the others, whose frames are much the same
        registrations = 0
        for c in asked:
            for segment, T, sigma, way in zip(c.segments.tolist(), c.T_map_body, c.sigma, c.travelled):
                m = int(self.segmap.table.map[segment])
                key = (m, *np.rint(T[:2] / s.same_start).astype(int).tolist(), round(float(heading_of(T)) / 0.1))
                if key in done or len(done) >= s.most_searches:
                    continue
                known = self._map(m, segment)
                if known.target is None or known.field is None:
                    continue
                done.add(key)
                cloud = Target(source, neighbours=known.target.neighbours) if cloud is None else cloud
                radius = min(s.max_radius, 2.5 * float(sigma))
                half = [radius, radius, *([] if planar else [s.height]), s.yaw_width(float(way))]
                steps = [s.grid, s.grid, *([] if planar else [s.grid]), s.yaw_step]
                starts = [p.T for p in correlative_search(source, known.field, T, half, steps, s.starts)]
                starts += good
                found = register_starts(cloud, known.target, starts, rules)
                registrations += len(starts)
                results[m] = distinct(results.get(m, []) + found)
                good += [r.T_target_source for r in found if r.accepted][:1]
        return results, len(done), registrations

    def _map(self, m: int, segment: int) -> _Map:
        if m not in self._maps:
            grid, _ = self.segmap.map_of(segment)
            points = grid.binned_cloud(self.config.search.cloud_level).points
            occupied = grid.occupied_cloud()
            enough = len(points) >= self.config.registration.least_points
            self._maps[m] = _Map(
                target=Target(points) if enough else None,
                field=SearchField(occupied, cell=0.5 * self.config.search.grid) if enough else None,
            )
        return self._maps[m]

    def forget(self) -> None:
        """Drop what belongs to maps that are gone."""
        self._maps = {m: v for m, v in self._maps.items() if self.segmap.maps.grids[m] is not None}

    # --- what is drawn ---------------------------------------------------------------------------------------

    def _proposals(
        self, c: Candidates, results: dict[int, list[Registration]], ahead: Ahead, seed: SeedTree
    ) -> list[Proposal]:
        out: list[Proposal] = []
        for k, segment in enumerate(c.segments.tolist()):
            for r in results.get(int(self.segmap.table.map[segment]), []):
                local = None
                if self.config.choice.method != "registration" and r.accepted:
                    local = localise(
                        self.segmap.map_of(segment)[0], r.T_target_source, ahead.window, self.max_range,
                        seed.child(len(out)).generator(), self.config.localisation, threads=self.threads,
                    )  # fmt: skip
                out.append(
                    Proposal(
                        segment=segment,
                        registration=r,
                        T_prior=c.T_map_body[k],
                        sigma=float(c.sigma[k]),
                        localisation=local,
                    )
                )
        return out

    def _spread(self, entries: list[Entry | None], seed: SeedTree) -> list[Entry | None]:
        """Particles that drew one match stand where its covariance may have them, not all at one place."""
        group, n = self.segmap.group, len(entries)
        if n == 1:
            return entries
        normal = seed.child("entry").generator().standard_normal((n, group.dof))
        out: list[Entry | None] = []
        for e, x in zip(entries, normal):
            if e is None or e.covariance is None:
                out.append(e)
                continue
            moved = group.compose(e.T_entry, group.exp(np.linalg.cholesky(e.covariance) @ x))
            out.append(Entry(T_entry=moved, kind=e.kind, source=e.source, covariance=e.covariance, fitness=e.fitness))
        return out
