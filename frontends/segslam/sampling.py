"""Map samples: one path through the SegMap, with the pose of every submap on it (SegSLAM section 3.3).

A sample begins at one segment and grows breadth-first along two kinds of links: to segments that end where one begins
(or begin where it ends), any of which will do (A6), and from a segment that entered an older map to the one it
entered. So after a loop closure older submaps stand where the closure says, not where the long way round would put
them. Among links of equal depth the order is random.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt

from frontends.segslam.poses import frame_between
from frontends.segslam.segmap import NEW, Entry, SegMap
from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.trajectory import Trajectory

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
    return grow_by(
        segmap,
        root,
        lambda n: [int(k) for k in rng.permutation(n)],
        lambda p: int(rng.choice(len(p), p=p)) if len(p) > 1 else 0,
        weights=weights,
        local_length=local_length,
        local_depth=local_depth,
    )


def grow_by(
    segmap: SegMap,
    root: Root,
    order: Callable[[int], list[int]],
    choose: Callable[[Array], int],
    *,
    weights: Array | None = None,
    local_length: float = 0.0,
    local_depth: int = 0,
) -> MapSample:
    """As :func:`grow`, with the two kinds of choice given.

    Parameters
    ----------
    order : callable
        Number of links of a level → the order in which they are taken.
    choose : callable
        Probabilities ``(k,)`` of the segments that fit → which of them.
    """
    g, t = segmap.group, segmap.table
    L = segmap.path_length
    segments, poses, via, depth = [root.segment], [g.identity], [-1], [0]
    intervals, anchor, travelled = [(root.start, root.end)], [root.anchor], [0.0]

    def fits(candidates: Ints) -> Ints:
        """Candidates that do not overlap in time with what is there."""
        taken = np.array(intervals, np.int64)
        clash = (t.start[candidates, None] < taken[None, :, 1]) & (taken[None, :, 0] < t.end[candidates, None])
        return candidates[~clash.any(axis=1)]

    def add(index: int, T_from_it: Array, at: int, step_there: int, step_here: int) -> None:
        segments.append(index)
        poses.append(g.compose(poses[at], T_from_it))
        via.append(at)
        depth.append(depth[at] + 1)
        intervals.append((int(t.start[index]), int(t.end[index])))
        anchor.append(step_there)
        travelled.append(travelled[at] + float(abs(L[step_here] - L[anchor[at]])))

    level = [0]
    while level:
        links: list[tuple[int, str]] = []
        for k in level:
            if (local_length and travelled[k] > local_length) or (local_depth and depth[k] >= local_depth):
                continue
            links.append((k, "before"))
            if segments[k] != OPEN:
                links.append((k, "after"))
            source = root.source if k == 0 else int(t.source[segments[k]])
            if source >= 0 and t.alive[source]:
                links.append((k, "entered"))
        level = []
        for j in order(len(links)):
            k, direction = links[j]
            i = segments[k]
            entry, source, link = (
                (root.entry, root.source, root.link) if k == 0 else (t.entry[i], t.source[i], t.link[i])
            )
            begin, end = intervals[k]
            if direction == "entered":
                if not len(fits(np.array([source], np.int64))):
                    continue
                chosen = int(source)
                # the way goes on from where the body stood in the entered map
                there = nearest_step(segmap, chosen, g.compose(g.inverse(cast(Array, link)), entry))
                add(chosen, cast(Array, link), k, there, begin)
            else:
                candidates = fits(segmap.ending_at(begin) if direction == "before" else segmap.beginning_at(end))
                if not len(candidates):
                    continue
                chosen = int(candidates[choose(_probabilities(candidates, weights))])
                if direction == "before":
                    # T_here_before: both know the body at the boundary (A6)
                    T = frame_between(entry, t.exit[chosen], gravity=segmap.gravity)
                    add(chosen, T, k, begin, begin)
                else:
                    leave = cast(Array, root.exit) if k == 0 else t.exit[i]
                    T = frame_between(leave, t.entry[chosen], gravity=segmap.gravity)
                    add(chosen, T, k, end, end)
            level.append(len(segments) - 1)
    return MapSample(
        segments=np.array(segments, np.int64),
        poses=np.stack(poses),
        via=np.array(via, np.int64),
        depth=np.array(depth, np.int64),
        intervals=np.array(intervals, np.int64),
        anchor=np.array(anchor, np.int64),
        travelled=np.array(travelled),
    )


def nearest_step(segmap: SegMap, index: int, T_segment_body: Array) -> int:
    """Step of a segment at which its body stood nearest to a pose in its frame."""
    path = cast(Array, segmap.table.paths[index])
    d = path[:, : segmap.group.dim] - np.asarray(T_segment_body)[: segmap.group.dim]
    return int(segmap.table.start[index]) + int(np.argmin(np.einsum("ni,ni->n", d, d)))


def concatenate(segmap: SegMap, sample: MapSample, open_path: Array | None = None) -> Trajectory:
    """The path of a sample in the frame of its root (A6, eq. 11–12).

    A boundary stands in two segments; its pose is that of the exit.

    Parameters
    ----------
    segmap : SegMap
    sample : MapSample
    open_path : (n, 7) or (n, 3), optional
        ``T_segment_body`` of an open root, from its start to the step of now; without it the path ends where that
        begins.

    Raises
    ------
    DataError
        Nothing but an open root whose path is not given.
    """
    g = segmap.group
    steps: list[Ints] = []
    poses: list[Array] = []
    last = -1
    for k in sample.in_time.tolist():
        i, (a, b) = int(sample.segments[k]), sample.intervals[k]
        path = open_path if i == OPEN else segmap.table.paths[i]
        if path is None:
            continue
        rows = np.asarray(path, dtype=np.float64)
        if i == OPEN and len(rows) != b - a + 1:
            raise DataError("the path of the open segment has the wrong length", got=len(rows), wanted=int(b - a + 1))
        new = np.arange(a, b + 1)
        skip = 1 if a == last else 0
        steps.append(new[skip:].astype(np.int64))
        poses.append(g.compose(np.broadcast_to(sample.poses[k], rows.shape), rows)[skip:])
        last = int(b)
    if not steps:
        raise DataError("a sample without any path", wanted="a closed segment, or the path of the open one")
    s = np.concatenate(steps)
    return Trajectory(segmap.times[s], np.concatenate(poses))


def _probabilities(candidates: Ints, weights: Array | None) -> Array:
    n = len(candidates)
    if weights is None:
        return np.full(n, 1.0 / n)
    w = np.asarray(weights, dtype=np.float64)[candidates]
    return w / w.sum() if w.sum() > 0 else np.full(n, 1.0 / n)
