"""Compiled ray casting: the first occupied voxel along each beam, in many grids.

A ray crosses the voxel planes of each axis at increasing parameters t. Each parameter is computed from its plane,
``t = (k - o) / d``, never by summation. So steps of one voxel, of one brick and over a large empty cube use the same
numbers and visit the same voxels, also for equal parameters (order: z, then y, then x).

There are three step sizes. Subtrees whose bit in ``node_occupied`` is 0 are skipped. Inside a block of 4³ bricks the
ray steps by bricks and reads one 64-bit mask only. Voxels are read only in lines of 32 with an occupied one
(``brick_lines``). Arrays of the tree as in :mod:`~graphslam.evidence.tree_kernels`, read only; poses ``(12,)`` are R
row by row, then t [m].
"""

from __future__ import annotations

import math

import numpy as np

from graphslam.core.jit import callee
from graphslam.evidence.kernels import kernel

MAX_RANGE, HIT, INSIDE, LEFT, UNUSABLE, UNKNOWN_SPACE = 0, 1, 2, 3, 4, 5

# closer to a plane than this [voxels], its crossing parameter is compared with t instead; rounding in o + d t is
# below 1e-10 in the largest addressable cube
NEAR = 1e-9
# a component below FLAT crosses no plane inside the cube; NEVER replaces its infinite inverse, as 0 · inf is NaN
FLAT, NEVER = 1e-200, 1e300


@callee(error_model="numpy")
def coordinate_after(o, d, inverse, first, t, closed):
    """Voxel coordinate on one axis after the ray crossed all planes before ``t`` (with ``closed`` also those at ``t``).

    ``first`` is the voxel coordinate of the origin ``o``; the result is never behind it.
    """
    f = o + d * t
    p = math.floor(f + 0.5)
    if abs(f - p) > NEAR:
        return math.floor(f)
    at = (p - o) * inverse
    behind = at < t or (closed and at == t)
    if d >= 0.0:
        k = p if behind else p - 1
        return max(k, first)
    k = p - 1 if behind else p
    return min(k, first)


@callee(error_model="numpy")
def crossed_lines(oy, dy, oz, dz, t, end):
    """Bits of the lines of a brick (8 x 4 x 1 voxels each) that a ray may cross between parameters t and end.

    The set may contain too many lines, never too few; coordinates are relative to the corner of the brick.
    """
    a, b = oz + dz * t, oz + dz * end
    low = int(max(min(a, b) - NEAR, 0.0))
    high = int(min(max(a, b) + NEAR, 7.0))
    lines = (4 << (2 * high)) - (1 << (2 * low))
    a, b = oy + dy * t, oy + dy * end
    if max(a, b) < 4.0 - NEAR:
        return lines & 0x5555
    if min(a, b) > 4.0 + NEAR:
        return lines & 0xAAAA
    return lines


@kernel(error_model="numpy")
def unit_directions(directions, out):
    """Normalise directions ``(n, 3)``; NaN for zero and non-finite ones."""
    for b in range(directions.shape[0]):
        x, y, z = directions[b, 0], directions[b, 1], directions[b, 2]
        # scaled first, so that squares neither underflow nor overflow
        m = max(abs(x), abs(y), abs(z))
        if m > 0.0 and m < np.inf:
            x, y, z = x / m, y / m, z / m
            s = 1.0 / math.sqrt(x * x + y * y + z * z)
        else:
            s = np.nan
        out[b, 0], out[b, 1], out[b, 2] = x * s, y * s, z * s


@kernel(error_model="numpy")
def cast_rays(
    begin,
    end,
    roots,
    poses,
    origins,
    directions,
    reach,
    voxel_size,
    half,
    levels,
    threshold,
    stop_at_unknown,
    children,
    node_occupied,
    bricks,
    brick_lines,
    ranges,
    status,
    voxels,
):
    """Cast beams in grids ``begin … end - 1``.

    Parameters
    ----------
    roots : (P,) int64
    poses : (P, 12)
    origins : (n, 3) or (1, 3)
        In the scan frame [m].
    directions : (n, 3)
        Unit length, or NaN.
    reach : float
        Maximum range [m], may be infinite.
    threshold : int
        Smallest value of an occupied voxel.
    ranges, status : (P, n) float64, int8
        Output. For a hit, the range to the middle of the ray's chord in the voxel, at most ``reach``; for other beams
        the range where they ended.
    voxels : (P, n, 3) int32 or (0, 0, 0)
        Output if requested: signed coordinates of the voxel where the beam ended; undefined for unusable beams.
    """
    scale = 1.0 / voxel_size
    edge = 2.0 * half
    reach_voxels = reach * scale
    single = origins.shape[0] == 1
    want_voxels = voxels.shape[0] > 0
    blocks = half >> 4  # blocks of 32 voxels along an edge
    flat = bricks.reshape(-1)
    for g in range(begin, end):
        root = roots[g]
        pose = poses[g]
        for b in range(directions.shape[0]):
            q = 0 if single else b
            lx, ly, lz = origins[q, 0], origins[q, 1], origins[q, 2]
            ox = (pose[0] * lx + pose[1] * ly + pose[2] * lz + pose[9]) * scale + half
            oy = (pose[3] * lx + pose[4] * ly + pose[5] * lz + pose[10]) * scale + half
            oz = (pose[6] * lx + pose[7] * ly + pose[8] * lz + pose[11]) * scale + half
            lx, ly, lz = directions[b, 0], directions[b, 1], directions[b, 2]
            inside = min(ox, oy, oz) >= 0.0 and max(ox, oy, oz) < edge and lx == lx
            if not inside:
                ranges[g, b] = np.nan
                status[g, b] = UNUSABLE
                continue
            dx = pose[0] * lx + pose[1] * ly + pose[2] * lz
            dy = pose[3] * lx + pose[4] * ly + pose[5] * lz
            dz = pose[6] * lx + pose[7] * ly + pose[8] * lz
            ix, iy, iz = NEVER, NEVER, NEVER
            if abs(dx) > FLAT:
                ix = 1.0 / dx
            else:
                dx = 0.0
            if abs(dy) > FLAT:
                iy = 1.0 / dy
            else:
                dy = 0.0
            if abs(dz) > FLAT:
                iz = 1.0 / dz
            else:
                dz = 0.0
            # face through which a ray leaves a cell: 1 upper, 0 lower
            ux, uy, uz = (1 if dx >= 0.0 else 0), (1 if dy >= 0.0 else 0), (1 if dz >= 0.0 else 0)
            x0, y0, z0 = int(ox), int(oy), int(oz)
            x, y, z = x0, y0, z0
            bx, by, bz = x0 >> 3, y0 >> 3, z0 >> 3
            # parameters of the exit faces of the brick
            gx = (((bx + ux) << 3) - ox) * ix
            gy = (((by + uy) << 3) - oy) * iy
            gz = (((bz + uz) << 3) - oz) * iz
            t, axis = 0.0, 3  # parameter and axis of entry into the current brick; axis 3: the ray starts in it
            cx, cy, cz = -9, -9, -9  # current block of bricks; outside the cube it may be -1
            node, mask = 0, np.uint64(0)
            state, leave = MAX_RANGE, 0.0
            while t <= reach_voxels:
                if (bx >> 2) != cx or (by >> 2) != cy or (bz >> 2) != cz:
                    cx, cy, cz = bx >> 2, by >> 2, bz >> 2
                    if min(cx, cy, cz) < 0 or max(cx, cy, cz) >= blocks:
                        state = LEFT
                        break
                    node = root
                    shift = 0
                    for level in range(levels - 1, 0, -1):
                        s = 2 * level
                        c = (((bz >> s) & 3) << 4) | (((by >> s) & 3) << 2) | ((bx >> s) & 3)
                        child = np.int64(children[np.uint64(node), np.uint64(c)])
                        if stop_at_unknown:
                            if child == 0:
                                state = UNKNOWN_SPACE
                                break
                        elif ((node_occupied[np.uint64(node)] >> np.uint64(c)) & np.uint64(1)) == np.uint64(0):
                            shift = s
                            break
                        node = child
                    if state == UNKNOWN_SPACE:
                        break
                    if shift > 0:
                        # nothing occupied in a cube of 4^level bricks per edge: go to its exit face
                        gx = ((((bx >> shift) + ux) << (shift + 3)) - ox) * ix
                        gy = ((((by >> shift) + uy) << (shift + 3)) - oy) * iy
                        gz = ((((bz >> shift) + uz) << (shift + 3)) - oz) * iz
                        if gx < gy and gx < gz:
                            axis, t = 0, gx
                            bx = (((bx >> shift) + ux) << shift) + ux - 1
                        elif gy < gz:
                            axis, t = 1, gy
                            by = (((by >> shift) + uy) << shift) + uy - 1
                        else:
                            axis, t = 2, gz
                            bz = (((bz >> shift) + uz) << shift) + uz - 1
                        if axis != 0:
                            bx = coordinate_after(ox, dx, ix, x0, t, False) >> 3
                        if axis != 1:
                            by = coordinate_after(oy, dy, iy, y0, t, axis == 0) >> 3
                        if axis != 2:
                            bz = coordinate_after(oz, dz, iz, z0, t, True) >> 3
                        gx = (((bx + ux) << 3) - ox) * ix
                        gy = (((by + uy) << 3) - oy) * iy
                        gz = (((bz + uz) << 3) - oz) * iz
                        cx = -9
                        continue
                    mask = node_occupied[np.uint64(node)]
                c = ((bz & 3) << 4) | ((by & 3) << 2) | (bx & 3)
                if stop_at_unknown or ((mask >> np.uint64(c)) & np.uint64(1)) != np.uint64(0):
                    brick = np.int64(children[np.uint64(node), np.uint64(c)])
                    lines = 0xFFFF
                    if not stop_at_unknown:
                        lines = np.int64(brick_lines[np.uint64(brick)])
                        lines &= crossed_lines(oy - (by << 3), dy, oz - (bz << 3), dz, t, min(gx, gy, gz))
                    if lines == 0:
                        pass
                    elif axis == 0:
                        x = (bx << 3) + 7 * (1 - ux)
                        y = coordinate_after(oy, dy, iy, y0, t, True)
                        z = coordinate_after(oz, dz, iz, z0, t, True)
                    elif axis == 1:
                        x = coordinate_after(ox, dx, ix, x0, t, False)
                        y = (by << 3) + 7 * (1 - uy)
                        z = coordinate_after(oz, dz, iz, z0, t, True)
                    elif axis == 2:
                        x = coordinate_after(ox, dx, ix, x0, t, False)
                        y = coordinate_after(oy, dy, iy, y0, t, False)
                        z = (bz << 3) + 7 * (1 - uz)
                    tx, ty, tz = (x + ux - ox) * ix, (y + uy - oy) * iy, (z + uz - oz) * iz
                    enter = t
                    while lines != 0:
                        i = ((z & 7) << 6) | ((y & 7) << 3) | (x & 7)
                        if (lines >> (i >> 5)) & 1:
                            v = flat[np.uint64((brick << 9) | i)]
                            if v >= threshold:
                                state = HIT
                                break
                            if stop_at_unknown and v == -32768:
                                state = UNKNOWN_SPACE
                                break
                        if tx < ty and tx < tz:
                            if tx == gx:
                                break
                            enter = tx
                            x += 2 * ux - 1
                            tx = (x + ux - ox) * ix
                        elif ty < tz:
                            if ty == gy:
                                break
                            enter = ty
                            y += 2 * uy - 1
                            ty = (y + uy - oy) * iy
                        else:
                            if tz == gz:
                                break
                            enter = tz
                            z += 2 * uz - 1
                            tz = (z + uz - oz) * iz
                    if state != MAX_RANGE:
                        t = enter
                        leave = min(tx, ty, tz)
                        break
                # next brick
                if gx < gy and gx < gz:
                    axis, t = 0, gx
                    bx += 2 * ux - 1
                    gx = (((bx + ux) << 3) - ox) * ix
                elif gy < gz:
                    axis, t = 1, gy
                    by += 2 * uy - 1
                    gy = (((by + uy) << 3) - oy) * iy
                else:
                    axis, t = 2, gz
                    bz += 2 * uz - 1
                    gz = (((bz + uz) << 3) - oz) * iz
            if t > reach_voxels:
                state = MAX_RANGE
            if state == HIT and axis == 3 and x == x0 and y == y0 and z == z0:
                state = INSIDE
                t = 0.0
            if state == HIT:
                t = 0.5 * (t + leave)
            t = min(t, reach_voxels)
            ranges[g, b] = t * voxel_size
            status[g, b] = state
            if want_voxels:
                if state != HIT and state != INSIDE:
                    x, y, z = math.floor(ox + dx * t), math.floor(oy + dy * t), math.floor(oz + dz * t)
                voxels[g, b, 0], voxels[g, b, 1], voxels[g, b, 2] = x - half, y - half, z - half
