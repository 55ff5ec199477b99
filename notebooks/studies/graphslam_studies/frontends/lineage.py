"""Particle set with one map of a whole log; paths and associations are stored with an ancestry tree.

In a submap of about a minute, each particle can store its own path and associations. Over a whole log, this would copy
megabytes at every resampling. Here the poses and associations of a scan are stored once, together with the parent of
each particle. A survivor keeps its row, so a resampling copies one map per particle that is replaced, and nothing else.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from graphslam.core.geometry import Array
from graphslam_frontends.landmarks.config import FilterConfig
from graphslam_frontends.landmarks.filter import ParticleSet
from graphslam_frontends.landmarks.kernels import IGNORED
from graphslam_frontends.landmarks.range_only import BeaconInitialisation
from graphslam_frontends.landmarks.summarise import majority_slots

Ints = npt.NDArray[np.int64]


class SingleMapParticles(ParticleSet):
    """N particles over a whole log.

    Parameters
    ----------
    config, sensor, field_of_view, miss_range, rng
        As in :class:`graphslam_frontends.landmarks.filter.ParticleSet`.
    """

    def __init__(
        self,
        config: FilterConfig,
        sensor: Array,
        field_of_view: tuple[float, float],
        miss_range: float,
        rng: np.random.Generator,
    ) -> None:
        super().__init__(config, sensor, field_of_view, miss_range, rng)
        n = config.particles
        self.path = np.zeros((n, 0, 3))  # see :meth:`paths`
        self._by_identity = config.association == "known"
        self._poses = np.zeros((64, n, 3))  # scan × particle: poses at that scan
        self._slots = np.full((256, n), IGNORED, dtype=np.int32)  # observation × particle: slots at that scan
        self._scan_of = np.zeros(256, dtype=np.int32)
        self._parents: list[tuple[int, Ints]] = []  # (number of scans, parent row of each row)

    def _grow_history(self, n_obs: int) -> None:
        if n_obs > self.assoc.shape[1]:
            self.assoc = np.full((len(self.assoc), 2 * n_obs), IGNORED, dtype=np.int32)
        self.assoc[:] = IGNORED  # for the current scan only
        if self.scans >= len(self._poses):
            self._poses = np.concatenate([self._poses, np.zeros_like(self._poses)])
        if self._by_identity:
            return
        while self.observations + n_obs > len(self._slots):
            self._slots = np.concatenate([self._slots, np.full_like(self._slots, IGNORED)])
            self._scan_of = np.concatenate([self._scan_of, np.zeros_like(self._scan_of)])

    def _column(self) -> int:
        return 0

    def _record(self, n_obs: int) -> None:
        self._poses[self.scans] = self.pose
        if not self._by_identity:
            rows = slice(self.observations, self.observations + n_obs)
            self._slots[rows] = self.assoc[:, :n_obs].T
            self._scan_of[rows] = self.scans

    def _note_past(self, start: BeaconInitialisation) -> None:
        pass  # known identities: no association history is stored; otherwise no range waits for initialisation

    def _resample(self, survivors: Ints) -> None:
        copies = np.bincount(survivors, minlength=len(self.pose))
        source = np.arange(len(self.pose))
        source[copies == 0] = np.repeat(source, np.maximum(copies - 1, 0))
        dead = np.flatnonzero(copies == 0)
        parent, m = source[dead], int(self.count.max())
        self.pose[dead], self.ancestor[dead], self.count[dead] = (
            self.pose[parent],
            self.ancestor[parent],
            self.count[parent],
        )
        for a in (self.mean, self.cov, self.hits, self.misses, self.born):
            a[dead, :m] = a[parent, :m]
        self._copy_waiting(source)
        self._parents.append((self.scans, source))
        self.log_weight[:] = 0.0
        self.weights[:] = 1.0 / len(self.weights)
        self.resamplings += 1

    def _stretches(self) -> list[tuple[int, int, Ints]]:
        """Intervals between resamplings: first scan, scan after the last, rows of the ancestors of the particles."""
        row, end, out = np.arange(len(self.pose)), self.scans, []
        for scan, source in reversed(self._parents):
            out.append((scan, end, row))
            row, end = source[row], scan
        out.append((0, end, row))
        return out[::-1]

    def paths(self) -> Array:
        """Path of every particle ``(scans, n, 3)``."""
        out = np.empty((self.scans, len(self.pose), 3))
        for a, b, row in self._stretches():
            out[a:b] = self._poses[a:b, row]
        return out

    def associations(self) -> Ints:
        """Slot of every observation in the history of every particle ``(observations, n)``; -1 if it was not used.

        Observations of a provisional feature that was deleted count as not used, even if its slot was reused.
        """
        q = self.observations
        scan_of = self._scan_of[:q]
        out = np.empty((q, len(self.pose)), dtype=np.int64)
        for a, b, row in self._stretches():
            rows = slice(*np.searchsorted(scan_of, [a, b]))
            out[rows] = self._slots[rows][:, row]
        particle = np.arange(len(self.pose))
        slot = np.maximum(out, 0)
        unused = (self.hits[particle, slot] == 0) | (scan_of[:, None] < self.born[particle, slot])
        out[unused] = IGNORED
        return out

    def features(self, min_hits: int) -> tuple[Ints, Ints]:
        """Common features of the particles, in the order of the standard particle (B4, eq. 9–11).

        Parameters
        ----------
        min_hits : int
            Features observed less often by the standard particle are omitted.

        Returns
        -------
        kept : (k,)
            Particles that have all of these features.
        slots : (k, L)
            Their slots.
        """
        best = self.best
        chosen = np.flatnonzero(self.hits[best, : self.count[best]] >= min_hits)
        if self._by_identity:  # the slot is the identity
            kept = np.flatnonzero(np.all(self.hits[:, chosen] > 0, axis=1))
            return kept, np.broadcast_to(chosen, (len(kept), len(chosen)))
        table = self.associations()
        rank = np.full(self.hits.shape[1] + 1, -1, dtype=np.int64)  # the last entry is for slot -1
        rank[chosen] = np.arange(len(chosen))
        feature = rank[table[:, best]]
        used = feature >= 0
        return majority_slots(table[used].T, feature[used], len(chosen))
