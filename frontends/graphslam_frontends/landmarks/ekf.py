"""The front end ``ekf``: EKF local maps."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import MissingDataError
from graphslam.core.gaussian import Gaussian
from graphslam.core.geometry import Array, vector_to_tangent_covariance
from graphslam.core.log import DropCounter
from graphslam.core.path_points import PathPoints
from graphslam.core.random import SeedTree
from graphslam.core.record_source import RecordSource
from graphslam.core.submap import LandmarkMap, Submap
from graphslam.core.trajectory import Trajectory
from graphslam_frontends.base import FrontEnd, Watch
from graphslam_frontends.landmarks.bias_score import bias_score_test
from graphslam_frontends.landmarks.ekf_config import EkfConfig, EkfFilterConfig
from graphslam_frontends.landmarks.ekf_filter import EkfMap
from graphslam_frontends.landmarks.fix_points import (
    expects_fixes,
    fix_points,
    has_fixes,
    place_fixes,
    transfer_points,
)
from graphslam_frontends.landmarks.prepare import LogPreparation, PreparedLog, known_slots
from graphslam_frontends.landmarks.stopping import StoppingRule
from graphslam_frontends.landmarks.summarise import SmoothingProblem, SmoothingResult

Ints = npt.NDArray[np.int64]


def require_bearings(data: PreparedLog, where: str) -> None:
    """Reject logs with ranges only."""
    if len(data.rows) and not np.any(np.isfinite(data.rows[:, 3])):
        raise MissingDataError(
            "an EKF cannot start a landmark from ranges alone", where=where, wanted="bearings in some observations"
        )


class EkfRun:
    """One growing EKF map from scan ``first`` on, with its path."""

    def __init__(self, data: PreparedLog, config: EkfFilterConfig, first: int, t_start: float) -> None:
        obs = data.observations
        self.local = isinstance(config, EkfConfig)
        self.data, self.config, self.first, self.t_start = data, config, first, t_start
        self.next = first
        self.map = EkfMap(config, obs.T_base_sensor, obs.field_of_view, obs.max_range)
        self.slots: dict[int, int] = {}
        self.poses: list[Array] = []
        self.covariances: list[Array] = []  # of the plain vectors

    def advance(self) -> None:
        """Process the next scan."""
        obs, k = self.data.observations, self.next
        rows = self.data.scan(k) if self.local else obs.scan(k)
        if self.config.association == "known":
            known = known_slots(obs, rows, self.slots)
        else:
            known = np.full(rows.stop - rows.start, -1, dtype=np.int64)
        odometry = self.data.odometry
        self.map.step(odometry.increments[k], odometry.covariances[k], self.data.rows[rows], known)
        self.poses.append(self.map.pose)
        self.covariances.append(self.map.pose_covariance)
        self.next += 1

    def identities(self, slots: Ints) -> Ints:
        """Identities in the log of the landmarks ``slots``; -1 if the filter created them without one."""
        identity = {key: i for i, key in self.slots.items()}
        by_founding = {founding: identity[key] for key, founding in self.map.keys.items()}
        return np.array([by_founding.get(int(f), -1) for f in self.map.founded[slots]], dtype=np.int64)

    def detections(self, slots: Ints) -> tuple[Ints, Ints]:
        """Observations (index in the prepared log) of the landmarks ``slots``, and the index of each one's landmark."""
        a = self.map.association()
        rank = np.full(self.map.foundings + 1, -1, dtype=np.int64)
        rank[self.map.founded[slots]] = np.arange(len(slots))
        landmark = rank[a]  # a = -1 reads the last entry, which is -1
        used = np.flatnonzero(landmark >= 0)
        return used + int(self.data.observations.offsets[self.first]), landmark[used]

    def trajectory(self, poses: Array, covariances: Array) -> Trajectory:
        """Path in the base frame; the base itself is first, with zero covariance, unless the first scan is the base."""
        times = self.data.observations.times[self.first : self.next]
        if self.t_start < times[0]:
            times = np.concatenate([[self.t_start], times])
            poses = np.concatenate([np.zeros((1, 3)), poses])
            covariances = np.concatenate([np.zeros((1, 3, 3)), covariances])
        return Trajectory(times, poses, covariances)

    def report(self, used: int) -> dict[str, Any]:
        """Counts and the consistency statistics (NIS) of the filter."""
        m, c = self.map, self.config
        offsets = self.data.observations.offsets
        out: dict[str, Any] = {
            "gaps": self.data.gaps_in(self.first, self.next),
            "scans": m.scans,
            "observations": m.observations,
            "after_gap": int(offsets[self.next] - offsets[self.first]) - m.observations,
            "used": used,
            "not_associated": m.observations - used,
            "founded": m.foundings,
            "dropped": m.foundings - int(np.count_nonzero(m.hits > 0)),
            "range_only_without_landmark": m.unfounded,
            "outliers": m.outliers,
            "nis": float(m.nis),
            "nis_dof": m.nis_dof,
        }
        if c.association == "jcbb":
            out |= {"jcbb_nodes": m.nodes, "jcbb_capped_scans": m.capped}
        return out

    def _smoothed(self, places: Array, rows: Ints, landmark: Ints, trim: float) -> SmoothingResult:
        """Gauss-Newton over the submap's poses and landmarks under the filter's association."""
        data, obs, span = self.data, self.data.observations, slice(self.first, self.next)
        problem = SmoothingProblem(
            data.odometry.increments[span],
            data.odometry.covariances[span],
            np.searchsorted(obs.offsets, rows, side="right") - 1 - self.first,
            landmark,
            np.column_stack([data.rows[rows, :2], data.smoothing_variances[rows]]),
            obs.T_base_sensor,
            trim,
            self.config.min_hits,
        )
        return problem.smooth(np.array(self.poses), places)

    def submap(self, key: int, report: dict[str, Any], feed: RecordSource | None = None) -> Submap:
        """The Gaussian of the filter as a submap; points of its path at fixes are from a smoothing."""
        slots = self.map.landmarks(self.config.min_hits)
        mean, P = self.map.joint(slots)
        rows, landmark = self.detections(slots)
        path = np.array(self.poses)
        places = mean[3:].reshape(-1, 2)
        report |= {"systematic": bias_score_test(self.data, self.first, self.next, rows, landmark, path, places)}
        times, points = self.data.observations.times[self.first : self.next], None
        if feed is not None and has_fixes(feed, self.t_start, times):
            s = self._smoothed(places, rows, landmark, 0.0)
            placed = place_fixes(feed, s, self.t_start, times)
            if placed is not None and np.all(s.landmark_kept):
                points = transfer_points(fix_points(s, placed), s.gaussian, mean, P)
        return self._hand_over(
            key,
            Gaussian(mean, P, (2,)),
            self.identities(slots),
            np.column_stack([self.data.original[rows], landmark]),
            self.trajectory(path, vector_to_tangent_covariance(path, np.array(self.covariances))),
            report | {"handover": "filter"} | self.report(len(rows)),
            points,
        )

    def smoothed_submap(self, feed: RecordSource, key: int, report: dict[str, Any], trim: float) -> Submap:
        """The optimum under the filter's association as a submap."""
        obs, c = self.data.observations, self.config
        slots = self.map.landmarks(c.min_hits)
        mean, _ = self.map.joint(slots)
        rows, landmark = self.detections(slots)
        s = self._smoothed(mean[3:].reshape(-1, 2), rows, landmark, trim)
        data, span = self.data, slice(self.first, self.next)
        index = (np.cumsum(s.landmark_kept) - 1)[landmark[s.kept]]
        used = int(s.kept.sum())
        places = s.gaussian.mean[3:].reshape(-1, 2)
        report |= {"systematic": bias_score_test(data, self.first, self.next, rows[s.kept], index, s.poses, places)}
        placed = place_fixes(feed, s, self.t_start, obs.times[span])
        counts = self.report(used) | {"not_associated": self.map.observations - len(rows)}
        return self._hand_over(
            key,
            s.gaussian,
            self.identities(slots)[s.landmark_kept],
            np.column_stack([data.original[rows[s.kept]], index]),
            self.trajectory(s.poses, s.pose_covariances),
            report | {"handover": "smoothed", "trimmed": len(s.kept) - used} | counts | s.report(),
            None if placed is None else fix_points(s, placed),
        )

    def _hand_over(
        self,
        key: int,
        g: Gaussian,
        ids: Ints,
        detections: Ints,
        path: Trajectory,
        report: dict[str, Any],
        points: PathPoints | None = None,
    ) -> Submap:
        landmarks = LandmarkMap(
            ids=ids,
            exit_pose=g.mean[:3],
            positions=g.mean[3:].reshape(-1, 2),
            covariance=g.covariance,
            detections=detections,
            chart="group",
            path=points,
        )
        return Submap.from_landmarks(
            key,
            landmarks,
            interval=(self.t_start, float(self.data.observations.times[self.next - 1])),
            trajectory=path,
            uses=self.data.uses,
            report=report,
        )


@dataclass(frozen=True, slots=True)
class Ekf(FrontEnd):
    """The front end ``ekf``: EKF local maps, each a Gaussian in the frame of its base.

    Needs a stream of motion and one of landmark observations or, with the tree detector, of laser scans. Draws no
    random numbers.
    """

    config: EkfConfig = field(default_factory=EkfConfig)
    name: ClassVar[str] = "ekf"
    calibrates: ClassVar[str] = "observations"

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
        data = LogPreparation(feed, self.config, drops if drops is not None else DropCounter())
        yield from data.reach(0)
        if data.done:
            require_bearings(data.prepared, feed.name)
        key, scan, t_start = yield from data.resume(after)
        while (yield from data.reach(scan)):
            submap, scan = yield from self._build(data, key, scan, t_start)
            yield submap
            key, t_start = key + 1, submap.interval[1]

    def _build(
        self, growing: LogPreparation, key: int, first: int, t_start: float
    ) -> Generator[None, None, tuple[Submap, int]]:
        """Filter from scan ``first`` until the submap ends; returns it and the next scan."""
        run = EkfRun(growing.prepared, self.config, first, t_start)
        stopping = StoppingRule(self.config.stopping)
        ended, previous = None, t_start
        while ended is None and (yield from growing.reach(run.next)):
            k, run.data = run.next, growing.prepared
            obs = run.data.observations
            run.advance()
            now, seen = float(obs.times[k]), int(obs.offsets[k + 1] - obs.offsets[k])
            u, sigma = run.data.odometry.increments[k], run.data.usual_sigma(k)
            ended = stopping.reason(run.map, now - previous, u, seen, sigma)
            previous = now
            if run.data.splits(run.next):
                ended = "gap"
        run.data = growing.prepared
        report: dict[str, Any] = {"ended": ended or "end-of-log"}
        while expects_fixes(growing.feed, float(run.data.observations.times[run.next - 1])):
            yield None
        if self.config.handover == "filter":
            return run.submap(key, report, growing.feed), run.next
        return run.smoothed_submap(growing.feed, key, report, self.config.trim), run.next
