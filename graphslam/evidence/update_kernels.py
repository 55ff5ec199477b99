"""Second phase of inserting a scan, compiled: *apply* the marks of :mod:`mark_kernels` to the maps.

The path to each marked brick is resolved once (copy-on-write), then whole lines of voxels are updated. Marking changes
no map, and applying cannot run out of memory, because capacity was reserved before. Scratch arrays as in
:mod:`mark_kernels`, tree arrays as in :mod:`tree_kernels`.
"""

from __future__ import annotations

import numpy as np

from graphslam.core.jit import callee
from graphslam.evidence.kernels import kernel
from graphslam.evidence.prefetch_kernels import prefetch
from graphslam.evidence.tree_kernels import clone_node, drop_brick, set_occupied, take_brick, take_node

AHEAD = 4
"""Prefetch distance [bricks]."""
PENDING = 4
"""Index in the counters of a pool: 1 while an update is between its phases and its trees are not valid."""


@callee
def find_identical_write(s, source, marks64, table, made, made_marks):
    """Row in ``made`` of the brick with this source and these marks; a new last row if there is none, -1 if ``made``
    is full.

    ``made (M, 4) int64``: [source, target, hash, index in the table], row 0 the number of rows in use;
    ``made_marks (M + 1, 16) uint64``: two bits per voxel; ``table (T,) int32``: rows, or -1; T a power of two, at least
    2 M. Source and marks are compared in full; the hash only selects candidates.
    """
    n = made[0, 0]
    for k in range(16):  # written to its final row if it is new
        a, b, c, d = marks64[s, k], marks64[s, 16 + k], marks64[s, 32 + k], marks64[s, 48 + k]
        made_marks[n, k] = a | (b << np.uint64(2)) | (c << np.uint64(4)) | (d << np.uint64(6))
    # four independent chains for speed; no product, because without numba its overflow raises a warning
    h, h1, h2, h3 = np.uint64(source), np.uint64(0), np.uint64(0), np.uint64(0)
    left, right = np.uint64(13), np.uint64(7)
    for k in range(4):
        h, h1 = h ^ made_marks[n, k], h1 ^ made_marks[n, 4 + k]
        h2, h3 = h2 ^ made_marks[n, 8 + k], h3 ^ made_marks[n, 12 + k]
        h, h1, h2, h3 = h ^ (h << left), h1 ^ (h1 << left), h2 ^ (h2 << left), h3 ^ (h3 << left)
        h, h1, h2, h3 = h ^ (h >> right), h1 ^ (h1 >> right), h2 ^ (h2 >> right), h3 ^ (h3 >> right)
    h ^= (h1 << np.uint64(17)) ^ (h1 >> np.uint64(47)) ^ (h2 << np.uint64(31)) ^ (h2 >> np.uint64(33))
    h ^= (h3 << np.uint64(43)) ^ (h3 >> np.uint64(21))
    h ^= h << left
    h ^= h >> right
    h ^= h << np.uint64(17)
    mixed = np.int64(h >> np.uint64(1))
    last = table.shape[0] - 1
    i = mixed & last
    while table[i] >= 0:
        t = np.int64(table[i])
        if made[t, 2] == mixed and made[t, 0] == source:
            differ = np.uint64(0)
            for k in range(16):
                differ |= made_marks[n, k] ^ made_marks[t, k]
            if differ == np.uint64(0):
                return t
        i = (i + 1) & last
    if n == made.shape[0]:
        return np.int64(-1)
    table[i] = n
    made[n, 0], made[n, 1], made[n, 2], made[n, 3] = source, 0, mixed, i
    made[0, 0] = n + 1
    return n


@kernel()
def resolve_writes(
    begin,
    end,
    roots,
    ends,
    levels,
    slot_key,
    marks64,
    work,
    share,
    table,
    made,
    made_marks,
    children,
    node_ref,
    node_occupied,
    brick_ref,
    node_free,
    brick_free,
    counters,
):
    """Make the paths to the marked bricks of grids ``begin … end-1`` unshared, and assign a target brick to each slot.

    ``work (S, 5)`` becomes [parent node, child, source, target, state]. Source equals target if the brick has no other
    parent. Bricks with the same source and the same marks will be equal, so several grids get one target: particles
    from one parent have equal marks in most bricks for some scans, and these bricks stay shared. State is 0, or ~source
    if another slot writes the target. Sources keep all their parents until :func:`release_sources` at the end of the
    update, so that sharing does not depend on the order of the grids. From here to :func:`finalise_writes`,
    ``counters[PENDING]`` is 1 and the trees are not valid. Capacity must be reserved.

    ``share``: find equal bricks within this update, with ``table, made, made_marks`` of the scratch. The loop over
    bricks is inside, because a call with a dozen arrays per brick would take longer than the work.
    """
    path = np.empty(8, np.int64)
    s = 0
    for g in range(begin, end):
        path[levels - 1] = roots[g]
        px, py, pz = 0, 0, 0
        known = levels - 1  # lowest level at which path is valid
        while s < ends[g]:
            key = slot_key[s]
            bx, by, bz = key & 0xFFFFF, (key >> 20) & 0xFFFFF, key >> 40
            # go up to the lowest common node of this brick and the last one
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
            target, state = source, 0
            work[s, 2] = source
            if source == 0 or brick_ref[source] > 1:
                twin = find_identical_write(s, source, marks64, table, made, made_marks) if share else np.int64(-1)
                if twin >= 0 and made[twin, 1] != 0:
                    target, state = made[twin, 1], ~source
                    brick_ref[target] += 1
                else:
                    target = take_brick(brick_ref, brick_free, counters)
                    if twin >= 0:
                        made[twin, 1] = target
                children[parent, c] = target
            work[s, 0] = parent
            work[s, 1] = c
            work[s, 3] = target
            work[s, 4] = state
            s += 1
    counters[PENDING] = 1


@callee
def _fetch(s, marks64, work, bricks):
    """Prefetch the lines of a slot's bricks that will be read or written."""
    source, target = np.int64(work[s, 2]), np.int64(work[s, 3])
    if work[s, 4] < 0:
        return
    for line in range(16):
        k = 4 * line
        if source != target:
            prefetch(bricks, source, 32 * line)
            prefetch(bricks, target, 32 * line)
        elif (marks64[s, k] | marks64[s, k + 1] | marks64[s, k + 2] | marks64[s, k + 3]) != np.uint64(0):
            prefetch(bricks, target, 32 * line)


@callee
def carry_flag(s, root, lines, levels, slot_key, work, children, node_occupied):
    """If the occupancy flag of a slot's brick changed, update the flags on its path in the tree."""
    bit = (node_occupied[work[s, 0]] >> np.uint64(work[s, 1])) & np.uint64(1)
    if (bit != np.uint64(0)) != (lines != 0):
        key = slot_key[s]
        bx, by, bz = key & 0xFFFFF, (key >> 20) & 0xFFFFF, key >> 40
        set_occupied(root, bx, by, bz, levels, lines != 0, children, node_occupied)


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
    """Write the bricks of grids ``begin … end-1``: target = source updated by its marks; then the marks are cleared.

    Brick 0 as a source is an unobserved brick. Lines without marks are copied, or skipped if source and target are the
    same brick, because a planar scanner marks few lines of a brick and with many particles the bricks are not in the
    cache. For vectorisation, all arithmetic is in int16, and there are separate loops for update in place and for copy.
    Values are clamped before the step is added, not after, because values of a file may be anywhere and could
    overflow. Calling it again after an interruption gives the same result.
    """
    miss, hit, low, high, threshold = steps[0], steps[1], steps[2], steps[3], steps[4]
    s = 0
    last = ends[end - 1]
    for s in range(min(AHEAD, last)):
        _fetch(s, marks64, work, bricks)
    s = 0
    for g in range(begin, end):
        while s < ends[g]:
            next_s = s + AHEAD
            if next_s < last:
                _fetch(next_s, marks64, work, bricks)
            if work[s, 4] < 0:  # another slot writes this brick
                for k in range(64):
                    marks64[s, k] = np.uint64(0)
                s += 1
                continue
            source, target = np.int64(work[s, 2]), np.int64(work[s, 3])
            lines = np.int64(brick_lines[source])
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
            carry_flag(s, roots[g], lines, levels, slot_key, work, children, node_occupied)
            s += 1


@kernel()
def finalise_writes(
    begin, end, roots, ends, levels, slot_key, work, children, node_occupied, brick_lines, left, counters
):  # fmt: skip
    """After all threads wrote their bricks: set the flags of bricks that another slot wrote, and add the copied sources
    to ``left (n,) int64`` (element 0 is their number). Calling it again gives the same result.
    """
    s = 0
    for g in range(begin, end):
        while s < ends[g]:
            source = np.int64(work[s, 4])
            if source < 0:
                source = ~source
                lines = np.int64(brick_lines[work[s, 3]])
                carry_flag(s, roots[g], lines, levels, slot_key, work, children, node_occupied)
            if source != 0:
                left[0] += 1
                left[left[0]] = source
            work[s, 4] = 0
            s += 1
    counters[PENDING] = 0


@kernel()
def release_sources(left, brick_ref, brick_free, counters):
    """Decrease the parent count of each source brick that was replaced by a copy."""
    for k in range(left[0]):
        drop_brick(left[k + 1], brick_ref, brick_free, counters)
    left[0] = 0
