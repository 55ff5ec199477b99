"""Particle weights and resampling, used by all particle filters of the project."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from graphslam.core.geometry import Array

Index = npt.NDArray[np.int64]


def normalise_log_weights(log_weights: Array) -> Array:
    """Weights ``(n,)`` summing to one from log-weights; uniform if none is finite."""
    m = np.max(log_weights)
    if not np.isfinite(m):
        return np.full(len(log_weights), 1.0 / len(log_weights))
    w = np.exp(log_weights - m)
    return np.asarray(w / w.sum())


def effective_sample_size(weights: Array) -> float:
    """``N_eff = 1 / Σ w²`` (SegSLAM eq. 7), for normalised weights."""
    return float(1.0 / np.sum(weights**2))


def systematic_resample(weights: Array, uniform: float) -> Index:
    """Indices ``(n,)`` of the survivors: one uniform draw, n equally spaced pointers (Arulampalam 2002).

    Each particle survives ``floor(n w)`` or ``ceil(n w)`` times; the expectation is ``n w``.
    """
    n = len(weights)
    positions = (np.arange(n) + uniform) / n
    chosen = np.searchsorted(np.cumsum(weights), positions, side="right")
    # rounding must not move the last pointer past the end, nor to a particle of zero weight
    return np.minimum(chosen, np.flatnonzero(weights > 0)[-1]).astype(np.int64)
