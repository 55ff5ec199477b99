"""Learnt weights of detections: log-likelihood ratios by band and channel, and their combination to a probability.

The file of a table contains the training data's description. Tables belong to one sensor and one vehicle: its climbable
step defines which training cells are hazards.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.atomic import read_json, write_json
from graphslam.core.errors import ConfigError, FormatError
from graphslam.core.geometry import Array

FORMAT = "graphslam.terrain-tables/2"
BINS = 48
"""Bins of 1 cm; the last one contains all larger values."""
SCALE = 256
"""Ratios are stored as integers in units of 1/256, so that sums do not depend on their order."""
WEIGHTS = 9
"""Number of weights per band."""
DEFAULT = Path(__file__).with_name("tables.json")


@dataclass(frozen=True, slots=True, eq=False)
class TerrainWeights:
    """Learnt weights of detections.

    Parameters
    ----------
    ratios : (2, b, 48) int32
        Log-likelihood ratios of a step [cm] and of missing support [cm], hazard against free, in units of 1/256.
    weights : (b, 9)
        Per band ``p, a0, a1, q, b0, b1, c``, see `hazard_factors`, and ``u, v``, see `calibrated`.
    single : (9,)
        The same for a map with a single resolution.
    threshold : float
        Probability above which a cell is a hazard, from the training drives.
    provenance : dict
        Description of the training data.
    """

    ratios: npt.NDArray[np.int32]
    weights: Array
    single: Array
    threshold: float
    provenance: dict[str, Any]

    def __post_init__(self) -> None:
        ratios = np.ascontiguousarray(self.ratios, dtype=np.int32)
        weights = np.ascontiguousarray(self.weights, dtype=np.float64)
        if ratios.ndim != 3 or ratios.shape[0] != 2 or ratios.shape[2] != BINS:
            raise ConfigError(f"terrain tables have the shape {ratios.shape}; wanted (2, bands, {BINS})")
        if weights.shape != (ratios.shape[1], WEIGHTS) or not np.all(np.isfinite(weights)):
            raise ConfigError(
                f"weights of terrain tables: shape {weights.shape}; wanted ({ratios.shape[1]}, {WEIGHTS}), finite"
            )
        single = np.ascontiguousarray(self.single, dtype=np.float64)
        if single.shape != (WEIGHTS,) or not np.all(np.isfinite(single)):
            raise ConfigError(f"weights of a single resolution: shape {single.shape}; wanted ({WEIGHTS},), finite")
        if not 0.0 < self.threshold < 1.0:
            raise ConfigError(f"threshold of terrain tables: {self.threshold}; wanted between 0 and 1")
        object.__setattr__(self, "ratios", ratios)
        object.__setattr__(self, "weights", weights)
        object.__setattr__(self, "single", single)

    @property
    def bands(self) -> int:
        """Number of range bands."""
        return self.ratios.shape[1]

    def write(self, path: str | Path) -> None:
        """Write the weights as JSON."""
        write_json(
            path,
            {
                "format": FORMAT,
                "provenance": self.provenance,
                "threshold": self.threshold,
                "step": self.ratios[0].tolist(),
                "support": self.ratios[1].tolist(),
                "weights": np.round(self.weights, 6).tolist(),
                "single": np.round(self.single, 6).tolist(),
            },
        )


def read_tables(path: str | Path = DEFAULT) -> TerrainWeights:
    """Read a table file; default: that of the package, learnt for the panning line laser of the simulated streets."""
    shape = {
        "provenance": object, "threshold": float, "step": [[int]], "support": [[int]], "weights": [(float,) * WEIGHTS],
        "single": (float,) * WEIGHTS,
    }  # fmt: skip
    found = read_json(path, fmt=FORMAT, shape=shape)
    if not isinstance(found["provenance"], dict):
        raise FormatError("provenance is no mapping", where=str(path))
    try:
        ratios = np.array([found["step"], found["support"]], dtype=np.int32)
        weights, single = np.array(found["weights"]), np.array(found["single"])
        return TerrainWeights(ratios, weights, single, float(found["threshold"]), found["provenance"])
    except (ValueError, OverflowError, ConfigError) as error:
        raise FormatError(f"terrain tables that do not fit ({error})", where=str(path)) from None


def fixed_tables(bands: int, hit: float, miss: float) -> npt.NDArray[np.int32]:
    """Ratios ``(2, bands, 48)`` of a plain occupancy update: ``+hit`` from 6 cm on, ``−miss`` below."""
    rows = [np.where(np.arange(BINS) >= 6, hit, -miss)] * 2
    return np.repeat(np.round(SCALE * np.array(rows))[:, None], bands, axis=1).astype(np.int32)


def effective_count(count: Array) -> Array:
    """Effective number of ``count`` detections, at most 5: lines in one cell are not independent."""
    return count / (1.0 + count / 5.0)


def hazard_factors(ratios: Array, counts: Array, weights: Array) -> Array:
    """Probabilities ``(3, ...)`` that cells have no step, no missing support and no overhang.

    With ``n`` step detections whose ratios sum to ``L``, and ``m(n) = n / (1 + n/5)``, the first one is
    ``σ(−p − m (a0 + a1 L / n))``; the second one is ``σ(−q − m (b0 + b1 L / n))`` with the support detections; the
    third one is ``exp(−c n)`` with the number of lines with an obstacle at the height of the vehicle. Without
    detections it is 1.

    Parameters
    ----------
    ratios : (2, ...)
        Sums of log-likelihood ratios of steps and of support.
    counts : (3, ...)
        Detections of steps, of support, and lines with an obstacle at the height of the vehicle.
    weights : (9,)
    """
    p, a0, a1, q, b0, b1, c = weights[:7]
    out = np.ones(counts.shape)
    for k, (prior, shift, slope) in enumerate(((p, a0, a1), (q, b0, b1))):
        n = counts[k].astype(np.float64)
        x = prior + effective_count(n) * (shift + slope * ratios[k] / np.maximum(n, 1.0))
        out[k] = np.where(n > 0, 0.5 * (1.0 - np.tanh(0.5 * x)), 1.0)
    out[2] = np.exp(-c * counts[2])
    return out


def noisy_or(ratios: Array, counts: Array, weights: Array) -> Array:
    """Probability ``(...)`` of a hazard: that not all of the conditions in `hazard_factors` hold."""
    return np.asarray(1.0 - hazard_factors(ratios, counts, weights).prod(axis=0))


def calibrate_probability(p: Array, u: Array | float, v: Array | float) -> Array:
    """Probability whose log-odds are ``u + v · log-odds(p)``: calibrated frequencies (Platt scaling).

    Parameters
    ----------
    p : (...)
        Of the noisy-OR, NaN if unknown; clipped to 0.0001 … 0.9999.
    u, v : (...)
        Calibration, the last two weights.
    """
    q = np.clip(p, 1e-4, 1.0 - 1e-4)
    return np.asarray(1.0 / (1.0 + np.exp(-(u + v * np.log(q / (1.0 - q))))))
