"""End of a submap (Combined SLAM B8): no features, lost diversity, enough features; and two practical limits."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from graphslam.core.geometry import Array
from graphslam_frontends.landmarks.config import StoppingConfig


class GrowingMap(Protocol):
    """State of a filter that the criteria read."""

    @property
    def scans(self) -> int:
        """Number of scans processed."""

    @property
    def confirmed(self) -> int:
        """Number of features that are no longer provisional (of the standard particle, if there are several)."""

    @property
    def resamplings(self) -> int:
        """Number of resamplings; 0 for a filter without particles."""

    @property
    def ancestors(self) -> int | None:
        """Number of initial particles with descendants; None for a filter without particles."""

    def pose_std(self) -> Array:
        """Standard deviation of x, y [m] and heading [rad], ``(3,)``."""


class StoppingRule:
    """The criteria for one growing submap."""

    def __init__(self, config: StoppingConfig) -> None:
        self.config = config
        self.without_features = 0.0
        self.distance = 0.0

    def reason(self, growing: GrowingMap, dt: float, u: Array, n_obs: int, epsilon: Array) -> str | None:
        """Reason why the submap ends after this scan, or None.

        Parameters
        ----------
        growing : GrowingMap
            The filter, after the scan.
        dt : float
            Seconds since the last scan.
        u : (3,)
            Motion since the last scan.
        n_obs : int
            Number of observations in this scan.
        epsilon : (3,)
            ε: mean measurement noise as x, y [m] and heading [rad].
        """
        c = self.config
        self.distance += float(np.hypot(u[0], u[1]))
        self.without_features = 0.0 if n_obs else self.without_features + dt
        if c.scans:
            return "scans" if growing.scans >= c.scans else None
        if growing.scans < c.min_scans:
            return None
        if self.without_features > 0.0:
            # (i) TIME = TIME_max · min(1, ε_x/σ_x, ε_y/σ_y, ε_θ/σ_θ)
            sigma = np.maximum(growing.pose_std(), 1e-12)
            if self.without_features > c.time_max * min(1.0, float(np.min(epsilon / sigma))):
                return "no-features"
        # (ii) diversity: only resampling reduces it
        if growing.resamplings > 0 and self._diversity_lost(growing):
            return "diversity"
        # (iii) enough features in the standard particle
        if growing.confirmed >= c.num_features:
            return "features"
        if self.distance >= c.max_distance:
            return "distance"
        return "scans" if growing.scans >= c.max_scans else None

    def _diversity_lost(self, growing: GrowingMap) -> bool:
        c = self.config
        if c.max_resamplings and growing.resamplings >= c.max_resamplings:
            return True
        return bool(c.min_ancestors and growing.ancestors is not None and growing.ancestors <= c.min_ancestors)
