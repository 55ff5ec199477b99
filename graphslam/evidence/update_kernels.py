"""Compiled insertion of scans, in two phases: *mark* what the beams cross, then *apply* each voxel's mark once.

Marking needs no map: it writes one byte a voxel into scratch bricks that a small table around the sensor finds (64³
entries by the low bits of a brick's coordinates; bricks that fall on the same entry are chained, so that a scan may be
of any extent). Applying resolves the path to each touched brick once (copy-on-write) and then works on whole lines of
voxels. A scan that is half marked has changed no map, and applying cannot fail, since room was reserved before.

Scratch arrays: ``window (64³,) int32`` first slot of an entry or -1, ``slot_key (S,) int64`` packed brick coordinates,
``slot_next (S,) int32`` next slot of the entry or -1, ``marks (S, 512) uint8``
(``marks64 (S, 64)`` is the same memory), ``work (S, 4) int32``; between scans the window is all -1 and
the marks are all 0. Scans are ``points (n, 3)``, ``origins (n, 3) or (1, 3)``, ``returns (n,) or (0,) uint8``; poses
``(12,)`` are R row by row, then t [m].
"""

from __future__ import annotations

import math

import numba
import numpy as np

from graphslam.evidence.tree_kernels import (
    clone_node,
    drop_brick,
    free_bricks,
    free_nodes,
    set_occupied,
    take_brick,
    take_node,
)

# what a tally counts, per call
RAYS, NOT_FINITE, ZERO_LENGTH, OUTSIDE, CUT, BRICKS, NEED_SLOTS, NEED_NODES, NEED_BRICKS = 0, 1, 2, 3, 4, 5, 6, 7, 8


@numba.njit(cache=True, nogil=True)
def find_slot(bx, by, bz, window, slot_key, slot_next):
    """Slot of a brick, or -1."""
    key = (bz << 40) | (by << 20) | bx
    s = int(window[((bz & 63) << 12) | ((by & 63) << 6) | (bx & 63)])
    while s >= 0 and slot_key[s] != key:
        s = int(slot_next[s])
    return s


@numba.njit(cache=True, nogil=True)
def add_slot(bx, by, bz, n, window, slot_key, slot_next):
    """Make slot n that of a brick."""
    w = ((bz & 63) << 12) | ((by & 63) << 6) | (bx & 63)
    slot_key[n] = (bz << 40) | (by << 20) | bx
    slot_next[n] = window[w]
    window[w] = n


@numba.njit(cache=True, nogil=True)
def clear_window(first, n, window, slot_key):
    """Empty the entries of slots first … n-1."""
    for s in range(first, n):
        key = slot_key[s]
        window[(((key >> 40) & 63) << 12) | (((key >> 20) & 63) << 6) | (key & 63)] = -1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def mark_scan(pose, points, origins, returns, max_range, scale, half, first, window, slot_key, slot_next, marks, tally):
    """Mark what a scan crosses in slots ``first …``; returns their end, or -1 where the slots do not suffice.

    Amanatides & Woo's traversal in voxel coordinates (``scale`` = 1 / voxel size), from the voxel of the origin up to
    but not including the voxel of the end, which is marked as hit if the beam returned and was not cut.
    """
    n = first
    capacity = slot_key.shape[0]
    single = origins.shape[0] == 1
    all_return = returns.shape[0] == 0
    edge = 2 * half
    full = False
    for b in range(points.shape[0]):
        o = 0 if single else b
        lx, ly, lz = origins[o, 0], origins[o, 1], origins[o, 2]
        dx, dy, dz = points[b, 0] - lx, points[b, 1] - ly, points[b, 2] - lz
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        if not length < np.inf:  # neither of two infinities nor of a NaN
            tally[NOT_FINITE] += 1
            continue
        if length == 0.0:
            tally[ZERO_LENGTH] += 1
            continue
        hit = all_return or returns[b] != 0
        cut = 1.0
        if length > max_range:
            cut = max_range / length
            hit = False
        # voxel coordinates, shifted so that they are not negative in the addressable cube
        ox = (pose[0] * lx + pose[1] * ly + pose[2] * lz + pose[9]) * scale + half
        oy = (pose[3] * lx + pose[4] * ly + pose[5] * lz + pose[10]) * scale + half
        oz = (pose[6] * lx + pose[7] * ly + pose[8] * lz + pose[11]) * scale + half
        f = cut * scale
        vx = (pose[0] * dx + pose[1] * dy + pose[2] * dz) * f
        vy = (pose[3] * dx + pose[4] * dy + pose[5] * dz) * f
        vz = (pose[6] * dx + pose[7] * dy + pose[8] * dz) * f
        px, py, pz = ox + vx, oy + vy, oz + vz
        inside = (
            min(ox, px) >= 0.0
            and min(oy, py) >= 0.0
            and min(oz, pz) >= 0.0
            and max(ox, px) < edge
            and max(oy, py) < edge
            and max(oz, pz) < edge
        )
        if not inside:
            tally[OUTSIDE] += 1
            continue
        tally[RAYS] += 1
        if cut < 1.0:
            tally[CUT] += 1
        x, y, z = int(ox), int(oy), int(oz)
        ex, ey, ez = int(px), int(py), int(pz)
        steps = abs(ex - x) + abs(ey - y) + abs(ez - z)
        sx, sy, sz = (1 if vx > 0 else -1), (1 if vy > 0 else -1), (1 if vz > 0 else -1)
        # parameter of the next crossing on each axis, and from one crossing to the next
        ix = 1.0 / abs(vx) if vx != 0 else np.inf
        iy = 1.0 / abs(vy) if vy != 0 else np.inf
        iz = 1.0 / abs(vz) if vz != 0 else np.inf
        tx = (x + 1 - ox if vx > 0 else ox - x) * ix if vx != 0 else np.inf
        ty = (y + 1 - oy if vy > 0 else oy - y) * iy if vy != 0 else np.inf
        tz = (z + 1 - oz if vz > 0 else oz - z) * iz if vz != 0 else np.inf
        bx, by, bz = -1, -1, -1
        slot = -1
        while steps > 0:
            if (x >> 3) != bx or (y >> 3) != by or (z >> 3) != bz:
                bx, by, bz = x >> 3, y >> 3, z >> 3
                slot = find_slot(bx, by, bz, window, slot_key, slot_next)
                if slot < 0:
                    if n == capacity:
                        full = True
                        break
                    add_slot(bx, by, bz, n, window, slot_key, slot_next)
                    slot = n
                    n += 1
            row = marks[slot]
            # run to the edge of this brick
            while steps > 0:
                row[((z & 7) << 6) | ((y & 7) << 3) | (x & 7)] |= 1
                steps -= 1
                if tx < ty and tx < tz:
                    x += sx
                    tx += ix
                    if (x >> 3) != bx:
                        break
                elif ty < tz:
                    y += sy
                    ty += iy
                    if (y >> 3) != by:
                        break
                else:
                    z += sz
                    tz += iz
                    if (z >> 3) != bz:
                        break
        if full:
            break
        if hit:
            bx, by, bz = ex >> 3, ey >> 3, ez >> 3
            slot = find_slot(bx, by, bz, window, slot_key, slot_next)
            if slot < 0:
                if n == capacity:
                    full = True
                    break
                add_slot(bx, by, bz, n, window, slot_key, slot_next)
                slot = n
                n += 1
            marks[slot, ((ez & 7) << 6) | ((ey & 7) << 3) | (ex & 7)] |= 2
    clear_window(first, n, window, slot_key)
    if full:
        for s in range(first, n):
            for j in range(512):
                marks[s, j] = 0
        tally[NEED_SLOTS] = max(2 * capacity, capacity + 1)
        return -1
    return n


@numba.njit(cache=True, nogil=True)
def resolve_slots(
    begin,
    end,
    root,
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
    """Own the paths to the bricks of slots ``begin … end-1`` and a brick at the end of each; room was reserved.

    ``work (S, 4)`` becomes [parent node, child, source, target]. Source equals target where the brick is nobody
    else's; a copied brick keeps all its parents until :func:`drop_sources`, when everybody has read it. One function
    with the loop inside: handing a dozen arrays to a function for every brick would cost more than the work.
    """
    path = np.empty(8, np.int64)
    path[levels - 1] = root
    px, py, pz = 0, 0, 0
    known = levels - 1  # lowest level at which path holds
    for s in range(begin, end):
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


@numba.njit(cache=True, nogil=True)
def apply_slots(
    begin,
    end,
    root,
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
    """Write the bricks of slots ``begin … end-1``: each target is its source updated by the marks, which are cleared.

    Brick 0 as a source is a brick nobody has seen. Lines without marks are copied, or not touched at all: a planar
    scanner marks few lines of the bricks it crosses, and with many particles the bricks are not in the cache.
    Arithmetic stays in int16 after each operation, or it is not vectorised (the model's range keeps it from overflow);
    so does having one loop that reads and writes one brick and another that copies.
    """
    miss, hit, low, high, threshold = steps[0], steps[1], steps[2], steps[3], steps[4]
    for s in range(begin, end):
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
                    w = np.int16(base + (hit if m >= 2 else miss))
                    w = low if w < low else w
                    w = high if w > high else w
                    w = w if m != 0 else v
                    bricks[target, a + j] = w
                    greatest = max(greatest, w)
            else:
                for j in range(32):
                    v = bricks[source, a + j]
                    m = marks[s, a + j]
                    base = np.int16(0) if v == np.int16(-32768) else v
                    w = np.int16(base + (hit if m >= 2 else miss))
                    w = low if w < low else w
                    w = high if w > high else w
                    w = w if m != 0 else v
                    bricks[target, a + j] = w
                    greatest = max(greatest, w)
            for i in range(4):
                marks64[s, k + i] = np.uint64(0)
            if greatest >= threshold:
                lines |= 1 << line
            else:
                lines &= ~(1 << line)
        brick_lines[target] = lines
        # carry the brick's flag up the tree where it changed
        bit = (node_occupied[work[s, 0]] >> np.uint64(work[s, 1])) & np.uint64(1)
        if (bit != np.uint64(0)) != (lines != 0):
            key = slot_key[s]
            bx, by, bz = key & 0xFFFFF, (key >> 20) & 0xFFFFF, key >> 40
            set_occupied(root, bx, by, bz, levels, lines != 0, children, node_occupied)


@numba.njit(cache=True, nogil=True)
def drop_sources(end, work, brick_ref, brick_free, counters):
    """Take one parent from the bricks that were copied."""
    for s in range(end):
        if work[s, 2] != 0 and work[s, 2] != work[s, 3]:
            drop_brick(np.int64(work[s, 2]), brick_ref, brick_free, counters)


@numba.njit(cache=True, nogil=True)
def update_grids(
    begin,
    roots,
    poses,
    points,
    origins,
    returns,
    max_range,
    scale,
    half,
    levels,
    steps,
    children,
    node_ref,
    node_occupied,
    bricks,
    brick_ref,
    brick_lines,
    node_free,
    brick_free,
    counters,
    window,
    slot_key,
    slot_next,
    marks,
    marks64,
    work,
    tally,
):
    """Insert one scan into grids ``begin …``, one after another; returns the first that was not done.

    ``steps (5,) int16``: miss, hit, low, high, threshold. Where room is short it is asked for in ``tally``, and the
    grid it was for is as before. Roots are the caller's own.
    """
    counted = np.zeros(6, np.int64)
    for g in range(begin, roots.shape[0]):
        counted[:] = tally[:6]
        n = mark_scan(
            poses[g],
            points,
            origins,
            returns,
            max_range,
            scale,
            half,
            0,
            window,
            slot_key,
            slot_next,
            marks,
            tally,
        )
        short = n < 0
        if not short:
            # every touched brick may need itself and a path of its own; levels - 1 since the root is there
            need_nodes = n * (levels - 1)
            if free_bricks(brick_free, counters) < n or free_nodes(node_free, counters) < need_nodes:
                tally[NEED_BRICKS], tally[NEED_NODES] = n, need_nodes
                for s in range(n):
                    for j in range(64):
                        marks64[s, j] = np.uint64(0)
                short = True
        if short:
            tally[:6] = counted
            return g
        resolve_slots(
            0,
            n,
            roots[g],
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
        )
        apply_slots(
            0,
            n,
            roots[g],
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
        )
        drop_sources(n, work, brick_ref, brick_free, counters)
        tally[BRICKS] += n
    return roots.shape[0]
