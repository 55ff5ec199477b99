"""Compiled sampling of the log-odds of one map at the voxel centres of another, under a rigid transform.

For each target voxel the source voxel that contains its centre is read. So each target voxel gets one value; mapping
source voxels to a rotated target lattice would skip some target voxels and hit others twice.
"""

from __future__ import annotations

import numpy as np

from graphslam.evidence.kernels import kernel
from graphslam.evidence.tree_kernels import find_node


@kernel()
def sample_bricks(keys, T, voxel, half, root, source, values):
    """Source values ``(n, 512)`` at the voxel centres of target bricks ``keys (n,)``; returns the number known.

    ``T (12,)`` transforms target to source coordinates [m]; ``half`` is that of the target, ``source`` the Tree of the
    source.
    """
    children, bricks, levels, source_half = source.children, source.bricks, source.levels, source.half
    scale, edge = 1.0 / voxel, 2 * source_half
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
                    brick = np.int64(children[parent, c])
            value = bricks[brick, ((l & 7) << 6) | ((j & 7) << 3) | (i & 7)]
            values[k, v] = value
            if value != -32768:
                found += 1
    return found
