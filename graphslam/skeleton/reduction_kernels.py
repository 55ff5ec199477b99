"""Numba kernels of the explicit reduced network: a block for any two poses that observed the same landmark (C4)."""

from __future__ import annotations

import numpy as np

from graphslam.core.jit import njit
from graphslam.skeleton.block_table_kernels import _find
from graphslam.skeleton.coarse_kernels import _add_lever, _weighted
from graphslam.skeleton.landmark_kernels import _nine, _seen


@njit(nogil=True)
def order_by_landmark(landmark, first, ptr, pose, measurement):
    """Sort observations by landmark: ``ptr (L + 1,)``, poses and measurements ``(M,)`` in pose order (output)."""
    for m in range(len(landmark)):
        ptr[landmark[m] + 1] += 1
    for j in range(len(ptr) - 1):
        ptr[j + 1] += ptr[j]
    fill = ptr[:-1].copy()
    for i in range(len(first) - 1):
        for m in range(first[i], first[i + 1]):
            at = fill[landmark[m]]
            pose[at], measurement[at] = i, m
            fill[landmark[m]] = at + 1


@njit(nogil=True)
def count_blocks(landmark, first, ptr, pose, step, mark):
    """Number of blocks on and right of the diagonal in the rows of every ``step``-th pose."""
    total = 0
    for i in range(0, len(first) - 1, step):
        for m in range(first[i], first[i + 1]):
            j = landmark[m]
            for e in range(ptr[j], ptr[j + 1]):
                if pose[e] >= i and mark[pose[e]] != i:
                    mark[pose[e]] = i
                    total += 1
    return total


@njit(nogil=True, error_model="numpy")
def eliminate_landmarks(detections, poses, landmarks, order, table):
    """Marginalise all landmarks: ``Σ Jᵀ W J`` on the diagonal, minus the pairs of observations, into ``table``.

    Parameters
    ----------
    landmarks : (l (L, 3), D⁻¹ (L, 6))
    order : (ptr, pose, measurement)
    """
    l, Di = landmarks
    ptr, pose, measurement = order
    N = len(poses.position)
    most = 0
    for j in range(len(ptr) - 1):
        most = max(most, ptr[j + 1] - ptr[j])
    X, Y = np.empty((most, 3, 6)), np.empty((most, 3, 6))
    W = np.empty(6)
    for j in range(len(ptr) - 1):
        a, n = ptr[j], ptr[j + 1] - ptr[j]
        for e in range(n):
            i, m = pose[a + e], measurement[a + e]
            nx, ny, nz, al, be = _seen(_nine(poses.rotation, i), detections, m)[3:]
            W[0], W[1], W[2] = al + be * nx * nx, be * nx * ny, be * nx * nz
            W[3], W[4], W[5] = al + be * ny * ny, be * ny * nz, al + be * nz * nz
            qx, qy, qz = l[j, 0] - poses.position[i, 0], l[j, 1] - poses.position[i, 1], l[j, 2] - poses.position[i, 2]
            _weighted(W, qx, qy, qz, X[e])
            _add_lever(qx, qy, qz, X[e], 1.0, table.block[_find(table, np.int64(i) * N + i)])
            for d in range(6):
                x, y, z = X[e, 0, d], X[e, 1, d], X[e, 2, d]
                Y[e, 0, d] = Di[j, 0] * x + Di[j, 1] * y + Di[j, 2] * z
                Y[e, 1, d] = Di[j, 1] * x + Di[j, 3] * y + Di[j, 4] * z
                Y[e, 2, d] = Di[j, 2] * x + Di[j, 4] * y + Di[j, 5] * z
        for e in range(n):
            for f in range(n):
                if pose[a + f] < pose[a + e]:
                    continue
                B = table.block[_find(table, np.int64(pose[a + e]) * N + pose[a + f])]
                for r in range(6):
                    x, y, z = X[e, 0, r], X[e, 1, r], X[e, 2, r]
                    for c in range(6):
                        B[r, c] -= x * Y[f, 0, c] + y * Y[f, 1, c] + z * Y[f, 2, c]
