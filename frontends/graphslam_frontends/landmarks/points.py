"""3-D landmark submaps: points with identities, as from a stereo or depth camera, smoothed with odometry.

Each submap is one least-squares problem over its poses and points (:mod:`graphslam.linear.space_maps`). The result is
the Gaussian of its end pose and its landmarks, in the group parametrisation of SE₁₊ₙ(3).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from graphslam.core.config import check_options
from graphslam.core.errors import DataError, MissingDataError
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.poses import SE3
from graphslam.core.random import SeedTree
from graphslam.core.records import Odometry, PointObservations
from graphslam.core.se3 import quat_to_matrix, se3_compose, se3_transform
from graphslam.core.submap import LandmarkMap, Submap, turned_covariance
from graphslam.core.trajectory import Trajectory
from graphslam.linear.space_maps import ORIGIN, PlacedMap, SpaceMap, minimise_space_maps
from graphslam_frontends.base import FrontEnd, Watch
from graphslam_frontends.odometry.motion import MotionNoise, cut_odometry

Ints = npt.NDArray[np.int64]
NO_POSES, NO_POINTS = np.zeros((0, 7)), np.zeros((0, 3))
NONE = np.zeros(0, dtype=np.int64)
_ROUNDS = 10
MAX_LANDMARKS = 60
"""A submap ends with this many landmarks."""

MIN_SCANS = 5
"""A submap does not end before this many scans."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PointsConfig:
    """Options of the front end ``points``."""

    max_distance: float = 20.0
    """A submap ends after this many metres …"""
    max_scans: int = 100
    """… or after this many scans, or with :data:`MAX_LANDMARKS` landmarks."""
    min_hits: int = 2
    """Landmarks of a submap were observed at least this often in it."""
    gate: float = 0.9999
    """χ² gate (probability, 3 dof) of an observation against all others; those beyond it are left out and counted."""

    def __post_init__(self) -> None:
        ranges = {"> 0 or inf": "max_distance", "≥ 1": "max_scans min_hits", "in (0.5, 1)": "gate"}
        check_options(self, "", ranges)


class Points(FrontEnd):
    """Front end for submaps of 3-D points with identities."""

    name: ClassVar[str] = "points"
    config: PointsConfig

    def __init__(self, config: PointsConfig | None = None) -> None:
        self.config = config or PointsConfig()

    def submaps(
        self,
        log: SensorLog,
        *,
        seed: SeedTree,
        after: Submap | None = None,
        drops: DropCounter | None = None,
        watch: Watch | None = None,
    ) -> Iterator[Submap]:
        """See :meth:`FrontEnd.submaps`; deterministic."""
        motion, seen = log.of_type(Odometry), log.of_type(PointObservations)
        if motion is None or log[motion].increments.shape[1] != 7:
            raise MissingDataError("no odometry in space", where=log.name, wanted="Odometry with increments (n, 7)")
        if seen is None:
            raise MissingDataError("no points", where=log.name, wanted="PointObservations")
        odometry, points = log[motion], log[seen]
        inside = (points.times >= odometry.times[0]) & (points.times <= odometry.times[-1])
        if drops is not None and not inside.all():
            drops.drop(seen, "scans of points outside the odometry", int(np.sum(~inside)))
        points = points.take(inside)
        if len(points.times) < 2:
            raise DataError("points in fewer than two scans within the odometry", where=log.name, got=len(points.times))
        steps = cut_odometry(odometry, points.times, MotionNoise())
        first = 0 if after is None else int(np.searchsorted(points.times, after.interval[1]))
        key = 0 if after is None else after.key + 1
        while first < len(points.times) - 1:
            last, reason = self._end(steps, points, first)
            submap = _Smoothing(self.config, steps, points, first, last, own_scan=first == 0).submap(key, reason)
            if drops is not None and submap.report["outliers"]:
                drops.drop(seen, "points without a landmark", submap.report["outliers"])
            yield replace(submap, uses=frozenset({motion, seen}))
            first, key = last, key + 1

    def _end(self, steps: Odometry, points: PointObservations, first: int) -> tuple[int, str]:
        """The last scan of the submap that begins at scan ``first``, and the reason."""
        c, length = self.config, 0.0
        hits: dict[int, int] = {}
        end = len(points.times) - 1
        for k in range(first + 1, end + 1):
            length += float(np.linalg.norm(steps.increments[k, :3]))
            for i in points.ids[points.scan(k)].tolist():
                hits[i] = hits.get(i, 0) + 1
            n = k - first
            if n < MIN_SCANS or end - k < MIN_SCANS:
                continue
            if length >= c.max_distance:
                return k, "distance"
            if n >= c.max_scans:
                return k, "scans"
            if sum(h >= c.min_hits for h in hits.values()) >= MAX_LANDMARKS:
                return k, "landmarks"
        return end, "end"


@dataclass
class _Smoothing:
    """One submap as a least-squares problem, from scan ``first``, its base, to scan ``last``."""

    config: PointsConfig
    steps: Odometry
    points: PointObservations
    first: int
    last: int
    own_scan: bool
    """Are the observations at the base used? Those of later submaps' bases were already used by the previous submap."""
    outliers: int = field(default=0, init=False)

    def submap(self, key: int, reason: str) -> Submap:
        """The submap, smoothed."""
        c, z = self.config, self.points
        begin = self.first if self.own_scan else self.first + 1
        rows = np.arange(z.offsets[begin], z.offsets[self.last + 1])
        pose = np.repeat(np.arange(begin, self.last + 1), np.diff(z.offsets[begin : self.last + 2])) - self.first - 1
        R = quat_to_matrix(z.T_base_sensor[3:])
        places = se3_transform(z.T_base_sensor, z.points[rows])
        information: Array = np.asarray(np.linalg.inv(R @ z.covariances[rows] @ R.T), dtype=np.float64)
        ids = z.ids[rows]
        usable = self._often(ids, np.ones(len(rows), dtype=bool))
        keep = usable.copy()
        gate = chi2_quantile(c.gate, 3)
        for turn in range(_ROUNDS):
            names, mark = np.unique(ids[keep], return_inverse=True)
            found = self._solve(pose[keep], mark, len(names), places[keep], information[keep])
            # each observation is tested against the kept ones: one left out because of another's error is used again
            judged = np.flatnonzero(usable & np.isin(ids, names))
            mark = np.searchsorted(names, ids[judged])
            d2 = self._squared(found.poses, found.points, pose[judged], mark, places[judged], information[judged])
            wrong = self._worst(np.where(keep[judged], d2, 0.0), mark, gate)
            back = ~keep[judged] & (d2 <= gate)
            if turn == _ROUNDS - 1 or not (wrong.any() or back.any()):
                break
            keep[judged[wrong]], keep[judged[back]] = False, True
            keep &= self._often(ids, keep)
        self.outliers = int(np.sum(usable & ~keep))
        n = self.last - self.first
        P = np.linalg.inv(found.information.toarray())
        P = 0.5 * (P + P.T)
        own = np.concatenate([np.arange(6 * (n - 1), 6 * n), np.arange(6 * n, len(P))])
        landmarks = LandmarkMap(
            ids=names, exit_pose=found.poses[-1], positions=found.points, covariance=P[np.ix_(own, own)], chart="group",
        )  # fmt: skip
        t = z.times[self.first : self.last + 1]
        covariances = np.zeros((n + 1, 6, 6))
        for k in range(n):
            at = slice(6 * k, 6 * k + 6)
            covariances[k + 1] = turned_covariance(quat_to_matrix(found.poses[k, 3:]).T, P[at, at])
        dof = 6 * n + 3 * int(keep.sum()) - len(P)
        return Submap.from_landmarks(
            key, landmarks, interval=(float(t[0]), float(t[-1])),
            trajectory=Trajectory(t, np.vstack([SE3.identity, found.poses]), covariances),
            report={
                "reason": reason, "scans": n + 1, "observations": len(rows), "used": int(keep.sum()),
                "outliers": self.outliers, "chi2": found.objective, "dof": dof, "converged": found.converged,
            },
        )  # fmt: skip

    def _often(self, ids: Ints, keep: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        names, counts = np.unique(ids[keep], return_counts=True)
        return np.isin(ids, names[counts >= self.config.min_hits])

    def _solve(self, pose: Ints, mark: Ints, marks: int, places: Array, information: Array) -> Any:
        n = self.last - self.first
        maps, poses = [], []
        here = SE3.identity
        for k in range(n):
            step = self.steps.increments[self.first + 1 + k]
            own = turned_covariance(quat_to_matrix(step[3:]), self.steps.covariances[self.first + 1 + k])
            one = SpaceMap(step[None], NO_POINTS, NONE, sp.csr_matrix(np.linalg.inv(own)))
            maps.append(PlacedMap(one, k - 1 if k else ORIGIN, np.array([k]), NONE))
            here = se3_compose(here, step)
            poses.append(here)
        whole = np.vstack([SE3.identity, poses])
        start = np.zeros((marks, 3))
        at = se3_transform(whole[pose + 1], places)
        start[mark[::-1]] = at[::-1]  # position at the first observation
        for k in np.unique(pose).tolist():
            rows = np.flatnonzero(pose == k)
            seen = SpaceMap(
                NO_POSES, places[rows], np.full(len(rows), ORIGIN), sp.block_diag(list(information[rows]), format="csr")
            )
            maps.append(PlacedMap(seen, k if k >= 0 else ORIGIN, NONE, mark[rows]))
        return minimise_space_maps(maps, np.array(poses), start, rtol=1e-10)

    @staticmethod
    def _squared(poses: Array, points: Array, pose: Ints, mark: Ints, places: Array, information: Array) -> Array:
        """Squared Mahalanobis distance of every observation from its landmark ``(q,)``."""
        whole = np.vstack([SE3.identity, poses])
        e = se3_transform(whole[pose + 1], places) - points[mark]
        R = quat_to_matrix(whole[pose + 1, 3:])
        e = np.einsum("kji,kj->ki", R, e)
        return np.einsum("ki,kij,kj->k", e, information, e)

    @staticmethod
    def _worst(d2: Array, mark: Ints, gate: float) -> npt.NDArray[np.bool_]:
        """For every landmark the worst observation, if it is beyond the gate."""
        order = np.lexsort([-d2, mark])
        first = order[np.r_[True, np.diff(mark[order]) > 0]] if len(order) else order
        out = np.zeros(len(d2), dtype=bool)
        out[first] = d2[first] > gate
        return out
