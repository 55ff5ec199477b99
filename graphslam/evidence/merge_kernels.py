"""Compiled addition of one map's log-odds to another's under a rigid transform.

Every voxel of the target asks which voxel of the source its centre lies in: no voxel is met twice and none is left out,
as scattering the source's voxels over a turned lattice would.
"""

from __future__ import annotations

import numba
import numpy as np

from graphslam.evidence.tree_kernels import find_node, own_parent, set_occupied, take_brick


@numba.njit(cache=True, nogil=True)
def sample_bricks(keys, T, scale, voxel, half, source_half, root, levels, children, bricks, values):
    """Source values ``(n, 512)`` at the voxel centres of target bricks ``keys (n,)``; returns how many are known.

    ``T (12,)`` takes target coordinates to the source's [m]; ``half`` of the target's cube, ``source_half`` of the
    source's, whose tree follows.
    """
    edge = 2 * source_half
    found = 0
    for k in range(keys.shape[0]):
        key = keys[k]
        bx, by, bz = key & 0xFFFFF, (key >> 20) & 0xFFFFF, key >> 40
        last, brick = np.int64(-1), 0
        for v in range(512):
            x = ((bx << 3) + (v & 7) - half + 0.5) * voxel
            y = ((by << 3) + ((v >> 3) & 7) - half + 0.5) * voxel
            z = ((bz << 3) + (v >> 6) - half + 0.5) * voxel
            sx = (T[0] * x + T[1] * y + T[2] * z + T[9]) * scale + source_half
            sy = (T[3] * x + T[4] * y + T[5] * z + T[10]) * scale + source_half
            sz = (T[6] * x + T[7] * y + T[8] * z + T[11]) * scale + source_half
            values[k, v] = -32768
            if not (0.0 <= sx < edge and 0.0 <= sy < edge and 0.0 <= sz < edge):
                continue
            i, j, l = int(sx), int(sy), int(sz)
            here = ((l >> 3) << 40) | ((j >> 3) << 20) | (i >> 3)
            if here != last:
                last = here
                parent = find_node(root, i >> 3, j >> 3, l >> 3, levels, children)
                brick = 0
                if parent != 0:
                    c = (((l >> 3) & 3) << 4) | (((j >> 3) & 3) << 2) | ((i >> 3) & 3)
                    brick = int(children[parent, c])
            value = bricks[brick, ((l & 7) << 6) | ((j & 7) << 3) | (i & 7)]
            values[k, v] = value
            if value != -32768:
                found += 1
    return found


@numba.njit(cache=True, nogil=True)
def add_bricks(
    root,
    keys,
    values,
    steps,
    levels,
    children,
    node_ref,
    node_occupied,
    bricks,
    brick_ref,
    brick_lines,
    node_free,
    brick_free,
    counters,
):
    """Add log-odds ``values (n, 512)`` to bricks; unknown ones add nothing, unknown voxels start at 0.

    Room was reserved.
    """
    low, high, threshold = int(steps[2]), int(steps[3]), int(steps[4])
    for k in range(keys.shape[0]):
        some = False
        for v in range(512):
            if values[k, v] != -32768:
                some = True
                break
        if not some:
            continue
        bx, by, bz = keys[k] & 0xFFFFF, (keys[k] >> 20) & 0xFFFFF, keys[k] >> 40
        parent = own_parent(root, bx, by, bz, levels, children, node_ref, node_occupied, brick_ref, node_free, counters)
        c = ((bz & 3) << 4) | ((by & 3) << 2) | (bx & 3)
        source = int(children[parent, c])
        target = source
        if source == 0 or brick_ref[source] > 1:
            target = take_brick(brick_ref, brick_free, counters)
            children[parent, c] = target
            if source != 0:
                brick_ref[source] -= 1
        lines = 0
        for v in range(512):
            old, add = int(bricks[source, v]), int(values[k, v])
            new = old
            if add != -32768:
                new = (0 if old == -32768 else old) + add
                new = min(max(new, low), high)
            bricks[target, v] = new
            if new >= threshold:
                lines |= 1 << (v >> 5)
        brick_lines[target] = lines
        set_occupied(root, bx, by, bz, levels, lines != 0, children, node_occupied)
