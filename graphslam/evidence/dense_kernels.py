"""Compiled copies from a tree to a dense array, in the order of the array."""

from __future__ import annotations

import numba
import numpy as np

from graphslam.evidence.tree_kernels import find_node


@numba.njit(cache=True, nogil=True)
def row_of_bricks(root, bx, by, bz, levels, children, ids):
    """Bricks bx, bx + 1, … at one height and depth, 0 (all unknown) where there is none or no room for one."""
    edge = 1 << (2 * levels)
    parent, column = 0, -1
    inside = root != 0 and 0 <= by < edge and 0 <= bz < edge
    for k in range(ids.shape[0]):
        x = bx + k
        ids[k] = 0
        if not inside or not 0 <= x < edge:
            continue
        if (x >> 2) != column:
            column = x >> 2
            parent = find_node(root, x, by, bz, levels, children)
        if parent != 0:
            ids[k] = children[parent, ((bz & 3) << 4) | ((by & 3) << 2) | (x & 3)]


@numba.njit(cache=True, nogil=True)
def dense_values(root, first, levels, children, bricks, out):
    """Fill ``out (nz, ny, nx) int16`` from the voxel of offset coordinates ``first (3,)`` on."""
    nz, ny, nx = out.shape
    x0, y0, z0 = first[0], first[1], first[2]
    if nx == 0 or ny == 0:
        return
    bx = x0 >> 3
    ids = np.empty(((x0 + nx - 1) >> 3) - bx + 1, np.int64)
    last = ids.shape[0] - 1
    begin = x0 - 8 * bx  # voxels of the first brick that are not wanted
    for bz in range(z0 >> 3, ((z0 + nz - 1) >> 3) + 1):
        for by in range(y0 >> 3, ((y0 + ny - 1) >> 3) + 1):
            row_of_bricks(root, bx, by, bz, levels, children, ids)
            for z in range(max(8 * bz, z0), min(8 * bz + 8, z0 + nz)):
                for y in range(max(8 * by, y0), min(8 * by + 8, y0 + ny)):
                    row = out[z - z0, y - y0]
                    j = ((z & 7) << 6) | ((y & 7) << 3)
                    for i in range(begin, min(8, begin + nx)):
                        row[i - begin] = bricks[ids[0], j + i]
                    for k in range(1, last):
                        brick = bricks[ids[k], j : j + 8]
                        part = row[8 * k - begin : 8 * k - begin + 8]
                        for i in range(8):
                            part[i] = brick[i]
                    if last > 0:
                        for i in range(nx + begin - 8 * last):
                            row[8 * last - begin + i] = bricks[ids[last], j + i]


@numba.njit(cache=True, nogil=True)
def dense_log_odds(values, out):
    """Log-odds ``out`` float32 of ``values`` int16 in steps of 1/2048, both ``(n,)``; NaN where unknown."""
    for k in range(values.shape[0]):
        v = values[k]
        out[k] = np.float32(np.nan) if v == -32768 else np.float32(v) * np.float32(1.0 / 2048.0)
