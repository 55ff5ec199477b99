"""Selection of beams for the weights, and likelihoods of particles with young maps."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from graphslam.core.geometry import Array
from graphslam_frontends.grid.particles import normalise_log_weights

Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


def evenly_spaced_indices(n: int, most: int) -> Ints:
    """At most ``most`` (0: all) of ``n`` indices, ascending and evenly spaced; deterministic."""
    if most <= 0 or n <= most:
        return np.arange(n, dtype=np.int64)
    return (np.arange(most, dtype=np.int64) * n) // most


def maps_with_enough_scans(ages: Ints, young: int) -> Flags:
    """Which maps ``(n,)`` are used for weights: those of at least ``young`` scans or, without any, the oldest.

    Maps without any scan are never used.
    """
    oldest = int(ages.max(initial=0))
    return np.asarray((ages >= min(young, oldest)) & (ages > 0))


def fill_with_mean_likelihood(gains: Array, log_weights: Array, known: Flags) -> Array:
    """Log-likelihoods ``(n,)`` in which particles not ``known`` get the mean likelihood of the others.

    The mean is weighted by the prior weights, so it is the evidence ``p(z)`` of the ``known`` ones: the total weight of
    the others does not change. If none is ``known``: zeros.

    Parameters
    ----------
    gains : (n,)
        Log-likelihoods; only those of ``known`` particles are read.
    log_weights : (n,)
        Before this step.
    known : (n,) bool
    """
    out = np.zeros(len(gains))
    if not known.any():
        return out
    prior, new = normalise_log_weights(log_weights[known]), gains[known]
    top = float(new.max())
    out[known] = new
    out[~known] = top + float(np.log(np.sum(prior * np.exp(new - top))))
    return out
