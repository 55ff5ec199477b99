"""Seams of a path through segments: where loops bend it."""

from __future__ import annotations

from itertools import pairwise

from graphslam.core.geometry import Array
from graphslam_frontends.segslam.sampling import OPEN, MapSample
from graphslam_frontends.segslam.segmap import SegMap


def find_seams(segmap: SegMap, sample: MapSample) -> list[tuple[int, int, Array]]:
    """Where segments follow each other in time that the sample did not link, and what is missing between them.

    Returns
    -------
    list of (a, b, T)
        Places in the sample of the segment before and the one after, and ``T_bodybefore_bodyafter`` at the boundary
        they share: the identity if all loops closed exactly.
    """
    g, t = segmap.group, segmap.table
    order = sample.in_time.tolist()
    found = []
    for a, b in pairwise(order):
        if sample.intervals[a, 1] != sample.intervals[b, 0] or OPEN in (sample.segments[a], sample.segments[b]):
            continue
        if sample.via[a] == b or sample.via[b] == a:
            continue
        before = g.compose(sample.poses[a], t.exit[sample.segments[a]])
        after = g.compose(sample.poses[b], t.entry[sample.segments[b]])
        found.append((a, b, g.between(before, after)))
    return found
