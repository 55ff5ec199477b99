"""Particle filter core: particles with a pose and an evidence grid each; motion, weights, resampling, map updates.

The caller calls the parts of a step in order: :meth:`GridFilter.predict`, :meth:`~GridFilter.weigh`,
:meth:`~GridFilter.record`, :meth:`~GridFilter.resample_if_needed`, :meth:`~GridFilter.update` (or all of them by
:meth:`~GridFilter.step`), and may change poses, maps and ages in between. All random numbers are from
``seed.child(purpose, step)``: the same seed gives identical results for any number of threads.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, cast

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import GeometryError
from graphslam.core.geometry import Array
from graphslam.core.poses import SE2, SE3
from graphslam.core.random import SeedTree
from graphslam.evidence.batch import update_grids
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.likelihood import CastLikelihood, EndpointLikelihood, log_weights
from graphslam.evidence.pool import GridPool
from graphslam.evidence.scan import UpdateReport
from graphslam_frontends.grid.ancestry import Ancestry
from graphslam_frontends.grid.config import GridFilterConfig
from graphslam_frontends.grid.motion import (
    motion_covariance,
    move_poses,
    square_root,
    walk_tilt_errors,
    with_roll_pitch,
)
from graphslam_frontends.grid.particles import effective_sample_size, normalise_log_weights, systematic_resample
from graphslam_frontends.grid.upright import upright_beams
from graphslam_frontends.grid.weights import evenly_spaced_indices, fill_with_mean_likelihood, maps_with_enough_scans

if TYPE_CHECKING:
    from graphslam_frontends.odometry.growing_steps import GrowingSteps
    from graphslam_frontends.odometry.steps import Steps

Ints = npt.NDArray[np.int64]

PARTS = ("predict", "weigh", "record", "resample", "update")
CAST_BEAMS = 60
"""Most ray-cast beams of a step in addition to the end points on vertical surfaces, evenly spaced."""


@dataclass(slots=True)
class GridParticles:
    """N particles.

    Parameters
    ----------
    poses : (N, 7) or (N, 3)
        ``T_map_body`` of each particle, in the frame of its own map.
    tilt_errors : (N, 2) or None
        Error of roll and pitch by gravity for each particle [rad]; None without gravity.
    grids : list of N EvidenceGrid
        All from one pool.
    log_weights : (N,)
        Normalised: their exponentials sum to one.
    ages : (N,) int64
        Number of scans in each map.
    scores : (N,)
        Accumulated log-likelihood of each particle's history, tempered as the weights are.
    """

    poses: Array
    tilt_errors: Array | None
    grids: list[EvidenceGrid]
    log_weights: Array
    ages: Ints
    scores: Array

    def __len__(self) -> int:
        return len(self.grids)

    @property
    def weights(self) -> Array:
        """Normalised weights ``(N,)``."""
        return normalise_log_weights(self.log_weights)

    @property
    def best(self) -> int:
        """Index of the largest weight; if equal, as after resampling, that of the largest score."""
        return int(np.lexsort((-np.arange(len(self)), self.scores, self.log_weights))[-1])

    def gain(self, log_likelihoods: Array) -> None:
        """Multiply likelihoods ``(N,)`` into the weights and the scores."""
        self.scores = self.scores + log_likelihoods
        total = self.log_weights + log_likelihoods
        with np.errstate(divide="ignore"):
            self.log_weights = np.log(normalise_log_weights(total))

    def take(self, ancestors: Ints) -> None:
        """Particle i becomes a copy of ``ancestors[i]``, with equal weights; maps are copied in constant time."""
        n = len(self)
        kept: set[int] = set()
        grids = []
        for a in ancestors.tolist():
            grids.append(self.grids[a].copy() if a in kept else self.grids[a])
            if self.grids[a].locked:
                grids[-1].lock()
            kept.add(a)
        self.grids = grids
        self.poses, self.ages, self.scores = self.poses[ancestors], self.ages[ancestors], self.scores[ancestors]
        if self.tilt_errors is not None:
            self.tilt_errors = self.tilt_errors[ancestors]
        self.log_weights = np.full(n, -np.log(n))


@dataclass(slots=True)
class FilterCounts:
    """Counts of a filter.

    Parameters
    ----------
    seconds : mapping of part to float
        Wall time [s].
    without_beams, without_returns : int
        Steps updated without a beam, and with beams but without returns.
    rays, dropped_rays : int
        Beams inserted into maps, and beams that could not be inserted, summed over the maps.
    """

    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PARTS, 0.0))
    resamplings: int = 0
    without_beams: int = 0
    without_returns: int = 0
    rays: int = 0
    dropped_rays: int = 0


class GridFilter:
    """A particle filter on evidence grids over prepared steps (SegSLAM eq. 1–7).

    Parameters
    ----------
    seed : SeedTree
        Of this filter only.
    first : int
        First step, with the particles at the start pose; earlier steps are not used.
    start : (7,), (3,), or (N, …), optional
        ``T_map_body`` at that step; default the origin, in 3-D with gravity `lift` above it. With gravity, roll and
        pitch are replaced by those measured.
    pool : GridPool, optional
        Storage of the maps; default one of its own.
    prune_every : int
        See :class:`~graphslam_frontends.grid.ancestry.Ancestry`.
    """

    def __init__(
        self,
        steps: Steps | GrowingSteps,
        config: GridFilterConfig,
        seed: SeedTree,
        *,
        first: int = 0,
        start: Array | None = None,
        pool: GridPool | None = None,
        prune_every: int = 32,
    ) -> None:
        if not 0 <= first < len(steps):
            raise GeometryError(
                f"no step {first} to start a filter at", where=steps.name, wanted=f"0 … {len(steps) - 1}"
            )
        self.steps, self.config, self.seed, self.first = steps, config, seed, first
        n, group = config.particles, SE2 if steps.dim == 2 else SE3
        self.tally = FilterCounts()
        empty = EvidenceGrid(
            config.voxel_size, model=config.beam_model(), pool=GridPool() if pool is None else pool, dim=steps.dim
        )
        at = np.array(group.identity) if start is None else np.asarray(start, dtype=np.float64)
        if start is None and steps.dim == 3:
            at[2] = self.lift
        width = group.size
        if at.shape not in ((width,), (n, width)) or not np.all(np.isfinite(at)):
            raise GeometryError("impossible start of a filter", got=at.shape, wanted=f"({width},) or ({n}, {width})")
        errors = None
        if steps.tilt is not None:
            errors = np.zeros((n, 2))
            if n > 1:
                errors = steps.tilt_sigma * self._normal("tilt", first, 2)
        self.particles = GridParticles(
            poses=np.array(np.broadcast_to(at, (n, width))),
            tilt_errors=errors,
            grids=[empty, *(empty.empty() for _ in range(n - 1))],
            log_weights=np.full(n, -np.log(n)),
            ages=np.zeros(n, dtype=np.int64),
            scores=np.zeros(n),
        )
        self._level(first)
        wanted = config.likelihood == "upright" and steps.tilt is not None
        self.upright = upright_beams(cast("Steps", steps)) if wanted else None
        self.ancestry = Ancestry(n, width, prune_every=prune_every)

    def __len__(self) -> int:
        return self.config.particles

    @property
    def lift(self) -> float:
        """Height of the body above the voxel boundary of a new map [m]; 0 without gravity."""
        return self.config.lift * self.config.voxel_size if self.steps.tilt is not None else 0.0

    @property
    def pool(self) -> GridPool:
        """Storage of the maps."""
        return self.particles.grids[0].pool

    @property
    def effective(self) -> float:
        """N_eff (eq. 7)."""
        return effective_sample_size(self.particles.weights)

    # --- the parts of a step ---------------------------------------------------------------------------------

    def predict(self, k: int) -> None:
        """Move to step k from the previous one (A1); no motion at the first step."""
        if k == self.first:
            return
        with self._timed("predict"):
            p, odometry = self.particles, self.steps.odometry
            increment = odometry.increments[k]
            noise = None
            if len(p) > 1:
                cov = motion_covariance(increment, odometry.covariances[k], self.config)
                noise = self._normal("motion", k, len(cov)) @ square_root(cov).T
            p.poses = move_poses(p.poses, increment, noise)
            if p.tilt_errors is not None and len(p) > 1:
                seconds = float(self.steps.times[k] - self.steps.times[k - 1])
                p.tilt_errors = walk_tilt_errors(
                    p.tilt_errors, seconds, self.steps.tilt_sigma, self.steps.tilt_time, self._normal("tilt", k, 2)
                )
            self._level(k)

    def weigh(self, k: int) -> Array:
        """Multiply the likelihood of step k's scan into the weights (A3); returns its logarithms ``(N,)``.

        Particles with a young map get the mean likelihood of the others; a scan without beams changes nothing.
        """
        with self._timed("weigh"):
            p, config = self.particles, self.config
            gains = np.zeros(len(p))
            points, origins, returns = self.steps.scan(k)
            weighed = self.weighed_beams(k)
            known = maps_with_enough_scans(p.ages, config.young)
            rows = np.flatnonzero(known)
            if weighed and len(rows):
                for beams, likelihood in weighed:
                    gains[rows] += log_weights(
                        [p.grids[i] for i in rows],
                        p.poses[rows],
                        points[beams],
                        likelihood,
                        origin=origins[beams],
                        max_range=self.steps.max_range,
                        returns=returns[beams],
                        threads=config.threads,
                    )
                gains = fill_with_mean_likelihood(gains, p.log_weights, known)
                p.gain(gains)
            return gains

    def record(self, tags: npt.ArrayLike | None = None) -> None:
        """Store poses, with tags ``(N,)``, in the ancestry: once per step, in their current frames."""
        with self._timed("record"):
            self.ancestry.record(self.particles.poses, tags)

    def resample_if_needed(self, k: int) -> Ints | None:
        """Resample if too few particles are effective (A4); returns the ancestor of each ``(N,)``, or None."""
        with self._timed("resample"):
            p = self.particles
            w = p.weights
            if len(p) == 1 or effective_sample_size(w) >= self.config.ess_fraction * len(p):
                return None
            ancestors = systematic_resample(w, float(self.seed.child("resample", k).generator().random()))
            p.take(ancestors)
            self.ancestry.branch(ancestors)
            self.tally.resamplings += 1
            return ancestors

    def update(self, k: int) -> UpdateReport:
        """Insert step k's scan into all maps that are not locked.

        Particles with the same map and pose, such as copies after resampling, share one update.
        """
        with self._timed("update"):
            p = self.particles
            points, origins, returns = self.steps.scan(k)
            if len(points) == 0:
                self.tally.without_beams += 1
                return UpdateReport()
            self.tally.without_returns += not returns.any()
            use = evenly_spaced_indices(len(points), self.config.map_beams)
            leads: dict[tuple[int, bytes, int], int] = {}
            first_of = np.empty(len(p), dtype=np.int64)
            for i, grid in enumerate(p.grids):
                # a locked map is not written, and counted once per handle
                key = (grid.root, p.poses[i].tobytes(), i if grid.locked else -1)
                first_of[i] = leads.setdefault(key, i)
            rows = sorted(leads.values())
            report = update_grids(
                [p.grids[i] for i in rows],
                p.poses[rows],
                points[use],
                origin=origins[use],
                max_range=self.steps.max_range,
                returns=returns[use],
                threads=self.config.threads,
            )
            for i in np.flatnonzero(first_of != np.arange(len(p))).tolist():
                p.grids[i].replace_contents(p.grids[int(first_of[i])])
            p.ages = p.ages + np.array([not g.locked for g in p.grids], dtype=np.int64)
            self.tally.rays += report.rays
            self.tally.dropped_rays += report.dropped
            return report

    def step(self, k: int) -> tuple[float, Ints | None]:
        """All parts of step k; returns N_eff before resampling, and the ancestors if resampled."""
        self.predict(k)
        self.weigh(k)
        self.record()
        effective = self.effective
        ancestors = self.resample_if_needed(k)
        self.update(k)
        return effective, ancestors

    # --- internals -------------------------------------------------------------------------------------------

    def weighed_beams(self, k: int) -> list[tuple[Ints, EndpointLikelihood | CastLikelihood]]:
        """Beams of step k for the weights, with their likelihood; only non-empty sets.

        End points use returns only; ray casting also uses beams without a return.
        """
        c, returns = self.config, self.steps.scan(k)[2]
        out: list[tuple[Ints, EndpointLikelihood | CastLikelihood]] = []
        if c.likelihood != "cast":
            first = 0 if self.upright is None else int(cast("Steps", self.steps).offsets[k])
            ends = returns if self.upright is None else self.upright[first : first + len(returns)]
            rows = _some(np.flatnonzero(ends), c.weight_beams)
            out.append((rows, c.by_end_points(len(rows))))
        if c.likelihood == "cast" or self.upright is not None:
            rows = evenly_spaced_indices(len(returns), c.weight_beams if self.upright is None else CAST_BEAMS)
            out.append((rows, c.by_casting(len(rows))))
        return [(rows, likelihood) for rows, likelihood in out if len(rows)]

    def _level(self, k: int) -> None:
        """Set roll and pitch of all particles from gravity at step k, minus each particle's error."""
        p = self.particles
        if p.tilt_errors is not None:
            assert self.steps.tilt is not None
            p.poses = with_roll_pitch(p.poses, self.steps.tilt[k] - p.tilt_errors)

    def _normal(self, purpose: str, k: int, d: int) -> Array:
        """Standard normal ``(N, d)`` for one purpose in one step."""
        return self.seed.child(purpose, k).generator().standard_normal((self.config.particles, d))

    @contextmanager
    def _timed(self, part: str) -> Iterator[None]:
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.tally.seconds[part] += time.perf_counter() - begin


def _some(rows: Ints, most: int) -> Ints:
    """At most ``most`` of the rows, evenly spaced."""
    return rows[evenly_spaced_indices(len(rows), most)]
