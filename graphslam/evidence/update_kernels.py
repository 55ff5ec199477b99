"""Second phase of inserting a scan, compiled: *apply* the marks of :mod:`mark_kernels` to the maps.

The path to each touched brick is resolved once (copy-on-write), then whole lines of voxels are worked on. A scan that
is half marked has changed no map, and applying cannot fail, since room was reserved before. Scratch arrays as in
:mod:`mark_kernels`, tree arrays as in :mod:`tree_kernels`.
"""

from __future__ import annotations

import numpy as np

from graphslam.evidence.kernel import kernel
from graphslam.evidence.prefetch import prefetch
from graphslam.evidence.tree_kernels import clone_node, drop_brick, set_occupied, take_brick, take_node

AHEAD = 4
"""Bricks that memory is asked for before the one that is worked on."""
PENDING = 4
"""Place in the pool's counters: an update is between its phases, and its trees are no maps."""


@kernel()
def resolve_grids(
    begin,
    end,
    roots,
    ends,
    levels,
    slot_key,
    work,
    children,
    node_ref,
    node_occupied,
    brick_ref,
    node_free,
    brick_free,
    counters,
):
    """Own the paths to the bricks of the slots of grids ``begin … end-1``, and a brick at the end of each.


    ``work (S, 5)`` becomes [parent node, child, source, target, 0]. Source equals target where the brick is nobody
    else's; a copied brick keeps all its parents until :func:`drop_sources`, when everybody has read it. From here to
    there ``counters[PENDING]`` is set: the trees are no maps. Room was
    reserved. The loops are inside: handing a dozen arrays to a function for every brick would cost more than the work.
    """
    path = np.empty(8, np.int64)
    s = 0
    for g in range(begin, end):
        path[levels - 1] = roots[g]
        px, py, pz = 0, 0, 0
        known = levels - 1  # lowest level at which path holds
        while s < ends[g]:
            key = slot_key[s]
            bx, by, bz = key & 0xFFFFF, (key >> 20) & 0xFFFFF, key >> 40
            # climb to the lowest node that this brick shares with the last one
            differ = ((bx ^ px) | (by ^ py) | (bz ^ pz)) >> 2
            level = known
            if level == 0:
                while differ != 0:
                    differ >>= 2
                    level += 1
            px, py, pz = bx, by, bz
            known = 0
            while level > 0:
                shift = 2 * level
                c = (((bz >> shift) & 3) << 4) | (((by >> shift) & 3) << 2) | ((bx >> shift) & 3)
                node = path[level]
                child = np.int64(children[node, c])
                level -= 1
                if child == 0:
                    child = take_node(children, node_ref, node_occupied, node_free, counters)
                    children[node, c] = child
                elif node_ref[child] > 1:
                    child = clone_node(child, level, children, node_ref, node_occupied, brick_ref, node_free, counters)
                    children[node, c] = child
                path[level] = child
            parent = path[0]
            c = ((bz & 3) << 4) | ((by & 3) << 2) | (bx & 3)
            source = np.int64(children[parent, c])
            target = source
            if source == 0 or brick_ref[source] > 1:
                target = take_brick(brick_ref, brick_free, counters)
                children[parent, c] = target
            work[s, 0] = parent
            work[s, 1] = c
            work[s, 2] = source
            work[s, 3] = target
            work[s, 4] = 0
            s += 1
    counters[PENDING] = 1


@kernel()
def _fetch(s, marks64, work, bricks):
    """Ask for the lines of a slot's bricks that will be read or written."""
    source, target = np.int64(work[s, 2]), np.int64(work[s, 3])
    for line in range(16):
        k = 4 * line
        if source != target:
            prefetch(bricks, source, 32 * line)
            prefetch(bricks, target, 32 * line)
        elif (marks64[s, k] | marks64[s, k + 1] | marks64[s, k + 2] | marks64[s, k + 3]) != np.uint64(0):
            prefetch(bricks, target, 32 * line)


@kernel()
def apply_grids(
    begin,
    end,
    roots,
    ends,
    levels,
    steps,
    slot_key,
    marks,
    marks64,
    work,
    children,
    node_occupied,
    bricks,
    brick_lines,
):
    """Write the bricks of grids ``begin … end-1``: each target is its source updated by its marks, which are cleared.

    Brick 0 as a source is a brick nobody has seen. Lines without marks are copied, or not touched at all: a planar
    scanner marks few lines of the bricks it crosses, and with many particles the bricks are not in the cache.
    Arithmetic stays in int16 after each operation, or it is not vectorised; so does having one loop that reads and
    writes one brick and another that copies. Values are bounded before the step is added and not after: those of a
    file may lie anywhere, and would overflow. Applying twice is applying once.
    """
    miss, hit, low, high, threshold = steps[0], steps[1], steps[2], steps[3], steps[4]
    s = 0
    last = ends[end - 1]
    for s in range(min(AHEAD, last)):
        _fetch(s, marks64, work, bricks)
    s = 0
    for g in range(begin, end):
        while s < ends[g]:
            source, target = np.int64(work[s, 2]), np.int64(work[s, 3])
            lines = np.int64(brick_lines[source])
            next_s = s + AHEAD
            if next_s < last:
                _fetch(next_s, marks64, work, bricks)
            for line in range(16):
                k = 4 * line
                a = 32 * line
                if (marks64[s, k] | marks64[s, k + 1] | marks64[s, k + 2] | marks64[s, k + 3]) == np.uint64(0):
                    if source != target:
                        for j in range(32):
                            bricks[target, a + j] = bricks[source, a + j]
                    continue
                greatest = np.int16(-32768)
                if source == target:
                    for j in range(32):
                        v = bricks[target, a + j]
                        m = marks[s, a + j]
                        base = np.int16(0) if v == np.int16(-32768) else v
                        step = hit if m >= 2 else miss
                        least, most = np.int16(low - step), np.int16(high - step)
                        base = least if base < least else base
                        base = most if base > most else base
                        w = np.int16(base + step) if m != 0 else v
                        bricks[target, a + j] = w
                        greatest = max(greatest, w)
                else:
                    for j in range(32):
                        v = bricks[source, a + j]
                        m = marks[s, a + j]
                        base = np.int16(0) if v == np.int16(-32768) else v
                        step = hit if m >= 2 else miss
                        least, most = np.int16(low - step), np.int16(high - step)
                        base = least if base < least else base
                        base = most if base > most else base
                        w = np.int16(base + step) if m != 0 else v
                        bricks[target, a + j] = w
                        greatest = max(greatest, w)
                for i in range(4):
                    marks64[s, k + i] = np.uint64(0)
                if greatest >= threshold:
                    lines |= 1 << line
                else:
                    lines &= ~(1 << line)
            brick_lines[target] = lines
            if source != target:
                work[s, 2], work[s, 4] = target, source
            # carry the brick's flag up the tree where it changed
            bit = (node_occupied[work[s, 0]] >> np.uint64(work[s, 1])) & np.uint64(1)
            if (bit != np.uint64(0)) != (lines != 0):
                key = slot_key[s]
                bx, by, bz = key & 0xFFFFF, (key >> 20) & 0xFFFFF, key >> 40
                set_occupied(roots[g], bx, by, bz, levels, lines != 0, children, node_occupied)
            s += 1


@kernel()
def drop_sources(end, work, brick_ref, brick_free, counters):
    """Take one parent from the bricks that were copied."""
    for s in range(end):
        if work[s, 4] != 0:
            drop_brick(np.int64(work[s, 4]), brick_ref, brick_free, counters)
            work[s, 4] = 0
    counters[PENDING] = 0
