"""The SegMap Θ: all segments of the path, their submaps, and which of them fit together in time (SegSLAM section 3).

A segment covers the steps of an *interval*, from the boundary where a particle entered a submap to the one where it
left. Each particle at a boundary leaves one segment, so an interval has many. Segments of one interval are
interchangeable: any of them may be followed by any that begins where it ends (A6).

Frames. The frame of a new segment is the body at its entry, levelled and lowered by `lift` if gravity is known. A
segment that entered an older map uses the frame of that map, and a copy of it. Poses are ``T_segment_body``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import CovarianceError, DataError, GeometryError
from graphslam.core.gaussian import check_covariance
from graphslam.core.geometry import Array
from graphslam.core.poses import SE2, SE3, Group, normalise_weights
from graphslam.core.records import check_times
from graphslam.evidence.grid import EvidenceGrid
from graphslam_frontends.segslam.segment import KINDS, MATCH, NEW, SAME, Segment, SegmentEntry, check_path
from graphslam_frontends.segslam.store import SegmentMaps, SegmentTable

Ints = npt.NDArray[np.int64]

__all__ = ["KINDS", "MATCH", "NEW", "SAME", "SegMap", "Segment", "SegmentEntry"]

_NOBODY: Ints = np.zeros(0, np.int64)


class SegMap:
    """All segments of one filter.

    Parameters
    ----------
    times : (n,)
        Of the steps [s].
    path_length : (n,)
        Path length by odometry up to each step [m].
    dim : {3, 2}
    gravity : bool
        Frames are aligned with gravity: their relative rotation is a heading.
    lift : float
        Height of the body above the frame of a new segment at its entry [m].
    """

    def __init__(
        self, times: Any, path_length: Any, particles: int, *, dim: int = 3, gravity: bool = True, lift: float = 0.0
    ) -> None:
        self.times = check_times(times, where="steps of a SegMap")
        self.path_length = np.ascontiguousarray(path_length, dtype=np.float64)
        if self.path_length.shape != self.times.shape or np.any(~(np.diff(self.path_length) >= 0)):
            raise GeometryError(
                "path lengths do not belong to the steps", got=self.path_length.shape, wanted="one each, never falling"
            )
        if particles < 1 or dim not in (2, 3):
            raise GeometryError("impossible SegMap", got=f"{particles} particles, dim {dim}", wanted="≥ 1; 2 or 3")
        self.group: Group = SE2 if dim == 2 else SE3
        self.gravity = bool(gravity) and dim == 3
        self.lift = float(lift) if self.gravity else 0.0
        self.particles = int(particles)
        self.table = SegmentTable(self.group.size)
        self.maps = SegmentMaps()
        # the open segment of each particle: its entry, its first boundary, and the closed segment before it
        self.entries: list[SegmentEntry | None] = [None] * self.particles
        self.start: Ints = np.zeros(self.particles, np.int64)
        self.previous: Ints = np.full(self.particles, -1, np.int64)
        self.pruned = 0

    def __len__(self) -> int:
        """Number of all segments ever closed; their indices are 0 … len - 1, including pruned ones."""
        return self.table.count

    def __getitem__(self, index: int) -> Segment:
        i = self._alive(index)
        t = self.table
        a, b = int(t.start[i]), int(t.end[i])
        return Segment(
            index=i,
            interval=(a, b),
            t_start=float(self.times[a]),
            t_end=float(self.times[b]),
            kind=KINDS[t.kind[i]],
            source=int(t.source[i]),
            previous=int(t.previous[i]),
            T_entry=t.entry[i],
            T_exit=t.exit[i],
            path=cast(Array, t.paths[i]),
            length=float(self.path_length[b] - self.path_length[a]),
            weight=float(t.weight[i]),
            match_covariance=t.covariances[i],
            fitness=float(t.fitness[i]),
        )

    @property
    def alive(self) -> Ints:
        """Indices of the viable segments, ascending."""
        return np.flatnonzero(self.table.alive).astype(np.int64)

    # --- opening and closing of segments ---------------------------------------------------------------------

    def open(
        self, step: int, entries: Sequence[SegmentEntry], which: Iterable[int] | None = None
    ) -> list[EvidenceGrid | None]:
        """Particles enter segments at a boundary.

        Parameters
        ----------
        entries : sequence of SegmentEntry
            One per particle, in the order of ``which``.
        which : iterable of int, optional
            The particles; default all.

        Returns
        -------
        list of EvidenceGrid or None
            The map to continue with: a copy of the one entered; None for a new segment, whose map the filter creates.
        """
        chosen = self._which(which, len(entries), "entries")
        if not 0 <= step < len(self.times):
            raise DataError("a segment begins outside the path", got=step, wanted=f"0 … {len(self.times) - 1}")
        grids: list[EvidenceGrid | None] = []
        for p, e in zip(chosen, entries):
            if self.entries[p] is not None:
                raise DataError(f"particle {p} enters a segment before it left its last one", where=f"step {step}")
            if self.previous[p] >= 0 and self.start[p] != step:
                raise DataError(
                    f"particle {p} enters a segment elsewhere than where it left the last one",
                    got=step, wanted=int(self.start[p]),
                )  # fmt: skip
            self._check_entry(p, e)
        for p, e in zip(chosen, entries):
            grids.append(None if e.kind == NEW else self.map_of(e.source).copy())
            self.entries[p], self.start[p] = e, step
        return grids

    def resample(self, ancestors: npt.ArrayLike) -> None:
        """Particle i becomes a copy of particle ``ancestors[i]``; closed segments of all particles are kept (A6)."""
        a = np.asarray(ancestors, dtype=np.int64)
        if a.shape != (self.particles,) or a.min() < 0 or a.max() >= self.particles:
            raise DataError("impossible ancestors", got=a, wanted=f"{self.particles} of 0 … {self.particles - 1}")
        self.entries = [self.entries[i] for i in a]
        self.start, self.previous = self.start[a], self.previous[a]

    def close(
        self,
        step: int,
        grids: Sequence[EvidenceGrid],
        paths: Sequence[Array],
        weights: npt.ArrayLike | None = None,
        which: Iterable[int] | None = None,
    ) -> Ints:
        """Particles leave their segments at a boundary; the closed segments are stored.

        Parameters
        ----------
        grids : sequence of EvidenceGrid
            Their maps, in their frames. Copies are stored: the filter may continue to write to its own.
        paths : sequence of (step - start + 1, 7 or 3)
            ``T_segment_body`` at every step since the boundary, both boundaries included, **in the frame of this
            segment**: the first pose is that of the entry.
        weights : (particles,), optional
            Of all particles; default equal.

        Returns
        -------
        (n,) int64
            Indices of the segments. Particles that are copies of each other share one.
        """
        chosen = self._which(which, len(grids), "grids")
        self._which(which, len(paths), "paths")
        w = normalise_weights(weights, self.particles)
        last = len(self.times) - 1
        rows = [
            check_path(path, self.entries[p], p, (int(self.start[p]), step), last) for p, path in zip(chosen, paths)
        ]
        known: dict[tuple[Any, ...], int] = {}
        out = np.empty(len(chosen), np.int64)
        for k, (p, grid, path) in enumerate(zip(chosen, grids, rows)):
            e = cast(SegmentEntry, self.entries[p])
            key = (int(self.start[p]), e.kind, e.source, int(self.previous[p]), path.tobytes())
            i = known.get(key, -1)
            if i < 0:
                i = known[key] = self._append(p, step, e, grid, path)
            self.table.weight[i] += w[p]
            out[k] = i
        for p, i in zip(chosen, out.tolist()):
            self.entries[p], self.start[p], self.previous[p] = None, step, i
        return out

    # --- compatible segments ---------------------------------------------------------------------------------

    def ending_at(self, step: int) -> Ints:
        """Viable segments that end at a boundary, ascending: possible predecessors of those that begin there."""
        return self.table.fitting[1].get(int(step), _NOBODY)

    def beginning_at(self, step: int) -> Ints:
        """Viable segments that begin at a boundary, ascending: possible successors of those that end there."""
        return self.table.fitting[0].get(int(step), _NOBODY)

    def entering(self, index: int) -> Ints:
        """Viable segments that entered or continued the map of a segment, ascending: they share its frame."""
        return self.table.fitting[2].get(int(index), _NOBODY)

    def intervals(self) -> Ints:
        """Intervals ``(k, 2)`` of the viable segments, ascending."""
        a = self.alive
        return np.unique(np.stack([self.table.start[a], self.table.end[a]], axis=1), axis=0)

    def in_interval(self, interval: tuple[int, int]) -> Ints:
        """Viable segments of an interval, ascending."""
        t = self.table
        return np.flatnonzero(t.alive & (t.start == interval[0]) & (t.end == interval[1])).astype(np.int64)

    def chain(self, index: int) -> Ints:
        """Segments of one particle from the first to ``index``, back to the first one pruned."""
        found = [self._alive(index)]
        while (p := int(self.table.previous[found[-1]])) >= 0 and self.table.alive[p]:
            found.append(p)
        return np.array(found[::-1], np.int64)

    def map_of(self, index: int) -> EvidenceGrid:
        """Map of a segment, in its frame. Read-only."""
        return cast(EvidenceGrid, self.maps.grids[int(self.table.map[self._alive(index)])])

    # --- pruning ---------------------------------------------------------------------------------------------

    def prune(self) -> int:
        """Drop the segments that are not viable any more, and free their maps; returns their number.

        A segment is viable while a chain of segments, each beginning where the previous one ends, leads from it to the
        start of a current segment (A12).
        """
        t = self.table
        here = set(self.start.tolist())
        ends = t.end[: t.count]
        for b in np.unique(ends[t.alive[: t.count]])[::-1].tolist():
            if b in here:
                here.update(t.start[self.ending_at(b)].tolist())
        dead = np.flatnonzero(t.alive[: t.count] & ~np.isin(ends, list(here)))
        return self._release(dead)

    def describe(self) -> dict[str, Any]:
        """Intervals, segments and counts, ready for JSON; the same for the same seed."""
        t = self.table
        return {
            "segments": [t.row(i, self.times) for i in self.alive.tolist()],
            "intervals": self.intervals().tolist(),
            "closed": len(self),
            "pruned": self.pruned,
            "matches": int(np.sum(t.alive & (t.kind == MATCH))),
        }

    # --- internals -------------------------------------------------------------------------------------------

    def _append(self, p: int, step: int, e: SegmentEntry, grid: EvidenceGrid, path: Array) -> int:
        interval = (int(self.start[p]), step)
        scans = {interval}
        if e.kind != NEW:  # a copy: it contains the scans of its source, even if that was pruned since
            scans |= self._scans_of(e.source)
        m = self.maps.add(grid.copy(), frozenset(scans))
        return self.table.append(interval, e, int(self.previous[p]), path, m)

    def _scans_of(self, source: int) -> frozenset[tuple[int, int]]:
        """Intervals with scans in the map of a segment."""
        return self.maps.scans[int(self.table.map[source])]

    def _release(self, dead: Ints) -> int:
        for i in dead.tolist():
            self.table.kill(i)
            self.maps.drop(int(self.table.map[i]))
        self.pruned += len(dead)
        return len(dead)

    def _alive(self, index: int) -> int:
        i = int(index)
        if not 0 <= i < self.table.count:
            raise DataError("there is no such segment", got=i, wanted=f"0 … {self.table.count - 1}")
        if not self.table.alive[i]:
            raise DataError(f"segment {i} was pruned: it fits no path of now")
        return i

    def _which(self, which: Iterable[int] | None, n: int, what: str) -> list[int]:
        chosen = list(range(self.particles)) if which is None else [int(p) for p in which]
        if len(chosen) != n or len(set(chosen)) != n or any(not 0 <= p < self.particles for p in chosen):
            raise DataError(f"{what} do not belong to the particles", got=n, wanted=f"one each of {len(chosen)}")
        return chosen

    def _check_entry(self, p: int, e: SegmentEntry) -> None:
        """Raise if an entry is invalid."""
        T = np.asarray(e.T_entry, dtype=np.float64)
        if T.shape != (self.group.size,) or not np.all(np.isfinite(T)):
            raise GeometryError(f"entry of particle {p} is no pose", got=T, wanted=f"({self.group.size},) finite")
        if e.kind not in (NEW, MATCH, SAME) or (e.kind == NEW) != (e.source < 0):
            raise DataError(
                f"particle {p} enters impossibly", got=f"kind {e.kind}, source {e.source}", wanted="a source, or new"
            )
        if e.kind == NEW:
            return
        self._alive(e.source)
        if e.kind == MATCH:  # it may become a factor, which needs a covariance
            if e.covariance is None:
                raise CovarianceError(f"particle {p} enters segment {e.source} by a match without a covariance")
            check_covariance(e.covariance, what=f"covariance of a match into segment {e.source}", dim=self.group.dof)
