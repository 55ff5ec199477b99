"""Compiled comparison of two pieces where they overlap."""

from __future__ import annotations

import numpy as np

from graphslam.evidence.kernels import kernel


@kernel()
def compare_pieces(one, T, flat, other, limits, slack, counts):
    """Look up every known voxel of one piece in another.

    ``one`` are coordinates and values of its bricks. ``T (12,)`` takes its voxels to those of the box around the other,
    which is divided by ``table (nz, ny, nx)`` into rows of ``lookup``: these two are ``other``. Adds to ``counts (5,)``
    the voxels that both know; occupied ones of the first of which the second has an occupied voxel within ``slack``
    voxels along each axis; those where it is free instead; free ones of the first that are free in the second; voxels
    of the first that are sure. ``limits``: occupied is a value of at least the first, free one of at most the second.
    """
    (coordinates, values), (table, lookup), (occupied, free) = one, other, limits
    nz, ny, nx = table.shape
    up = 0 if flat else slack
    layers = 1 if flat else 8
    for b in range(coordinates.shape[0]):
        x0, y0, z0 = 8 * coordinates[b, 0] + 0.5, 8 * coordinates[b, 1] + 0.5, 8 * coordinates[b, 2] + 0.5
        for v in range(64 * layers):
            mine = values[b, v]
            if mine == -32768:
                continue
            sure = mine >= occupied or mine <= free
            counts[4] += sure
            x, y, z = x0 + (v & 7), y0 + ((v >> 3) & 7), z0 + (v >> 6)
            i = np.int64(np.floor(T[0] * x + T[1] * y + T[2] * z + T[9]))
            j = np.int64(np.floor(T[3] * x + T[4] * y + T[5] * z + T[10]))
            k = np.int64(np.floor(T[6] * x + T[7] * y + T[8] * z + T[11]))
            if not (slack <= i < 8 * nx - slack and slack <= j < 8 * ny - slack and up <= k < 8 * nz - up):
                continue
            theirs = lookup[table[k >> 3, j >> 3, i >> 3], ((k & 7) << 6) | ((j & 7) << 3) | (i & 7)]
            if theirs == -32768:
                continue
            counts[0] += 1
            if not sure:
                continue
            if mine <= free:
                counts[3] += theirs <= free
                continue
            beside = False
            for c in range(k - up, k + up + 1):
                for d in range(j - slack, j + slack + 1):
                    for e in range(i - slack, i + slack + 1):
                        w = lookup[table[c >> 3, d >> 3, e >> 3], ((c & 7) << 6) | ((d & 7) << 3) | (e & 7)]
                        beside = beside or w >= occupied
            if beside:
                counts[1] += 1
            elif theirs <= free:
                counts[2] += 1
