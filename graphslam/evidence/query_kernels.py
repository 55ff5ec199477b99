"""Compiled queries: values at points, counts in boxes, occupied voxels, shared nodes and bricks.

Arrays of the :class:`~graphslam.evidence.tree_kernels.Tree` are read only; poses ``(12,)`` are R row by row, then t
[m]. Lists of bricks are ``rows (n, 2) int64`` [packed offset coordinates, brick], as ``list_bricks`` gives them.
"""

from __future__ import annotations

import math

import numpy as np

from graphslam.core.jit import callee
from graphslam.evidence.kernels import kernel


@callee
def find_brick(root, x, y, z, levels, children, last):
    """Brick that contains voxel (x, y, z) [offset coordinates], or 0.

    ``last (4,)`` caches the node of the last block of 4³ bricks [x, y, z of the block, node], so that neighbouring
    points need one descent. Initialise it with -1.
    """
    bx, by, bz = x >> 3, y >> 3, z >> 3
    if (bx >> 2) != last[0] or (by >> 2) != last[1] or (bz >> 2) != last[2]:
        last[0], last[1], last[2] = bx >> 2, by >> 2, bz >> 2
        node = root
        for level in range(levels - 1, 0, -1):
            s = 2 * level
            c = (((bz >> s) & 3) << 4) | (((by >> s) & 3) << 2) | ((bx >> s) & 3)
            node = np.int64(children[np.uint64(node), np.uint64(c)])
            if node == 0:
                break
        last[3] = node
    # all children of node 0 are 0, so this is right for an absent block too
    return np.int64(children[np.uint64(last[3]), np.uint64(((bz & 3) << 4) | ((by & 3) << 2) | (bx & 3))])


@kernel(error_model="numpy")
def look_up_values(begin, end, roots, poses, points, scale, half, levels, trilinear, table, children, bricks, out):
    """Entries of ``table (65536,)`` for the voxel values at points, in grids ``begin … end-1``.

    Parameters
    ----------
    points : (n, 3)
        In the scan frame [m].
    trilinear : bool
        Interpolate between the centres of the eight voxels around a point, else use the voxel that contains it.
    table : (65536,) float32
        Row v + 32768 for a value v; row 0 is for unknown voxels and outside the cube.
    out : (P, n) float32
        Output; NaN for points that are not finite.
    """
    edge = 2.0 * half
    last = np.empty(4, np.int64)
    for g in range(begin, end):
        root = roots[g]
        pose = poses[g]
        last[:] = -1
        for b in range(points.shape[0]):
            px, py, pz = points[b, 0], points[b, 1], points[b, 2]
            x = (pose[0] * px + pose[1] * py + pose[2] * pz + pose[9]) * scale + half
            y = (pose[3] * px + pose[4] * py + pose[5] * pz + pose[10]) * scale + half
            z = (pose[6] * px + pose[7] * py + pose[8] * pz + pose[11]) * scale + half
            if not abs(x) + abs(y) + abs(z) < np.inf:
                out[g, b] = np.nan
                continue
            if not trilinear:
                if min(x, y, z) >= 0.0 and max(x, y, z) < edge:
                    i, j, k = int(x), int(y), int(z)
                    brick = find_brick(root, i, j, k, levels, children, last)
                    v = int(bricks[np.uint64(brick), np.uint64(((k & 7) << 6) | ((j & 7) << 3) | (i & 7))])
                    out[g, b] = table[v + 32768]
                else:
                    out[g, b] = table[0]
                continue
            x, y, z = x - 0.5, y - 0.5, z - 0.5
            fx, fy, fz = math.floor(x), math.floor(y), math.floor(z)
            x, y, z = x - fx, y - fy, z - fz
            total = 0.0
            for corner in range(8):
                cx, cy, cz = corner & 1, (corner >> 1) & 1, corner >> 2
                w = (x if cx else 1.0 - x) * (y if cy else 1.0 - y) * (z if cz else 1.0 - z)
                figure = table[0]
                if min(fx + cx, fy + cy, fz + cz) >= 0.0 and max(fx + cx, fy + cy, fz + cz) < edge:
                    i, j, k = int(fx) + cx, int(fy) + cy, int(fz) + cz
                    brick = find_brick(root, i, j, k, levels, children, last)
                    v = int(bricks[np.uint64(brick), np.uint64(((k & 7) << 6) | ((j & 7) << 3) | (i & 7))])
                    figure = table[v + 32768]
                total += w * figure
            out[g, b] = total


@kernel()
def count_boxes(root, lower, upper, levels, threshold, children, bricks, out):
    """Numbers of occupied and known voxels in boxes.

    Parameters
    ----------
    lower, upper : (m, 3) int64
        Offset coordinates of the first voxel and of the one after the last, inside the cube.
    out : (m, 2) int64
        Output: occupied, known.
    """
    stack = np.empty((64 * 8, 5), np.int64)  # node, level, voxel coordinates of its corner
    for q in range(lower.shape[0]):
        ax, ay, az = lower[q, 0], lower[q, 1], lower[q, 2]
        ex, ey, ez = upper[q, 0], upper[q, 1], upper[q, 2]
        occupied, known = 0, 0
        n = 0
        if root != 0 and ax < ex and ay < ey and az < ez:
            stack[0, 0], stack[0, 1] = root, levels - 1
            stack[0, 2], stack[0, 3], stack[0, 4] = 0, 0, 0
            n = 1
        while n > 0:
            n -= 1
            node, level = stack[n, 0], stack[n, 1]
            ox, oy, oz = stack[n, 2], stack[n, 3], stack[n, 4]
            s = 2 * level + 3
            for c in range(64):
                child = np.int64(children[node, c])
                if child == 0:
                    continue
                x, y, z = ox + ((c & 3) << s), oy + (((c >> 2) & 3) << s), oz + ((c >> 4) << s)
                size = 1 << s
                if x >= ex or y >= ey or z >= ez or x + size <= ax or y + size <= ay or z + size <= az:
                    continue
                if level > 0:
                    stack[n, 0], stack[n, 1] = child, level - 1
                    stack[n, 2], stack[n, 3], stack[n, 4] = x, y, z
                    n += 1
                    continue
                for k in range(max(az - z, 0), min(ez - z, 8)):
                    for j in range(max(ay - y, 0), min(ey - y, 8)):
                        for i in range(max(ax - x, 0), min(ex - x, 8)):
                            v = bricks[child, (k << 6) | (j << 3) | i]
                            known += v != -32768
                            occupied += v >= threshold
        out[q, 0], out[q, 1] = occupied, known


@kernel()
def list_occupied(rows, half, threshold, bricks, brick_lines, voxels, values):
    """Number of occupied voxels; fills the rows of ``voxels (n, 3) int32`` (signed) and ``values (n,) int16``.

    Order: brick by brick in the order of ``rows``, inside a brick x fastest.
    """
    n = 0
    for r in range(rows.shape[0]):
        b = rows[r, 1]
        lines = np.int64(brick_lines[b])
        if lines == 0:
            continue
        key = rows[r, 0]
        x, y, z = ((key & 0xFFFFF) << 3) - half, (((key >> 20) & 0xFFFFF) << 3) - half, ((key >> 40) << 3) - half
        for line in range(16):
            if (lines >> line) & 1 == 0:
                continue
            for i in range(32 * line, 32 * line + 32):
                v = bricks[b, i]
                if v >= threshold:
                    if n < voxels.shape[0]:
                        voxels[n, 0], voxels[n, 1], voxels[n, 2] = x + (i & 7), y + ((i >> 3) & 7), z + (i >> 6)
                        values[n] = v
                    n += 1
    return n


@kernel()
def walk_once(roots, levels, children, node_times, brick_times, nodes, links, begins):
    """Visit every node and brick below some roots exactly once, level by level, even if it has several parents.

    Parameters
    ----------
    roots : (R,) int64
        Distinct, none 0.
    node_times, brick_times : (N,), (B,) int64
        All 0 on input; output: number of places where a node or brick occurs in the trees.
    nodes : (N,) int64
        Output: nodes in the order of the visit, from the roots down.
    links : (B,) int64
        Output: bricks in the order of the visit.
    begins : (levels + 1,) int64
        Output: start of each level in ``nodes`` (roots first), and the end.

    Returns
    -------
    int
        Number of bricks.
    """
    n = 0
    for r in range(roots.shape[0]):
        nodes[n] = roots[r]
        node_times[roots[r]] = 1
        n += 1
    begins[0] = 0
    found = 0
    begin = 0
    for step in range(levels):
        end = n
        begins[step + 1] = end
        for q in range(begin, end):
            node = nodes[q]
            times = node_times[node]
            for c in range(64):
                child = np.int64(children[node, c])
                if child == 0:
                    continue
                if step == levels - 1:
                    if brick_times[child] == 0:
                        links[found] = child
                        found += 1
                    brick_times[child] += times
                else:
                    if node_times[child] == 0:
                        nodes[n] = child
                        n += 1
                    node_times[child] += times
        begin = end
    return found


@kernel()
def count_voxel_values(ids, times, bricks, counts):
    """Histogram ``counts (65536,) int64`` of the values of bricks ``ids (n,)``, each counted ``times[id]`` times."""
    for k in range(ids.shape[0]):
        b = ids[k]
        t = times[b]
        for i in range(512):
            counts[int(bricks[b, i]) + 32768] += t


@kernel()
def count_private(nodes, begins, free_roots, node_left, brick_left, tree):
    """Numbers of nodes and bricks that would be freed with some roots.

    ``nodes, begins`` are from :func:`walk_once`; ``free_roots (R,)`` is True for roots without another owner.
    ``node_left (N,)``, ``brick_left (B,)`` int32 are all 0 on input; output: numbers of parents that would be freed.
    """
    freed_nodes, freed_bricks = 0, 0
    for step in range(tree.levels):
        for q in range(begins[step], begins[step + 1]):
            node = nodes[q]
            if step == 0:
                if not free_roots[q]:
                    continue
            elif node_left[node] < tree.node_ref[node]:
                continue
            freed_nodes += 1
            for c in range(64):
                child = np.int64(tree.children[node, c])
                if child == 0:
                    continue
                if step == tree.levels - 1:
                    brick_left[child] += 1
                    freed_bricks += brick_left[child] == tree.brick_ref[child]
                else:
                    node_left[child] += 1
    return freed_nodes, freed_bricks
