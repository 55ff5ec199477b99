"""Gaussian cells by the book: points in lists, everything looked for among all cells."""

from __future__ import annotations

import numpy as np

LEAST = 5


def plain_cells(points, size, least, planes, wide=0.0):
    """Centres ``(n, 3)`` and information ``(n, 3, 3)`` of the cells of points ``(m, 3)``; ``wide``: edge of others."""
    flat = (0.12 * size) ** 2
    larger = {cube: rows for cube, rows in _cubes(points, wide).items() if len(rows) >= LEAST} if wide else {}
    centres, information = [], []
    for rows in _cubes(points, size).values():
        if len(rows) < LEAST:
            continue
        mean = rows.mean(axis=0)
        values, V, surface, spread = _shape(rows, flat)
        A = surface * spread / (values[0] + least**2) * np.outer(V[:, 0], V[:, 0])
        rest = 0.0 if planes else max(1 - 2 * surface, 0)
        A = A + rest * V @ np.diag(1 / (values + least**2)) @ V.T
        around = larger.get(tuple(np.floor(mean / wide).astype(int))) if wide else None
        if spread < 1 and around is not None:
            _, W, surface2, spread2 = _shape(around, flat)
            normal = W[:, 0]
            own = normal @ np.cov(rows.T, bias=True) @ normal
            off = normal @ (mean - around.mean(axis=0))
            share = surface2 * spread2 * max(1 - (own + off**2) / flat, 0)
            if share > surface * spread:
                A = share / (own + least**2) * np.outer(normal, normal)
        centres.append(mean)
        information.append(A)
    return np.array(centres), np.array(information)


def _cubes(points, size):
    cubes = {}
    for p in points:
        cubes.setdefault(tuple(np.floor(p / size).astype(int)), []).append(p)
    return {cube: np.array(rows) for cube, rows in cubes.items()}


def _shape(rows, flat):
    """Variances, axes, how far it is a surface, how far points spread over two directions."""
    values, V = np.linalg.eigh(np.cov(rows.T, bias=True))
    return values, V, max(1 - values[0] / flat, 0), np.clip(values[1] / flat - 0.5, 0, 1)


def plain_fit(points, R, t, cells, information, scale):
    """Normal equations of points ``(n, 3)`` in the body on the given cell of each; None for points without."""
    H, g, weights = np.zeros((6, 6)), np.zeros(6), 0.0
    for p, cell, A in zip(points, cells, information):
        if cell is None or np.trace(A) <= 0:
            continue
        r = R @ p + t - cell
        m = r @ A @ r
        w = 1.0 / (1.0 + m / scale**2) ** 2
        J = R @ np.hstack([-_skew(p), np.eye(3)])
        H += w * J.T @ A @ J
        g += w * J.T @ A @ r
        weights += w
    return H, g, weights / len(points)


def plain_cost(points, R, t, cells, information, scale):
    """What the weights of :func:`plain_fit` are the derivative of: ``½ Σ m / (1 + m / scale²)``."""
    total = 0.0
    for p, cell, A in zip(points, cells, information):
        if cell is not None:
            r = R @ p + t - cell
            m = r @ A @ r
            total += 0.5 * m / (1.0 + m / scale**2)
    return total


def _skew(v):
    x, y, z = v
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
