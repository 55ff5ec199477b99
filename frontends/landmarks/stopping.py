"""When a submap ends (Combined SLAM B8): no features, lost diversity, enough features; and two practical limits."""

from __future__ import annotations

import numpy as np

from frontends.landmarks.config import StoppingConfig
from frontends.landmarks.filter import ParticleSet
from graphslam.core.geometry import Array


class Stopping:
    """Watches one submap grow.

    Parameters
    ----------
    config : StoppingConfig
    confirm_hits : int
        Sightings that make a feature count.
    measurement_sigma : (3,)
        ε: mean measurement noise as x, y [m] and heading [rad].
    """

    def __init__(self, config: StoppingConfig, confirm_hits: int, measurement_sigma: Array) -> None:
        self.config, self.confirm_hits, self.epsilon = config, confirm_hits, measurement_sigma
        self.without_features = 0.0
        self.distance = 0.0

    def reason(self, particles: ParticleSet, dt: float, u: Array, n_obs: int) -> str | None:
        """Why the submap ends after this scan, or None.

        Parameters
        ----------
        dt : float
            Seconds since the last scan.
        u : (3,)
            Motion since the last scan.
        n_obs : int
            Features seen in this scan.
        """
        c = self.config
        self.distance += float(np.hypot(u[0], u[1]))
        self.without_features = 0.0 if n_obs else self.without_features + dt
        if particles.scans < c.min_scans:
            return None
        if self.without_features > 0.0:
            # (i) TIME = TIME_max · min(1, ε_x/σ_x, ε_y/σ_y, ε_θ/σ_θ)
            sigma = np.maximum(particles.pose_std(), 1e-12)
            if self.without_features > c.time_max * min(1.0, float(np.min(self.epsilon / sigma))):
                return "no-features"
        # (ii) diversity
        if c.max_resamplings and particles.resamplings >= c.max_resamplings:
            return "diversity"
        if c.min_ancestors and particles.ancestors <= c.min_ancestors < particles.config.particles:
            return "diversity"
        # (iii) enough features in the standard particle
        if int(np.count_nonzero(particles.hits[particles.best] >= self.confirm_hits)) >= c.num_features:
            return "features"
        if self.distance >= c.max_distance:
            return "distance"
        return "scans" if particles.scans >= c.max_scans else None
