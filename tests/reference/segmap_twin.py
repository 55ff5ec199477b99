"""Slow twins of a SegMap: lists of dictionaries, chains by recursion, and all map samples by trying every choice."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np

from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.pool import GridPool
from graphslam_frontends.segslam.sampling import SampleRoot, grow_sample_by, segment_probabilities
from graphslam_frontends.segslam.segmap import MATCH, NEW, SegMap, SegmentEntry


class PlainSegMap:
    """What a SegMap is, told once more: particles and segments as dictionaries, maps as sets of scans."""

    def __init__(self, particles: int) -> None:
        self.particles: list[dict[str, Any]] = [{"open": None, "previous": -1, "boundary": 0} for _ in range(particles)]
        self.segments: list[dict[str, Any]] = []

    def open(self, p: int, step: int, kind: int, source: int, entry: np.ndarray) -> None:
        scans = set() if kind == NEW else set(self.segments[source]["scans"])
        self.particles[p]["open"] = {
            "start": step, "kind": kind, "source": source, "scans": scans, "path": [entry],
        }  # fmt: skip
        self.particles[p]["boundary"] = step

    def advance(self, p: int, scan: tuple[int, int], pose: np.ndarray) -> None:
        if self.particles[p]["open"] is not None:
            self.particles[p]["open"]["scans"].add(scan)
            self.particles[p]["open"]["path"].append(pose)

    def resample(self, ancestors: list[int]) -> None:
        old = self.particles
        self.particles = []
        for a in ancestors:
            q = dict(old[a])
            if q["open"] is not None:
                q["open"] = {**q["open"], "scans": set(q["open"]["scans"]), "path": list(q["open"]["path"])}
            self.particles.append(q)

    def close(self, which: list[int], step: int, weight: float) -> list[int]:
        out = []
        made: list[int] = []
        for p in which:
            o = self.particles[p]["open"]
            for i in made:  # the same history: the same segment
                s = self.segments[i]
                if (s["start"], s["kind"], s["source"], s["previous"]) == (
                    o["start"], o["kind"], o["source"], self.particles[p]["previous"],
                ) and np.array_equal(np.stack(s["path"]), np.stack(o["path"])):  # fmt: skip
                    s["weight"] += weight
                    out.append(i)
                    break
            else:
                self.segments.append(
                    {**o, "end": step, "previous": self.particles[p]["previous"], "weight": weight, "alive": True}
                )
                made.append(len(self.segments) - 1)
                out.append(made[-1])
        for p, i in zip(which, out):
            self.particles[p] = {"open": None, "previous": i, "boundary": step}
        return out

    def leads_here(self, i: int) -> bool:
        """Does a chain of segments lead from segment i to where some particle is now?"""
        s = self.segments[i]
        if any(q["boundary"] == s["end"] for q in self.particles):
            return True
        return any(self.leads_here(j) for j, r in enumerate(self.segments) if r["alive"] and r["start"] == s["end"])

    def prune(self) -> int:
        dead = [i for i, s in enumerate(self.segments) if s["alive"] and not self.leads_here(i)]
        for i in dead:
            self.segments[i]["alive"] = False
        return len(dead)

    def compatible(self, i: int, j: int) -> bool:
        return bool(self.segments[i]["end"] == self.segments[j]["start"])


class _Script:
    """Answers choices by a script; beyond its end it takes the first option and notes how many there were."""

    def __init__(self, script: list[int], weights: np.ndarray | None) -> None:
        self.weights = weights
        self.script, self.options, self.chance = script, list[int](), Fraction(1)

    def _answer(self, options: int) -> int:
        k = len(self.options)
        self.options.append(options)
        return self.script[k] if k < len(self.script) else 0

    def order(self, n: int) -> list[int]:
        left, out = list(range(n)), []
        while left:
            out.append(left.pop(self._answer(len(left))))
            self.chance /= len(left) + 1
        return out

    def choose(self, fits: np.ndarray) -> int:
        p = segment_probabilities(fits, self.weights)
        k = self._answer(len(p))
        self.chance *= Fraction(float(p[k])).limit_denominator(10**6)
        return k


def all_samples(
    segmap: SegMap, root: SampleRoot, weights: np.ndarray | None = None, **options: Any
) -> dict[tuple[int, ...], Fraction]:
    """Every map sample, as the sorted tuple of its segments, with its probability, by trying every choice there is."""
    found: dict[tuple[int, ...], Fraction] = {}
    digits: list[int] = []  # an odometer over choices whose number depends on the ones before
    while True:
        script = _Script(digits, weights)
        sample = grow_sample_by(segmap, root, script.order, script.choose, **options)
        key = tuple(sorted(sample.segments.tolist()))
        found[key] = found.get(key, Fraction(0)) + script.chance
        digits = (digits + [0] * len(script.options))[: len(script.options)]
        while digits and digits[-1] + 1 >= script.options[len(digits) - 1]:
            digits.pop()
        if not digits:
            return found
        digits[-1] += 1


# --- small SegMaps to try things on ---


def flat_grid(pool: GridPool | None = None, dim: int = 2) -> EvidenceGrid:
    """An empty grid of voxels of 1 m."""
    return EvidenceGrid(1.0, pool=GridPool(levels=3) if pool is None else pool, dim=dim)


def mark(grid: EvidenceGrid, x: int, y: int) -> None:
    """Make one voxel occupied, and no other known: a beam that begins and ends in it."""
    z = [0.5] * (grid.dim - 2)
    grid.insert_scan([[x + 0.6, y + 0.5, *z]], origin=[x + 0.5, y + 0.5, *z])


def marked(grid: EvidenceGrid) -> set[tuple[int, int]]:
    """The voxels that were marked."""
    return {(int(x), int(y)) for x, y in np.floor(grid.occupied_cloud()[:, :2])}


def small_segmap(steps: int, particles: int, *, dim: int = 2, gravity: bool = False, speed: float = 1.0) -> SegMap:
    """A SegMap over so many steps of a second each."""
    times = np.arange(steps, dtype=float)
    return SegMap(times, speed * times, particles, dim=dim, gravity=gravity)


def straight(start: np.ndarray, length: float, steps: int) -> np.ndarray:
    """Poses ``(steps + 1, 3)`` ahead along the heading of the first."""
    s = np.linspace(0.0, length, steps + 1)
    x, y, a = start
    return np.stack([x + s * np.cos(a), y + s * np.sin(a), np.full(steps + 1, a)], axis=1)


def match_entry(T: np.ndarray, source: int, fitness: float = 0.9) -> SegmentEntry:
    """A match with a small covariance."""
    d = 3 if len(T) == 3 else 6
    return SegmentEntry(
        T_entry=np.asarray(T, float), kind=MATCH, source=source, covariance=1e-4 * np.eye(d), fitness=fitness
    )
