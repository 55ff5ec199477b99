"""The particle set of one submap: flat arrays, one compiled call per scan, resampling and ancestry."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from graphslam.core.gaussian import equal_tail_gate
from graphslam.core.geometry import Array, se2_transform, wrap_angle
from graphslam_frontends.grid.particles import effective_sample_size, normalise_log_weights, systematic_resample
from graphslam_frontends.landmarks.config import DELAYED, GATE_NEW, FilterConfig
from graphslam_frontends.landmarks.kernels import (
    CFG_LENGTH,
    IGNORED,
    MotionArrays,
    ParticleArrays,
    ScanArrays,
    fastslam_step,
)
from graphslam_frontends.landmarks.range_only import BeaconInitialisation, WaitingRanges

Ints = npt.NDArray[np.int64]


class ParticleSet:
    """N particles ``<w, S, μ_1, Σ_1, …>`` (Combined SLAM eq. 4) with their association (eq. 9).

    Parameters
    ----------
    sensor : (3,)
        ``T_base_sensor``.
    field_of_view : (2,)
        Bearings of the sensor [rad].
    miss_range : float
        A provisional feature nearer than this and in the field of view is expected to be observed [m].
    rng : numpy Generator
        Random numbers of this submap's branch of the seed tree.
    """

    def __init__(
        self,
        config: FilterConfig,
        sensor: Array,
        field_of_view: tuple[float, float],
        miss_range: float,
        rng: np.random.Generator,
    ) -> None:
        n = config.particles
        self.config, self.sensor, self.rng = config, sensor, rng
        self.pose = np.zeros((n, 3))
        self.log_weight = np.zeros(n)
        self.weights = np.full(n, 1.0 / n)
        self.ancestor = np.arange(n)
        self.count = np.zeros(n, dtype=np.int64)
        self.mean, self.cov = np.zeros((n, 32, 2)), np.zeros((n, 32, 3))
        self.hits, self.misses, self.born = (np.zeros((n, 32), dtype=np.int32) for _ in range(3))
        self.assoc = np.full((n, 256), IGNORED, dtype=np.int32)
        self.path = np.zeros((n, 64, 3))
        self.scans = 0
        self.observations = 0
        self.resamplings = 0
        self.min_ess = float(n)
        outlier = config.outlier_gate or np.inf
        self.waiting = WaitingRanges(n, DELAYED, equal_tail_gate(outlier, 2, 1))
        margin = np.deg2rad(1.0)  # at the edge of a scan a trunk is cut off and not reported
        self._cfg = np.zeros(CFG_LENGTH)
        self._cfg[:] = (
            1.0 if config.proposal == "2.0" else 0.0,
            config.gate,
            GATE_NEW,
            config.confirm_hits,
            config.drop_misses,
            config.drop_scans,
            miss_range,
            field_of_view[0] + margin,
            field_of_view[1] - margin,
            equal_tail_gate(config.gate, 2, 1),
            equal_tail_gate(GATE_NEW, 2, 1),
            outlier,
            equal_tail_gate(outlier, 2, 1),
        )

    def _grow_slots(self, new_slots: int) -> None:
        """Allocate space for ``new_slots`` more landmarks before the kernel needs it."""
        while self.count.max() + new_slots > self.mean.shape[1]:
            grow = ((0, 0), (0, self.mean.shape[1]))
            self.mean = np.pad(self.mean, (*grow, (0, 0)))
            self.cov = np.pad(self.cov, (*grow, (0, 0)))
            self.hits, self.misses, self.born = (np.pad(a, grow) for a in (self.hits, self.misses, self.born))

    def _grow_history(self, n_obs: int) -> None:
        """Allocate history for another scan with ``n_obs`` observations."""
        while self.observations + n_obs > self.assoc.shape[1]:
            self.assoc = np.pad(self.assoc, ((0, 0), (0, self.assoc.shape[1])), constant_values=IGNORED)
        if self.scans >= self.path.shape[1]:
            self.path = np.pad(self.path, ((0, 0), (0, self.path.shape[1]), (0, 0)))

    def _column(self) -> int:
        """First column of ``assoc`` for the observations of this scan."""
        return self.observations

    def _record(self, n_obs: int) -> None:
        """Store the history of the scan just processed."""
        self.path[:, self.scans] = self.pose

    def step(self, u: Array, Q: Array, observations: Array, known: Ints) -> None:
        """Process one scan: motion, association, weights, maps; then resampling if the effective size is low.

        Parameters
        ----------
        u, Q : (3,), (3, 3)
            Increment since the last scan and its right-tangent covariance.
        observations : (q, 4)
            Range, bearing and their variances.
        known : (q,)
            Slots in known-association mode, else -1.
        """
        n_obs = len(observations)
        highest = int(known.max()) + 1 if n_obs else 0
        self._grow_slots(max(n_obs, highest - int(self.count.max())))
        self._grow_history(n_obs)
        particles = ParticleArrays(
            self.pose, self.log_weight, self.mean, self.cov, self.hits, self.misses, self.born, self.count, self.assoc
        )
        motion = MotionArrays(u, Q, self.rng.standard_normal((len(self.pose), 3)))
        scan = ScanArrays(self.scans, self._column(), observations, known)
        fastslam_step(particles, scan, motion, self.sensor, self._cfg)
        if np.isinf(observations[:, 3]).any():
            self._wait_or_start(observations, known)
        self._record(n_obs)
        self.scans += 1
        self.observations += n_obs
        self.log_weight -= self.log_weight.max()
        self.weights = normalise_log_weights(self.log_weight)
        ess = effective_sample_size(self.weights)
        self.min_ess = min(self.min_ess, ess)
        uniform = self.rng.random()  # drawn every scan, so that random numbers do not depend on resampling
        if ess < self.config.ess_fraction * len(self.pose):
            self._resample(systematic_resample(self.weights, uniform))

    def _resample(self, survivors: Ints) -> None:
        m, t, q = int(self.count.max()), self.scans, self.observations
        self.pose, self.ancestor, self.count = self.pose[survivors], self.ancestor[survivors], self.count[survivors]
        for a in (self.mean, self.cov, self.hits, self.misses, self.born):
            a[:, :m] = a[survivors, :m]
        self.assoc[:, :q] = self.assoc[survivors, :q]
        self.path[:, :t] = self.path[survivors, :t]
        self._copy_waiting(survivors)
        self.log_weight[:] = 0.0
        self.weights[:] = 1.0 / len(self.weights)
        self.resamplings += 1

    def _wait_or_start(self, observations: Array, known: Ints) -> None:
        """Store the ranges of this scan to beacons without a landmark, and initialise those that have enough."""
        started = (self.hits[:, np.maximum(known, 0)] > 0).any(axis=0)
        new = np.flatnonzero(np.isinf(observations[:, 3]) & (known >= 0) & ~started)
        here = se2_transform(self.pose, self.sensor[:2])
        self.waiting.add(known[new], self.observations + new, observations[new, 0], observations[new, 2], here)
        for slot in np.unique(known[(known >= 0) & started]):
            self.waiting.forget(int(slot))  # initialised with a bearing: earlier ranges stay unused
        for start in self.waiting.ready(np.unique(known[new]), normalise_log_weights(self.log_weight)):
            j, ok = start.slot, start.solved
            self.mean[ok, j], self.cov[ok, j] = start.mean[ok], start.covariance[ok]
            self.hits[ok, j], self.misses[ok, j], self.born[ok, j] = start.used[ok].sum(axis=1), 0, self.scans
            self.count[ok] = np.maximum(self.count[ok], j + 1)
            # the ranges of the new landmark also weight the paths: likelihood with the landmark integrated out
            self.log_weight += np.where(ok, start.log_likelihood, -np.inf)
            self._note_past(start)

    def _note_past(self, start: BeaconInitialisation) -> None:
        """Store in the history which observations belong to the new landmark."""
        self.assoc[:, start.observations] = np.where(start.used & start.solved[:, None], start.slot, IGNORED)

    def _copy_waiting(self, source: Ints) -> None:
        """Row k of the stored ranges continues from row ``source[k]``."""
        self.waiting.resample(source)

    @property
    def best(self) -> int:
        """Index of the standard particle, the one of largest weight (B4); the first of equals."""
        return int(np.argmax(self.weights))

    @property
    def ancestors(self) -> int:
        """Number of distinct initial particles of the submap with descendants."""
        return len(np.unique(self.ancestor))

    @property
    def effective_ancestors(self) -> float:
        """Effective number of lineages ``1 / Σ f²``, f being the sum of the weights of each."""
        share = np.bincount(self.ancestor, weights=self.weights)
        return float(1.0 / np.sum(share**2))

    @property
    def confirmed(self) -> int:
        """Number of features of the standard particle that are no longer provisional."""
        return int(np.count_nonzero(self.hits[self.best] >= self.config.confirm_hits))

    def pose_std(self) -> Array:
        """Weighted standard deviation of x, y, θ over the particles ``(3,)``."""
        d = self.pose - self.pose[self.best]
        d[:, 2] = wrap_angle(d[:, 2])
        mean = self.weights @ d
        return np.asarray(np.sqrt(self.weights @ (d - mean) ** 2))
