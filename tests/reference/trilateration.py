"""Slow obvious twin of the trilateration: a grid over the plane, scipy from the grid's local minima, quadrature."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares


def residuals(p, anchors, ranges, variances):
    return (np.hypot(*(p - anchors).T) - ranges) / np.sqrt(variances)


def all_minima(anchors, ranges, variances, *, reach=60.0, step=0.5):
    """Local minima of χ² over a grid around the anchors, polished: ``(m, 3)`` x, y, χ², best first."""
    centre = anchors.mean(axis=0)
    g = np.arange(-reach, reach, step)
    x, y = np.meshgrid(centre[0] + g, centre[1] + g, indexing="ij")
    d = np.sqrt((x[..., None] - anchors[:, 0]) ** 2 + (y[..., None] - anchors[:, 1]) ** 2)
    cost = np.sum((d - ranges) ** 2 / variances, axis=-1)
    inner = cost[1:-1, 1:-1]
    neighbours = [
        cost[1 + a : len(g) - 1 + a, 1 + b : len(g) - 1 + b] for a in (-1, 0, 1) for b in (-1, 0, 1) if a or b
    ]
    low = np.argwhere(np.all([inner <= n for n in neighbours], axis=0)) + 1
    found = []
    for i, j in low:
        s = least_squares(residuals, [x[i, j], y[i, j]], args=(anchors, ranges, variances), xtol=1e-14, ftol=1e-14)
        if all(np.hypot(*(s.x - f[:2])) > 1e-3 for f in found):
            found.append(np.array([*s.x, 2 * s.cost]))
    return np.array(sorted(found, key=lambda f: f[2]))


def covariance(p, anchors, ranges, variances, h=1e-6):
    """Inverse of the Gauss-Newton matrix, its Jacobian by central differences."""
    J = np.array(
        [
            (residuals(p + e, anchors, ranges, variances) - residuals(p - e, anchors, ranges, variances)) / (2 * h)
            for e in h * np.eye(2)
        ]
    ).T
    return np.linalg.inv(J.T @ J)


def log_evidence(p, spread, anchors, ranges, variances):
    """Log of ∫ Π N(r; |l - p|, v) dl by quadrature over ±8 ``spread`` around p."""
    g = np.linspace(-8, 8, 801) * spread
    x, y = np.meshgrid(p[0] + g, p[1] + g, indexing="ij")
    log_density = np.zeros_like(x)
    for a, r, v in zip(anchors, ranges, variances):
        log_density -= 0.5 * ((np.hypot(x - a[0], y - a[1]) - r) ** 2 / v + np.log(2 * np.pi * v))
    top = log_density.max()
    return top + np.log(np.exp(log_density - top).sum() * (g[1] - g[0]) ** 2)
