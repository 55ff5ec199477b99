"""The front end ``lidar-odometry``: LiDAR odometry, cut into short submaps with a point cloud and an evidence grid."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, ClassVar, cast

import numpy as np

from graphslam.core import se3
from graphslam.core.config import check_options
from graphslam.core.dense import CloudMap
from graphslam.core.errors import ConfigError, DataError, MissingDataError
from graphslam.core.findings import Finding
from graphslam.core.geometry import Array
from graphslam.core.imu import Imu
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.point_clouds import PointClouds
from graphslam.core.random import SeedTree
from graphslam.core.record_source import RecordSource
from graphslam.core.records import Odometry, Stream
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evidence.beams import BeamModel
from graphslam.evidence.grid import EvidenceGrid
from graphslam_frontends.base import FrontEnd, Watch
from graphslam_frontends.lidar_odometry.cells import evenly_spaced_rows
from graphslam_frontends.lidar_odometry.config import LidarOdometryConfig
from graphslam_frontends.lidar_odometry.inertial import (
    USUAL,
    ImuReadings,
    InertialPredictor,
    PathGravity,
    align_with_gravity,
    gravity_along_path,
)
from graphslam_frontends.lidar_odometry.odometry import FEW, MAPPED, LidarOdometry, ScanResult
from graphslam_frontends.lidar_odometry.wheel_prior import WheelMotionPrior
from graphslam_frontends.odometry.steps import Steps
from graphslam_frontends.scan_window.relative_covariance import relative_covariance

BENT = 0.1
"""Motion of points between scans above which missing point times are reported [m]."""
UNEVEN = 0.03
"""Point displacement by non-uniform motion above which it is reported [m]: a typical range noise of data sheets."""
MANY = 0.05
"""Share of lost scans in a submap above which they are reported."""
BEGUN = 3
"""Unmatched scans accepted at the start of a log, when the map of a sparse lidar is still empty."""
FIRST = 5
"""Scans that must exist before the first is processed: an IMU that begins later is ignored."""
UNNAMED = ("auto", "none")
"""Values of the option ``imu`` that are not names of streams."""
OF_USE = 15.0
"""Readings are kept this long after a scan [s]."""
LEVEL = 1e-6
"""Odometry is planar if heights and tilts change by no more than this during the first scans [m, quaternion]."""
REHEARSED = 60
"""Scans at the start that are processed repeatedly to initialise the IMU."""
MOST_SCANS = 100
"""Most scans in a submap, however slowly the sensor moves."""

CLOUD_CELL = 0.1
"""One point per cube of this edge is kept in the cloud of a submap [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LidarSubmapConfig:
    """How the path is cut into submaps, and the contents of a submap."""

    length: float = 3.0
    """Path length of a submap [m] …"""
    scans: int = 5
    """… with at least this many scans."""
    voxel_size: float = 0.2
    """Edge of a voxel of the grid [m]."""
    reach: float = 40.0
    """Range up to which beams enter the grid [m]."""
    points: int = 2000
    """Most points of a scan in grid and cloud."""
    hit: float = 0.7
    """Probability that a voxel is occupied, given that a beam ended in it."""

    def __post_init__(self) -> None:
        ranges = {"> 0": "length voxel_size reach", f"in [1, {MOST_SCANS}]": "scans", "≥ 1": "points"}
        check_options(self, "submap: ", ranges)
        self.beam_model()

    def beam_model(self) -> BeamModel:
        """Sensor model of a beam for the evidence grid."""
        return BeamModel(hit=self.hit)


@dataclass(frozen=True, slots=True, kw_only=True)
class LidarFrontEndConfig:
    """The front end ``lidar-odometry``."""

    stream: str | None = None
    """Stream of point clouds; None: the first of the log."""
    imu: str = "auto"
    """Stream of an IMU for initial guesses, deskewing and the direction of gravity; ``none``; or ``auto``: the first of
    the log."""
    wheels: str = "auto"
    """Stream of odometry for unmatched scans, and for the initial guess if it predicts better than constant velocity;
    ``none``; or ``auto``: the first of the log, if it is planar (no heights and tilts)."""
    odometry: LidarOdometryConfig = field(default_factory=LidarOdometryConfig)
    """Matching of scans."""
    submap: LidarSubmapConfig = field(default_factory=LidarSubmapConfig)
    """Cutting of the path, and contents of the submaps."""


@dataclass(frozen=True, slots=True)
class FollowedScan:
    """A processed scan.

    Parameters
    ----------
    pose : (7,)
        ``T_first_base``.
    joint : (12, 12)
        Joint covariance of the first pose of the submap and this pose.
    spread : (6, 6)
        Covariance of the predicted motion from the last scan, right tangent.
    points : (m, 3)
        In the base frame at ``time``.
    """

    time: float
    pose: Array
    joint: Array
    spread: Array
    points: Array
    seen: ScanResult
    sweep: float | None
    """Time from its first to its last point [s]; None: points have no times of their own."""


@dataclass(frozen=True, slots=True)
class LidarFrontEnd(FrontEnd):
    """The front end ``lidar-odometry``.

    Needs a stream of point clouds and uses an IMU if there is one. It is deterministic and causal. A resumed run
    processes the scans again from the start, because window and running medians continue from submap to submap, and
    outputs only the missing submaps.
    """

    config: LidarFrontEndConfig = field(default_factory=LidarFrontEndConfig)
    _made: list[Any] = field(default_factory=list, init=False, repr=False, compare=False)
    name: ClassVar[str] = "lidar-odometry"

    def follow(
        self,
        feed: RecordSource,
        *,
        seed: SeedTree,
        after: Submap | None = None,
        drops: DropCounter | None = None,
        watch: Watch | None = None,
    ) -> Iterator[Submap | None]:
        """See :class:`~graphslam_frontends.base.FrontEnd`. A scan is processed when the next scan and the IMU readings
        up to it have arrived; the first ones when there are enough readings to initialise the IMU."""
        first = 0 if after is None else after.key + 1
        while not feed.ended and self._stream(feed) is None:
            yield None
        name = self._named(feed.name, self._stream(feed))
        while not feed.ended and (feed.count(name) < FIRST or self.config.imu not in (*feed.names(object), *UNNAMED)):
            yield None
        unit = Unit(feed, self._imu(feed, name), self.config.odometry)
        wheels = _Wheels(feed, self._wheels(feed, name))
        yield from unit.rehearse(name)
        odometry = self._odometry(unit)
        odometry.reckoned = wheels.reckoned
        seen: list[FollowedScan] = []
        self._made[:] = [feed, seen, unit, wheels.name]
        config = self.config.submap
        kept: list[FollowedScan] = []
        k, key, begin, warned, mapped, most = -1, 0, 0.0, False, False, 0
        while True:
            while not feed.ended and (
                feed.count(name) <= k + 2
                or not unit.reaches(feed.part(name, k + 1, k + 2))
                or not wheels.reaches(feed.part(name, k + 1, k + 2))
            ):
                yield None
            k, scans = k + 1, feed.count(name)  # only the end of the feed shows that a scan is the last
            if k >= scans:
                break
            clouds = self._checked(name, feed.part(name, k, k + 1))
            unit.hear(float(clouds.times[0]))
            wheels.hear(float(clouds.times[0]))
            seen.append(self._follow(odometry, clouds, 0))
            mapped, most = mapped or seen[-1].seen.state in MAPPED, max(most, seen[-1].seen.points)
            feed.discard_before(name, k + 1)
            if k == 0:
                odometry.errors.begin()
            kept.append(seen[-1])
            n = len(kept) - 1
            full = odometry.length - begin >= config.length and n >= config.scans
            if k == scans - 1 or full or n >= MOST_SCANS:
                bent = [] if warned else [*_bent(key, kept), *_uneven(key, kept)]
                warned = warned or bool(bent)
                if n and key >= first:
                    ended = "end-of-log" if k == scans - 1 else "length"
                    origin = se3.se3_transform(clouds.T_base_sensor, clouds.origin)
                    base = kept[0].pose
                    if key == 0 and odometry.inertial is not None:
                        base = align_with_gravity(base, odometry.inertial.up)
                    yield _submap((name, unit.name, wheels.name), base, kept, origin, config, key, ended, bent)
                odometry.errors.begin()
                for i in range(k - n, k):  # the points of a submap are needed again only by a refinement
                    seen[i] = replace(seen[i], points=seen[i].points.astype(np.float32))
                kept, key, begin = [replace(seen[-1], joint=odometry.errors.joint)], key + 1, odometry.length
        if scans and not mapped:
            c = self.config.odometry
            raise DataError(
                "no scan has enough points",
                where=f"{feed.name}/{name}",
                got=f"{scans} scans, of which the fullest has {most} points {c.min_range:g} to {c.max_range:g} m away",
                wanted=f"at least {FEW} points, in metres",
            )
        if key == 0:
            raise DataError("too few scans for a submap", where=f"{feed.name}/{name}", got=scans, wanted="at least 2")

    def steps(self, log: SensorLog) -> Steps:
        """Scans and motion for a refinement; the motion covariance is that of constant velocity.

        The odometry path was estimated from the same scans, so it is only the initial guess of a refinement.
        """
        name, clouds = self._clouds(log)
        made = bool(self._made) and self._made[0].ended and self._made[0].log is log
        if not (made and len(self._made[1]) == len(clouds)):
            feed = RecordSource(log)
            unit = Unit(feed, self._imu(feed, name), self.config.odometry)
            for _ in unit.rehearse(name):
                pass
            wheels = _Wheels(feed, self._wheels(feed, name))
            wheels.hear()
            odometry = self._odometry(unit)
            odometry.reckoned = wheels.reckoned
            followed = [self._follow(odometry, clouds, k) for k in range(len(clouds))]
            self._made[:] = [feed, followed, unit, wheels.name]
        _, seen, unit, moves = self._made
        uses = {name} | ({moves} if any(f.seen.bridged for f in seen) else set())
        return _steps(log, frozenset(uses), clouds, seen, self.config, unit.tilt(log, *_stamped(seen)))

    def forget(self) -> None:
        """Free the path and the scans of the last log."""
        self._made.clear()

    def _odometry(self, unit: Unit) -> LidarOdometry:
        """The odometry in its initial state."""
        return unit.odometry()

    def _stream(self, streams: SensorLog | RecordSource) -> str | None:
        return self.config.stream or streams.of_type(PointClouds)

    def _named(self, where: str, name: str | None) -> str:
        if name is None:
            raise MissingDataError("no stream of point clouds", where=where, wanted="PointClouds")
        return name

    def _checked(self, name: str, stream: Any) -> PointClouds:
        if not isinstance(stream, PointClouds):
            raise ConfigError(f"frontend.stream = {name!r} holds no point clouds; got {type(stream).__name__}")
        return stream

    def _clouds(self, log: SensorLog) -> tuple[str, PointClouds]:
        name = self._named(log.name, self._stream(log))
        return name, self._checked(name, log[name])

    def _imu(self, feed: RecordSource, clouds: str) -> str | None:
        """Name of the IMU that is used: it must have readings by the time of the first scans."""
        name = feed.of_type(Imu) if self.config.imu == "auto" else self.config.imu
        if name is None or name == "none":
            return None
        stream = feed.part(name)
        if not isinstance(stream, Imu):
            raise ConfigError(f"frontend.imu = {name!r} is no IMU; got {type(stream).__name__}")
        scans = feed.part(clouds, 0, min(FIRST, feed.count(clouds))).times
        return name if len(stream.times) and len(scans) and stream.times[0] <= scans[-1] else None

    def _wheels(self, feed: RecordSource, clouds: str) -> str | None:
        """Name of the odometry that is used: it must have records by the time of the first scans."""
        asked = self.config.wheels
        name = feed.of_type(Odometry) if asked == "auto" else asked
        scans = feed.part(clouds, 0, min(FIRST, feed.count(clouds))).times
        if name is None or name == "none" or not len(scans):
            return None
        stream = feed.part(name)
        if not isinstance(stream, Odometry):
            raise ConfigError(f"frontend.wheels = {name!r} is no odometry; got {type(stream).__name__}")
        some = stream.increments[stream.times <= scans[-1]]
        level = some.shape[1] == 3 or np.abs(some[:, 2:5]).max(initial=0.0) <= LEVEL
        return name if len(some) and (level or asked != "auto") else None

    def _follow(self, odometry: LidarOdometry, clouds: PointClouds, k: int) -> FollowedScan:
        seen, ages = _step(odometry, clouds, k), clouds.ages(k)
        return FollowedScan(
            float(clouds.times[k]),
            odometry.pose,
            odometry.errors.joint,
            odometry.spread,
            odometry.points[evenly_spaced_rows(len(odometry.points), self.config.submap.points)],
            seen,
            None if ages is None else float(np.ptp(ages)) if len(ages) else 0.0,
        )


class _Heard(ABC):
    """A stream used with the scans, read as it arrives.

    Parameters
    ----------
    name : str or None
        None: there is none, and nothing is waited for.
    """

    def __init__(self, feed: RecordSource, name: str | None) -> None:
        self.feed, self.name = feed, name
        self._heard, self._last = 0, -np.inf

    @property
    @abstractmethod
    def listener(self) -> ImuReadings | WheelMotionPrior | None:
        """The object that receives its records."""

    def reaches(self, scan: Stream) -> bool:
        """Have its records arrived up to the stamp of a scan?"""
        return self.name is None or self.feed.until(self.name) >= float(scan.times[0])

    def hear(self, now: float = -np.inf) -> None:
        """Process the new records, and discard those that are too old for the previous scan."""
        if self.name is None or self.listener is None:
            return
        n, since, self._last = self.feed.count(self.name), min(self._last, now) - OF_USE, now
        if n > self._heard:
            self.listener.more(self._part(self._heard, n), since)
            self._heard = n

    def _part(self, first: int, last: int) -> Any:
        assert self.name is not None
        return self.feed.part(self.name, first, last)


class Unit(_Heard):
    """The IMU of a feed, if there is one, and its estimated parameters."""

    def __init__(self, feed: RecordSource, name: str | None, config: LidarOdometryConfig) -> None:
        super().__init__(feed, name)
        self.config = config
        self.inertial: InertialPredictor | None = None

    @property
    def listener(self) -> ImuReadings | None:
        """The unit's readings."""
        return None if self.inertial is None else self.inertial.readings

    def rehearse(self, clouds: str) -> Iterator[None]:
        """Process the first scans to initialise the IMU; yields None while more records are needed.

        If the IMU does not predict the rotations of these scans, a second attempt deskews and predicts with it in any
        case: matches of distorted or sparse scans may be wrong. If the IMU then predicts the rotations and the overlap
        is not lower, the scans were wrong, not the IMU.
        """
        if self.name is None:
            return
        while not self.feed.ended and self.feed.count(self.name) < USUAL:
            yield None
        fitted: list[float] = []
        for trusted in (False, True):
            self._heard = self.feed.count(self.name)
            self.inertial = InertialPredictor(self._part(0, self._heard), trusted=trusted)
            odometry, overlaps = LidarOdometry(self.config, self.inertial), []
            for k in range(REHEARSED):
                while not self.feed.ended and (
                    self.feed.count(clouds) <= k or not self.reaches(self.feed.part(clouds, k, k + 1))
                ):
                    yield None
                if k >= self.feed.count(clouds):
                    break
                self.hear()
                overlaps.append(_step(odometry, self.feed.part(clouds, k, k + 1), 0).overlap)
                if self.inertial.rehearsed and not trusted:
                    break
            self.inertial.trusted = False
            fitted.append(float(np.median(overlaps[1:])) if len(overlaps) > 1 else 0.0)
            if self.inertial.believed and self.inertial.known and fitted[-1] >= fitted[0]:
                self.inertial.rewind()
                return
        self.inertial = InertialPredictor(self._part(0, self._heard))  # it may become reliable later

    def odometry(self) -> LidarOdometry:
        """The odometry in its initial state."""
        return LidarOdometry(self.config, self.inertial)

    def tilt(self, log: SensorLog, times: Array, poses: Array) -> PathGravity | None:
        """Gravity along a path, from all readings."""
        if self.name is None or self.inertial is None:
            return None
        self.inertial.readings = ImuReadings(log[self.name])
        return gravity_along_path(self.inertial, times, poses)


class _Wheels(_Heard):
    """The odometry stream of a feed, if one is used."""

    def __init__(self, feed: RecordSource, name: str | None) -> None:
        super().__init__(feed, name)
        self.reckoned = None if name is None else WheelMotionPrior(self._part(0, 0))

    @property
    def listener(self) -> WheelMotionPrior | None:
        """The motion prior from its records."""
        return self.reckoned


def _step(odometry: LidarOdometry, clouds: Any, k: int) -> ScanResult:
    points = se3.se3_transform(clouds.T_base_sensor, clouds.cloud(k))
    return odometry.step(points, float(clouds.times[k]), clouds.ages(k))


def _bent(key: int, kept: list[FollowedScan]) -> list[Finding]:
    """Report point clouds without point times if the motion distorts the scans."""
    worst = 0.0
    for a, b in pairwise(kept):
        if b.sweep is None and len(b.points):
            far = float(np.median(np.linalg.norm(b.points, axis=1)))
            move = np.asarray(se3.se3_log(se3.se3_between(a.pose, b.pose)))
            worst = max(worst, float(np.linalg.norm(move[3:]) + far * np.linalg.norm(move[:3])))
    if worst <= BENT:
        return []
    text = (
        f"point times in submap {key}: none, while points move by up to {worst:.2f} m from scan to scan — scans are "
        "distorted unless they were deskewed before, and the covariance does not include this. Give the points their "
        "times in a field t, time or offset_time."
    )
    return [Finding("look", "points-without-times", text)]


def _uneven(key: int, kept: list[FollowedScan]) -> list[Finding]:
    """Report a motion that changes too much from scan to scan for deskewing at constant velocity.

    If the velocity changes uniformly over a scan, by Δ in all, points in its middle are off by Δ / 8 times its
    duration. Δ is the change from one scan to the next; the duration is from the first point of a scan to its last.
    """
    off = []
    for a, b, c in zip(kept, kept[1:], kept[2:]):
        if c.sweep is not None and not c.seen.aided and len(c.points) and c.time > b.time:
            before, now = se3.se3_between(np.stack([a.pose, b.pose]), np.stack([b.pose, c.pose]))
            change = np.asarray(se3.se3_log(se3.se3_between(before, now)))
            far = float(np.median(np.linalg.norm(c.points, axis=1)))
            share = min(c.sweep / (c.time - b.time), 1.0)  # a hand shakes faster than the scan rate: scale time, not Δ
            off.append(share * float(np.linalg.norm(change[3:]) + far * np.linalg.norm(change[:3])) / 8.0)
    if not off or np.median(off) <= UNEVEN:
        return []
    text = (
        f"deskewing without IMU in submap {key}: error of about {np.median(off):.2f} m in the middle of a scan — the "
        "velocity changes within scans, and the covariance does not include this. To do: log the lidar's IMU, or move "
        "it more steadily."
    )
    return [Finding("bad", "uneven-motion", text)]


def _stamped(made: list[FollowedScan]) -> tuple[Array, Array]:
    """Stamps and poses of the scans in the map."""
    some = [f for f in made if f.seen.state in MAPPED]
    return np.array([f.time for f in some]), np.array([f.pose for f in some]).reshape(-1, 7)


def _submap(
    names: tuple[str, str | None, str | None],
    base: Array,
    kept: list[FollowedScan],
    origin: Array,
    config: LidarSubmapConfig,
    key: int,
    ended: str,
    bent: list[Finding],
) -> Submap:
    poses = np.array([f.pose for f in kept])
    path = se3.se3_between(np.broadcast_to(base, poses.shape), poses)
    C = np.array([relative_covariance((poses[0], f.pose), (poses[0], f.pose), f.joint) for f in kept])
    grid = EvidenceGrid(config.voxel_size, model=config.beam_model(), dim=3)
    dropped, points, scan = 0, [], []
    origins: list[Array] = []
    for k, (f, T) in enumerate(zip(kept, path)):
        # the scan between two submaps is in the map of the one that ends there
        if (k == 0 and key > 0) or f.seen.state not in MAPPED:
            continue
        at = np.broadcast_to(origin, f.points.shape)
        dropped += grid.insert_scan(f.points, at, pose=T, max_range=config.reach).dropped
        points.append(se3.se3_transform(T, f.points))
        scan.append(np.full(len(f.points), len(origins)))
        origins.append(se3.se3_transform(T, origin))
    states = Counter(f.seen.state for f in kept[int(key > 0) :])
    overlaps = [f.seen.overlap for f in kept if np.isfinite(f.seen.overlap)]
    # all six directions are unobservable: lost scans, and matches with too few cells
    lost = sum(f.seen.unobservable == 6 for f in kept[int(key > 0) :])
    report: dict[str, Any] = {
        "ended": ended,
        "scans": len(kept) - 1,
        "length": round(float(np.sum(np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1))), 3),
        "scan_states": dict(sorted(states.items())),
        "scans_searched": sum(f.seen.searched for f in kept[int(key > 0) :]),
        "scans_lost": lost,
        "scans_unobservable": sum(f.seen.unobservable > 0 for f in kept[int(key > 0) :] if f.seen.state in MAPPED),
        "overlap_median": float(np.median(overlaps)) if overlaps else None,
        "beams_dropped": int(dropped),
        "exit_covariance": "window",
    }
    aided = sum(f.seen.aided for f in kept[int(key > 0) :])
    if names[1] is not None:
        report["scans_aided"] = aided
    bridged = sum(f.seen.bridged for f in kept[int(key > 0) :])
    watched = any(f.seen.watched for f in kept[int(key > 0) :])
    if names[2] is not None:
        report["scans_bridged"] = bridged
    findings = [*bent, *_findings(key, kept, report, names[1:])]
    if findings:
        report["findings"] = [f.as_row() for f in findings]
    cloud = None
    if points:
        cloud = CloudMap(
            points=np.concatenate(points), origins=np.array(origins), scan=np.concatenate(scan), cell=CLOUD_CELL
        )
    return Submap(
        key=key,
        interval=(kept[0].time, kept[-1].time),
        exit_pose=path[-1],
        exit_covariance=C[-1],
        trajectory=Trajectory(np.array([f.time for f in kept]), path, C),
        grid=grid,
        cloud=cloud,
        uses=frozenset(n for n, used in ((names[0], True), (names[2], bridged)) if n is not None and used),
        assisting_streams=frozenset(
            n for n, of in ((names[1], aided), (names[2], watched and not bridged)) if n is not None and of
        ),
        report=report,
    )


def _findings(
    key: int, kept: list[FollowedScan], report: dict[str, Any], names: tuple[str | None, str | None]
) -> list[Finding]:
    out, n = [], report["scans"]
    imu, wheels = names
    if imu is not None and report["scans_aided"] < 0.5 * n:
        text = (
            f"{imu} in submap {key}: not used in {n - report['scans_aided']} of {n} scans — its readings have gaps, or "
            "constant velocity predicts the rotation better. Check its axes, units and stamps."
        )
        out.append(Finding("look", "imu-left-aside", text))
    own = kept[int(key > 0) :]
    alone = sum(f.seen.unobservable == 6 and not f.seen.bridged for f in own)
    if report["scans_lost"] > MANY * n + (BEGUN if key == 0 else 0):
        text = f"unmatched scans in submap {key}: {report['scans_lost']} of {n} — not in the map. "
        if alone < report["scans_lost"]:
            text += f"The path there is that of {wheels}, with the noise estimated from the other scans."
            text += f" For {alone} of them constant velocity is assumed, because {wheels} has no data." if alone else ""
        else:
            text += "Constant velocity is assumed there, with a matching covariance."
        out.append(Finding("bad" if alone > 0.5 * n else "look", "scans-lost", text))
    if report["scans_unobservable"] > 0.5 * n:
        by = "constant velocity" if report.get("scans_aided", 0) < 0.5 * n else imu
        by = wheels if any(f.seen.bridged for f in own) else by
        text = (
            f"unobservable directions in submap {key}: {report['scans_unobservable']} of {n} scans, as in a corridor "
            f"or on a plain — the path along them is that of {by}."
        )
        out.append(Finding("look", "scans-unobservable", text))
    return out


def _steps(
    log: SensorLog,
    uses: frozenset[str],
    clouds: PointClouds,
    made: list[FollowedScan],
    config: LidarFrontEndConfig,
    tilt: PathGravity | None,
) -> Steps:
    times = np.array([f.time for f in made])
    poses = np.array([f.pose for f in made])
    increments = np.concatenate([np.array([[0.0, 0, 0, 0, 0, 0, 1]]), se3.se3_between(poses[:-1], poses[1:])])
    covariances = np.array([np.zeros((6, 6)), *[f.spread for f in made[1:]]])
    points = [(f.points if f.seen.state in MAPPED else f.points[:0]).astype(np.float32, copy=False) for f in made]
    offsets = np.concatenate([[0], np.cumsum([len(p) for p in points])]).astype(np.int64)
    ends = np.concatenate(points)
    origin = se3.se3_transform(clouds.T_base_sensor, clouds.origin)
    return Steps(
        times=times,
        odometry=Odometry(times=times, increments=increments, covariances=covariances),
        offsets=offsets,
        points=cast(Array, ends),
        origins=cast(Array, np.broadcast_to(origin.astype(np.float32), ends.shape)),
        returns=np.ones(len(ends), np.bool_),
        max_range=config.odometry.max_range,
        range_sigma=0.03,
        tilt=None if tilt is None else tilt.at(times, poses),
        tilt_sigma=0.0 if tilt is None else tilt.sigma,
        tilt_time=1.0 if tilt is None else tilt.time,
        uses=uses,
        name=log.name,
        truth=log.truth.trajectory if log.truth is not None else None,
        matched=True,
    )
