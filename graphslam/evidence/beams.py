"""Beam model of an evidence grid: log-odds of a hit and of a miss, and the clamping bounds."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import ConfigError
from graphslam.evidence.layout import LIMIT, STEP


def log_odds(probability: float) -> float:
    """``log(p / (1 - p))``."""
    return math.log(probability / (1.0 - probability))


@dataclass(frozen=True, slots=True)
class BeamModel:
    """Inverse sensor model of a beam, in probabilities. The defaults are those of OctoMap.

    Parameters
    ----------
    hit : float
        Probability that a voxel is occupied, given that a beam ended in it; above 0.5.
    miss : float
        The same, given that a beam passed through it; below 0.5.
    clamp : (low, high)
        Bounds of the probability of a voxel, so that a map can adapt to changes.
    threshold : float
        A known voxel with at least this probability is occupied.
    """

    hit: float = 0.7
    miss: float = 0.4
    clamp: tuple[float, float] = (0.1192, 0.971)
    threshold: float = 0.5
    steps: npt.NDArray[np.int16] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        low, high = self.clamp
        for name, p in (("hit", self.hit), ("miss", self.miss), ("clamp", low), ("clamp", high)):
            if not 0.0 < p < 1.0:
                raise ConfigError(f"beam model: {name} is {p}; wanted a probability inside (0, 1)")
        if not 0.0 < self.threshold < 1.0:
            raise ConfigError(f"beam model: threshold is {self.threshold}; wanted a probability inside (0, 1)")
        if not self.miss < 0.5 < self.hit:
            raise ConfigError(f"beam model: miss {self.miss}, hit {self.hit}; wanted miss < 0.5 < hit")
        if not (low < 0.5 < high and low < self.threshold <= high):
            raise ConfigError(
                f"beam model: clamp ({low}, {high}), threshold {self.threshold}; "
                "wanted low < 0.5 < high, and the threshold between them"
            )
        values = [round(log_odds(p) / STEP) for p in (self.miss, self.hit, low, high, self.threshold)]
        if max(abs(v) for v in values[2:4]) + max(abs(v) for v in values[:2]) > LIMIT:
            raise ConfigError(f"beam model: clamp ({low}, {high}) is beyond the log-odds a voxel can hold (±16)")
        if values[0] == 0 or values[1] == 0:
            raise ConfigError(f"beam model: miss {self.miss}, hit {self.hit} change nothing; log-odds steps are {STEP}")
        object.__setattr__(self, "steps", np.array(values, np.int16))

    @property
    def miss_step(self) -> int:
        """Log-odds of a miss, in units of `layout.STEP`."""
        return int(self.steps[0])

    @property
    def hit_step(self) -> int:
        """Log-odds of a hit, in units of `layout.STEP`."""
        return int(self.steps[1])

    @property
    def clamp_steps(self) -> tuple[int, int]:
        """Bounds of the log-odds of a voxel, in units of `layout.STEP`."""
        return int(self.steps[2]), int(self.steps[3])

    @property
    def threshold_step(self) -> int:
        """Smallest value of an occupied voxel, in units of `layout.STEP`."""
        return int(self.steps[4])
