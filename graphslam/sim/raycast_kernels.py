"""Compiled ray casting: a bounding-box tree, the first triangle along each ray, the nearest point of the mesh.

Arrays of the tree, depth first: ``boxes`` (m, 6) low and high corners, slightly enlarged so that rounding misses no
triangle; ``first`` and ``count`` (m,): a leaf contains ``count`` triangles from ``first`` on; an inner node has count
0, its left child directly after it and its right child at ``first``. ``triangles`` (t, 9): a corner and the two edges
from it, in the order of the leaves. All in double precision and deterministic.
"""

from __future__ import annotations

import math

import numpy as np

from graphslam.core.jit import callee
from graphslam.evidence.kernels import kernel

_LEAF = 4  # triangles of a leaf
_BINS = 12  # places where a box may be cut, along each axis
_DEPTH = 128
_MARGIN = 1e-9  # relative to the size of the mesh: enlargement of a box, and tolerance at the edges of a triangle


@callee(error_model="numpy")
def _half_area(low, high):
    a, b, c = high[0] - low[0], high[1] - low[1], high[2] - low[2]
    return a * b + b * c + c * a


@kernel(error_model="numpy")
def build_kernel(low, high, boxes, first, count, order):
    """Tree over boxes ``low``, ``high`` (t, 3) by the surface-area heuristic; returns how many nodes were made.

    ``boxes`` (2t, 6), ``first``, ``count`` (2t,) and ``order`` (t,) = 0 … t-1 are written.
    """
    n = len(order)
    extent = 0.0
    for axis in range(3):
        extent = max(extent, np.max(np.abs(low[:, axis])), np.max(np.abs(high[:, axis])))
    margin = _MARGIN * extent
    stack = np.empty((_DEPTH, 3), np.int64)  # from, to, the node whose right child this is (-1: none)
    stack[0] = (0, n, -1)
    top, nodes = 1, 0
    a, b, middle_low, middle_high = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    bins, bin_low, bin_high = np.empty(_BINS, np.int64), np.empty((_BINS, 3)), np.empty((_BINS, 3))
    right_cost = np.empty(_BINS)
    while top:
        top -= 1
        start, end, parent = stack[top]
        node = nodes
        nodes += 1
        if parent >= 0:
            first[parent] = node
        a[:], b[:], middle_low[:], middle_high[:] = math.inf, -math.inf, math.inf, -math.inf
        for i in range(start, end):
            k = order[i]
            for axis in range(3):
                a[axis], b[axis] = min(a[axis], low[k, axis]), max(b[axis], high[k, axis])
                m = low[k, axis] + high[k, axis]
                middle_low[axis], middle_high[axis] = min(middle_low[axis], m), max(middle_high[axis], m)
        for axis in range(3):
            boxes[node, axis], boxes[node, 3 + axis] = a[axis] - margin, b[axis] + margin
        # the cut with the least expected number of triangles that a ray must be tested against
        best, best_axis, best_bin = math.inf, -1, 0
        for axis in range(3):
            width = middle_high[axis] - middle_low[axis]
            if end - start <= _LEAF or not width > 0.0:
                continue
            bins[:], bin_low[:], bin_high[:] = 0, math.inf, -math.inf
            for i in range(start, end):
                k = order[i]
                j = min(int((low[k, axis] + high[k, axis] - middle_low[axis]) / width * _BINS), _BINS - 1)
                bins[j] += 1
                for other in range(3):
                    bin_low[j, other] = min(bin_low[j, other], low[k, other])
                    bin_high[j, other] = max(bin_high[j, other], high[k, other])
            a[:], b[:] = math.inf, -math.inf
            held = 0
            for j in range(_BINS - 1, 0, -1):
                held += bins[j]
                for other in range(3):
                    a[other], b[other] = min(a[other], bin_low[j, other]), max(b[other], bin_high[j, other])
                right_cost[j] = held * _half_area(a, b) if held else math.inf
            a[:], b[:] = math.inf, -math.inf
            held = 0
            for j in range(_BINS - 1):
                held += bins[j]
                for other in range(3):
                    a[other], b[other] = min(a[other], bin_low[j, other]), max(b[other], bin_high[j, other])
                if held:
                    cost = held * _half_area(a, b) + right_cost[j + 1]
                    if cost < best:
                        best, best_axis, best_bin = cost, axis, j
        if best_axis < 0 or top + 2 > _DEPTH:
            first[node], count[node] = start, end - start
            continue
        width = middle_high[best_axis] - middle_low[best_axis]
        cut = start
        for i in range(start, end):
            k = order[i]
            m = low[k, best_axis] + high[k, best_axis]
            if min(int((m - middle_low[best_axis]) / width * _BINS), _BINS - 1) <= best_bin:
                order[i], order[cut] = order[cut], k
                cut += 1
        count[node] = 0
        stack[top] = (cut, end, node)
        stack[top + 1] = (start, cut, -1)
        top += 2
    return nodes


@callee(error_model="numpy")
def _enters(box, x, y, z, ix, iy, iz, until):
    """Where a ray with inverse direction enters a box; infinite if it does not before ``until``."""
    t0, t1 = (box[0] - x) * ix, (box[3] - x) * ix
    near, far = min(t0, t1), max(t0, t1)
    t0, t1 = (box[1] - y) * iy, (box[4] - y) * iy
    near, far = max(near, min(t0, t1)), min(far, max(t0, t1))
    t0, t1 = (box[2] - z) * iz, (box[5] - z) * iz
    near, far = max(near, min(t0, t1), 0.0), min(far, max(t0, t1))
    return near if near <= far and near < until else math.inf


@callee(error_model="numpy")
def _inverse(d):
    # a finite number instead of infinity, because 0 × ∞ is undefined
    return 1.0 / d if abs(d) > 1e-200 else 1e200


@kernel(error_model="numpy")
def ranges_kernel(rays, boxes, first, count, triangles, out):
    """Distance to the first triangle along rays (n, 6), in units of their directions; infinite where there is none."""
    stack, enter = np.empty(_DEPTH, np.int64), np.empty(_DEPTH)
    for r in range(len(rays)):
        x, y, z, dx, dy, dz = rays[r, 0], rays[r, 1], rays[r, 2], rays[r, 3], rays[r, 4], rays[r, 5]
        ix, iy, iz = _inverse(dx), _inverse(dy), _inverse(dz)
        best = math.inf
        stack[0], enter[0] = 0, _enters(boxes[0], x, y, z, ix, iy, iz, best)
        top = 1
        while top:
            top -= 1
            if not enter[top] < best:
                continue
            node = stack[top]
            if count[node]:
                for k in range(first[node], first[node] + count[node]):
                    t = triangles[k]
                    # Möller and Trumbore: solve o + s d = corner + u e + v f
                    px, py, pz = dy * t[8] - dz * t[7], dz * t[6] - dx * t[8], dx * t[7] - dy * t[6]
                    det = t[3] * px + t[4] * py + t[5] * pz
                    if det == 0.0:
                        continue
                    one = 1.0 / det
                    wx, wy, wz = x - t[0], y - t[1], z - t[2]
                    u = (wx * px + wy * py + wz * pz) * one
                    if u < -_MARGIN or u > 1.0 + _MARGIN:
                        continue
                    qx, qy, qz = wy * t[5] - wz * t[4], wz * t[3] - wx * t[5], wx * t[4] - wy * t[3]
                    v = (dx * qx + dy * qy + dz * qz) * one
                    if v < -_MARGIN or u + v > 1.0 + _MARGIN:
                        continue
                    s = (t[6] * qx + t[7] * qy + t[8] * qz) * one
                    if 0.0 < s < best:
                        best = s
                continue
            left, right = node + 1, first[node]
            a = _enters(boxes[left], x, y, z, ix, iy, iz, best)
            b = _enters(boxes[right], x, y, z, ix, iy, iz, best)
            if a > b:  # the nearer one is on top of the stack and is visited first
                left, right, a, b = right, left, b, a
            if b < math.inf:
                stack[top], enter[top] = right, b
                top += 1
            if a < math.inf:
                stack[top], enter[top] = left, a
                top += 1
        out[r] = best


@callee(error_model="numpy")
def _box_distance2(box, x, y, z):
    a = max(box[0] - x, x - box[3], 0.0)
    b = max(box[1] - y, y - box[4], 0.0)
    c = max(box[2] - z, z - box[5], 0.0)
    return a * a + b * b + c * c


@callee(error_model="numpy")
def _segment_distance2(wx, wy, wz, ex, ey, ez):
    """Squared distance from w, relative to the segment's start, to the segment e."""
    length2 = ex * ex + ey * ey + ez * ez
    s = min(max((wx * ex + wy * ey + wz * ez) / length2, 0.0), 1.0) if length2 > 0.0 else 0.0
    a, b, c = wx - s * ex, wy - s * ey, wz - s * ez
    return a * a + b * b + c * c


@callee(error_model="numpy")
def _triangle_distance2(t, x, y, z):
    wx, wy, wz = x - t[0], y - t[1], z - t[2]
    ee = t[3] * t[3] + t[4] * t[4] + t[5] * t[5]
    ff = t[6] * t[6] + t[7] * t[7] + t[8] * t[8]
    ef = t[3] * t[6] + t[4] * t[7] + t[5] * t[8]
    we = wx * t[3] + wy * t[4] + wz * t[5]
    wf = wx * t[6] + wy * t[7] + wz * t[8]
    area2 = ee * ff - ef * ef
    if area2 > 0.0:
        u, v = (ff * we - ef * wf) / area2, (ee * wf - ef * we) / area2
        if u >= 0.0 and v >= 0.0 and u + v <= 1.0:  # its foot lies inside
            a, b, c = wx - u * t[3] - v * t[6], wy - u * t[4] - v * t[7], wz - u * t[5] - v * t[8]
            return a * a + b * b + c * c
    d = _segment_distance2(wx, wy, wz, t[3], t[4], t[5])
    d = min(d, _segment_distance2(wx, wy, wz, t[6], t[7], t[8]))
    return min(d, _segment_distance2(wx - t[3], wy - t[4], wz - t[5], t[6] - t[3], t[7] - t[4], t[8] - t[5]))


@kernel(error_model="numpy")
def distances_kernel(points, boxes, first, count, triangles, out):
    """Distance of points (n, 3) to the nearest point of any triangle."""
    stack, away = np.empty(_DEPTH, np.int64), np.empty(_DEPTH)
    for r in range(len(points)):
        x, y, z = points[r, 0], points[r, 1], points[r, 2]
        best = math.inf
        stack[0], away[0] = 0, 0.0
        top = 1
        while top:
            top -= 1
            if not away[top] < best:
                continue
            node = stack[top]
            if count[node]:
                for k in range(first[node], first[node] + count[node]):
                    best = min(best, _triangle_distance2(triangles[k], x, y, z))
                continue
            left, right = node + 1, first[node]
            a, b = _box_distance2(boxes[left], x, y, z), _box_distance2(boxes[right], x, y, z)
            if a > b:
                left, right, a, b = right, left, b, a
            if b < best:
                stack[top], away[top] = right, b
                top += 1
            if a < best:
                stack[top], away[top] = left, a
                top += 1
        out[r] = math.sqrt(best)
