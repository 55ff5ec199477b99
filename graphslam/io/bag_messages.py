"""Messages of a bag by kind: which topics are read, their values, clouds on disk, and transforms between frames."""

from __future__ import annotations

import hashlib
import re
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.errors import ConfigError, FormatError, MissingDataError
from graphslam.core.geometry import Array
from graphslam.core.log import DropCounter
from graphslam.core.reading import finite_mask
from graphslam.io import ros_messages as ros
from graphslam.io.bag_files import BagFiles, BagTopic, error_text
from graphslam.io.cloud_logs import ages_of

KINDS = {
    "sensor_msgs/msg/LaserScan": "laser",
    "sensor_msgs/msg/PointCloud2": "clouds",
    "livox_ros_driver/msg/CustomMsg": "clouds",
    "livox_ros_driver2/msg/CustomMsg": "clouds",
    "sensor_msgs/msg/Imu": "imu",
    "nav_msgs/msg/Odometry": "odometry",
    "sensor_msgs/msg/NavSatFix": "gps",
}
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_NO_LIDAR = re.compile(r"depth|camera|rgbd|stereo|cost|octomap|map\b|_map|registered|mesh|obstacle|cluster|ground")
_MADE = re.compile(r"filtered|fused|ekf|ukf|global|map|ground_truth|gt\b|reference")
ODOMETRY_FRAMES = ("odom", "odom_combined", "odometry", "world_odom")
_PACKETS = re.compile(r"packets|VelodyneScan|PacketMsg|RawPacket|hesai|UdpFrame", re.IGNORECASE)
WANTED = "messages of LaserScan, PointCloud2 or CustomMsg (and Odometry)"


class SpooledClouds:
    """Clouds of a bag, in a file without a name that goes with the process; see ``CloudSource``.

    Parameters
    ----------
    bounds : (n + 1,) int64
    points : (q, 3) float32
    ages : (q,) float32 or None
    """

    def __init__(
        self, bounds: npt.NDArray[np.int64], points: npt.NDArray[np.float32], ages: npt.NDArray[np.float32] | None
    ) -> None:
        self._bounds, self._points, self._ages = bounds, points, ages
        self.counts = np.diff(bounds)

    def cloud(self, k: int) -> Array:
        """See :class:`~graphslam.core.point_clouds.CloudSource`."""
        return self._points[self._bounds[k] : self._bounds[k + 1]].astype(np.float64)

    def ages(self, k: int) -> Array | None:
        """See :class:`~graphslam.core.point_clouds.CloudSource`."""
        return None if self._ages is None else self._ages[self._bounds[k] : self._bounds[k + 1]].astype(np.float64)

    def packed(self) -> bytes:
        """See :class:`~graphslam.core.point_clouds.CloudSource`: digests of the points."""
        d = hashlib.blake2b(self._bounds.tobytes(), digest_size=32)
        for a in (self._points, self._ages):
            if a is not None:
                for k in range(0, len(a), 1 << 20):
                    d.update(a[k : k + (1 << 20)].tobytes())
        return d.digest()


class FloatSpool:
    """Rows of float32 that are written one after the other and read back as a map of memory."""

    def __init__(self, width: int) -> None:
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as its map
        self._width, self.rows = width, 0

    def add(self, a: Array) -> None:
        self._file.write(np.ascontiguousarray(a, dtype=np.float32).tobytes())
        self.rows += len(a)

    def map(self) -> npt.NDArray[np.float32]:
        self._file.flush()
        shape = (self.rows, self._width) if self._width > 1 else (self.rows,)
        return np.memmap(self._file, np.float32, "r", shape=shape) if self.rows else np.zeros(shape, np.float32)


@dataclass
class TopicRows:
    """What was read of one topic."""

    stamps: list[float] = field(default_factory=list)
    bag_stamps: list[float] = field(default_factory=list)
    values: list[Any] = field(default_factory=list)
    frame: str = ""
    child: str = ""
    damaged: int = 0
    why: str = ""
    one_time: bool = False  # points have a field of times, which says nothing


class FrameTree:
    """Transforms between frames that do not change, and one that does: of an odometry frame to the robot."""

    def __init__(self) -> None:
        self.fixed: dict[tuple[str, str], list[float]] = {}
        self.moving: dict[tuple[str, str], TopicRows] = {}

    def add(self, message: Any, bag_stamp: float, static: bool) -> None:
        for t in message.transforms:
            key = t.header.frame_id.lstrip("/"), t.child_frame_id.lstrip("/")
            pose = ros.pose_of_message(t.transform)
            norm = float(np.linalg.norm(pose[3:]))
            if not np.all(finite_mask(pose)) or abs(norm - 1.0) > 0.05:
                continue
            if static:
                self.fixed[key] = pose
            else:
                rows = self.moving.setdefault(key, TopicRows())
                rows.stamps.append(ros.stamp_of(t))
                rows.bag_stamps.append(bag_stamp)
                rows.values.append(pose)

    def settle(self) -> None:
        """Transforms of ``tf`` that never changed are fixed ones."""
        for key, rows in list(self.moving.items()):
            if np.ptp(np.array(rows.values), axis=0).max() == 0.0 and key[0] not in ODOMETRY_FRAMES:
                self.fixed.setdefault(key, rows.values[0])
                del self.moving[key]

    def know(self, a: str, b: str) -> bool:
        """Is the place of one in the other known?"""
        return self.between(a, b) is not None

    def between(self, a: str, b: str) -> Array | None:
        """``T_a_b`` over fixed transforms, or None."""
        if a == b:
            return np.array([0.0, 0, 0, 0, 0, 0, 1])
        steps: dict[str, list[tuple[str, Array]]] = {}
        for (parent, child), pose in self.fixed.items():
            T = np.concatenate([pose[:3], se3.quat_normalize(np.array(pose[3:]))])
            steps.setdefault(parent, []).append((child, T))
            steps.setdefault(child, []).append((parent, se3.se3_inverse(T)))
        reached = {a: np.array([0.0, 0, 0, 0, 0, 0, 1])}
        todo = [a]
        while todo:
            at = todo.pop(0)
            for to, T in steps.get(at, []):
                if to not in reached:
                    reached[to] = se3.se3_compose(reached[at], T)
                    todo.append(to)
        return reached.get(b)


def choose_topics(
    bag: BagFiles, asked: dict[str, str | None], notes: list[str], counter: DropCounter
) -> dict[str, BagTopic]:
    """The topic of each kind."""
    there: dict[str, list[BagTopic]] = {}
    for t in bag.topics.values():
        kind = KINDS.get(t.type)
        if kind is not None and t.count:
            there.setdefault(kind, []).append(t)
    chosen: dict[str, BagTopic] = {}
    for kind, want in asked.items():
        if want is not None and want != "none":
            topic = bag.topics.get(want) or bag.topics.get(f"/{want.lstrip('/')}")
            if topic is None or KINDS.get(topic.type) != kind:
                known = ", ".join(t.name for t in there.get(kind, [])) or "none"
                raise ConfigError(f"no topic {want!r} of {kind} in {bag.path.name}; there are: {known}")
            chosen[kind] = topic
        elif want is None and kind in there:
            ranked = [(_rank(kind, t.name), -t.count, t.name, t) for t in there[kind]]
            chosen[kind] = min(ranked, key=lambda row: row[:3])[3]
    if asked["clouds"] is None and asked["laser"] is None and {"clouds", "laser"} <= chosen.keys():
        # a depth camera beside a laser is no lidar; else the sensor that sees more is taken
        cloud_topic: BagTopic = chosen["clouds"]
        del chosen["clouds" if _rank("clouds", cloud_topic.name) else "laser"]
    if asked["laser"] not in (None, "none") and asked["clouds"] is None:
        chosen.pop("clouds", None)
    for kind, topic in chosen.items():
        others = [t for t in there.get(kind, []) if t is not topic]
        also = f" (also {', '.join(f'{t.name} ({t.count})' for t in others)}: option {kind}=)" if others else ""
        notes.append(f"{kind} from {topic.name}{also}")
    unused = [t for t in bag.topics.values() if t.count and t not in chosen.values() and t.type not in TRANSFORMS]
    for t in unused:
        known = "not chosen" if t.type in KINDS else "of a type that is not read"
        counter.drop("bag", f"{t.name} ({t.type}) {known}", t.count)
    if not {"clouds", "laser"} & chosen.keys() and not {"odometry", "imu", "gps"} & chosen.keys():
        types = Counter({t.type: t.count for t in bag.topics.values() if t.count})
        packets = any(_PACKETS.search(t) for t in types)
        said = ", ".join(f"{n} {k}" for k, n in types.most_common(8)) or "no message at all"
        hint = "; these are raw packets: run the driver of the lidar and record its clouds" if packets else ""
        raise MissingDataError("no scanner in this bag", where=str(bag.path), got=said, wanted=WANTED + hint)
    return chosen


def _rank(kind: str, topic: str) -> int:
    """0: the raw stream of a sensor; 1: probably something made of it."""
    name = topic.lower()
    if kind == "clouds":
        return int(bool(_NO_LIDAR.search(name)))
    return int(bool(_MADE.search(name))) if kind in ("odometry", "gps", "imu") else 0


def collect_messages(
    bag: BagFiles, chosen: dict[str, BagTopic], counter: DropCounter, point_times: bool
) -> tuple[FrameTree, dict[str, TopicRows], tuple[FloatSpool, FloatSpool | None] | None]:
    """All messages of the chosen topics, points in a spool."""
    kind_of = {t.name: k for k, t in chosen.items()}
    transforms = {t.name for t in bag.topics.values() if t.type in TRANSFORMS}
    frames, rows = FrameTree(), {k: TopicRows() for k in chosen}
    points, ages = FloatSpool(3), FloatSpool(1)
    timed: bool | None = None if point_times else False
    lost: Counter[str] = Counter()
    for topic, raw, bag_stamp in bag.messages({*kind_of, *transforms}, counter):
        kind = kind_of.get(topic)
        try:
            if kind is None:
                message = bag.decode(raw, bag.topics[topic].type)
                frames.add(message, bag_stamp, "static" in topic)
                continue
            r, type_ = rows[kind], bag.topics[topic].type
            if type_ in ros.LIVOX:
                livox = ros.livox_cloud(raw, ros2=bag.ros2)
                stamp, frame, cloud = livox.stamp, livox.frame, livox.cloud
            else:
                message = bag.decode(raw, type_)
                stamp, frame = ros.stamp_of(message), str(message.header.frame_id)
            if kind == "clouds":
                if type_ not in ros.LIVOX:
                    cloud = ros.point_cloud(message)
                lost["point not finite"] += cloud.not_finite
                lost["point at the origin (no return)"] += cloud.at_origin
                before = ages_of(cloud, stamp or bag_stamp) if timed is not False else None
                if timed is None and len(cloud.points):
                    timed = before is not None
                    r.one_time = not timed and cloud.times is not None
                points.add(cloud.points)
                ages.add(before if before is not None else np.zeros(len(cloud.points)))
                r.values.append(len(cloud.points))
            else:
                r.values.append(_TAKE[kind](message))
            r.stamps.append(stamp)
            r.bag_stamps.append(bag_stamp)
            r.frame = r.frame or frame.lstrip("/")
            if kind == "odometry":
                r.child = r.child or str(message.child_frame_id).lstrip("/")
        except (ValueError, AttributeError, TypeError, OverflowError, FormatError) as error:
            if kind is not None:
                rows[kind].damaged += 1
                rows[kind].why = error_text(error)
            else:
                counter.drop("tf", "message cannot be decoded")
    for reason, n in lost.items():
        counter.drop("clouds", reason, n)
    for kind, r in list(rows.items()):
        counter.drop(kind, f"message cannot be decoded ({r.why})", r.damaged)
        if not r.values:
            del rows[kind]
    if "clouds" not in rows:
        return frames, rows, None
    return frames, rows, (points, ages if timed else None)


def _take_laser(m: Any) -> tuple[Any, ...]:
    ranges = np.asarray(m.ranges, dtype=np.float32)
    return ranges, float(m.angle_min), float(m.angle_increment), float(m.range_min), float(m.range_max)


def _take_imu(m: Any) -> list[float]:
    w, a = m.angular_velocity, m.linear_acceleration
    return [float(v) for v in (w.x, w.y, w.z, a.x, a.y, a.z)]


def _take_fix(m: Any) -> tuple[list[float], Array, int, int]:
    P = np.asarray(m.position_covariance, dtype=np.float64).reshape(3, 3)
    return (
        [float(m.latitude), float(m.longitude), float(m.altitude)],
        P,
        int(m.status.status),
        int(m.position_covariance_type),
    )


_TAKE: dict[str, Callable[[Any], Any]] = {
    "laser": _take_laser,
    "imu": _take_imu,
    "odometry": lambda m: ros.pose_of_message(m.pose.pose),
    "gps": _take_fix,
}
