"""Compiled kernels: resampling of pieces on the world lattice, and their sum.

Keys are packed offset coordinates of bricks, ``z << 40 | y << 20 | x``, as in :mod:`graphslam.evidence.tree_kernels`. A
resampled piece is a list of *entries* of its known voxels, brick by brick: ``voxel << 16 | value`` as uint32, with the
index of the voxel in its brick and the sixteen bits of its log-odds.
"""

from __future__ import annotations

import numpy as np

from graphslam.evidence.kernels import kernel
from graphslam.evidence.tree_kernels import find_node


@kernel()
def meet_bricks(coordinates, extents, R, t, flat, low, marks):
    """Mark the world bricks that overlap the bounding boxes of a piece's rotated bricks; returns their number.

    ``extents (n, 6)``: first known voxel of each brick and the one after the last [voxels of the brick]. ``R (3, 3)``,
    ``t (3,)`` [voxels] transform the piece's base frame to the world; ``marks (nz, ny, nx) uint8`` represents bricks
    from ``low (3,)`` on and is initially zero; ``flat``: one layer only. A margin of 1e-6 voxel excludes bricks that
    only touch.
    """
    first, last = np.empty(3, np.int64), np.empty(3, np.int64)
    found = 0
    for b in range(coordinates.shape[0]):
        for a in range(3):
            c, reach = t[a], -1e-6
            for i in range(3):
                lower, upper = extents[b, i], extents[b, i + 3]
                c += R[a, i] * (8 * coordinates[b, i] + 0.5 * (lower + upper))
                reach += abs(R[a, i]) * 0.5 * (upper - lower)
            first[a] = max(np.int64(np.floor(0.125 * (c - reach))) - low[a], 0)
            last[a] = min(np.int64(np.floor(0.125 * (c + reach))) - low[a], marks.shape[2 - a] - 1)
        if flat:
            first[2] = last[2] = 0
        for k in range(first[2], last[2] + 1):
            for j in range(first[1], last[1] + 1):
                for i in range(first[0], last[0] + 1):
                    if marks[k, j, i] == 0:
                        marks[k, j, i] = 1
                        found += 1
    return found


@kernel()
def list_marked(low, marks, keys):
    """Keys of the marked bricks, ascending; here ``low`` is in offset coordinates."""
    n = 0
    for k in range(marks.shape[0]):
        for j in range(marks.shape[1]):
            for i in range(marks.shape[2]):
                if marks[k, j, i] != 0:
                    keys[n] = ((low[2] + k) << 40) | ((low[1] + j) << 20) | (low[0] + i)
                    n += 1


@kernel()
def sample_piece(keys, T, half, layers, table, lookup, entries, starts):
    """Sample a piece at the voxel centres of the bricks ``keys (n,)``; known voxels only.

    The entries of brick k are ``entries[starts[k]:starts[k + 1]]``; ``entries`` has space for all voxels of all bricks.
    ``T (12,)``: rotation row by row, then translation, from world voxels to voxels of the box around the piece.
    ``table (nz, ny, nx) int32`` maps the bricks of this box to rows of ``lookup``; row 0 is all unknown. The margin of
    the box (`pieces.MARGIN`) makes bounds checks unnecessary.

    Coordinates are integers in units of 2⁻³² voxel: steps along a line of eight voxels are integer sums, and truncation
    is a shift.
    """
    ny, nx = table.shape[1], table.shape[2]
    cells, source = table.reshape(-1), lookup.reshape(-1)
    one = 4294967296.0
    dx, dy, dz = np.int64(np.rint(T[0] * one)), np.int64(np.rint(T[3] * one)), np.int64(np.rint(T[6] * one))
    n = 0
    starts[0] = 0
    for k in range(keys.shape[0]):
        key = keys[k]
        x0 = ((key & 0xFFFFF) << 3) - half + 0.5
        y0 = (((key >> 20) & 0xFFFFF) << 3) - half + 0.5
        z0 = ((key >> 40) << 3) - half + 0.5
        for line in range(8 * layers):
            y, z = y0 + (line & 7), z0 + (line >> 3)
            sx = np.int64((T[0] * x0 + T[1] * y + T[2] * z + T[9]) * one)
            sy = np.int64((T[3] * x0 + T[4] * y + T[5] * z + T[10]) * one)
            sz = np.int64((T[6] * x0 + T[7] * y + T[8] * z + T[11]) * one)
            for i in range(8):
                u, v, w = sx >> 32, sy >> 32, sz >> 32
                # unsigned: avoids the check for negative indices
                cell = np.uint64(((w >> 3) * ny + (v >> 3)) * nx + (u >> 3))
                place = np.uint64((np.int64(cells[cell]) << 9) | ((w & 7) << 6) | ((v & 7) << 3) | (u & 7))
                value = source[place]
                entries[np.uint64(n)] = np.uint32(((8 * line + i) << 16) | (np.int64(value) & 0xFFFF))
                n += np.int64(value != -32768)
                sx += dx
                sy += dy
                sz += dz
        starts[k + 1] = n


@kernel()
def find_bricks(root, keys, levels, children, ids):
    """Bricks of the keys ``(n,)`` in a tree; 0 (all unknown) if there is none."""
    for k in range(keys.shape[0]):
        key = keys[k]
        bx, by, bz = key & 0xFFFFF, (key >> 20) & 0xFFFFF, key >> 40
        ids[k] = 0
        parent = find_node(root, bx, by, bz, levels, children) if root != 0 else 0
        if parent != 0:
            ids[k] = children[parent, ((bz & 3) << 4) | ((by & 3) << 2) | (bx & 3)]


@kernel()
def sum_bricks(ranges, entries, clamp, ids, bricks, out, changed):
    """Sum of the entries that touch each brick, clamped once at the end; returns how many bricks change.

    ``ranges`` are ``starts, begins, ends``: those of brick k are ``begins, ends [starts[k]:starts[k + 1]]``, in
    ``entries``. A voxel without an entry is unknown. If the sum differs from the map's brick ``ids[k]``, ``changed``
    gets k, or ~k if no voxel is known any more, and ``out (n, 512)`` the values, from row 0 on.

    The bits of a total above the 32nd count its entries, so that 0 means unknown.
    """
    starts, begins, ends = ranges
    low, high = clamp
    total = np.zeros(512, np.int64)
    n = 0
    for k in range(ids.shape[0]):
        for v in range(512):
            total[v] = 0
        for r in range(starts[k], starts[k + 1]):
            for e in range(begins[r], ends[r]):
                entry = entries[e]
                total[np.uint64(entry >> np.uint32(16))] += np.int64(np.int16(entry)) + np.int64(4294967296)
        differs, known = np.int64(0), np.int64(0)
        for v in range(512):
            known |= total[v]
            s = np.int64(np.int32(total[v]))
            s = low if s < low else s
            s = high if s > high else s
            value = np.int16(s) if total[v] != 0 else np.int16(-32768)
            differs |= np.int64(value) ^ np.int64(bricks[ids[k], v])
            out[n, v] = value
        if differs != 0:
            changed[n] = k if known != 0 else ~k
            n += 1
    return n


@kernel()
def count_changes(before, after, bricks, counts):
    """Update the histogram ``counts (65536,)`` of value + 32768 from a map's bricks ``before (n,)`` to ``after``,
    including unknown voxels."""
    for k in range(before.shape[0]):
        if before[k] == after[k]:
            continue
        for v in range(512):
            a, b = np.int64(bricks[before[k], v]), np.int64(bricks[after[k], v])
            counts[a + 32768] -= 1
            counts[b + 32768] += 1
