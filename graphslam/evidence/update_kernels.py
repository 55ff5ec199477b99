"""Compiled insertion of scans, in two phases: *mark* what the beams cross, then *apply* each voxel's mark once.

Marking needs no map: it writes one byte a voxel into scratch bricks that a small table around the sensor finds (64³
entries by the low bits of a brick's coordinates; bricks that fall on the same entry are chained, so that a scan may be
of any extent). Applying resolves the path to each touched brick once (copy-on-write) and then works on whole lines of
voxels. A scan that is half marked has changed no map, and applying cannot fail, since room was reserved before.

Scratch arrays: ``window (64³,) int32`` first slot of an entry or -1, ``slot_key (S,) int64`` packed brick coordinates,
``slot_next (S,) int32`` next slot of the entry or -1, ``marks (S, 512) uint8``; between scans the window is all -1 and
the marks are all 0. Scans are ``points (n, 3)``, ``origins (n, 3) or (1, 3)``, ``returns (n,) or (0,) uint8``; poses
``(12,)`` are R row by row, then t [m].
"""

from __future__ import annotations

import math

import numba
import numpy as np

from graphslam.evidence.tree_kernels import drop_brick, free_bricks, free_nodes, own_parent, set_occupied, take_brick

# what a tally counts, per call
RAYS, NOT_FINITE, ZERO_LENGTH, OUTSIDE, CUT, BRICKS, NEED_SLOTS, NEED_NODES, NEED_BRICKS = 0, 1, 2, 3, 4, 5, 6, 7, 8


@numba.njit(cache=True, nogil=True)
def find_slot(bx, by, bz, n, window, slot_key, slot_next):
    """Slot of a brick, or -1; -2 - entry would be ambiguous, so the caller asks :func:`add_slot` to make one."""
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
                slot = find_slot(bx, by, bz, n, window, slot_key, slot_next)
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
            slot = find_slot(bx, by, bz, n, window, slot_key, slot_next)
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
def apply_line(source, target, line, row, miss, hit, low, high, threshold, bricks):
    """One line of 32 voxels from one brick to another; returns whether it holds an occupied voxel.

    Arithmetic stays in int16 after each operation, or it is not vectorised; the model's range keeps it from overflow.
    """
    src = bricks[source, 32 * line : 32 * line + 32]
    dst = bricks[target, 32 * line : 32 * line + 32]
    m = row[32 * line : 32 * line + 32]
    occupied = np.int16(0)
    for j in range(32):
        v = src[j]
        base = np.int16(0) if v == np.int16(-32768) else v
        w = np.int16(base + (hit if m[j] >= 2 else miss))
        w = low if w < low else w
        w = high if w > high else w
        w = w if m[j] != 0 else v
        dst[j] = w
        occupied |= np.int16(1) if w >= threshold else np.int16(0)
    return occupied != 0


@numba.njit(cache=True, nogil=True)
def apply_line_in_place(target, line, row, miss, hit, low, high, threshold, bricks):
    """As :func:`apply_line` on one brick; reading and writing through one name is what lets it be vectorised."""
    dst = bricks[target, 32 * line : 32 * line + 32]
    m = row[32 * line : 32 * line + 32]
    occupied = np.int16(0)
    for j in range(32):
        v = dst[j]
        base = np.int16(0) if v == np.int16(-32768) else v
        w = np.int16(base + (hit if m[j] >= 2 else miss))
        w = low if w < low else w
        w = high if w > high else w
        w = w if m[j] != 0 else v
        dst[j] = w
        occupied |= np.int16(1) if w >= threshold else np.int16(0)
    return occupied != 0


@numba.njit(cache=True, nogil=True)
def apply_marks(source, target, slot, miss, hit, low, high, threshold, bricks, brick_lines, marks, marks64):
    """Write ``target`` = ``source`` updated by the marks of a slot, which are cleared; lines without marks are copied.

    Brick 0 as a source is a brick nobody has seen. Returns whether the brick holds an occupied voxel.
    """
    lines = int(brick_lines[source])
    row = marks[slot]
    words = marks64[slot]
    for line in range(16):
        k = 4 * line
        if (words[k] | words[k + 1] | words[k + 2] | words[k + 3]) == np.uint64(0):
            if source != target:
                bricks[target, 32 * line : 32 * line + 32] = bricks[source, 32 * line : 32 * line + 32]
            continue
        if source == target:
            occupied = apply_line_in_place(target, line, row, miss, hit, low, high, threshold, bricks)
        else:
            occupied = apply_line(source, target, line, row, miss, hit, low, high, threshold, bricks)
        for i in range(4):
            words[k + i] = np.uint64(0)
        if occupied:
            lines |= 1 << line
        else:
            lines &= ~(1 << line)
    brick_lines[target] = lines
    return lines != 0


@numba.njit(cache=True, nogil=True)
def resolve_brick(
    root, key, levels, children, node_ref, node_occupied, brick_ref, node_free, brick_free, counters, out
):
    """Own the path to a brick and a brick of one's own at its end: ``out`` = [parent node, child, source, target].

    Source equals target where the brick is nobody else's; a copied brick has still all its parents (the caller takes
    one away when it has read it).
    """
    bx, by, bz = key & 0xFFFFF, (key >> 20) & 0xFFFFF, key >> 40
    if out[0] == 0 or (bx >> 2) != out[4] or (by >> 2) != out[5] or (bz >> 2) != out[6]:
        out[0] = own_parent(root, bx, by, bz, levels, children, node_ref, node_occupied, brick_ref, node_free, counters)
        out[4], out[5], out[6] = bx >> 2, by >> 2, bz >> 2
    parent = out[0]
    c = ((bz & 3) << 4) | ((by & 3) << 2) | (bx & 3)
    out[1] = c
    source = int(children[parent, c])
    out[2] = source
    if source != 0 and brick_ref[source] == 1:
        out[3] = source
    else:
        out[3] = take_brick(brick_ref, brick_free, counters)
        children[parent, c] = out[3]


@numba.njit(cache=True, nogil=True)
def note_occupied(root, key, levels, parent, c, occupied, children, node_occupied):
    """Carry a brick's flag up the tree where it changed."""
    if (((node_occupied[parent] >> np.uint64(c)) & np.uint64(1)) != np.uint64(0)) != occupied:
        set_occupied(root, key & 0xFFFFF, (key >> 20) & 0xFFFFF, key >> 40, levels, occupied, children, node_occupied)


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
    tally,
):
    """Insert one scan into grids ``begin …``, one after another; returns the first that was not done.

    ``steps (5,) int16``: miss, hit, low, high, threshold. Where room is short it is asked for in ``tally``, and the
    grid it was for is as before. Roots are the caller's own.
    """
    miss, hit, low, high, threshold = steps[0], steps[1], steps[2], steps[3], steps[4]
    out = np.zeros(7, np.int64)
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
        root = roots[g]
        out[0] = 0
        for s in range(n):
            key = slot_key[s]
            resolve_brick(
                root,
                key,
                levels,
                children,
                node_ref,
                node_occupied,
                brick_ref,
                node_free,
                brick_free,
                counters,
                out,
            )
            source, target = out[2], out[3]
            occupied = apply_marks(
                source, target, s, miss, hit, low, high, threshold, bricks, brick_lines, marks, marks64
            )
            if source != 0 and source != target:
                drop_brick(source, brick_ref, brick_free, counters)
            note_occupied(root, key, levels, out[0], out[1], occupied, children, node_occupied)
        tally[BRICKS] += n
    return roots.shape[0]
