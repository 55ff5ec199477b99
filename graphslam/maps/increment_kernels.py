"""Compiled difference of a map and an earlier map that it may be a copy of."""

from __future__ import annotations

import numpy as np

from graphslam.evidence.kernels import kernel
from graphslam.evidence.tree_kernels import find_node


@kernel()
def subtract_bricks(keys, new, tree, slack, flat, out, counts):
    """``out (n, 512)``: ``new (n, 512)`` minus the values of a tree at the same voxels; unknown if unchanged.

    ``tree`` is its root, its levels, and the children and bricks of its pool. A voxel is unchanged if the tree has the
    same value, or knows the voxel and has this value within ``slack`` (0 or 1) voxels along each axis (rounding). Adds
    to ``counts (3,)``: voxels with a difference, unchanged ones, and voxels known in both.
    """
    root, levels, children, bricks = tree
    near = np.zeros((3, 3, 3), np.int64)
    edge = 1 << (2 * levels)
    up = 0 if flat else slack
    for k in range(keys.shape[0]):
        key = keys[k]
        bx, by, bz = key & 0xFFFFF, (key >> 20) & 0xFFFFF, key >> 40
        for c in range(-up, up + 1):
            for d in range(-slack, slack + 1):
                for e in range(-slack, slack + 1):
                    x, y, z = bx + e, by + d, bz + c
                    near[c + 1, d + 1, e + 1] = 0
                    if root == 0 or not (0 <= x < edge and 0 <= y < edge and 0 <= z < edge):
                        continue
                    parent = find_node(root, x, y, z, levels, children)
                    if parent != 0:
                        near[c + 1, d + 1, e + 1] = children[parent, ((z & 3) << 4) | ((y & 3) << 2) | (x & 3)]
        for v in range(512):
            value = new[k, v]
            out[k, v] = -32768
            if value == -32768:
                continue
            old = bricks[near[1, 1, 1], v]
            counts[2] += old != -32768
            x, y, z = v & 7, (v >> 3) & 7, v >> 6
            same = old == value
            beside = slack > 0 and old != -32768 and not same
            for c in range(z - up, z + up + 1 if beside else z - up):
                for d in range(y - slack, y + slack + 1):
                    for e in range(x - slack, x + slack + 1):
                        b = near[(c >> 3) + 1, (d >> 3) + 1, (e >> 3) + 1]
                        same = same or bricks[b, ((c & 7) << 6) | ((d & 7) << 3) | (e & 7)] == value
            if same:
                counts[1] += 1
                continue
            difference = np.int64(value) - (np.int64(old) if old != -32768 else np.int64(0))
            counts[0] += 1
            out[k, v] = min(max(difference, -32767), 32767)
