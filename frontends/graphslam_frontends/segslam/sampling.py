"""Map samples: one path through the SegMap, with the pose of every submap on it (SegSLAM section 3.3).

A sample begins at one segment and grows along two kinds of links: in time, to any segment that ends where one begins or
begins where it ends (A6); and in space, between a segment that entered an older map and the one it entered. Linked in
space, two segments share a frame, in which the later one was localised, so there is no drift between them. So links in
space are followed at once, links in time breadth-first, in random order at equal depth. After a loop closure submaps
are where the closure puts them, not where the long path would, whichever of two segments of a place was reached first.
"""

from __future__ import annotations

import math
from bisect import bisect_right, insort
from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array, wrap_angle
from graphslam.core.poses import frame_between, heading_of, level_poses
from graphslam_frontends.segslam.segmap import NEW, SegMap, SegmentEntry

Ints = npt.NDArray[np.int64]

OPEN = -1
"""Index of the open segment of a particle."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MapSample:
    """Consecutive segments and the poses of their frames.

    Parameters
    ----------
    segments : (m,) int64
        In the order in which they were reached; the first is the root, `OPEN` if it is the current segment of a
        particle.
    poses : (m, 7) or (m, 3)
        ``T_root_segment``: frames of the segments in the frame of the root.
    via : (m,) int64
        Index in this sample of the segment from which each was reached; -1 for the root.
    depth : (m,) int64
        Number of links from the root, of both kinds.
    intervals : (m, 2) int64
        Steps of the boundaries; for an open root its start and the current step.
    anchor : (m,) int64
        Step at which the path from the root enters the segment …
    travelled : (m,) float64
        … and the length of that path up to there [m], which determines the drift.
    """

    segments: Ints
    poses: Array
    via: Ints
    depth: Ints
    intervals: Ints
    anchor: Ints
    travelled: Array

    def __len__(self) -> int:
        return len(self.segments)

    @property
    def in_time(self) -> Ints:
        """Indices of this sample in the order of time."""
        return np.argsort(self.intervals[:, 0], kind="stable").astype(np.int64)  # intervals do not overlap


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleRoot:
    """Root of a sample: use :func:`root_of_particle` or :func:`root_of_segment`."""

    segment: int
    start: int
    end: int
    anchor: int
    entry: Array
    exit: Array | None
    source: int


def root_of_particle(segmap: SegMap, particle: int, step: int) -> SampleRoot:
    """The current segment of a particle, at the current step."""
    if not 0 <= particle < segmap.particles or segmap.entries[particle] is None:
        raise DataError(f"particle {particle} is in no segment", wanted="one that entered a segment and did not leave")
    e = cast(SegmentEntry, segmap.entries[particle])
    start = int(segmap.start[particle])
    if not start <= step < len(segmap.times):
        raise DataError("a sample cannot begin before its segment did", got=step, wanted=f"≥ {start}")
    return SampleRoot(
        segment=OPEN, start=start, end=step, anchor=step, entry=e.T_entry, exit=None,
        source=-1 if e.kind == NEW else e.source,
    )  # fmt: skip


def root_of_segment(segmap: SegMap, index: int) -> SampleRoot:
    """A closed segment, at its end."""
    s = segmap[index]
    return SampleRoot(
        segment=s.index, start=s.interval[0], end=s.interval[1], anchor=s.interval[1], entry=s.T_entry, exit=s.T_exit,
        source=s.source,
    )  # fmt: skip


def grow_sample(
    segmap: SegMap,
    root: SampleRoot,
    rng: np.random.Generator,
    *,
    weights: Array | None = None,
    local_length: float = 0.0,
    local_depth: int = 0,
) -> MapSample:
    """Draw a map sample.

    Level by level, the links in time of all segments of a level are followed in random order; each leads to a segment
    that fits there and does not overlap in time with the sample. When a segment is reached, those that share its frame
    follow on the same level: the one whose map it entered, unless that overlaps; and of each interval with segments
    that entered its own map the segment drawn for that interval, if it is one of these. One segment is drawn per
    interval, once.

    Parameters
    ----------
    weights : (len(segmap),), optional
        Of the segments, for the draw among those that fit; default equal. If all that fit have zero weight, equal.
    local_length : float
        Local sample: no growth from segments that the path from the root enters beyond this length [m]; 0 = full.
    local_depth : int
        … nor from those this many links away; 0 = full.
    """
    w = None if weights is None else np.asarray(weights, dtype=np.float64)
    return grow_sample_by(
        segmap,
        root,
        lambda n: rng.permutation(n).tolist() if n > 1 else [0],
        lambda fits: _draw(fits, w, rng),
        local_length=local_length,
        local_depth=local_depth,
    )


def draw_weights(segmap: SegMap) -> Array:
    """Weights of all segments ``(len(segmap),)`` for the draw among those of an interval.

    The own weight of a segment is that of its particles when it was closed. If later segments entered maps of an
    interval, more is known: surviving particles recognised those maps and were localised in them. Then the entered
    segments share the weight of those that entered them, and the others of that interval have zero weight, because
    their maps would duplicate the place.
    """
    t, n = segmap.table, len(segmap)
    out = np.where(t.alive[:n], t.weight[:n], 0.0)
    received = np.zeros(n)
    # the latest first: a segment is only entered by later ones
    for begin, end in segmap.intervals()[::-1].tolist():
        rows = segmap.in_interval((begin, end))
        if received[rows].any():
            out[rows] = received[rows]
        entered = rows[t.source[rows] >= 0]
        np.add.at(received, t.source[entered], out[entered])
    return out


def segment_probabilities(fits: Ints, weights: Array | None) -> Array:
    """Of the segments that fit ``(k,)``; equal without weights, and if all are zero."""
    w = np.ones(len(fits)) if weights is None else np.asarray(weights, dtype=np.float64)[fits]
    return np.asarray(w / w.sum()) if w.sum() > 0 else np.full(len(fits), 1.0 / len(fits))


def _draw(fits: Ints, weights: Array | None, rng: np.random.Generator) -> int:
    if len(fits) == 1:
        return 0
    if weights is None:
        return int(rng.integers(len(fits)))
    p = segment_probabilities(fits, weights)
    # rounding must not choose a segment of zero weight
    return int(min(np.searchsorted(np.cumsum(p), rng.random(), side="right"), np.flatnonzero(p)[-1]))


def grow_sample_by(
    segmap: SegMap,
    root: SampleRoot,
    order: Callable[[int], list[int]],
    choose: Callable[[Ints], int],
    *,
    local_length: float = 0.0,
    local_depth: int = 0,
) -> MapSample:
    """As :func:`grow_sample`, with given functions for the two kinds of choice.

    Parameters
    ----------
    order : callable
        Number of links of a level → the order in which they are followed.
    choose : callable
        Segments ``(k,)`` that fit → index of the chosen one, 0 … k - 1.
    """
    growing = _GrowingSample(segmap, root, choose, local_length, local_depth)
    level = growing.add_joined(0)
    while level:
        links = growing.links(level)
        chosen = [links[j] for j in order(len(links))] if links else []
        level = [place for k, direction in chosen for place in growing.join(k, direction)]
    return growing.sample()


_BEFORE, _AFTER = 0, 1


class _Free:
    """Frames of a sample as full poses, without gravity."""

    def __init__(self, segmap: SegMap, root: SampleRoot) -> None:
        self.g, self.t, self.root = segmap.group, segmap.table, root
        self.at = [self.g.identity]

    def shared(self, k: int) -> None:
        """Add a segment with the frame k."""
        self.at.append(self.at[k])

    def joined(self, k: int, here: int, there: int, direction: int) -> None:
        """Add the frame of segment ``there`` before or after ``here`` (frame k): both have the body pose at the
        boundary (A6)."""
        entry, exit = (self.root.entry, self.root.exit) if k == 0 else (self.t.entry[here], self.t.exit[here])
        if direction == _BEFORE:
            T = frame_between(entry, self.t.exit[there], gravity=False)
        else:
            T = frame_between(cast(Array, exit), self.t.entry[there], gravity=False)
        self.at.append(self.g.compose(self.at[k], T))

    def poses(self) -> Array:
        """``(m, 7)``."""
        return np.stack(self.at)


class _Upright:
    """Frames of a sample by position and heading, for levelled frames; ten times as fast as full poses."""

    def __init__(self, segmap: SegMap, root: SampleRoot) -> None:
        self.t, self.dim, self.root = segmap.table, segmap.group.dim, root
        self.at = [(0.0, 0.0, 0.0, 0.0)]

    def shared(self, k: int) -> None:
        """As :meth:`_Free.shared`."""
        self.at.append(self.at[k])

    def joined(self, k: int, here: int, there: int, direction: int) -> None:
        """As :meth:`_Free.joined`."""
        leaving = int(direction == _AFTER)
        if k == 0:
            a = cast(Array, self.root.exit if leaving else self.root.entry)
            heading = float(heading_of(a))
        else:
            a = self.t.exit[here] if leaving else self.t.entry[here]
            heading = float(self.t.headings[here, leaving])
        b = self.t.entry[there] if leaving else self.t.exit[there]
        self._put(k, a, heading, b, float(self.t.headings[there, 1 - leaving]))

    def _put(self, k: int, a: Array, heading_a: float, b: Array, heading_b: float) -> None:
        """The body is at ``a`` in frame k, and at ``b`` in the new one."""
        x, y, z, yaw = self.at[k]
        c, s = math.cos(yaw), math.sin(yaw)
        ax, ay, bx, by = float(a[0]), float(a[1]), float(b[0]), float(b[1])
        turn = yaw + heading_a - heading_b
        ct, st = math.cos(turn), math.sin(turn)
        up = float(a[2] - b[2]) if self.dim == 3 else 0.0
        self.at.append((x + c * ax - s * ay - ct * bx + st * by, y + s * ax + c * ay - st * bx - ct * by, z + up, turn))

    def poses(self) -> Array:
        """``(m, 7)`` or ``(m, 3)``."""
        p = np.array(self.at)
        if self.dim == 3:
            return level_poses(p[:, :3], p[:, 3])
        return np.stack([p[:, 0], p[:, 1], wrap_angle(p[:, 3])], axis=1)


class _GrowingSample:
    """A growing sample: segments in the order in which they were added, each with its predecessor."""

    def __init__(
        self,
        segmap: SegMap,
        root: SampleRoot,
        choose: Callable[[Ints], int],
        local_length: float,
        local_depth: int,
    ) -> None:
        self.segmap, self.root, self.t, self.choose = segmap, root, segmap.table, choose
        self.local_length, self.local_depth = local_length, local_depth
        self.frames = _Upright(segmap, root) if segmap.group.dim == 2 or segmap.gravity else _Free(segmap, root)
        self.segments, self.via, self.depth = [root.segment], [-1], [0]
        self.intervals, self.anchor, self.travelled = [(root.start, root.end)], [root.anchor], [0.0]
        self.starts, self.ends = [root.start], [root.end]  # of the intervals, ascending
        self.drawn: dict[tuple[int, int], int] = {}

    def free(self, begin: int, end: int) -> bool:
        """Is an interval without overlap with the sample?"""
        first = bisect_right(self.ends, begin)  # they do not overlap each other
        return first == len(self.ends) or self.starts[first] >= end

    def fits(self, found: Ints) -> Ints:
        """Those without overlap in time with the sample."""
        if not len(found):
            return found
        ends, begins = self.t.end[found], self.t.start[found]
        if (ends == ends[0]).all() and (begins == begins[0]).all():
            return found if self.free(int(begins[0]), int(ends[0])) else found[:0]
        return found[[self.free(b, e) for b, e in zip(begins.tolist(), ends.tolist())]]

    def add(self, index: int, at: int, step_there: int, step_here: int) -> int:
        """Add a segment; returns its index in the sample."""
        L = self.segmap.path_length
        self.segments.append(index)
        self.via.append(at)
        self.depth.append(self.depth[at] + 1)
        self.intervals.append((int(self.t.start[index]), int(self.t.end[index])))
        insort(self.starts, self.intervals[-1][0])
        insort(self.ends, self.intervals[-1][1])
        self.anchor.append(step_there)
        self.travelled.append(self.travelled[at] + float(abs(L[step_here] - L[self.anchor[at]])))
        return len(self.segments) - 1

    def draw(self, found: Ints) -> int:
        """Draw one of those that fit; the same one again for an interval that was drawn before."""
        begins, ends = self.t.start[found], self.t.end[found]
        if (begins != begins[0]).any() or (ends != ends[0]).any():
            return int(found[self.choose(found)])
        key = int(begins[0]), int(ends[0])
        if key not in self.drawn:
            self.drawn[key] = int(found[self.choose(found)])
        return self.drawn[key]

    def grows(self, k: int) -> bool:
        """Is segment k of the sample near enough to the root to grow from?"""
        far = self.local_length and self.travelled[k] > self.local_length
        return not (far or (self.local_depth and self.depth[k] >= self.local_depth))

    def add_joined(self, k: int) -> list[int]:
        """Add all segments that share a frame with segment k, recursively; returns their indices, k first."""
        found, t, segmap = [k], self.t, self.segmap
        for k in found:  # the list grows in the loop
            if not self.grows(k):
                continue
            i, begin = self.segments[k], self.intervals[k][0]
            source, entry = self.root.source, self.root.entry
            if k:
                source, entry = int(t.source[i]), t.entry[i]
            if source >= 0 and t.alive[source] and self.free(int(t.start[source]), int(t.end[source])):
                # the path continues from the position of the body in the entered map
                found.append(self.add(source, k, nearest_step(segmap, source, entry), begin))
                self.frames.shared(k)
            entering = segmap.entering(i)
            for begin, end in dict.fromkeys(zip(t.start[entering].tolist(), t.end[entering].tolist())):
                if not self.free(begin, end):
                    continue
                rivals = segmap.beginning_at(begin)
                chosen = self.draw(rivals[t.end[rivals] == end])
                if t.source[chosen] != i:
                    continue  # particles of that time did not enter this map
                found.append(self.add(chosen, k, begin, nearest_step(segmap, i, t.entry[chosen])))
                self.frames.shared(k)
        return found

    def links(self, level: list[int]) -> list[tuple[int, int]]:
        """Links in time from the segments of a level: index and direction."""
        out = []
        for k in level:
            if self.grows(k):
                out.append((k, _BEFORE))
                if self.segments[k] != OPEN:
                    out.append((k, _AFTER))
        return out

    def join(self, k: int, direction: int) -> list[int]:
        """Add a segment before or after segment k, if one fits; returns the new indices."""
        begin, end = self.intervals[k]
        at = begin if direction == _BEFORE else end
        there = self.fits(self.segmap.ending_at(at) if direction == _BEFORE else self.segmap.beginning_at(at))
        if not len(there):
            return []
        chosen = self.draw(there)
        place = self.add(chosen, k, at, at)
        self.frames.joined(k, self.segments[k], chosen, direction)
        return self.add_joined(place)

    def sample(self) -> MapSample:
        """The finished sample."""
        return MapSample(
            segments=np.array(self.segments, np.int64),
            poses=self.frames.poses(),
            via=np.array(self.via, np.int64),
            depth=np.array(self.depth, np.int64),
            intervals=np.array(self.intervals, np.int64),
            anchor=np.array(self.anchor, np.int64),
            travelled=np.array(self.travelled),
        )


def nearest_step(segmap: SegMap, index: int, T_segment_body: Array) -> int:
    """Step of a segment with the body position nearest to a pose in its frame."""
    path = cast(Array, segmap.table.paths[index])
    d = path[:, : segmap.group.dim] - np.asarray(T_segment_body)[: segmap.group.dim]
    return int(segmap.table.start[index]) + int(np.argmin(np.einsum("ni,ni->n", d, d)))
