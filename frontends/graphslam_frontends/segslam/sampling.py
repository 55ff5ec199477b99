"""Map samples: one path through the SegMap, with the pose of every submap on it (SegSLAM section 3.3).

A sample begins at one segment and grows along two kinds of links: to segments that end where one begins (or begin where
it ends), any of which will do (A6), and between a segment that entered an older map and the one it entered. These two
share a frame, in which the later was localised in what the earlier saw: nothing drifts between them. So such links are
taken at once, before those in time, which are taken breadth-first, among links of equal depth in random order. After a
loop closure submaps stand where the closure says, not where the long way round would put them; and a place that was
driven through twice is one place, whichever of its two segments was reached first.
"""

from __future__ import annotations

import math
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
        Links from the root, of both kinds.
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
        return np.argsort(self.intervals[:, 0], kind="stable").astype(np.int64)  # they do not overlap


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleRoot:
    """Where a sample begins: use :func:`root_of_particle` or :func:`root_of_segment`."""

    segment: int
    start: int
    end: int
    anchor: int
    entry: Array
    exit: Array | None
    source: int
    link: Array | None


def root_of_particle(segmap: SegMap, particle: int, step: int) -> SampleRoot:
    """The segment a particle is in, at the step of now."""
    if not 0 <= particle < segmap.particles or segmap.entries[particle] is None:
        raise DataError(f"particle {particle} is in no segment", wanted="one that entered a segment and did not leave")
    e = cast(SegmentEntry, segmap.entries[particle])
    start = int(segmap.start[particle])
    if not start <= step < len(segmap.times):
        raise DataError("a sample cannot begin before its segment did", got=step, wanted=f"≥ {start}")
    return SampleRoot(
        segment=OPEN, start=start, end=step, anchor=step, entry=e.T_entry, exit=None,
        source=-1 if e.kind == NEW else e.source, link=segmap.links[particle],
    )  # fmt: skip


def root_of_segment(segmap: SegMap, index: int) -> SampleRoot:
    """A closed segment, seen from its end."""
    s = segmap[index]
    return SampleRoot(
        segment=s.index, start=s.interval[0], end=s.interval[1], anchor=s.interval[1], entry=s.T_entry, exit=s.T_exit,
        source=s.source, link=segmap.table.link[s.index],
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

    Level by level, the links in time of all segments of a level are taken in random order; each leads to any segment
    that fits there and does not overlap in time with what the sample holds. As soon as a segment is reached, those that
    share its frame follow, on the same level: the one whose map it entered, unless its place is taken, and of each
    interval with segments that entered its own map the one that is drawn of that interval, if it is one of these. Of
    each interval one segment is drawn, once.

    Parameters
    ----------
    weights : (len(segmap),), optional
        Of the segments, for the draw among those that fit; default equal. Where all that fit weigh nothing, equal.
    local_length : float
        Local sample: do not grow on from segments that the way from the root enters beyond this length [m]; 0 = full.
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

    A segment's own weight is what its particles had when it was closed, of what was known by then. Where later segments
    entered maps of an interval, more is known: those maps were found again, by particles that are still there, and what
    came after was localised in them. So of such an interval the segments that were entered share the weight of those
    that entered them, and the others, beside whose maps a second one of the same place would stand, have none.
    """
    t, n = segmap.table, len(segmap)
    out = np.where(t.alive[:n], t.weight[:n], 0.0)
    received = np.zeros(n)
    # the latest first: a segment is entered only by later ones
    for begin, end in segmap.intervals()[::-1].tolist():
        rows = segmap.in_interval((begin, end))
        if received[rows].any():
            out[rows] = received[rows]
        entered = rows[t.source[rows] >= 0]
        np.add.at(received, t.source[entered], out[entered])
    return out


def segment_probabilities(fits: Ints, weights: Array | None) -> Array:
    """Of the segments that fit ``(k,)``; equal without weights, and where all weigh nothing."""
    w = np.ones(len(fits)) if weights is None else np.asarray(weights, dtype=np.float64)[fits]
    return np.asarray(w / w.sum()) if w.sum() > 0 else np.full(len(fits), 1.0 / len(fits))


def _draw(fits: Ints, weights: Array | None, rng: np.random.Generator) -> int:
    if len(fits) == 1:
        return 0
    if weights is None:
        return int(rng.integers(len(fits)))
    p = segment_probabilities(fits, weights)
    # rounding must not choose one without weight
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
    """As :func:`grow_sample`, with the two kinds of choice given.

    Parameters
    ----------
    order : callable
        Number of links of a level → the order in which they are taken.
    choose : callable
        Segments ``(k,)`` that fit → which of them, 0 … k - 1.
    """
    growing = _GrowingSample(segmap, root, choose, local_length, local_depth)
    level = growing.settle(0)
    while level:
        links = growing.links(level)
        chosen = [links[j] for j in order(len(links))] if links else []
        level = [place for k, direction in chosen for place in growing.join(k, direction)]
    return growing.sample()


_BEFORE, _AFTER = 0, 1


class _Free:
    """Frames of a sample as whole poses: where gravity is not known."""

    def __init__(self, segmap: SegMap, root: SampleRoot) -> None:
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

    def __init__(self, segmap: SegMap, root: SampleRoot) -> None:
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
            return level_poses(p[:, :3], p[:, 3])
        return np.stack([p[:, 0], p[:, 1], wrap_angle(p[:, 3])], axis=1)


class _GrowingSample:
    """A sample while it grows: places in the order in which they were added, each with the one that it hangs on."""

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
        self.drawn: dict[tuple[int, int], int] = {}

    def free(self, begin: int, end: int) -> bool:
        """Does an interval overlap in time with nothing that is there?"""
        return not any(begin < e and s < end for s, e in self.intervals)

    def fits(self, found: Ints) -> Ints:
        """Those that do not overlap in time with what is there."""
        if not len(found):
            return found
        ends, begins = self.t.end[found], self.t.start[found]
        if (ends == ends[0]).all() and (begins == begins[0]).all():
            return found if self.free(int(begins[0]), int(ends[0])) else found[:0]
        return found[[self.free(b, e) for b, e in zip(begins.tolist(), ends.tolist())]]

    def add(self, index: int, at: int, step_there: int, step_here: int) -> int:
        """A place more; its number."""
        L = self.segmap.path_length
        self.segments.append(index)
        self.via.append(at)
        self.depth.append(self.depth[at] + 1)
        self.intervals.append((int(self.t.start[index]), int(self.t.end[index])))
        self.anchor.append(step_there)
        self.travelled.append(self.travelled[at] + float(abs(L[step_here] - L[self.anchor[at]])))
        return len(self.segments) - 1

    def draw(self, found: Ints) -> int:
        """One of those that fit; the same again of an interval that was asked for before."""
        begins, ends = self.t.start[found], self.t.end[found]
        if (begins != begins[0]).any() or (ends != ends[0]).any():
            return int(found[self.choose(found)])
        key = int(begins[0]), int(ends[0])
        if key not in self.drawn:
            self.drawn[key] = int(found[self.choose(found)])
        return self.drawn[key]

    def grows(self, k: int) -> bool:
        """Is place k near enough to the root to be gone on from?"""
        far = self.local_length and self.travelled[k] > self.local_length
        return not (far or (self.local_depth and self.depth[k] >= self.local_depth))

    def settle(self, k: int) -> list[int]:
        """Places of what shares a frame with place k, and with those in turn; place k first."""
        found, g, t, segmap = [k], self.segmap.group, self.t, self.segmap
        for k in found:  # grows as it goes
            if not self.grows(k):
                continue
            i, begin = self.segments[k], self.intervals[k][0]
            source, T, entry = self.root.source, self.root.link, self.root.entry
            if k:
                source, T, entry = int(t.source[i]), t.link[i], t.entry[i]
            if source >= 0 and t.alive[source] and self.free(int(t.start[source]), int(t.end[source])):
                T = cast(Array, T)
                # the way goes on from where the body stood in the entered map
                found.append(self.add(source, k, nearest_step(segmap, source, g.compose(g.inverse(T), entry)), begin))
                self.frames.linked(k, T)
            entering = segmap.entering(i)
            for begin, end in dict.fromkeys(zip(t.start[entering].tolist(), t.end[entering].tolist())):
                if not self.free(begin, end):
                    continue
                rivals = segmap.beginning_at(begin)
                chosen = self.draw(rivals[t.end[rivals] == end])
                if t.source[chosen] != i:
                    continue  # particles of that time that went another way
                T = g.inverse(t.link[chosen])
                found.append(self.add(chosen, k, begin, nearest_step(segmap, i, g.compose(T, t.entry[chosen]))))
                self.frames.linked(k, T)
        return found

    def links(self, level: list[int]) -> list[tuple[int, int]]:
        """Where places of a level go on: place and direction in time."""
        out = []
        for k in level:
            if self.grows(k):
                out.append((k, _BEFORE))
                if self.segments[k] != OPEN:
                    out.append((k, _AFTER))
        return out

    def join(self, k: int, direction: int) -> list[int]:
        """Add what comes before or after place k, if anything fits; the new places."""
        begin, end = self.intervals[k]
        at = begin if direction == _BEFORE else end
        there = self.fits(self.segmap.ending_at(at) if direction == _BEFORE else self.segmap.beginning_at(at))
        if not len(there):
            return []
        chosen = self.draw(there)
        place = self.add(chosen, k, at, at)
        self.frames.joined(k, self.segments[k], chosen, direction)
        return self.settle(place)

    def sample(self) -> MapSample:
        """What has grown."""
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
    """Step of a segment at which its body stood nearest to a pose in its frame."""
    path = cast(Array, segmap.table.paths[index])
    d = path[:, : segmap.group.dim] - np.asarray(T_segment_body)[: segmap.group.dim]
    return int(segmap.table.start[index]) + int(np.argmin(np.einsum("ni,ni->n", d, d)))
