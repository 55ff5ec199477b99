"""First phase of inserting a scan, compiled: *mark* the voxels that beams cross; the map is not read.

One byte per voxel is written into scratch bricks. They are found in a hash table, the window: 64³ entries, indexed by
the low bits of the brick coordinates. Bricks with the same entry are chained, so a scan may have any extent.

Sixteen beams (lanes) are stepped in parallel without branches: the next axis along a beam is unpredictable, and branch
misprediction took most of the time. For equal operations on every lane, a voxel is one integer with separate bit fields
for each coordinate (low 9 bits: voxel in the brick; next 18: entry of the window; then the rest), and the parameters of
the next plane crossings are fixed-point integers.

Scratch arrays: ``window (64³, 2) int64`` [key, 512 × slot] of the last brick of an entry or -1, ``slot_key (S,) int64``
brick coordinates, ``slot_next (S,) int32`` next slot of the entry or -1, ``marks (S, 512) uint8`` (``marks64 (S, 64)
uint64`` is the same memory), ``work (S, 5) int32``; between scans the window is all -1 and the marks are all 0. Scans
are ``points (n, 3)``, ``origins (n, 3) or (1, 3)``, ``returns (n,) or (0,) uint8``; poses ``(P, 12)`` are R row by row,
then t [m].
"""

from __future__ import annotations

import math

import numpy as np

from graphslam.core.jit import callee
from graphslam.evidence.kernels import kernel

# counters of a tally, per call
RAYS, NOT_FINITE, ZERO_LENGTH, OUTSIDE, CUT, BRICKS, NEED_SLOTS = 0, 1, 2, 3, 4, 5, 6
TALLY = 7

# bits of the three coordinates in the code of a voxel; the code of a brick is shifted right by 9
MASK_X = 0b111 | (0x3F << 9) | (0x1FF << 27)
MASK_Y = (0b111 << 3) | (0x3F << 15) | (0x1FF << 36)
MASK_Z = (0b111 << 6) | (0x3F << 21) | (0x1FF << 45)
ONE = 2.0**58  # parameter of the end of a beam in fixed point
NEVER = 2**61


@callee
def voxel_code(x, y, z):
    """Code of a voxel: integer with separate bit fields of its offset coordinates."""
    return (
        (x & 7)
        | (((x >> 3) & 0x3F) << 9)
        | ((x >> 9) << 27)
        | ((y & 7) << 3)
        | (((y >> 3) & 0x3F) << 15)
        | ((y >> 9) << 36)
        | ((z & 7) << 6)
        | (((z >> 3) & 0x3F) << 21)
        | ((z >> 9) << 45)
    )


@callee
def brick_key(code):
    """Packed brick coordinates (20 bits each) from the code of a brick."""
    bx = (code & 0x3F) | (((code >> 18) & 0x1FF) << 6)
    by = ((code >> 6) & 0x3F) | (((code >> 27) & 0x1FF) << 6)
    bz = ((code >> 12) & 0x3F) | (((code >> 36) & 0x1FF) << 6)
    return (bz << 40) | (by << 20) | bx


@callee
def find_slot(code, n, window, slot_key, slot_next):
    """Slot of a brick that is not the last one of its entry; n if it is new, -1 if all slots are in use."""
    w = code & 0x3FFFF
    s = window[w, 1] >> 9
    while s >= 0 and slot_key[s] != code:
        s = np.int64(slot_next[s])
    if s >= 0:
        return s
    if n == slot_key.shape[0]:
        return -1
    slot_key[n] = code
    slot_next[n] = window[w, 1] >> 9
    window[w, 0] = code
    window[w, 1] = n << 9
    return n


@callee(error_model="numpy")
def fixed_point(parameter):
    """Parameter along a beam in fixed point; `NEVER` if it is too large or NaN."""
    f = parameter * ONE
    return np.int64(f) if f < 2.0**61 else np.int64(NEVER)


@kernel(error_model="numpy")
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
    """Mark the voxels crossed by a scan in grids ``begin … end-1``; their slots are consecutive, from 0 on.

    Writes the end of the slots of each grid to ``ends (P,)``. Returns whether there were enough slots; if not,
    ``tally[NEED_SLOTS]`` is the number to allocate before the next attempt.

    Amanatides & Woo's traversal in voxel coordinates (``scale`` = 1 / voxel size), from the voxel of the origin up to
    but not including the voxel of the end, which is marked as hit if the beam returned and was not cut.
    """
    n = 0
    total = points.shape[0]
    single = origins.shape[0] == 1
    all_return = returns.shape[0] == 0
    edge = 2 * half
    flat = marks.reshape(marks.size)
    hits = np.empty(total, np.int64)
    left = np.empty(16, np.int64)  # remaining steps of a lane
    # rows of 16 lanes: parameters of the next crossings in x, y, z (0, 16, 32), their increments (48, 64, 80),
    # coordinates (96, 112, 128), bits set before a step so that the carry crosses the gaps (144, 160, 176), steps (192,
    # 208, 224), remaining steps (240, 256, 272). It is one flat array with constant offsets, so that the compiler sees
    # that the rows do not overlap.
    room = np.empty(296, np.int64)
    shift = (-room.ctypes.data & 63) >> 3  # aligned, because rows across cache lines take a third more time
    L = room[shift : shift + 288]
    for l in range(288):  # np.zeros would take longer to compile
        L[l] = 0
    full = False
    for g in range(begin, end):
        first, active, b, n_hits = n, 0, 0, 0
        while True:
            while active < 16 and b < total:  # fill free lanes
                o = 0 if single else b
                lx, ly, lz = origins[o, 0], origins[o, 1], origins[o, 2]
                dx, dy, dz = points[b, 0] - lx, points[b, 1] - ly, points[b, 2] - lz
                hit = all_return or returns[b] != 0
                b += 1
                length = math.sqrt(dx * dx + dy * dy + dz * dz)
                if not length < np.inf:  # also rejects NaN
                    tally[NOT_FINITE] += 1
                    continue
                if length == 0.0:
                    tally[ZERO_LENGTH] += 1
                    continue
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
                if hit:
                    p = voxel_code(ex, ey, ez)
                    code = p >> 9
                    slot = window[code & 0x3FFFF, 1] >> 9
                    if window[code & 0x3FFFF, 0] != code:
                        slot = find_slot(code, n, window, slot_key, slot_next)
                        if slot < 0:
                            full = True
                            break
                        if slot == n:
                            n += 1
                    hits[n_hits] = (slot << 9) | (p & 511)
                    n_hits += 1
                steps = abs(ex - x) + abs(ey - y) + abs(ez - z)
                if steps == 0:
                    continue
                a = active
                active += 1
                left[a] = steps
                ix = 1.0 / abs(vx) if ex != x else 0.0
                iy = 1.0 / abs(vy) if ey != y else 0.0
                iz = 1.0 / abs(vz) if ez != z else 0.0
                L[a] = fixed_point((x + 1 - ox if ex > x else ox - x) * ix) if ex != x else NEVER
                L[16 + a] = fixed_point((y + 1 - oy if ey > y else oy - y) * iy) if ey != y else NEVER
                L[32 + a] = fixed_point((z + 1 - oz if ez > z else oz - z) * iz) if ez != z else NEVER
                L[48 + a] = fixed_point(ix)
                L[64 + a] = fixed_point(iy)
                L[80 + a] = fixed_point(iz)
                p = voxel_code(x, y, z)
                L[96 + a], L[112 + a], L[128 + a] = p & MASK_X, p & MASK_Y, p & MASK_Z
                L[144 + a] = ~MASK_X if ex > x else 0
                L[160 + a] = ~MASK_Y if ey > y else 0
                L[176 + a] = ~MASK_Z if ez > z else 0
                L[192 + a] = 1 if ex > x else -1
                L[208 + a] = 8 if ey > y else -8
                L[224 + a] = 64 if ez > z else -64
                L[240 + a], L[256 + a], L[272 + a] = abs(ex - x), abs(ey - y), abs(ez - z)
            if full or active == 0:
                break
            run = left[0]
            for l in range(1, active):
                run = min(run, left[l])
            for l in range(active):
                left[l] -= run
            for _ in range(run):  # no active lane ends before these steps
                for l in range(active):
                    p = L[96 + l] | L[112 + l] | L[128 + l]
                    code = p >> 9
                    w = code & 0x3FFFF
                    place = window[w, 1]
                    if window[w, 0] != code:
                        slot = find_slot(code, n, window, slot_key, slot_next)
                        if slot < 0:
                            full = True
                            break
                        if slot == n:
                            n += 1
                        place = slot << 9
                    # store without reading first, so that lanes in the same voxel do not wait for each other
                    flat[np.uint64(place | (p & 511))] = 1
                if full:
                    break
                for l in range(16):
                    tx, ty, tz = L[l], L[16 + l], L[32 + l]
                    mx = -(np.int64(tx < ty) & np.int64(tx < tz))  # all bits set for the axis of the next step
                    my = -np.int64(ty < tz) & ~mx
                    mz = ~(mx | my)
                    # an axis is not stepped more often than start and end differ on it, so that a beam through edges
                    # or corners ends in the right voxel despite rounding
                    nx, ny, nz = L[240 + l] + mx, L[256 + l] + my, L[272 + l] + mz
                    L[240 + l], L[256 + l], L[272 + l] = nx, ny, nz
                    L[l] = (tx + (L[48 + l] & mx)) | (NEVER & -np.int64(nx == 0))
                    L[16 + l] = (ty + (L[64 + l] & my)) | (NEVER & -np.int64(ny == 0))
                    L[32 + l] = (tz + (L[80 + l] & mz)) | (NEVER & -np.int64(nz == 0))
                    L[96 + l] = ((L[96 + l] | (L[144 + l] & mx)) + (L[192 + l] & mx)) & MASK_X
                    L[112 + l] = ((L[112 + l] | (L[160 + l] & my)) + (L[208 + l] & my)) & MASK_Y
                    L[128 + l] = ((L[128 + l] | (L[176 + l] & mz)) + (L[224 + l] & mz)) & MASK_Z
            if full:
                break
            l = 0
            while l < active:  # move the last active lane to the place of a finished one
                if left[l] > 0:
                    l += 1
                    continue
                active -= 1
                left[l] = left[active]
                for k in range(0, 288, 16):
                    L[k + l] = L[k + active]
                for k in range(48, 96, 16):
                    L[k + active] = 0  # an idle lane does not move
        for k in range(n_hits):
            flat[np.uint64(hits[k])] |= 2
        for s in range(first, n):  # clear the window, and convert codes of bricks to packed coordinates
            w = slot_key[s] & 0x3FFFF
            window[w, 0] = -1
            window[w, 1] = -1
            slot_key[s] = brick_key(slot_key[s])
        if full:
            tally[NEED_SLOTS] = 4 * slot_key.shape[0]
            return False
        ends[g] = n
    return True
