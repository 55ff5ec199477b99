"""Slow, obvious twins of the registration package: one point, one cell, one start at a time."""

from __future__ import annotations

import numpy as np
import small_gicp

from graphslam.core import geometry as se2
from graphslam.core import se3
from graphslam.core.geometry import Array
from graphslam.registration.target import flat_shapes


def slow_field(points: Array, low: Array, shape: tuple[int, ...], cell: float, sigma: float) -> Array:
    """Field ``[z, y, x]``: of each cell the distance to every occupied cell, in 255ths."""
    occupied = np.unique(np.floor(points / cell), axis=0)
    out = np.zeros(shape, dtype=np.int64)
    for k in range(shape[0]):
        for j in range(shape[1]):
            for i in range(shape[2]):
                here = (np.array([i, j, k]) + low)[: points.shape[1]]
                d2 = np.min(np.sum((occupied - here) ** 2, axis=1)) * cell**2
                out[k, j, i] = np.rint(255 * np.exp(-0.5 * d2 / sigma**2)) if d2 <= (3 * sigma) ** 2 else 0
    return out


def slow_scores(points: Array, field, around: Array, axes: tuple[Array, Array, Array, Array]) -> Array:
    """Sums of the field ``[heading, z, y, x]`` at the offsets of four axes x, y, z, heading; a start at a time."""
    values, low = field.values.astype(np.int64), field._low
    out = np.zeros([len(a) for a in axes[::-1]], dtype=np.int64)
    for a, yaw in enumerate(axes[3]):
        if len(around) == 3:
            middle = se2.se2_transform(se2.se2_compose(around, [0, 0, yaw]), points)
            middle = np.column_stack([middle, np.zeros(len(points))])
            low3 = np.array([low[0], low[1], 0])
        else:
            turn = se3.quat_multiply([0, 0, np.sin(yaw / 2), np.cos(yaw / 2)], around[3:])
            middle = se3.quat_rotate(turn, points) + around[:3]
            low3 = low
        base = np.floor(middle / field.cell).astype(np.int64) - low3
        for k, z in enumerate(axes[2]):
            for j, y in enumerate(axes[1]):
                for i, x in enumerate(axes[0]):
                    total = 0
                    for cx, cy, cz in base + np.rint(np.array([x, y, z]) / field.cell).astype(np.int64):
                        inside = 0 <= cx < values.shape[2] and 0 <= cy < values.shape[1] and 0 <= cz < values.shape[0]
                        total += values[cz, cy, cx] if inside else 0
                    out[a, k, j, i] = total
    return out


def slow_maxima(weights: Array) -> list[tuple[int, ...]]:
    """Elements that no neighbour exceeds, nor equals before them."""
    found = []
    for at in np.ndindex(weights.shape):
        window = [range(max(0, c - 1), min(n, c + 2)) for c, n in zip(at, weights.shape)]
        good = weights[at] > -np.inf
        for other in np.stack(np.meshgrid(*window, indexing="ij"), -1).reshape(-1, len(at)):
            o = tuple(int(c) for c in other)
            if o != at and (weights[o] > weights[at] or (weights[o] == weights[at] and o < at)):
                good = False
        if good:
            found.append(at)
    return found


def gicp_hessian(source, target, T: Array, radius: float) -> tuple[Array, int]:
    """Hessian of generalised ICP at ``T (7,)``, a factor at a time."""
    (cloud, tree), (moving, _) = target.cloud, source.cloud
    rejector = small_gicp.DistanceRejector()
    rejector.set_max_distance(radius)
    factor, H, pairs = small_gicp.GICPFactor(), np.zeros((6, 6)), 0
    for k in range(len(source)):
        good, h, _, _ = factor.linearize(cloud, moving, tree, se3.pose_to_matrix(T), k, rejector)
        if good:
            H, pairs = H + h, pairs + 1
    return H, pairs


def planar_error(source, target, T: Array, radius: float, T_weights: Array) -> float:
    """Half squared error of generalised ICP in two dimensions, a pair at a time; shapes turned as at ``T_weights``,
    pairs as there.
    """
    R, total = se2.rotation2(T_weights[2]), 0.0
    own, other = (flat_shapes(t.normals(np.arange(len(t)))[0]) for t in (source, target))
    for p, C in zip(source.points, own):
        at = se2.se2_transform(T_weights, p)
        distances = np.hypot(*(target.points - at).T)
        k = int(np.argmin(distances))
        if distances[k] < radius:
            d = se2.se2_transform(T, p) - target.points[k]
            total += 0.5 * float(d @ np.linalg.inv(other[k] + R @ C @ R.T) @ d)
    return total
