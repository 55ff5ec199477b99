"""Scores of maps against ground truth, one metric per row, in the frame of the first base (without alignment).

NEES is eq. 18 of Combined SLAM: of the end pose (3 degrees of freedom), of each feature (2), and of all features
jointly. The consistency index CI (eq. 20), NEES over its 95 % quantile, is computed with the tables.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from time import perf_counter

import numpy as np
import numpy.typing as npt

from graphslam.app.compare import map_nees
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array, se2_between, vector_to_tangent_covariance
from graphslam.core.log import Truth
from graphslam.core.map_truth import MapTruth
from graphslam.core.submap import Submap
from graphslam.evaluate.consistency import joint_nees, nees, pose_error, vector_pose_error
from graphslam.join.joined_map import JoinedMapView, landmark_scalars
from graphslam.join.submap_solver import SubmapEstimate
from graphslam_studies.evaluate.submap_consistency import submap_nees
from graphslam_studies.frontends.snapshot import Snapshot
from graphslam_studies.montecarlo.trials import Measurement

Ids = npt.NDArray[np.int64]
FEATURE_STRIDE = 9
"""Features are scored after every ninth submap and at the end, because their marginals take longer than the join."""
_DIVERGED = 0.05


@dataclass(frozen=True)
class MapState:
    """Estimate of a method: pose at the end of a submap, and features, with their marginal covariances."""

    pose: Array
    pose_covariance: Array
    ids: Ids
    landmarks: Array
    landmark_covariances: Array | None


@dataclass(frozen=True)
class Judge:
    """Ground truth of one run at the ends of its submaps, and scoring with it.

    Parameters
    ----------
    times : (m,)
        End times of the submaps [s].
    distance : float
        Distance driven [m].
    """

    truth: Truth
    times: Array
    distance: float
    end_poses: Array = field(init=False)
    _positions: dict[int, Array] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        base = self.truth.trajectory.interpolate(np.zeros(1))[0]
        poses = self.truth.trajectory.interpolate(np.asarray(self.times))
        object.__setattr__(self, "end_poses", se2_between(base, poses))
        known = zip(self.truth.landmark_ids.tolist(), self.truth.landmarks, strict=True)
        object.__setattr__(self, "_positions", dict(known))

    def landmarks(self, ids: Ids) -> Array:
        """True positions ``(L, 2)``."""
        return np.array([self._positions[int(i)] for i in ids]).reshape(-1, 2)

    def wants_features(self, k: int) -> bool:
        """Whether features are scored after submap k."""
        return k == len(self.times) - 1 or (k + 1) % FEATURE_STRIDE == 0

    def online(self, algorithm: str, k: int, state: MapState) -> Iterator[Measurement]:
        """Metrics of the state after submap k."""
        e = vector_pose_error(state.pose, self.end_poses[k])
        sigma = np.sqrt(np.diag(state.pose_covariance))
        yield Measurement(algorithm, "pose_nees", float(nees(e, state.pose_covariance)), k)
        tangent = vector_to_tangent_covariance(state.pose, state.pose_covariance)
        d2 = float(nees(pose_error(state.pose, self.end_poses[k]), tangent))
        yield Measurement(algorithm, "pose_nees_tangent", d2, k)
        for i, axis in enumerate(("x", "y", "heading")):
            yield Measurement(algorithm, f"error_{axis}", float(e[i]), k)
            yield Measurement(algorithm, f"sigma_{axis}", float(sigma[i]), k)
        if state.landmark_covariances is not None and len(state.ids):
            d = self.landmarks(state.ids) - state.landmarks
            yield Measurement(algorithm, "feature_nees", float(nees(d, state.landmark_covariances).mean()), k)
            yield Measurement(algorithm, "feature_rms", float(np.sqrt(np.mean(np.sum(d**2, axis=1)))), k)

    def final(
        self,
        algorithm: str,
        ids: Ids,
        landmarks: Array,
        covariance: Array,
        *,
        poses: Array,
        pose_covariance: Array,
    ) -> Iterator[Measurement]:
        """Metrics of a whole run.

        Parameters
        ----------
        covariance : (2 L, 2 L)
            Joint covariance of the features.
        poses : (m, 3)
            End poses of all submaps, estimated at the end of the run (or online, if the method does not keep them).
        pose_covariance : (3, 3)
            Covariance of the last pose.
        """
        d = self.landmarks(ids) - landmarks
        at = landmark_scalars(2 * np.arange(len(ids)))
        each = nees(d, covariance[at[:, :, None], at[:, None, :]])
        e = vector_pose_error(poses, self.end_poses)
        position = np.hypot(e[:, 0], e[:, 1])
        rms = float(np.sqrt(np.mean(position**2)))
        figures = {
            "pose_nees": float(nees(e[-1], pose_covariance)),
            "feature_nees": float(each.mean()),
            "feature_inside": float(np.mean(each <= chi2_quantile(0.95, 2))),
            "feature_joint_nees": joint_nees(d.ravel(), covariance=covariance),
            "feature_joint_dof": float(d.size),
            "feature_rms": float(np.sqrt(np.mean(np.sum(d**2, axis=1)))),
            "feature_median_error": float(np.median(np.hypot(d[:, 0], d[:, 1]))),
            "pose_rms": rms,
            "heading_rms": float(np.sqrt(np.mean(e[:, 2] ** 2))),
            "features": float(len(ids)),
            "diverged": float(not rms <= _DIVERGED * self.distance),
        }
        for quantity, value in figures.items():
            yield Measurement(algorithm, quantity, value)

    def estimate(self, algorithm: str, estimate: SubmapEstimate) -> Iterator[Measurement]:
        """Metrics of a joined or solved map."""
        m = len(estimate.poses) - 1
        at = 3 * m + np.arange(2 * len(estimate.landmark_ids))
        yield from self.final(
            algorithm,
            estimate.landmark_ids,
            estimate.landmarks,
            estimate.covariance_block(at),
            poses=estimate.poses[1:],
            pose_covariance=estimate.pose_covariance(m),
        )
        truth = MapTruth(
            keys=np.arange(m),
            exit_poses=self.end_poses,
            landmark_ids=np.array(list(self._positions)),
            landmarks=np.array(list(self._positions.values())),
        )
        for quantity, chart in (("map_nees", "group"), ("map_nees_plain", "cartesian")):
            d2, dof = map_nees(estimate, range(m), truth, chart=chart)
            yield Measurement(algorithm, quantity, d2)
        yield Measurement(algorithm, "map_dof", float(dof))

    def local(self, algorithm: str, submaps: list[Submap]) -> Iterator[Measurement]:
        """Consistency of local maps, each in its own frame, and metrics from the report of the front end."""
        for k, s in enumerate(submaps):
            r = submap_nees(s, self.truth)
            figures = {
                "local_joint_nees": r.joint,
                "local_joint_nees_plain": r.joint_plain,
                "local_joint_dof": float(r.joint_dof),
                "local_pose_nees": r.exit,
                "local_feature_nees": float(np.mean(r.landmarks)) if len(r.landmarks) else np.nan,
                "local_inside": float(r.joint <= chi2_quantile(0.95, r.joint_dof)),
                "local_features": float(len(r.landmark_ids)),
            }
            report = s.report or {}
            for name in ("min_ess", "ancestors", "moment_d2_per_dof", "moment_kl"):
                if report.get(name) is not None:
                    figures[name] = float(report[name])
            for quantity, value in figures.items():
                yield Measurement(algorithm, quantity, value, k)


class Watch:
    """``on_join`` callback that scores every intermediate map, and measures joining time without scoring time."""

    def __init__(self, judge: Judge, algorithm: str) -> None:
        self.judge, self.algorithm = judge, algorithm
        self.rows: list[Measurement] = []
        self._seconds = 0.0
        self._left = perf_counter()

    def __call__(self, k: int, view: JoinedMapView) -> None:
        """Score the map after submap k."""
        self._seconds += perf_counter() - self._left
        self.rows.append(Measurement(self.algorithm, "seconds_cumulative", self._seconds, k, timing=True))
        marginals = view.landmark_marginals() if self.judge.wants_features(k) else None
        at = landmark_scalars(view.landmark_at)
        state = MapState(view.pose(), view.pose_covariance(), view.ids, view.x[at], marginals)
        self.rows.extend(self.judge.online(self.algorithm, k, state))
        self._left = perf_counter()


def watch_snapshots(
    judge: Judge, algorithm: str, snapshots: Iterator[Snapshot]
) -> tuple[list[Measurement], list[Snapshot]]:
    """Score a single-map filter at the ends of the submaps; returns the scores and the snapshots."""
    rows: list[Measurement] = []
    kept: list[Snapshot] = []
    seconds, left = 0.0, perf_counter()
    for k, s in enumerate(snapshots):
        seconds += perf_counter() - left
        rows.append(Measurement(algorithm, "seconds_cumulative", seconds, k, timing=True))
        marginals = s.landmark_covariances if judge.wants_features(k) else None
        state = MapState(s.pose, s.pose_covariance, s.landmark_ids, s.landmarks, marginals)
        rows.extend(judge.online(algorithm, k, state))
        kept.append(s)
        left = perf_counter()
    return rows, kept


def timed(algorithm: str, parts: dict[str, float]) -> Iterator[Measurement]:
    """Times of a map-joining method by part, as timings [s]."""
    for part, seconds in parts.items():
        yield Measurement(algorithm, f"seconds_{part}", seconds, timing=True)
    yield Measurement(algorithm, "seconds_total", sum(parts.values()), timing=True)


Clocked = Callable[[], list[Submap]]


def clock(algorithm: str, make: Clocked) -> tuple[list[Submap], Measurement]:
    """Make local maps and measure the time [s]."""
    start = perf_counter()
    submaps = make()
    return submaps, Measurement(algorithm, "seconds_total", perf_counter() - start, timing=True)
