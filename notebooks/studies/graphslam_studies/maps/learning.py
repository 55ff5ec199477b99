"""Learns the tables of the terrain from statements whose cells are known to be hazards or free."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.maps.terrain.lines import Rows
from graphslam.maps.terrain.tables import BINS, SCALE, noisy_or

Ints = npt.NDArray[np.int64]
_CLIP = 4.0
_LEAST = 20
_SLOPES = 0.5
"""Share of slopes among the free ground that weights are fitted on."""


def count_values(rows: Rows, labels: npt.NDArray[np.int8], bands: int) -> Ints:
    """Histograms ``(2, 3, bands, 48)`` of a channel's values: of even free cells, of legal slopes, and of hazards.

    Parameters
    ----------
    rows : (k, 6)
        Statements.
    labels : (2, k)
        For steps and for support, of the cell of each statement: 0 free, 1 free on a slope that may be driven, 2 a
        hazard, −1 neither.
    """
    out = np.zeros((2, 3, bands, BINS), np.int64)
    for channel in (0, 1):
        for kind in range(3):
            mine = rows[(rows[:, 4] == channel) & (labels[channel] == kind)]
            np.add.at(out[channel, kind], (mine[:, 1], np.minimum(mine[:, 5], BINS - 1)), 1)
    return out


def ratios_of(histograms: Ints) -> npt.NDArray[np.int32]:
    """Log-likelihood ratios ``(2, bands, 48)`` [1/256] of histograms: smoothed, at most ±4, 0 where none was seen.

    Of a hazard against that free ground, even or a legal slope, which says the value more often: slopes are rare in any
    street, but one that lies there must not be closed because the others are even.
    """
    h = histograms.astype(np.float64)
    # a triangle over neighbouring bins, so that a sparse bin does not stand alone
    wide = np.pad(h, ((0, 0), (0, 0), (0, 0), (1, 1)), mode="edge")
    h = 0.25 * wide[..., :-2] + 0.5 * wide[..., 1:-1] + 0.25 * wide[..., 2:]
    share = (h + 0.5) / (h.sum(axis=-1, keepdims=True) + 0.5 * BINS)
    taught = h[:, :2].sum(axis=-1, keepdims=True) >= _LEAST  # ground that was not taught says nothing
    free = np.where(taught | ~taught.any(axis=1, keepdims=True), share[:, :2], 0.0).max(axis=1)
    ratio = np.clip(np.log(share[:, 2]) - np.log(free), -_CLIP, _CLIP)
    return np.round(SCALE * np.where(h.sum(axis=1) >= 1.0, ratio, 0.0)).astype(np.int32)


def fit_weights(
    ratios: Array,
    counts: Array,
    hazard: npt.NDArray[np.bool_],
    slope: npt.NDArray[np.bool_] | None = None,
) -> Array:
    """Weights ``(9,)`` of one band by maximum likelihood, not yet calibrated.

    Legal slopes count as much as all even ground, however rare they were.

    Parameters
    ----------
    ratios : (2, k)
    counts : (3, k)
        Of cells; see :func:`~graphslam.maps.terrain.tables.hazard_factors`.
    hazard : (k,) bool
        The truth.
    slope : (k,) bool, optional
        Free cells on a slope that may be driven.
    """
    if min(int(hazard.sum()), int((~hazard).sum())) < _LEAST:
        raise DataError(
            "too few cells to learn from",
            got=f"{int(hazard.sum())} hazards, {int((~hazard).sum())} free",
            wanted=f"at least {_LEAST} of each",
        )

    share = np.ones(len(hazard))
    if slope is not None and slope.any() and (~hazard & ~slope).any():
        free = ~hazard
        even = free & ~slope
        share[slope], share[even] = _SLOPES * free.sum() / slope.sum(), (1.0 - _SLOPES) * free.sum() / even.sum()

    def weights(x: Array) -> Array:
        return np.array([x[0], x[1], np.exp(x[2]), x[3], x[4], np.exp(x[5]), np.exp(x[6]), 0.0, 1.0])

    def cost(x: Array) -> float:
        p = np.clip(noisy_or(ratios, counts, weights(x)), 1e-6, 1.0 - 1e-6)
        prior = 1e-6 * float(np.sum((x - start) ** 2))  # keeps a weight that no cell tells of where it began
        return -float(np.mean(share * np.where(hazard, np.log(p), np.log1p(-p)))) + prior

    start = np.array([-3.0, 0.0, 0.0, -3.0, 0.0, 0.0, 0.0])
    # a single line that saw something hang is never certain of it
    bounds = [(-8, -1), (-3, 3), (-4, 2), (-8, -1), (-3, 3), (-4, 2), (-4, math.log(2.0))]
    return weights(minimize(cost, start, method="L-BFGS-B", bounds=bounds, options={"ftol": 1e-10, "gtol": 1e-8}).x)


def fit_calibration(probability: Array, hazard: npt.NDArray[np.bool_]) -> Array:
    """Weights ``u, v`` of :func:`~graphslam.maps.terrain.tables.calibrate_probability` by maximum likelihood, ``v >
    0``.

    The noisy-OR was fitted to cells in which slopes weigh more than they are many; here every cell counts once.

    Parameters
    ----------
    probability : (k,)
        That the noisy-OR gives to cells.
    hazard : (k,) bool
        The truth.
    """
    p = np.clip(probability, 1e-4, 1.0 - 1e-4)
    odds = np.log(p / (1.0 - p))

    def cost(x: Array) -> float:
        z = x[0] + np.exp(x[1]) * odds
        return float(np.mean(np.logaddexp(0.0, z) - hazard * z)) + 1e-5 * float(x @ x)

    u, log_v = minimize(cost, np.zeros(2), method="L-BFGS-B", options={"ftol": 1e-12, "gtol": 1e-9}).x
    return np.array([u, np.exp(log_v)])
