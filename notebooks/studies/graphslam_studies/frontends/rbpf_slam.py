"""RBPF-SLAM with a single map of the whole log: the baseline of Combined SLAM.

One FastSLAM filter; its output is moment-matched (B3). Forty particles cannot represent the uncertainty of a long path,
so this map is overconfident by orders of magnitude; it serves for comparison only.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array, circular_mean, vector_to_tangent_covariance, wrap_angle
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.random import SeedTree
from graphslam.core.records import LandmarkObservations
from graphslam.core.submap import LandmarkMap, Submap
from graphslam.core.trajectory import Trajectory
from graphslam_frontends.base import FrontEnd, Watch
from graphslam_frontends.landmarks.bias_score import bias_score_test
from graphslam_frontends.landmarks.config import FilterConfig
from graphslam_frontends.landmarks.prepare import PreparedLog, known_slots, landmark_stream, prepare_log
from graphslam_frontends.landmarks.summarise import REGULARISER, Moments
from graphslam_studies.frontends.lineage import SingleMapParticles
from graphslam_studies.frontends.snapshot import Snapshot

Ints = npt.NDArray[np.int64]
Joint = Literal["never", "last", "all"]


@dataclass(frozen=True, slots=True, kw_only=True)
class RbpfSlamConfig(FilterConfig):
    """Settings of one particle filter with one map of the whole log."""

    @property
    def smoothing_noise(self) -> None:
        """A single map is not smoothed."""
        return None


class SingleMapFilter:
    """Particle filter over one log, advanced scan by scan."""

    def __init__(self, data: PreparedLog, config: RbpfSlamConfig, rng: np.random.Generator) -> None:
        obs = data.observations
        self.data, self.config = data, config
        miss_range = 0.9 * min(config.max_range, obs.max_range)
        self.particles = SingleMapParticles(config, obs.T_base_sensor, obs.field_of_view, miss_range, rng)
        self.slot_of: dict[int, int] = {}
        """Identity → slot, if identities are known."""

    def advance(self) -> None:
        """Process the next scan."""
        k, obs = self.particles.scans, self.data.observations
        rows = obs.scan(k)
        if self.config.association == "known":
            known = known_slots(obs, rows, self.slot_of)
        else:
            known = np.full(rows.stop - rows.start, -1, dtype=np.int64)
        odometry = self.data.odometry
        self.particles.step(odometry.increments[k], odometry.covariances[k], self.data.rows[rows], known)

    def ids(self, slots: Ints) -> Ints:
        """Identities of the landmarks in ``slots`` of the standard particle; -1 for unknown identities."""
        by_slot = {s: i for i, s in self.slot_of.items()}
        return np.array([by_slot.get(int(s), -1) for s in slots], dtype=np.int64)

    def snapshot(self, *, joint: bool) -> tuple[Snapshot, int, Ints]:
        """Snapshot, number of particles not used for it (B4), and the landmark slots of the standard particle."""
        p = self.particles
        kept, slots = p.features(self.config.min_hits)
        m = Moments.of(p, kept, slots)
        standard = slots[int(np.argmax(p.weights[kept]))]
        snapshot = Snapshot(
            scan=p.scans,
            time=float(self.data.observations.times[p.scans - 1]),
            pose=m.mean[:3],
            pose_covariance=m.pose_covariance(),
            landmark_ids=self.ids(standard),
            landmarks=m.mean[3:].reshape(-1, 2),
            landmark_covariances=m.landmark_covariances(),
            gaussian=m.joint() if joint else None,
        )
        return snapshot, len(p.pose) - len(kept), standard


def rbpf_snapshots(
    log: SensorLog,
    config: RbpfSlamConfig,
    *,
    seed: SeedTree,
    cuts: Sequence[int] | Ints,
    joint: Joint = "last",
    drops: DropCounter | None = None,
) -> Iterator[Snapshot]:
    """Run one filter over the log and yield its estimate at each cut.

    Parameters
    ----------
    cuts : sequence of int
        Numbers of scans after which a snapshot is taken, increasing; the filter stops at the last one.
    joint : {"last", "all", "never"}
        Which snapshots have the joint Gaussian; the others have marginals of pose and landmarks only.

    Yields
    ------
    Snapshot
        Moment-matched (B3) in the frame of the first base.
    """
    if joint not in ("last", "all", "never"):
        raise ConfigError(f"joint = {joint!r}; known: last, all, never")
    data = prepare_log(log, config, drops if drops is not None else DropCounter())
    at = [int(c) for c in cuts]
    if any(b <= a for a, b in zip([0, *at], at)) or (at and at[-1] > len(data)):
        raise ConfigError(f"cuts must increase from 1 to the log's {len(data)} scans, got {at[:3]} … {at[-1:]}")
    filter = SingleMapFilter(data, config, seed.generator())
    for k, cut in enumerate(at):
        while filter.particles.scans < cut:
            filter.advance()
        yield filter.snapshot(joint=joint == "all" or (joint == "last" and k == len(at) - 1))[0]


@dataclass(frozen=True, slots=True)
class RbpfSlam(FrontEnd):
    """The front end ``rbpf-slam``: the whole log as one submap.

    Needs a stream of controls or odometry, and one of landmark observations or, with the tree detector, of laser scans.
    """

    config: RbpfSlamConfig = field(default_factory=RbpfSlamConfig)
    name: ClassVar[str] = "rbpf-slam"
    calibrates: ClassVar[str] = "observations"

    def submaps(
        self,
        log: SensorLog,
        *,
        seed: SeedTree,
        after: Submap | None = None,
        drops: DropCounter | None = None,
        watch: Watch | None = None,
    ) -> Iterator[Submap]:
        """See :class:`graphslam_frontends.base.FrontEnd`. There is only one submap."""
        if after is None:
            data = prepare_log(log, self.config, drops if drops is not None else DropCounter())
            yield self._build(data, seed.child(0))

    def observations(self, log: SensorLog) -> tuple[str, LandmarkObservations]:
        """Name of the stream used, and its landmark observations (detected, if it has raw scans)."""
        return landmark_stream(log, self.config.detector)

    def _build(self, data: PreparedLog, seed: SeedTree) -> Submap:
        filter = SingleMapFilter(data, self.config, seed.generator())
        p, times = filter.particles, data.observations.times
        while p.scans < len(times):
            filter.advance()
        end, dropped, slots = filter.snapshot(joint=True)
        assert end.gaussian is not None
        report: dict[str, Any] = {
            "ended": "end-of-log",
            "gaps": data.gaps_in(0, len(times)),
            "scans": p.scans,
            "observations": p.observations,
            "resamplings": p.resamplings,
            "min_ess": round(p.min_ess, 3),
            "ancestors": p.ancestors,
            "dropped_particles": dropped,
            "regulariser": REGULARISER,
        }
        if not data.has_bearing.all():
            report |= {
                "beacons_without_landmark": len(p.waiting.slots),
                "ranges_unspent": len(p.waiting) + p.waiting.unspent,
            }
        used, landmark = self._associated(filter, slots)
        report |= {"used": len(used), "not_associated": p.observations - len(used)}
        path = _trajectory(filter)
        poses = path.poses[len(path) - len(times) :]
        report["systematic"] = bias_score_test(data, 0, len(times), used, landmark, poses, end.landmarks)
        detections = np.column_stack([data.original[used], landmark])
        landmarks = LandmarkMap(
            ids=end.landmark_ids,
            exit_pose=end.pose,
            positions=end.landmarks,
            covariance=end.gaussian.covariance,
            detections=None if self.config.association == "known" else detections,
        )
        return Submap.from_landmarks(
            0,
            landmarks,
            interval=(data.t_start, float(times[-1])),
            trajectory=path,
            uses=data.uses,
            report=report,
        )

    def _associated(self, filter: SingleMapFilter, slots: Ints) -> tuple[Ints, Ints]:
        """Observations of the output landmarks in the standard particle, and the landmark index of each."""
        p = filter.particles
        rank = np.full(p.hits.shape[1] + 1, -1, dtype=np.int64)  # the last entry is for slot -1
        rank[slots] = np.arange(len(slots))
        if self.config.association == "known":  # one association for all particles, not recorded
            ids = filter.data.observations.ids
            assert ids is not None
            seen = np.array([filter.slot_of.get(int(i), -1) for i in ids], dtype=np.int64)
        else:
            seen = p.associations()[:, p.best]
        landmark = rank[seen]
        used = np.flatnonzero(landmark >= 0)
        return used, landmark[used]


def _trajectory(filter: SingleMapFilter) -> Trajectory:
    """Mean path of the final particles with their covariance; the first pose, the base, is exactly known."""
    p, times, t_start = filter.particles, filter.data.observations.times, filter.data.t_start
    paths, w = p.paths(), p.weights
    mean = np.einsum("k,tkc->tc", w, paths)
    mean[:, 2] = [circular_mean(a, w) for a in paths[:, :, 2]]
    d: Array = paths - mean[:, None]
    d[..., 2] = wrap_angle(d[..., 2])
    covariances = np.einsum("k,tka,tkb->tab", w, d, d) + REGULARISER * np.eye(3)
    covariances = vector_to_tangent_covariance(mean, covariances)
    if t_start < times[0]:
        times = np.concatenate([[t_start], times])
        mean = np.concatenate([np.zeros((1, 3)), mean])
        covariances = np.concatenate([np.zeros((1, 3, 3)), covariances])
    return Trajectory(times, mean, covariances)
