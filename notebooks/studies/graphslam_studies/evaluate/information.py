"""Information matrices of many Gaussians."""

from __future__ import annotations

import numpy as np

from graphslam.core.errors import FormatError
from graphslam.core.geometry import Array


def information_matrices(covariances: Array, where: str) -> Array:
    """Information matrices of covariances ``(n, d, d)`` from a file."""
    finite = np.isfinite(covariances).all(axis=(1, 2))
    low = np.where(finite, 0.0, np.nan)
    low[finite] = np.linalg.eigvalsh(covariances[finite])[:, 0]
    with np.errstate(over="ignore", divide="ignore"):
        bad = ~(np.isfinite(1.0 / low) & (low > 0.0))
    if np.any(bad):
        raise FormatError(
            f"{int(bad.sum())} covariances are not positive definite, first: number {int(np.argmax(bad))}",
            where=where,
            got=f"smallest eigenvalue {low[bad][0]:.3g}",
            wanted="> 0; check units and time stamps",
        )
    try:
        inverse = np.linalg.inv(covariances)
    except np.linalg.LinAlgError:
        raise FormatError("a covariance is singular", where=where) from None
    return np.asarray(0.5 * (inverse + np.swapaxes(inverse, 1, 2)))
