"""Messages of a bag by kind: choice of topics, message values, point clouds on disk, and transforms."""

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
from graphslam.io import ros_messages as ros
from graphslam.io.bag_files import BagFiles, BagTopic, error_text
from graphslam.io.cloud_files import CloudData
from graphslam.io.frame_tree import FrameTree, TopicRows
from graphslam.io.point_times import PointClock

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
_PACKETS = re.compile(r"packets|VelodyneScan|PacketMsg|RawPacket|hesai|UdpFrame", re.IGNORECASE)
WANTED = "messages of LaserScan, PointCloud2 or CustomMsg (and Odometry)"


class FloatSpool:
    """Rows of float32 in a temporary file: appended, then read as a memory map."""

    def __init__(self, width: int) -> None:
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - must stay open for its memory map
        self._width, self.rows = width, 0

    def add(self, a: Array) -> None:
        self._file.write(np.ascontiguousarray(a, dtype=np.float32).tobytes())
        self.rows += len(a)

    def map(self) -> npt.NDArray[np.float32]:
        self._file.flush()
        shape = (self.rows, self._width) if self._width > 1 else (self.rows,)
        return np.memmap(self._file, np.float32, "r", shape=shape) if self.rows else np.zeros(shape, np.float32)


@dataclass
class CloudSpool:
    """Points of the clouds of a bag and their times, written to disk while the bag is read.

    Times are stored relative to the earliest one of their scan, ``first`` (n,), NaN for scans without times; ``spans``
    (n,) is latest minus earliest. All are in the unit of the message field.
    """

    points: FloatSpool = field(default_factory=lambda: FloatSpool(3))
    times: FloatSpool = field(default_factory=lambda: FloatSpool(1))
    first: list[float] = field(default_factory=list)
    spans: list[float] = field(default_factory=list)

    def add(self, cloud: CloudData) -> None:
        self.points.add(cloud.points)
        t = cloud.times if cloud.times is not None and len(cloud.times) else None
        self.first.append(float("nan") if t is None else float(t.min()))
        self.spans.append(float("nan") if t is None else float(np.ptp(t)))
        self.times.add(np.zeros(len(cloud.points)) if t is None else t - t.min())


class SpooledClouds:
    """Clouds of a bag in temporary files that are deleted with the process; see ``CloudSource``.

    Parameters
    ----------
    counts : (n,) int64
        Number of points of each scan.
    stamps : (n,)
        Stamps of the scans [s].
    clock : PointClock or None
        Unit and origin of the point times; None: they are not used.
    T_base_frame : (n, 7) or None
        Pose of the frame of each cloud in the base, if that frame moves relative to the base; otherwise None.
    """

    def __init__(
        self,
        spool: CloudSpool,
        counts: npt.NDArray[np.int64],
        stamps: Array,
        clock: PointClock | None,
        T_base_frame: Array | None = None,
    ) -> None:
        self._bounds = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        self._points, self._times, self._first = spool.points.map(), spool.times.map(), np.array(spool.first)
        self._stamps, self._clock, self._T_base_frame = stamps, clock, T_base_frame
        self.counts = np.diff(self._bounds)

    def cloud(self, k: int) -> Array:
        """See :class:`~graphslam.core.point_clouds.CloudSource`."""
        points = self._points[self._bounds[k] : self._bounds[k + 1]].astype(np.float64)
        if self._T_base_frame is None:
            return points
        T = self._T_base_frame[k]
        return np.asarray(se3.quat_rotate(np.tile(T[3:], (len(points), 1)), points) + T[:3])

    def ages(self, k: int) -> Array | None:
        """See :class:`~graphslam.core.point_clouds.CloudSource`."""
        if self._clock is None or np.isnan(self._first[k]):
            return None
        times = self._times[self._bounds[k] : self._bounds[k + 1]].astype(np.float64) + self._first[k]
        return self._clock.ages(times, float(self._stamps[k]))

    def packed(self) -> bytes:
        """See :class:`~graphslam.core.point_clouds.CloudSource`: a digest of points, times and poses."""
        d = hashlib.blake2b(self._bounds.tobytes(), digest_size=32)
        T = self._T_base_frame
        for a in (self._points, self._times, self._first, *(() if T is None else (T,))):
            for k in range(0, len(a), 1 << 20):
                d.update(a[k : k + (1 << 20)].tobytes())
        return d.digest()


def choose_topics(
    bag: BagFiles, asked: dict[str, str | None], notes: list[str], counter: DropCounter
) -> dict[str, BagTopic]:
    """The topic of each kind: the requested one, or else by :func:`_rank` and number of messages."""
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
        # the laser is used if the clouds are probably not from a lidar (depth camera); otherwise the clouds
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
        present = ", ".join(f"{n} {k}" for k, n in types.most_common(8)) or "no message at all"
        hint = "; these are raw packets: run the driver of the lidar and record its clouds" if packets else ""
        raise MissingDataError("no scanner in this bag", where=str(bag.path), got=present, wanted=WANTED + hint)
    return chosen


def _rank(kind: str, topic: str) -> int:
    """0: the raw stream of a sensor; 1: probably derived data."""
    name = topic.lower()
    if kind == "clouds":
        return int(bool(_NO_LIDAR.search(name)))
    return int(bool(_MADE.search(name))) if kind in ("odometry", "gps", "imu") else 0


def collect_messages(
    bag: BagFiles, chosen: dict[str, BagTopic], counter: DropCounter
) -> tuple[FrameTree, dict[str, TopicRows], CloudSpool | None]:
    """Read all messages of the chosen topics; points are written to a :class:`CloudSpool`."""
    kind_of = {t.name: k for k, t in chosen.items()}
    transforms = {t.name for t in bag.topics.values() if t.type in TRANSFORMS}
    frames, rows = FrameTree(), {k: TopicRows() for k in chosen}
    spool = CloudSpool()
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
                spool.add(cloud)
                r.values.append(len(cloud.points))
            else:
                r.values.append(_TAKE[kind](message))
            r.stamps.append(stamp)
            r.bag_stamps.append(bag_stamp)
            r.frames.append(frame.lstrip("/"))
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
        r.frame = next((f for f, _ in Counter(r.frames).most_common() if f), "")
        counter.drop(kind, f"message cannot be decoded ({r.why})", r.damaged)
        if not r.values:
            del rows[kind]
    return frames, rows, spool if "clouds" in rows else None


def _take_laser(m: Any) -> tuple[Any, ...]:
    ranges = np.asarray(m.ranges, dtype=np.float32)
    lasts = abs(float(m.time_increment)) * max(len(ranges) - 1, 0)
    return ranges, float(m.angle_min), float(m.angle_increment), float(m.range_min), float(m.range_max), lasts


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
