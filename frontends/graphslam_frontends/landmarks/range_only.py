"""Range-only beacons: delayed initialisation, per particle.

A range constrains the beacon to a circle, which no Gaussian describes. So ranges are stored, with the sensor position
of every particle, until a trilateration is well conditioned and unique; the fit then is the landmark, and its ranges
are used up. Their likelihood, with the beacon integrated out, weights the particles.

Each particle has its own fit from its own path, but all of them initialise a beacon at the same scan: weights are
comparable only between particles that used the same observations.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graphslam.core.geometry import Array
from graphslam_frontends.landmarks.config import DelayedInitialisation
from graphslam_frontends.landmarks.range_only_kernels import (
    FIT_LENGTH,
    FIT_LOG_LIKELIHOOD,
    FIT_MARGIN,
    FIT_MEAN_RANGE,
    FIT_USED,
    FIT_X,
    FIT_XX,
    FIT_XY,
    FIT_Y,
    FIT_YY,
    circle_starts,
    trilaterate_all_kernel,
    trilaterate_kernel,
)

Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]
_GROWTH = 1.2  # a beacon that could not be initialised is tried again with 20 % more ranges


@dataclass(frozen=True, slots=True)
class BeaconInitialisation:
    """Initialisation of a beacon as a landmark.

    Parameters
    ----------
    observations : (k,) int64
        Indices of the ranges used.
    used : (n, k) bool
        Which of them are inliers for each particle.
    solved : (n,) bool
        Particles with a fit; the others cannot explain the ranges.
    mean : (n, 2)
    covariance : (n, 3)
        xx, xy, yy, given the particle's path.
    log_likelihood : (n,)
        Of all k ranges given the path, with the beacon integrated out.
    """

    slot: int
    observations: Ints
    used: Bools
    solved: Bools
    mean: Array
    covariance: Array
    log_likelihood: Array


class WaitingRanges:
    """Stored ranges, with the sensor position of each of n particles.

    Parameters
    ----------
    limit : float
        χ² gate (1 dof) for outliers of the fit; inf = no outliers.
    """

    def __init__(self, particles: int, config: DelayedInitialisation, limit: float) -> None:
        self.config, self.limit = config, limit
        self._slot = np.zeros(0, dtype=np.int64)
        self._observation = np.zeros(0, dtype=np.int64)
        self._range, self._variance = np.zeros(0), np.zeros(0)
        self._anchor = np.zeros((particles, 0, 2))
        self._tried: dict[int, int] = {}
        self.unspent = 0
        """Number of ranges discarded because a bearing initialised the landmark first."""

    def __len__(self) -> int:
        """Number of stored ranges."""
        return len(self._slot)

    @property
    def slots(self) -> Ints:
        """Beacons with stored ranges."""
        return np.unique(self._slot)

    def add(self, slots: Ints, observations: Ints, ranges: Array, variances: Array, here: Array) -> None:
        """Store ranges.

        Parameters
        ----------
        slots, observations, ranges, variances : (k,)
        here : (n, 2)
            Sensor position of every particle.
        """
        self._slot = np.concatenate([self._slot, slots])
        self._observation = np.concatenate([self._observation, observations])
        self._range, self._variance = np.concatenate([self._range, ranges]), np.concatenate([self._variance, variances])
        self._anchor = np.concatenate([self._anchor, np.repeat(here[:, None], len(slots), axis=1)], axis=1)

    def resample(self, source: Ints) -> None:
        """Particle k continues from particle ``source[k]``."""
        if len(self):
            self._anchor = self._anchor[source]

    def forget(self, slot: int) -> None:
        """Discard the ranges of a beacon that was initialised otherwise."""
        self.unspent += self._take_out(slot)

    def _take_out(self, slot: int) -> int:
        keep = self._slot != slot
        if keep.all():
            return 0
        self._slot, self._observation = self._slot[keep], self._observation[keep]
        self._range, self._variance = self._range[keep], self._variance[keep]
        self._anchor = np.ascontiguousarray(self._anchor[:, keep])
        self._tried.pop(slot, None)
        return int((~keep).sum())

    def ready(self, slots: Ints, weights: Array) -> Iterator[BeaconInitialisation]:
        """Beacons among ``slots`` that can be initialised now; their ranges are removed from the store.

        Parameters
        ----------
        slots : (m,)
            Beacons with a new range.
        weights : (n,)
            Of the particles, normalised.
        """
        c = self.config
        best = int(np.argmax(weights))
        for slot in (int(s) for s in slots):
            rows = np.flatnonzero(self._slot == slot)
            if len(rows) < max(c.min_ranges, _GROWTH * self._tried.get(slot, 0)):
                continue
            self._tried[slot] = len(rows)
            z = np.ascontiguousarray(self._anchor[:, rows]), self._range[rows], self._variance[rows]
            # the best particle searches the circle, and the others start from its minima: their paths differ by motion
            # noise only
            starts = circle_starts(z[0][best], z[1], self.limit)
            fit, used, minima = np.empty(FIT_LENGTH), np.zeros(len(rows), dtype=np.bool_), np.empty((len(starts), 3))
            found = trilaterate_kernel(z[0][best], z[1], z[2], self.limit, starts, fit, used, minima)
            if not found or not self._good(fit[None], len(rows))[0]:
                continue
            n = len(weights)
            fits, used, solved = np.full((n, FIT_LENGTH), np.nan), np.zeros((n, len(rows)), bool), np.zeros(n, bool)
            trilaterate_all_kernel(*z, self.limit, np.ascontiguousarray(minima[:found, :2]), fits, used, solved)
            if float(weights[solved & self._good(fits, len(rows))].sum()) >= c.support:
                start = BeaconInitialisation(
                    slot=slot,
                    observations=self._observation[rows],
                    used=used,
                    solved=solved,
                    mean=fits[:, [FIT_X, FIT_Y]],
                    covariance=fits[:, [FIT_XX, FIT_XY, FIT_YY]],
                    log_likelihood=fits[:, FIT_LOG_LIKELIHOOD],
                )
                self._take_out(slot)
                yield start

    def _good(self, fits: Array, k: int) -> Bools:
        """Fits ``(n, FIT_LENGTH)`` of k ranges that are well conditioned and unique."""
        c = self.config
        a, b, d = fits[:, FIT_XX], fits[:, FIT_XY], fits[:, FIT_YY]
        largest = 0.5 * (a + d) + np.sqrt((0.5 * (a - d)) ** 2 + b**2)  # eigenvalue of the covariance
        return np.asarray(
            (fits[:, FIT_USED] >= max(c.min_ranges, 0.5 * k))
            & (np.sqrt(largest) <= c.spread * fits[:, FIT_MEAN_RANGE])
            & (fits[:, FIT_MARGIN] >= c.margin)
        )
