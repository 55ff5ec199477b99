"""Map samples: one path through the SegMap, with the pose of every submap on it (SegSLAM section 3.3).

A sample begins at one segment and grows breadth-first along two kinds of links: to segments that end where one begins
(or begin where it ends), any of which will do (A6), and from a segment that entered an older map to the one it
entered. So after a loop closure older submaps stand where the closure says, not where the long way round would put
them. Among links of equal depth the order is random.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt

from frontends.segslam.segmap import NEW, Entry, SegMap
from graphslam.core.errors import DataError
from graphslam.core.geometry import Array, wrap_angle
from graphslam.core.poses import frame_between, heading_of, upright

Ints = npt.NDArray[np.int64]

OPEN = -1
"""Stands for the segment a particle is in now, which has no index yet."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MapSample:
    """Segments that follow each other, and where their frames are.

    Parameters
    ----------
    segments : (m,) int64
        In the order they were reached; the first is the root, `OPEN` if it is the one a particle is in now.
    poses : (m, 7) or (m, 3)
        ``T_root_segment``: frames of the segments in that of the root.
    via : (m,) int64
        Place in this sample of the segment each was reached from; -1 of the root.
    depth : (m,) int64
        Links from the root.
    intervals : (m, 2) int64
        Steps of the boundaries; of an open root its start and the step of now.
    anchor : (m,) int64
        Step at which the way from the root comes into the segment …
    travelled : (m,) float64
        … and the length of that way up to there [m]: how far poses have drifted apart depends on it.
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
        """Places in this sample in the order of the path."""
        return np.lexsort((self.intervals[:, 1], self.intervals[:, 0])).astype(np.int64)


@dataclass(frozen=True, slots=True, kw_only=True)
class Root:
    """Where a sample begins: use :func:`root_of_particle` or :func:`root_of_segment`."""

    segment: int
    start: int
    end: int
    anchor: int
    entry: Array
    exit: Array | None
    source: int
    link: Array | None


def root_of_particle(segmap: SegMap, particle: int, step: int) -> Root:
    """The segment a particle is in, at the step of now.

    Raises
    ------
    DataError
        It is in none.
    """
    if not 0 <= particle < segmap.particles or segmap.entries[particle] is None:
        raise DataError(f"particle {particle} is in no segment", wanted="one that entered a segment and did not leave")
    e = cast(Entry, segmap.entries[particle])
    start = int(segmap.start[particle])
    if not start <= step < len(segmap.times):
        raise DataError("a sample cannot begin before its segment did", got=step, wanted=f"≥ {start}")
    return Root(
        segment=OPEN, start=start, end=step, anchor=step, entry=e.T_entry, exit=None,
        source=-1 if e.kind == NEW else e.source, link=segmap.links[particle],
    )  # fmt: skip


def root_of_segment(segmap: SegMap, index: int) -> Root:
    """A closed segment, seen from its end."""
    s = segmap[index]
    return Root(
        segment=s.index, start=s.interval[0], end=s.interval[1], anchor=s.interval[1], entry=s.T_entry, exit=s.T_exit,
        source=s.source, link=segmap.table.link[s.index],
    )  # fmt: skip


def grow(
    segmap: SegMap,
    root: Root,
    rng: np.random.Generator,
    *,
    weights: Array | None = None,
    local_length: float = 0.0,
    local_depth: int = 0,
) -> MapSample:
    """Draw a map sample.

    Level by level, the links of all segments of a level are taken in random order. A link in time leads to any
    segment that fits there and does not overlap in time with what the sample holds; a link to an entered map leads to
    the one segment that was entered, unless its place is taken.

    Parameters
    ----------
    segmap : SegMap
    root : Root
    rng : numpy Generator
    weights : (len(segmap),), optional
        Of the segments, for the draw among those that fit; default equal. Where all that fit weigh nothing, equal.
    local_length : float
        Local sample: do not grow on from segments that the way from the root enters beyond this length [m]; 0 = full.
    local_depth : int
        … nor from those this many links away; 0 = full.
    """
    w = None if weights is None else np.asarray(weights, dtype=np.float64)
    return grow_by(
        segmap,
        root,
        lambda n: rng.permutation(n).tolist() if n > 1 else [0],
        lambda fits: _draw(fits, w, rng),
        local_length=local_length,
        local_depth=local_depth,
    )


def probabilities(fits: Ints, weights: Array | None) -> Array:
    """Of the segments that fit ``(k,)``; equal without weights, and where all weigh nothing."""
    w = np.ones(len(fits)) if weights is None else np.asarray(weights, dtype=np.float64)[fits]
    return np.asarray(w / w.sum()) if w.sum() > 0 else np.full(len(fits), 1.0 / len(fits))


def _draw(fits: Ints, weights: Array | None, rng: np.random.Generator) -> int:
    if len(fits) == 1:
        return 0
    if weights is None:
        return int(rng.integers(len(fits)))
    p = probabilities(fits, weights)
    # rounding must not choose one without weight
    return int(min(np.searchsorted(np.cumsum(p), rng.random(), side="right"), np.flatnonzero(p)[-1]))


def grow_by(
    segmap: SegMap,
    root: Root,
    order: Callable[[int], list[int]],
    choose: Callable[[Ints], int],
    *,
    local_length: float = 0.0,
    local_depth: int = 0,
) -> MapSample:
    """As :func:`grow`, with the two kinds of choice given.

    Parameters
    ----------
    order : callable
        Number of links of a level → the order in which they are taken.
    choose : callable
        Segments ``(k,)`` that fit → which of them, 0 … k - 1.
    """
    g, t = segmap.group, segmap.table
    L = segmap.path_length
    frames = _Upright(segmap, root) if g.dim == 2 or segmap.gravity else _Free(segmap, root)
    segments, via, depth = [root.segment], [-1], [0]
    intervals, anchor, travelled = [(root.start, root.end)], [root.anchor], [0.0]

    def free(begin: int, end: int) -> bool:
        return not any(begin < e and s < end for s, e in intervals)

    def fits(found: Ints) -> Ints:
        """Those that do not overlap in time with what is there."""
        if not len(found):
            return found
        ends, begins = t.end[found], t.start[found]
        if ends[0] == ends.min() == ends.max() and begins[0] == begins.min() == begins.max():
            return found if free(int(begins[0]), int(ends[0])) else found[:0]
        return found[[free(b, e) for b, e in zip(begins.tolist(), ends.tolist())]]

    def add(index: int, at: int, step_there: int, step_here: int) -> None:
        segments.append(index)
        via.append(at)
        depth.append(depth[at] + 1)
        intervals.append((int(t.start[index]), int(t.end[index])))
        anchor.append(step_there)
        travelled.append(travelled[at] + float(abs(L[step_here] - L[anchor[at]])))

    level = [0]
    while level:
        links: list[tuple[int, int]] = []
        for k in level:
            if (local_length and travelled[k] > local_length) or (local_depth and depth[k] >= local_depth):
                continue
            links.append((k, _BEFORE))
            if segments[k] != OPEN:
                links.append((k, _AFTER))
            source = root.source if k == 0 else int(t.source[segments[k]])
            if source >= 0 and t.alive[source]:
                links.append((k, _ENTERED))
        level = []
        if not links:
            break
        for j in order(len(links)):
            k, direction = links[j]
            begin, end = intervals[k]
            if direction == _ENTERED:
                i = segments[k]
                chosen, link, entry = root.source, root.link, root.entry
                if k:
                    chosen, link, entry = int(t.source[i]), t.link[i], t.entry[i]
                if not free(int(t.start[chosen]), int(t.end[chosen])):
                    continue
                # the way goes on from where the body stood in the entered map
                T = cast(Array, link)
                there = nearest_step(segmap, chosen, g.compose(g.inverse(T), entry))
                add(chosen, k, there, begin)
                frames.linked(k, T)
                level.append(len(segments) - 1)
                continue
            found = fits(segmap.ending_at(begin) if direction == _BEFORE else segmap.beginning_at(end))
            if not len(found):
                continue
            chosen = int(found[choose(found)])
            at = begin if direction == _BEFORE else end
            add(chosen, k, at, at)
            frames.joined(k, segments[k], chosen, direction)
            level.append(len(segments) - 1)
    return MapSample(
        segments=np.array(segments, np.int64),
        poses=frames.poses(),
        via=np.array(via, np.int64),
        depth=np.array(depth, np.int64),
        intervals=np.array(intervals, np.int64),
        anchor=np.array(anchor, np.int64),
        travelled=np.array(travelled),
    )


_BEFORE, _AFTER, _ENTERED = 0, 1, 2


class _Free:
    """Frames of a sample as whole poses: where gravity is not known."""

    def __init__(self, segmap: SegMap, root: Root) -> None:
        self.g, self.t, self.root = segmap.group, segmap.table, root
        self.at = [self.g.identity]

    def linked(self, k: int, T: Array) -> None:
        """A frame more, at ``T`` in that of place k."""
        self.at.append(self.g.compose(self.at[k], T))

    def joined(self, k: int, here: int, there: int, direction: int) -> None:
        """A frame more, of segment ``there`` that comes before or after ``here`` in place k: both know the body at the
        boundary (A6)."""
        entry, exit = (self.root.entry, self.root.exit) if k == 0 else (self.t.entry[here], self.t.exit[here])
        if direction == _BEFORE:
            T = frame_between(entry, self.t.exit[there], gravity=False)
        else:
            T = frame_between(cast(Array, exit), self.t.entry[there], gravity=False)
        self.linked(k, T)

    def poses(self) -> Array:
        """``(m, 7)``."""
        return np.stack(self.at)


class _Upright:
    """Frames of a sample by position and heading: those between level frames, ten times as fast as whole poses."""

    def __init__(self, segmap: SegMap, root: Root) -> None:
        self.t, self.dim, self.root = segmap.table, segmap.group.dim, root
        self.at = [(0.0, 0.0, 0.0, 0.0)]

    def linked(self, k: int, T: Array) -> None:
        """As :meth:`_Free.linked`; T is level."""
        if T.any():
            self._put(k, T, float(heading_of(T)), np.zeros(3), 0.0)
        else:
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
        """The body is at ``a`` in the frame of place k, and at ``b`` in the new one."""
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
            return upright(p[:, :3], p[:, 3])
        return np.stack([p[:, 0], p[:, 1], wrap_angle(p[:, 3])], axis=1)


def nearest_step(segmap: SegMap, index: int, T_segment_body: Array) -> int:
    """Step of a segment at which its body stood nearest to a pose in its frame."""
    path = cast(Array, segmap.table.paths[index])
    d = path[:, : segmap.group.dim] - np.asarray(T_segment_body)[: segmap.group.dim]
    return int(segmap.table.start[index]) + int(np.argmin(np.einsum("ni,ni->n", d, d)))
