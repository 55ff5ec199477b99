"""Scans of round trunks by ray casting, with their true centres."""

from __future__ import annotations

import numpy as np


def cast(centres: np.ndarray, radii: np.ndarray, bearings: np.ndarray, no_return: float) -> np.ndarray:
    """Exact ranges ``(m,)`` from the origin to circles at ``centres`` ``(k, 2)``."""
    d = np.stack([np.cos(bearings), np.sin(bearings)], -1)
    along = d @ centres.T
    square = radii**2 - (np.sum(centres**2, 1) - along**2)
    hit = (square > 0) & (along > 0)
    ranges = np.where(hit, along - np.sqrt(np.where(hit, square, 0.0)), no_return)
    return ranges.min(axis=1) if ranges.shape[1] else np.full(len(bearings), no_return)


def one_trunk_scans(
    rng: np.random.Generator,
    bearings: np.ndarray,
    *,
    n: int,
    distance: tuple[float, float],
    half_angle: tuple[float, float] | None = None,
    radius: tuple[float, float] | None = None,
    sigma: float,
    no_return: float = 81.91,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``n`` scans of one trunk each: ranges ``(n, m)``, true (range, bearing) ``(n, 2)`` and radii ``(n,)``.

    Either the half angle under which the trunk is seen, or its radius, is uniform. Range noise is Gaussian.
    """
    rho = rng.uniform(*distance, n)
    beta = rng.uniform(-1.2, 1.2, n)
    if half_angle is not None:
        R = rho * np.sin(rng.uniform(*half_angle, n))
    else:
        assert radius is not None
        R = rng.uniform(*radius, n)
    scans = np.empty((n, len(bearings)))
    for k in range(n):
        scans[k] = cast(rho[k] * np.array([[np.cos(beta[k]), np.sin(beta[k])]]), R[k : k + 1], bearings, no_return)
    hit = scans < no_return
    scans[hit] += rng.normal(0.0, sigma, int(hit.sum()))
    return scans, np.stack([rho, beta], -1), R
