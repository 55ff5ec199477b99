"""Gaussian cells by the book: points in lists, everything looked for among all cells."""

from __future__ import annotations

import numpy as np

LEAST = 5


def plain_cells(points, size, least, planes):
    """Centres ``(n, 3)`` and information ``(n, 3, 3)`` of the cells of points ``(m, 3)``."""
    cubes = {}
    for p in points:
        cubes.setdefault(tuple(np.floor(p / size).astype(int)), []).append(p)
    centres, information = [], []
    for rows in cubes.values():
        if len(rows) < LEAST:
            continue
        rows = np.array(rows)
        values, V = np.linalg.eigh(np.cov(rows.T, bias=True))
        if planes:
            flat = (0.12 * size) ** 2
            weight = max(1 - values[0] / flat, 0) * np.clip(values[1] / flat - 0.5, 0, 1) / (values[0] + least**2)
            A = weight * np.outer(V[:, 0], V[:, 0])
        else:
            A = V @ np.diag(1 / (values + least**2)) @ V.T
        centres.append(rows.mean(axis=0))
        information.append(A)
    return np.array(centres), np.array(information)


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
