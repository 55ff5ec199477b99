"""RBPF-EKF local maps: association by FastSLAM, Gaussian by one smoothing (Combined SLAM section 4)."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import CovarianceError
from graphslam.core.geometry import Array, vector_to_tangent_covariance
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.random import SeedTree
from graphslam.core.record_source import RecordSource
from graphslam.core.records import LandmarkObservations
from graphslam.core.submap import LandmarkMap, Submap
from graphslam.core.trajectory import Trajectory
from graphslam_frontends.base import FrontEnd, Watch
from graphslam_frontends.landmarks.bias_score import bias_score_test
from graphslam_frontends.landmarks.config import DELAYED, RbpfEkfConfig
from graphslam_frontends.landmarks.filter import ParticleSet
from graphslam_frontends.landmarks.fix_points import expects_fixes, fix_points, place_fixes
from graphslam_frontends.landmarks.mirror_ambiguity import resolve_mirror_ambiguity
from graphslam_frontends.landmarks.moment_consistency import (
    ParticleGaussians,
    consistency_flag,
    gaussian_discrepancy,
    particle_gaussians,
)
from graphslam_frontends.landmarks.prepare import LogPreparation, PreparedLog, known_slots, landmark_stream
from graphslam_frontends.landmarks.sensor_biases import estimate_sensor_biases, possible_biases
from graphslam_frontends.landmarks.stopping import StoppingRule
from graphslam_frontends.landmarks.summarise import (
    LandmarkAssociation,
    SmoothingProblem,
    SmoothingResult,
    winning_association,
)

Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class RbpfEkf(FrontEnd):
    """The front end ``rbpf-ekf``.

    Needs a stream of controls and one of landmark observations or, with the tree detector, of laser scans.
    """

    config: RbpfEkfConfig = field(default_factory=RbpfEkfConfig)
    name: ClassVar[str] = "rbpf-ekf"
    calibrates: ClassVar[str] = "observations"

    def with_calibration(self, log: SensorLog, asked: Mapping[str, Any], *, corrected: bool, drift: bool) -> FrontEnd:
        """See :class:`~graphslam_frontends.base.FrontEnd`.

        The graph estimates systematic errors that a calibration did not remove, or removed wrongly.
        """
        if not corrected or self.config.biases is not None or "biases" in asked:
            return self
        return type(self)(config=replace(self.config, biases=possible_biases(log, self.config.detector)))

    def follow(
        self,
        feed: RecordSource,
        *,
        seed: SeedTree,
        after: Submap | None = None,
        drops: DropCounter | None = None,
        watch: Watch | None = None,
    ) -> Iterator[Submap | None]:
        """See :class:`graphslam_frontends.base.FrontEnd`."""
        for found in self.with_particles(feed, seed=seed, after=after, drops=drops):
            yield None if found is None else found[0]

    def with_particles(
        self, feed: RecordSource, *, seed: SeedTree, after: Submap | None = None, drops: DropCounter | None = None
    ) -> Iterator[tuple[Submap, ParticleSet] | None]:
        """The submaps of :meth:`follow`, each with its particles at its last scan.

        For inspection; with pooled filters the particles of the first one.
        """
        data = LogPreparation(feed, self.config, drops if drops is not None else DropCounter())
        key, scan, t_start = yield from data.resume(after)
        while (yield from data.reach(scan)):
            submap, particles, scan = yield from self._build(data, key, scan, t_start, seed.child(key))
            yield submap, particles
            key, t_start = key + 1, submap.interval[1]

    def observations(self, log: SensorLog) -> tuple[str, LandmarkObservations]:
        """Name of the stream used, and the landmark observations in it (detected from raw scans if necessary)."""
        return landmark_stream(log, self.config.detector)

    def _build(
        self, growing: LogPreparation, key: int, first: int, t_start: float, seed: SeedTree
    ) -> Generator[None, None, tuple[Submap, ParticleSet, int]]:
        """Filter from scan ``first`` until the submap ends; returns it, its particles and the next scan."""
        c, obs = self.config, growing.prepared.observations
        miss_range = 0.9 * min(c.max_range, obs.max_range)
        branches = [seed, *(seed.child("pooled", k) for k in range(1, c.pooled))]
        filters = [
            ParticleSet(c, obs.T_base_sensor, obs.field_of_view, miss_range, branch.generator()) for branch in branches
        ]
        particles = filters[0]  # it alone determines the association; the others are for comparison
        stopping = StoppingRule(c.stopping)
        slots: dict[int, int] = {}
        ended, scan = None, first
        previous = t_start
        while ended is None and (yield from growing.reach(scan)):
            data = growing.prepared
            obs, rows = data.observations, data.scan(scan)
            known = self._known(obs, rows, slots)
            u, Q = data.odometry.increments[scan], data.odometry.covariances[scan]
            for filter in filters:
                filter.step(u, Q, data.rows[rows], known)
            dt, sigma = float(obs.times[scan]) - previous, data.usual_sigma(scan)
            ended = stopping.reason(particles, dt, u, rows.stop - rows.start, sigma)
            previous = float(obs.times[scan])
            scan += 1
            if data.splits(scan):
                ended = "gap"
        report: dict[str, Any] = {"ended": ended or "end-of-log"}
        while expects_fixes(growing.feed, float(growing.prepared.observations.times[scan - 1])):
            yield None
        made = self._summarise(growing, filters, key, first, scan, t_start, slots, report)
        return made, particles, scan

    def _known(self, obs: LandmarkObservations, rows: slice, slots: dict[int, int]) -> Ints:
        """Slot of every observation in known-association mode, else -1."""
        if self.config.association != "known":
            return np.full(rows.stop - rows.start, -1, dtype=np.int64)
        return known_slots(obs, rows, slots)

    def _summarise(
        self,
        growing: LogPreparation,
        filters: list[ParticleSet],
        key: int,
        first: int,
        last: int,
        t_start: float,
        slots: dict[int, int],
        report: dict[str, Any],
    ) -> Submap:
        c, data, particles = self.config, growing.prepared, filters[0]
        obs = data.observations
        association = winning_association(particles, c.min_hits)
        rows = int(obs.offsets[first]) + association.observation
        best, span = particles.best, slice(first, last)
        problem = self._problem(data, association, rows, span)
        smoothed = problem.smooth(particles.path[best, : last - first], particles.mean[best, association.slots])
        if not data.has_bearing.all():
            resolved = resolve_mirror_ambiguity(problem, smoothed, DELAYED)
            smoothed = resolved.smoothed
            report |= {
                "beacons_without_landmark": len(particles.waiting.slots),
                "ranges_unspent": len(particles.waiting) + particles.waiting.unspent,
                "mirrors_swapped": resolved.swapped,
                "ambiguous_landmarks": resolved.ambiguous,
                "vague_landmarks": resolved.vague,
            }
        slot_of = association.slots[smoothed.landmark_kept]
        made = particle_gaussians(filters, association, smoothed, inflate=c.moment_inflation)
        report |= gaussian_discrepancy("moment", made.moments, smoothed.gaussian)
        if c.pooled:
            report |= gaussian_discrepancy("pooled", made.pooled, smoothed.gaussian) | {
                "dropped_filters": made.dropped_filters,
                "pooled_filters": c.pooled - made.dropped_filters,
            }
        report |= self._counts(data, particles, association, smoothed, made, span)
        report["flag"] = consistency_flag(report, c.particles)
        handed = {"smoothed": smoothed.gaussian, "moments": made.moments, "pooled": made.pooled}[c.handover]
        if handed is None:
            raise CovarianceError(f"submap {key}: too few particles hold the common features, nothing to moment-match")
        by_slot = {s: i for i, s in slots.items()}
        ids = np.array([by_slot.get(int(s), -1) for s in slot_of], dtype=np.int64)
        lm_index = (np.cumsum(smoothed.landmark_kept) - 1)[association.landmark[smoothed.kept]]
        places = smoothed.gaussian.mean[3:].reshape(-1, 2)
        used = rows[smoothed.kept]
        report["systematic"] = bias_score_test(data, first, last, used, lm_index, smoothed.poses, places)
        whole = c.handover == "smoothed"
        placed = place_fixes(growing.feed, smoothed, t_start, obs.times[span]) if whole else None
        biases = None
        if whole and c.biases is not None:
            seconds = np.diff(obs.times[span], prepend=t_start)
            biases = estimate_sensor_biases(c.biases, smoothed, seconds, placed, base=t_start < obs.times[first])
            report["biases"] = [n for n in biases.names if n]
        landmarks = LandmarkMap(
            ids=ids,
            exit_pose=handed.mean[:3],
            positions=handed.mean[3:].reshape(-1, 2),
            covariance=handed.covariance,
            detections=np.column_stack([data.original[used], lm_index]),
            chart="group" if whole else "cartesian",  # particles: as in the paper
            path=None if placed is None else fix_points(smoothed, placed),
            biases=biases,
        )
        trajectory = _trajectory(t_start, obs.times[span], smoothed)
        if not whole:  # the end of the path is that of the Gaussian
            cov = trajectory.covariances
            assert cov is not None
            cov[-1] = vector_to_tangent_covariance(handed.mean[:3], handed.covariance[:3, :3])
            trajectory.poses[-1] = handed.mean[:3]
        return Submap.from_landmarks(
            key,
            landmarks,
            interval=(t_start, float(obs.times[last - 1])),
            trajectory=trajectory,
            uses=data.uses,
            report=report,
        )

    def _problem(
        self, data: PreparedLog, association: LandmarkAssociation, rows: Ints, span: slice
    ) -> SmoothingProblem:
        """Smoothing of the scans of a span with their observations ``rows``."""
        obs = data.observations
        return SmoothingProblem(
            increments=data.odometry.increments[span],
            covariances=data.odometry.covariances[span],
            ob_pose=np.searchsorted(obs.offsets, rows, side="right") - 1 - span.start,
            ob_landmark=association.landmark,
            observations=np.column_stack([data.rows[rows, :2], data.smoothing_variances[rows]]),
            sensor=obs.T_base_sensor,
            trim=self.config.trim,
            min_hits=self.config.min_hits,
        )

    def _counts(
        self,
        data: PreparedLog,
        particles: ParticleSet,
        association: LandmarkAssociation,
        smoothed: SmoothingResult,
        made: ParticleGaussians,
        span: slice,
    ) -> dict[str, Any]:
        """Counts of scans, observations and particles, and the fit of the smoothing, for the report of a submap."""
        obs, first, last = data.observations, span.start, span.stop
        return {
            "gaps": data.gaps_in(first, last),
            "handover": self.config.handover,
            "scans": last - first,
            "observations": int(particles.observations),
            "after_gap": int(obs.offsets[last] - obs.offsets[first]) - int(particles.observations),
            "used": int(smoothed.kept.sum()),
            "not_associated": int(particles.observations - len(association.observation)),
            "trimmed": int(len(smoothed.kept) - smoothed.kept.sum()),
            "particles": self.config.particles,
            "association": self.config.association,
            "resamplings": particles.resamplings,
            "min_ess": round(particles.min_ess, 3),
            "ancestors": particles.ancestors,
            "effective_ancestors": round(particles.effective_ancestors, 3),
            "dropped_particles": made.dropped_particles,
            **smoothed.report(),
        }


def _trajectory(t_start: float, times: Array, smoothed: SmoothingResult) -> Trajectory:
    """Path in the base frame; the base itself is first, with zero covariance, unless the first scan is the base."""
    if t_start < times[0]:
        return Trajectory(
            np.concatenate([[t_start], times]),
            np.concatenate([np.zeros((1, 3)), smoothed.poses]),
            np.concatenate([np.zeros((1, 3, 3)), smoothed.pose_covariances]),
        )
    return Trajectory(times, smoothed.poses.copy(), smoothed.pose_covariances.copy())
