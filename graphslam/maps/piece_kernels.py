"""Compiled division of a submap's voxels among the nodes of its path.

Bricks are rows ``(n, 512) int16`` with signed coordinates ``(n, 3) int64``, as in `evidence.layout`. Coordinates are in
voxels; the caller stretches the heights.
"""

from __future__ import annotations

import numpy as np

from graphslam.evidence.kernels import kernel


@kernel()
def own_voxels(coordinates, values, stretch, points, nodes, reach, layers, owners):
    """Fill ``owners (n, 512) int32`` with the node of the nearest place of a path; -1 where unknown or out of reach.

    ``points (p, 3)`` are the places [voxels, heights times ``stretch``], ``nodes (p,)`` whose they are; ``reach``
    [voxels] is true distance, heights not stretched. Of places at the same distance the first counts. Places that are
    farther from the middle of a block than the nearest one by more than its diagonal are nearest to none of its voxels:
    so most are passed over, first for a brick, then for each of its layers.
    """
    p = points.shape[0]
    near, far = np.empty(p, np.int64), np.empty(p)
    close = np.empty(p, np.int64)
    brick = np.sqrt(128.0 + 64.0 * stretch * stretch) + 1e-9  # diagonals of a stretched brick, and of a layer of it
    layer = np.sqrt(128.0 + stretch * stretch) + 1e-9
    true = max(1.0, 1.0 / stretch)  # true distance is at most so much of the stretched one
    for b in range(coordinates.shape[0]):
        x0, y0, z0 = 8.0 * coordinates[b, 0], 8.0 * coordinates[b, 1], 8.0 * coordinates[b, 2]
        least = np.inf
        for k in range(p):
            dx, dy, dz = points[k, 0] - x0 - 4.0, points[k, 1] - y0 - 4.0, points[k, 2] - stretch * (z0 + 4.0)
            far[k] = np.sqrt(dx * dx + dy * dy + dz * dz)
            least = min(least, far[k])
        n = 0
        for k in range(p):
            if far[k] <= least + brick:
                near[n] = k
                n += 1
        for v in range(512):
            owners[b, v] = -1
        for h in range(layers):
            least = np.inf
            for i in range(n):
                k = near[i]
                dx, dy, dz = points[k, 0] - x0 - 4.0, points[k, 1] - y0 - 4.0, points[k, 2] - stretch * (z0 + h + 0.5)
                far[i] = np.sqrt(dx * dx + dy * dy + dz * dz)
                least = min(least, far[i])
            m, one = 0, True
            for i in range(n):
                if far[i] <= least + layer:
                    close[m] = near[i]
                    one = one and nodes[close[m]] == nodes[close[0]]
                    m += 1
            one = one and (least + layer) * true <= reach
            for v in range(64 * h, 64 * h + 64):
                if values[b, v] == -32768:
                    continue
                if one:
                    owners[b, v] = nodes[close[0]]
                    continue
                x, y, z = x0 + (v & 7) + 0.5, y0 + ((v >> 3) & 7) + 0.5, z0 + h + 0.5
                best, chosen = np.inf, -1
                for i in range(m):
                    k = close[i]
                    dx, dy, dz = points[k, 0] - x, points[k, 1] - y, points[k, 2] - stretch * z
                    d = dx * dx + dy * dy + dz * dz
                    if d < best:
                        best, chosen = d, k
                dx, dy = points[chosen, 0] - x, points[chosen, 1] - y
                dz = points[chosen, 2] / stretch - z
                if dx * dx + dy * dy + dz * dz <= reach * reach:
                    owners[b, v] = nodes[chosen]


@kernel()
def count_owned(owners, counts):
    """Bricks in which each node owns something, ``counts (m,)``."""
    seen = np.full(counts.shape[0], -1, np.int64)
    for b in range(owners.shape[0]):
        for v in range(512):
            o = owners[b, v]
            if o >= 0 and seen[o] != b:
                seen[o] = b
                counts[o] += 1


@kernel()
def distribute_voxels(owners, values, starts, places, dealt):
    """Copy each voxel to its owner's bricks.

    ``dealt (total, 512)`` is all unknown; the bricks of node m are its rows from ``starts[m]`` on, in the order of the
    source's; ``places (total,)`` becomes the source row of each.
    """
    m = starts.shape[0]
    seen = np.full(m, -1, np.int64)
    at = np.empty(m, np.int64)
    next_row = starts.copy()
    for b in range(owners.shape[0]):
        for v in range(512):
            o = owners[b, v]
            if o < 0:
                continue
            if seen[o] != b:
                seen[o] = b
                at[o] = next_row[o]
                places[at[o]] = b
                next_row[o] += 1
            dealt[at[o], v] = values[b, v]


@kernel()
def known_extents(coordinates, values, extents, box):
    """First known voxel and the one after the last per axis, of each brick ``extents (n, 6) int8`` [its voxels], all 0
    where nothing is known, and of all ``box (6,)`` [signed voxels]; returns how many are known."""
    for a in range(3):
        box[a], box[a + 3] = 1 << 40, -(1 << 40)
    known = 0
    for b in range(coordinates.shape[0]):
        x0, y0, z0, x1, y1, z1 = 8, 8, 8, 0, 0, 0
        n = 0
        for v in range(512):
            if values[b, v] != -32768:
                n += 1
                x, y, z = v & 7, (v >> 3) & 7, v >> 6
                x0, y0, z0 = min(x0, x), min(y0, y), min(z0, z)
                x1, y1, z1 = max(x1, x + 1), max(y1, y + 1), max(z1, z + 1)
        if n == 0:
            for a in range(6):
                extents[b, a] = 0
            continue
        known += n
        extents[b, 0], extents[b, 1], extents[b, 2] = x0, y0, z0
        extents[b, 3], extents[b, 4], extents[b, 5] = x1, y1, z1
        for a in range(3):
            box[a] = min(box[a], 8 * coordinates[b, a] + extents[b, a])
            box[a + 3] = max(box[a + 3], 8 * coordinates[b, a] + extents[b, a + 3])
    return known
