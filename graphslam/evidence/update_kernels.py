"""Compiled insertion of scans, in two phases: *mark* what the beams cross, then *apply* each voxel's mark once.

Marking needs no map: it writes one byte a voxel into scratch bricks that a small table around the sensor finds (64³
entries by the low bits of a brick's coordinates; bricks that fall on the same entry are chained, so that a scan may be
of any extent). Applying resolves the path to each touched brick once (copy-on-write) and then works on whole lines of
voxels. A scan that is half marked has changed no map, and applying cannot fail, since room was reserved before.

Scratch arrays: ``window (64³,) int32`` first slot of an entry or -1, ``slot_key (S,) int64`` packed brick coordinates,
``slot_next (S,) int32`` next slot of the entry or -1, ``marks (S, 512) uint8`` (``marks64 (S, 64) uint64`` is the same
memory), ``work (S, 5) int32``; between scans the window is all -1 and the marks are all 0. Scans are ``points (n, 3)``,
``origins (n, 3) or (1, 3)``, ``returns (n,) or (0,) uint8``; poses ``(P, 12)`` are R row by row, then t [m].
"""

from __future__ import annotations

import math

import numba
import numpy as np

from graphslam.evidence.tree_kernels import (
    clone_node,
    drop_brick,
    set_occupied,
    take_brick,
    take_node,
)

# what a tally counts, per call
RAYS, NOT_FINITE, ZERO_LENGTH, OUTSIDE, CUT, BRICKS, NEED_SLOTS = 0, 1, 2, 3, 4, 5, 6
TALLY = 7
# place in the pool's counters
PENDING = 4


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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def mark_grids(
    begin,
    end,
    poses,
    points,
    origins,
    returns,
    max_range,
    scale,
    half,
    ends,
    window,
    slot_key,
    slot_next,
    marks,
    tally,
):
    """Mark what a scan crosses in grids ``begin … end-1``, whose slots follow each other from 0 on.

    ``ends (P,)`` becomes the end of each grid's slots. Returns whether the slots sufficed; if not, ``tally`` says how
    many to have, and the scratch must be made anew.

    Amanatides & Woo's traversal in voxel coordinates (``scale`` = 1 / voxel size), from the voxel of the origin up to
    but not including the voxel of the end, which is marked as hit if the beam returned and was not cut.
    """
    n = 0
    capacity = slot_key.shape[0]
    single = origins.shape[0] == 1
    all_return = returns.shape[0] == 0
    edge = 2 * half
    full = False
    for g in range(begin, end):
        first = n
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
            ox = (poses[g, 0] * lx + poses[g, 1] * ly + poses[g, 2] * lz + poses[g, 9]) * scale + half
            oy = (poses[g, 3] * lx + poses[g, 4] * ly + poses[g, 5] * lz + poses[g, 10]) * scale + half
            oz = (poses[g, 6] * lx + poses[g, 7] * ly + poses[g, 8] * lz + poses[g, 11]) * scale + half
            f = cut * scale
            vx = (poses[g, 0] * dx + poses[g, 1] * dy + poses[g, 2] * dz) * f
            vy = (poses[g, 3] * dx + poses[g, 4] * dy + poses[g, 5] * dz) * f
            vz = (poses[g, 6] * dx + poses[g, 7] * dy + poses[g, 8] * dz) * f
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
            sx, sy, sz = (1 if ex > x else -1), (1 if ey > y else -1), (1 if ez > z else -1)
            # parameter of the next crossing on each axis, and from one crossing to the next; an axis on which the ends
            # share a voxel is never stepped, also where the origin lies on a plane and the beam leaves it by a rounding
            ix = 1.0 / abs(vx) if ex != x else np.inf
            iy = 1.0 / abs(vy) if ey != y else np.inf
            iz = 1.0 / abs(vz) if ez != z else np.inf
            tx = (x + 1 - ox if ex > x else ox - x) * ix if ex != x else np.inf
            ty = (y + 1 - oy if ey > y else oy - y) * iy if ey != y else np.inf
            tz = (z + 1 - oz if ez > z else oz - z) * iz if ez != z else np.inf
            bx, by, bz = -1, -1, -1
            slot = -1
            while steps > 0:
                if (x >> 3) != bx or (y >> 3) != by or (z >> 3) != bz:
                    if min(x, y, z) < 0 or max(x, y, z) >= edge:
                        break  # an end on the cube's own face, passed by a rounding of the parameters
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
        # empty the entries of this grid's slots
        for s in range(first, n):
            key = slot_key[s]
            window[(((key >> 40) & 63) << 12) | (((key >> 20) & 63) << 6) | (key & 63)] = -1
        if full:
            tally[NEED_SLOTS] = 2 * capacity
            return False
        ends[g] = n
    return True


@numba.njit(cache=True, nogil=True)
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


@numba.njit(cache=True, nogil=True)
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
    Arithmetic stays in int16 after each operation, or it is not vectorised (the model's range keeps it from overflow);
    so does having one loop that reads and writes one brick and another that copies. Applying twice is applying once.
    """
    miss, hit, low, high, threshold = steps[0], steps[1], steps[2], steps[3], steps[4]
    s = 0
    for g in range(begin, end):
        while s < ends[g]:
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
            if source != target:
                work[s, 2], work[s, 4] = target, source
            # carry the brick's flag up the tree where it changed
            bit = (node_occupied[work[s, 0]] >> np.uint64(work[s, 1])) & np.uint64(1)
            if (bit != np.uint64(0)) != (lines != 0):
                key = slot_key[s]
                bx, by, bz = key & 0xFFFFF, (key >> 20) & 0xFFFFF, key >> 40
                set_occupied(roots[g], bx, by, bz, levels, lines != 0, children, node_occupied)
            s += 1


@numba.njit(cache=True, nogil=True)
def drop_sources(end, work, brick_ref, brick_free, counters):
    """Take one parent from the bricks that were copied."""
    for s in range(end):
        if work[s, 4] != 0:
            drop_brick(np.int64(work[s, 4]), brick_ref, brick_free, counters)
            work[s, 4] = 0
    counters[PENDING] = 0
