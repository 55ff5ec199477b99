"""Compiled copies from a tree to a dense array, and the bounding box of the known voxels."""

from __future__ import annotations

import numpy as np

from graphslam.core.jit import callee
from graphslam.evidence.kernels import kernel
from graphslam.evidence.tree_kernels import find_node


@callee
def row_of_bricks(root, bx, by, bz, levels, children, ids):
    """Ids of bricks bx, bx + 1, … at given by and bz; 0 (the unknown brick) if absent or outside the cube."""
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


@kernel()
def known_box(root, levels, children, bricks, box):
    """First known voxel and the one after the last per axis, ``box (6,) int64`` [offset coordinates]; first > last
    for an empty map.

    Subtrees inside the box found so far are skipped, so that only a small part of a map is read.
    """
    for a in range(3):
        box[a], box[a + 3] = 1 << 40, 0
    if root == 0:
        return
    stack = np.empty((64 * 8, 5), np.int64)
    stack[0, 0], stack[0, 1] = root, levels
    stack[0, 2], stack[0, 3], stack[0, 4] = 0, 0, 0
    n = 1
    while n > 0:
        n -= 1
        node, size = stack[n, 0], stack[n, 1]  # size 0 is a brick
        x, y, z = stack[n, 2], stack[n, 3], stack[n, 4]
        edge = 8 << (2 * size)
        if (
            (x >= box[0] and y >= box[1] and z >= box[2])
            and (x + edge <= box[3] and y + edge <= box[4] and z + edge <= box[5])
        ):  # fmt: skip
            continue
        if size == 0:
            for j in range(512):
                if bricks[node, j] != -32768:
                    vx, vy, vz = x + (j & 7), y + ((j >> 3) & 7), z + (j >> 6)
                    box[0], box[1], box[2] = min(box[0], vx), min(box[1], vy), min(box[2], vz)
                    box[3], box[4], box[5] = max(box[3], vx + 1), max(box[4], vy + 1), max(box[5], vz + 1)
            continue
        part = edge >> 2
        for c in range(64):
            child = children[node, c]
            if child != 0:
                stack[n, 0], stack[n, 1] = child, size - 1
                stack[n, 2], stack[n, 3] = x + part * (c & 3), y + part * ((c >> 2) & 3)
                stack[n, 4] = z + part * (c >> 4)
                n += 1


@kernel()
def dense_values(root, first, levels, children, bricks, out):
    """Fill ``out (nz, ny, nx) int16`` from the voxel of offset coordinates ``first (3,)`` on."""
    nz, ny, nx = out.shape
    x0, y0, z0 = first[0], first[1], first[2]
    if nx == 0 or ny == 0:
        return
    source, target = bricks.reshape(-1), out.reshape(-1)
    bx = x0 >> 3
    ids = np.empty(((x0 + nx - 1) >> 3) - bx + 1, np.int64)
    last = ids.shape[0] - 1
    begin = x0 - 8 * bx  # voxels of the first brick before the box
    # unsigned, because numba checks signed indices for negative values
    u1, u2, u3, u4 = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)
    u5, u6, u7, u8 = np.uint64(5), np.uint64(6), np.uint64(7), np.uint64(8)
    for bz in range(z0 >> 3, ((z0 + nz - 1) >> 3) + 1):
        for by in range(y0 >> 3, ((y0 + ny - 1) >> 3) + 1):
            row_of_bricks(root, bx, by, bz, levels, children, ids)
            for z in range(max(8 * bz, z0), min(8 * bz + 8, z0 + nz)):
                for y in range(max(8 * by, y0), min(8 * by + 8, y0 + ny)):
                    j = ((z & 7) << 6) | ((y & 7) << 3)
                    row = ((z - z0) * ny + y - y0) * nx
                    for i in range(begin, min(8, begin + nx)):
                        target[row + i - begin] = source[512 * ids[0] + j + i]
                    t = np.uint64(row + 8 - begin)
                    for k in range(1, last):
                        s = np.uint64(512 * ids[k] + j)
                        # read all, then write all; otherwise the compiler does not make one load and one store
                        v0, v1, v2, v3 = source[s], source[s + u1], source[s + u2], source[s + u3]
                        v4, v5, v6, v7 = source[s + u4], source[s + u5], source[s + u6], source[s + u7]
                        target[t], target[t + u1], target[t + u2], target[t + u3] = v0, v1, v2, v3
                        target[t + u4], target[t + u5], target[t + u6], target[t + u7] = v4, v5, v6, v7
                        t += u8
                    if last > 0:
                        for i in range(nx + begin - 8 * last):
                            target[row + 8 * last - begin + i] = source[512 * ids[last] + j + i]


@kernel()
def dense_log_odds(values, out):
    """Log-odds ``out`` float32 of ``values`` int16 in steps of 1/2048, both ``(n,)``; NaN where unknown."""
    for k in range(values.shape[0]):
        v = values[k]
        out[k] = np.float32(np.nan) if v == -32768 else np.float32(v) * np.float32(1.0 / 2048.0)
