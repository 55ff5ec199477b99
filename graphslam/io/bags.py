"""Bags of ROS 1 and ROS 2 and MCAP files, read by the package ``rosbags``, without ROS.

Read are ``LaserScan``, ``PointCloud2``, Livox ``CustomMsg``, ``Imu``, ``Odometry``, ``NavSatFix`` and the transforms of
``tf_static`` (and those of ``tf`` that never change). Of several topics of one kind that with most messages is taken,
which an option replaces; the log's notes say which, and what else there is. Other messages are counted by type.

* Stamps are those of the headers; where a driver leaves them at zero, those of the bag.
* Odometry comes from ``Odometry``, or else from the transform of an ``odom`` frame to the robot; in a log of a planar
  laser it is planar. Its covariance is a part of the way driven (options): what messages state is seldom meant.
* The base is the frame that odometry moves, or else that of the clouds. A sensor without a known place sits in the
  base, which is said; an IMU without one is left out.
* Fixes without status or with impossible places are dropped and counted; positions are east, north, up at the first.
"""

from __future__ import annotations

import hashlib
import os
import re
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.errors import ConfigError, DataError, FormatError, GraphSlamError, MissingDataError
from graphslam.core.extras import import_extra
from graphslam.core.geodesy import geodetic_to_ecef
from graphslam.core.geometry import Array, se2_between
from graphslam.core.gnss import TangentPlane
from graphslam.core.imu import GRAVITY, Imu
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.point_clouds import PointClouds
from graphslam.core.reading import finite_mask, most_bytes
from graphslam.core.records import Gps, LaserScans, Odometry, Stream
from graphslam.io import ros_messages as ros
from graphslam.io.clock import usable_records
from graphslam.io.cloud_logs import IMU_NOISE, ages_of
from graphslam.io.planar_scans import unify_layout
from graphslam.io.recognise import bag_kind
from graphslam.io.source_probe import SourceProbe

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
_ODOM_FRAMES = ("odom", "odom_combined", "odometry", "world_odom")
_PACKETS = re.compile(r"packets|VelodyneScan|PacketMsg|RawPacket|hesai|UdpFrame", re.IGNORECASE)
FIX_SIGMA = 5.0
"""σ of a fix whose message says nothing of it [m]."""
_MOST_FAR = 3600.0  # [s] between stamps of headers and of the bag, beyond which it is said


@dataclass
class _Topic:
    """A topic: its type, and how many messages were seen."""

    name: str
    type: str
    count: int = 0


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


class _Spool:
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


@dataclass(frozen=True, slots=True)
class _Channel:
    """A topic of an MCAP file."""

    topic: str
    msgtype: str
    msgcount: int
    encoding: str


class _Mcap:
    """A single MCAP file, whatever else is in it; with the methods of the readers of rosbags that are used here."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.connections: list[_Channel] = []

    def open(self) -> None:
        """Find the topics: in the summary at the end, or else by all records."""
        from mcap.reader import make_reader

        try:
            with open(self._path, "rb") as stream:
                summary = make_reader(stream).get_summary()
        except Exception:  # cut off: its records may be there all the same
            summary = None
        if summary is not None and summary.statistics is not None and summary.channels:
            counts = summary.statistics.channel_message_counts
            schemas = summary.schemas
            self.connections = [self._channel(c, schemas, counts.get(k, 0)) for k, c in summary.channels.items()]
            return
        seen: Counter[str] = Counter()
        known: dict[str, _Channel] = {}
        try:
            for channel, _, _ in self._records():
                known.setdefault(channel.topic, channel)
                seen[channel.topic] += 1
        except Exception:
            if not known:
                raise
        self.connections = [replace(c, msgcount=seen[t]) for t, c in known.items()]

    @staticmethod
    def _channel(channel: Any, schemas: Any, count: int) -> _Channel:
        schema = schemas.get(channel.schema_id)
        name = str(schema.name) if schema is not None else "no schema"
        if channel.message_encoding not in ("cdr", "ros1"):
            name += f", {channel.message_encoding}"
        elif name.count("/") == 1:  # as ROS 1 says it
            name = name.replace("/", "/msg/")
        return _Channel(str(channel.topic), name, int(count), str(channel.message_encoding))

    def _records(self) -> Iterator[tuple[_Channel, int, bytes]]:
        from mcap.records import Channel, Message, Schema
        from mcap.stream_reader import StreamReader

        schemas: dict[int, Any] = {}
        channels: dict[int, _Channel] = {}
        with open(self._path, "rb") as stream:
            for record in StreamReader(stream, record_size_limit=most_bytes()).records:
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    channels[record.id] = self._channel(record, schemas, 0)
                elif isinstance(record, Message) and record.channel_id in channels:
                    yield channels[record.channel_id], record.log_time, record.data

    def messages(self, chosen: list[_Channel]) -> Iterator[tuple[_Channel, int, bytes]]:
        """Messages of topics."""
        topics = {c.topic for c in chosen}
        return (r for r in self._records() if r[0].topic in topics)

    def close(self) -> None:
        """Nothing is open between two calls."""


class _Bag:
    """The files of a bag, opened: topics, and messages as ``(topic, bytes, bag's stamp, decode)``."""

    def __init__(self, path: Path, stack: ExitStack) -> None:
        for package in ("mcap", "rosbags"):
            import_extra(package, "a bag", where=str(path))
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2
        from rosbags.typesys import Stores, get_typestore

        self.path = path
        files = _files(path)
        kinds = {f: "" if f.is_dir() else bag_kind(SourceProbe(f), f) for f in files}
        self.ros2 = "ROS 1 bag" not in kinds.values()
        self.readers: list[Any] = []
        for f in files:
            try:
                reader = _Mcap(f) if kinds[f] == "MCAP" else Reader2(f) if self.ros2 else Reader1(f)
                reader.open()
            except Exception as error:  # MemoryError, too: a damaged length asks for more than any file holds
                raise FormatError(
                    f"bag cannot be opened: {_said(error)}",
                    where=str(f),
                    got=f"{_size(f):,} bytes" if f.is_file() else None,
                    wanted="a bag that is whole: `rosbag reindex`, `ros2 bag reindex` or `mcap recover` may repair it",
                ) from None
            stack.callback(_quietly, reader.close)
            self.readers.append(reader)
        if kinds[files[0]] == "MCAP" and {c.encoding for r in self.readers for c in r.connections} == {"ros1"}:
            self.ros2 = False
        self.store = get_typestore(Stores.ROS2_HUMBLE if self.ros2 else Stores.ROS1_NOETIC)
        if not self.ros2:
            types = {"tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"}
            own = get_typestore(Stores.ROS2_HUMBLE).fielddefs["tf2_msgs/msg/TFMessage"]
            self.store.register({t: own for t in types if t not in self.store.fielddefs})
        self.topics: dict[str, _Topic] = {}
        for r in self.readers:
            for c in r.connections:
                topic = self.topics.setdefault(c.topic, _Topic(c.topic, c.msgtype))
                topic.count += int(c.msgcount)

    def messages(self, names: set[str], drops: DropCounter) -> Iterator[tuple[str, bytes, float]]:
        """Messages of topics, in the order of the bag; a bag that ends too early ends there, which is counted."""
        for r in self.readers:
            chosen = [c for c in r.connections if c.topic in names and c.msgtype == self.topics[c.topic].type]
            if not chosen:
                continue
            try:
                for c, t, raw in r.messages(chosen):
                    yield c.topic, bytes(raw), 1e-9 * t
            except GraphSlamError:
                raise
            except Exception as error:
                drops.drop("bag", f"is damaged or truncated; read up to there ({_said(error)})")

    def decode(self, raw: bytes, kind: str) -> Any:
        """A message; :class:`ValueError` where it cannot be decoded."""
        try:
            if self.ros2:
                return self.store.deserialize_cdr(raw, kind)
            return self.store.deserialize_ros1(raw, kind)
        except Exception as error:
            raise ValueError(_said(error)) from None


def _said(error: Exception) -> str:
    text = " ".join(str(error).split())[:200]
    return text or f"damaged or cut off ({type(error).__name__})"


def _size(path: Path) -> int:
    return path.stat().st_size


def _quietly(close: Callable[[], None]) -> None:
    try:
        close()
    except Exception:  # a reader that failed may be closed already
        return


def _files(path: Path) -> list[Path]:
    """What rosbags opens: a folder with metadata.yaml, or files that are parts of one recording."""
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise MissingDataError("no such file or folder", where=str(path), wanted="a bag")
    look = SourceProbe(path)
    metadata = [
        p for p in look.files if p.name == "metadata.yaml" and look.lines(p, 1)[:1] == ["rosbag2_bagfile_information:"]
    ]
    if len(metadata) == 1:
        return [metadata[0].parent]
    found = [p for p in look.files if bag_kind(look, p)]
    if len(metadata) > 1 or not found:
        raise MissingDataError(
            f"{len(metadata) or 'no'} bags here",
            where=str(path),
            got=", ".join(look.relative(p.parent) for p in metadata[:4]) or str(look),
            wanted="one bag",
        )
    parts = {re.sub(r"_\d+$", "", p.stem) for p in found}
    if len(parts) > 1 or len({p.suffix for p in found}) > 1:
        raise MissingDataError(
            f"{len(found)} bags here", where=str(path), got=", ".join(look.relative(p) for p in found[:6]), wanted="one"
        )
    return sorted(found, key=lambda p: [int(w) if w.isdigit() else 0 for w in re.split(r"(\d+)", p.stem)])


@dataclass
class _Rows:
    """What was read of one topic."""

    stamps: list[float] = field(default_factory=list)
    bag_stamps: list[float] = field(default_factory=list)
    values: list[Any] = field(default_factory=list)
    frame: str = ""
    child: str = ""
    damaged: int = 0
    why: str = ""
    one_time: bool = False  # points have a field of times, which says nothing


class _Frames:
    """Transforms between frames that do not change, and one that does: of an odometry frame to the robot."""

    def __init__(self) -> None:
        self.fixed: dict[tuple[str, str], list[float]] = {}
        self.moving: dict[tuple[str, str], _Rows] = {}

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
                rows = self.moving.setdefault(key, _Rows())
                rows.stamps.append(ros.stamp_of(t))
                rows.bag_stamps.append(bag_stamp)
                rows.values.append(pose)

    def settle(self) -> None:
        """Transforms of ``tf`` that never changed are fixed ones."""
        for key, rows in list(self.moving.items()):
            if np.ptp(np.array(rows.values), axis=0).max() == 0.0 and key[0] not in _ODOM_FRAMES:
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


def read_bag(
    path: str | os.PathLike[str],
    *,
    clouds: str | None = None,
    laser: str | None = None,
    odometry: str | None = None,
    imu: str | None = None,
    gps: str | None = None,
    base_frame: str | None = None,
    mount: tuple[float, float, float, float, float, float] | None = None,
    point_times: bool = True,
    max_range: float | None = None,
    accelerometer_unit: Literal["m/s2", "g"] = "m/s2",
    floor: tuple[float, float] = (0.01, 0.005),
    per_metre: tuple[float, float] = (0.1, 0.15),
    per_radian: float = 0.2,
    name: str | None = None,
    drops: DropCounter | None = None,
) -> SensorLog:
    """Read a bag.

    Parameters
    ----------
    path : path
        A ``.bag``, ``.db3`` or ``.mcap`` file, or a folder with one bag.
    clouds, laser, odometry, imu, gps : str, optional
        Topics; ``none`` leaves a kind out.
    base_frame : str, optional
        Frame of the robot.
    mount : (6,), optional
        Place of the scanner in the base, instead of what transforms say: x, y, z [m], roll, pitch, yaw [rad].
    point_times : bool
        Use times of points, where clouds have them.
    max_range : float, optional
        Of a planar laser [m], instead of what its messages say.
    accelerometer_unit : {"m/s2", "g"}
    floor, per_metre, per_radian : float
        σ of one motion of the odometry: at least metres, radians; per metre driven: of position [m/m] and heading
        [rad/m]; of the heading per radian turned.
    """
    values = [*floor, 1.0 if max_range is None else max_range]
    if not (all(np.isfinite(v) and v > 0 for v in values) and min(*per_metre, per_radian) >= 0):
        raise ConfigError(f"bag: σ {floor}, {per_metre}, {per_radian}, max_range {max_range}; wanted positive numbers")
    p, counter, notes = Path(path), DropCounter(), list[str]()
    asked = {"clouds": clouds, "laser": laser, "odometry": odometry, "imu": imu, "gps": gps}
    with ExitStack() as stack:
        bag = _Bag(p, stack)
        chosen = _choose(bag, asked, notes, counter)
        frames, rows, spool = _collect(bag, chosen, counter, point_times)
    frames.settle()
    streams: dict[str, Stream] = {}
    odom = rows.get("odometry")
    if odom is None and asked["odometry"] != "none":
        odom = _moving(frames, notes)
    planar = "laser" in chosen and "clouds" not in chosen
    base = base_frame or _base(odom, rows, frames)
    if spool is not None:
        found = _clouds(
            rows["clouds"],
            spool,
            _place(frames, base, rows["clouds"].frame, mount, "clouds", notes),
            counter,
            notes,
            str(p),
        )
        streams["clouds"] = found
    if "laser" in rows and "clouds" not in streams:
        place = _place(frames, base, rows["laser"].frame, mount, "laser", notes)
        streams["laser"] = _laser(rows["laser"], place, max_range, counter, notes, str(p))
    if odom is not None:
        streams["odometry"] = _odometry(odom, planar, floor, per_metre, per_radian, counter, notes, str(p))
    if "imu" in rows:
        place_of_imu = frames.between(base, rows["imu"].frame) if rows["imu"].frame else None
        if place_of_imu is None and rows["imu"].frame != base:
            notes.append(f"imu left out: no transform from {base!r} to {rows['imu'].frame!r}")
            counter.drop("imu", "unknown mounting", len(rows["imu"].values))
        else:
            streams["imu"] = _imu(rows["imu"], place_of_imu, accelerometer_unit, counter, notes, str(p))
    if "gps" in rows:
        place_of_gps = frames.between(base, rows["gps"].frame)
        fixes = _gps(rows["gps"], planar, place_of_gps, counter, notes, str(p))
        if fixes is not None:
            streams["gps"] = fixes
    if not streams:
        raise DataError("the bag has no usable messages", where=str(p), got=dict(counter.counts), wanted=_WANTED)
    if drops is not None:
        drops.counts.update(counter.counts)
    read = {k: len(rows[k].stamps) if k in rows else len(s.times) for k, s in streams.items()}
    lost = [] if mount else [k for k in ("clouds", "laser") if k in streams and not frames.know(base, rows[k].frame)]
    topics = {k: t.name for k, t in chosen.items()}
    meta = {"source": p.name, "notes": notes, "base_frame": base, "topics": topics, "unplaced": lost}
    if "clouds" in rows:
        timed = spool is not None and spool[1] is not None
        meta["point_times"] = "used" if timed else "constant" if rows["clouds"].one_time else "none"
    return SensorLog(name=name or p.stem, streams=streams, read=read, dropped=dict(counter.counts), meta=meta)


_WANTED = "messages of LaserScan, PointCloud2 or CustomMsg (and Odometry)"


def _choose(bag: _Bag, asked: dict[str, str | None], notes: list[str], counter: DropCounter) -> dict[str, _Topic]:
    """The topic of each kind."""
    there: dict[str, list[_Topic]] = {}
    for t in bag.topics.values():
        kind = KINDS.get(t.type)
        if kind is not None and t.count:
            there.setdefault(kind, []).append(t)
    chosen: dict[str, _Topic] = {}
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
        cloud_topic: _Topic = chosen["clouds"]
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
        raise MissingDataError("no scanner in this bag", where=str(bag.path), got=said, wanted=_WANTED + hint)
    return chosen


def _rank(kind: str, topic: str) -> int:
    """0: the raw stream of a sensor; 1: probably something made of it."""
    name = topic.lower()
    if kind == "clouds":
        return int(bool(_NO_LIDAR.search(name)))
    return int(bool(_MADE.search(name))) if kind in ("odometry", "gps", "imu") else 0


def _collect(
    bag: _Bag, chosen: dict[str, _Topic], counter: DropCounter, point_times: bool
) -> tuple[_Frames, dict[str, _Rows], tuple[_Spool, _Spool | None] | None]:
    """All messages of the chosen topics, points in a spool."""
    kind_of = {t.name: k for k, t in chosen.items()}
    transforms = {t.name for t in bag.topics.values() if t.type in TRANSFORMS}
    frames, rows = _Frames(), {k: _Rows() for k in chosen}
    points, ages = _Spool(3), _Spool(1)
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
                rows[kind].why = _said(error)
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


def _stamps(r: _Rows, kind: str, notes: list[str]) -> Array:
    """Stamps of headers; of the bag where headers have none."""
    t, b = np.array(r.stamps), np.array(r.bag_stamps)
    if np.mean(t <= 0.0) > 0.5 or (len(t) > 2 and np.ptp(t) == 0.0):
        notes.append(f"{kind} has no stamps in its headers: times of the bag are used")
        return b
    if np.abs(np.median(t - b)) > _MOST_FAR:
        notes.append(f"headers of {kind} are {np.median(t - b):.0f} s from the bag's clock")
    return t


def _moving(frames: _Frames, notes: list[str]) -> _Rows | None:
    """Odometry out of the transforms, or None."""
    found = [(k, r) for k, r in frames.moving.items() if k[0] in _ODOM_FRAMES and len(r.values) > 2]
    if not found:
        return None
    (parent, child), rows = max(found, key=lambda f: len(f[1].values))
    rows.frame, rows.child = parent, child
    notes.append(f"odometry from the transform {parent} → {child}")
    return rows


def _base(odom: _Rows | None, rows: dict[str, _Rows], frames: _Frames) -> str:
    if odom is not None and odom.child:
        return odom.child
    known = {f for key in frames.fixed for f in key}
    for name in ("base_link", "base_footprint", "base"):
        if name in known:
            return name
    return next((rows[k].frame for k in ("clouds", "laser", "imu") if k in rows), "base_link")


def _place(
    frames: _Frames, base: str, frame: str, mount: tuple[float, ...] | None, kind: str, notes: list[str]
) -> Array:
    """``T_base_sensor`` ``(7,)``."""
    if mount is not None:
        if not np.all(finite_mask(mount)):
            raise ConfigError(f"bag: mount is {mount}; wanted 6 finite numbers")
        q = np.array([0.0, 0, 0, 1.0])
        for axis, angle in ((2, mount[5]), (1, mount[4]), (0, mount[3])):
            turn = np.zeros(4)
            turn[axis], turn[3] = np.sin(angle / 2), np.cos(angle / 2)
            q = se3.quat_multiply(q, turn)
        return np.concatenate([mount[:3], q])
    found = frames.between(base, frame)
    if found is None:
        notes.append(
            f"no transform from {base!r} to {frame!r}: {kind} taken as at the base, looking ahead (option mount=)"
        )
        return np.array([0.0, 0, 0, 0, 0, 0, 1])
    return found


def _kept(
    r: _Rows, kind: str, bad: dict[str, Any], counter: DropCounter, notes: list[str], where: str
) -> tuple[Array, Any]:
    """Stamps, and which records are kept; ROS sends some twice and some late."""
    times = _stamps(r, kind, notes)
    keep = usable_records(times, bad, stream=kind, where=f"{where}, {kind}", drops=counter, limit=0.5)
    return times[keep], keep


def _clouds(
    r: _Rows,
    spool: tuple[_Spool, _Spool | None],
    place: Array,
    counter: DropCounter,
    notes: list[str],
    where: str,
) -> PointClouds:
    counts = np.array(r.values, dtype=np.int64)
    if not counts.any():
        raise DataError("all clouds are empty", where=where, got=dict(counter.counts), wanted="points")
    times, keep = _kept(r, "clouds", {"no point in it": counts == 0}, counter, notes, where)
    bounds = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    source = SpooledClouds(bounds, spool[0].map(), None if spool[1] is None else spool[1].map())
    notes.append("points have times" if spool[1] is not None else "points have no times")
    return PointClouds(times=times, source=source, index=np.flatnonzero(keep), T_base_sensor=place)


def _laser(
    r: _Rows, place: Array, max_range: float | None, counter: DropCounter, notes: list[str], where: str
) -> LaserScans:
    up = float(se3.quat_rotate(place[3:], np.array([0.0, 0, 1]))[2])
    if abs(up) < 0.9:
        notes.append("the laser does not scan level: its tilt is left out")
    known: dict[tuple[float, float, int], Array] = {}
    scans, odd, reach = [], np.zeros(len(r.values), np.bool_), []
    for k, (ranges, start, step, low, high) in enumerate(r.values):
        n = len(ranges)
        if n < 2 or not np.all(finite_mask([start, step])) or not 0 < abs(step) * (n - 1) <= 2.2 * np.pi:
            odd[k] = True
            scans.append((np.zeros(2, np.float32), np.array([0.0, 1.0])))
            continue
        if up < 0:  # hung upside down: what turns left for it turns right for the robot
            start, step = -start, -step
        beams = known.setdefault((start, step, n), np.sort(start + step * np.arange(n)))
        values = np.where(np.isfinite(ranges) & (ranges >= max(low, 0.0)) & (ranges > 0), ranges, np.nan)
        values[np.isposinf(ranges)] = np.inf
        scans.append((values[::-1] if step < 0 else values, beams))
        reach.append(high)
    times, keep = _kept(r, "laser", {"angles are impossible, or fewer than 2 beams": odd}, counter, notes, where)
    rows, beams, moved = unify_layout([s for s, good in zip(scans, keep) if good])
    counter.drop("laser", f"scan of other beams mapped to the usual {len(beams)} (kept)", moved)
    stated = [v for v in reach if np.isfinite(v) and v > 0]
    far = max_range or (float(np.median(stated)) if stated else 80.0)
    yaw = 2.0 * np.arctan2(place[5], place[6])
    if up < 0:
        ahead = se3.quat_rotate(place[3:], np.array([1.0, 0, 0]))
        yaw = np.arctan2(ahead[1], ahead[0])
    mounting = np.array([place[0], place[1], np.arctan2(np.sin(yaw), np.cos(yaw))])
    return LaserScans(times=times, ranges=rows, bearings=beams, max_range=far, T_base_sensor=mounting)


def _odometry(
    r: _Rows,
    planar: bool,
    floor: tuple[float, float],
    per_metre: tuple[float, float],
    per_radian: float,
    counter: DropCounter,
    notes: list[str],
    where: str,
) -> Odometry:
    a = np.array(r.values)
    norm = np.linalg.norm(np.where(finite_mask(a[:, 3:]), a[:, 3:], 0.0), axis=1)
    bad = {
        "pose is not finite": np.asarray(~finite_mask(a).all(axis=1)),
        "rotation is no unit quaternion": np.abs(norm - 1.0) > 0.05,
    }
    times, keep = _kept(r, "odometry", bad, counter, notes, where)
    a = a[keep]
    poses = np.column_stack([a[:, :3], se3.quat_normalize(a[:, 3:])])
    if planar:
        R = se3.quat_to_matrix(poses[:, 3:])
        flat = np.column_stack([poses[:, :2], np.arctan2(R[:, 1, 0], R[:, 0, 0])])
        motion = np.zeros((len(flat), 3))
        motion[1:] = se2_between(flat[:-1], flat[1:])
        driven, turned = np.linalg.norm(motion[:, :2], axis=1), np.abs(motion[:, 2])
        P = np.zeros((len(flat), 3, 3))
        P[:, 0, 0] = P[:, 1, 1] = floor[0] ** 2 + (per_metre[0] * driven) ** 2
        P[:, 2, 2] = floor[1] ** 2 + (per_metre[1] * driven) ** 2 + (per_radian * turned) ** 2
        return Odometry(times=times, increments=motion, covariances=P)
    motion = np.tile([0.0, 0, 0, 0, 0, 0, 1], (len(poses), 1))
    motion[1:] = se3.se3_between(poses[:-1], poses[1:])
    driven = np.linalg.norm(motion[:, :3], axis=1)
    turned = np.linalg.norm(se3.so3_log(motion[:, 3:]), axis=1)
    variance = np.empty((len(poses), 6))
    variance[:, :3] = (floor[1] ** 2 + (per_metre[1] * driven) ** 2 + (per_radian * turned) ** 2)[:, None]
    variance[:, 3:] = (floor[0] ** 2 + (per_metre[0] * driven) ** 2)[:, None]
    return Odometry(times=times, increments=motion, covariances=variance[:, :, None] * np.eye(6))


def _imu(r: _Rows, place: Array | None, unit: str, counter: DropCounter, notes: list[str], where: str) -> Imu:
    a = np.array(r.values)
    times, keep = _kept(
        r, "imu", {"reading is not finite": np.asarray(~finite_mask(a).all(axis=1))}, counter, notes, where
    )
    force = a[keep, 3:] * (GRAVITY if unit == "g" else 1.0)
    T = np.array([0.0, 0, 0, 0, 0, 0, 1]) if place is None else place
    return Imu(times=times, angular_rate=a[keep, :3], specific_force=force, noise=IMU_NOISE, T_base_imu=T)


def _gps(r: _Rows, planar: bool, place: Array | None, counter: DropCounter, notes: list[str], where: str) -> Gps | None:
    g = np.array([v[0] for v in r.values])
    status = np.array([v[2] for v in r.values])
    place_ok = finite_mask(g[:, :2]).all(axis=1) & (np.abs(g[:, 0]) <= 90) & (np.abs(g[:, 1]) <= 360)
    bad = {
        "no fix (status)": status < 0,
        "no place on Earth": ~np.asarray(place_ok),
        "latitude and longitude are 0": (g[:, :2] == 0.0).all(axis=1),
    }
    wrong = np.logical_or.reduce(list(bad.values()))
    if wrong.all():
        for reason, mask in bad.items():
            counter.drop("gps", reason, int(mask.sum()))
        notes.append(f"gps left out: none of {len(g)} messages is a fix")
        return None
    times = _stamps(r, "gps", notes)
    good = np.flatnonzero(~wrong)
    for reason, mask in bad.items():
        counter.drop("gps", reason, int(mask.sum()))
    inner = usable_records(times[good], {}, stream="gps", where=f"{where}, gps", drops=counter, limit=0.5)
    keep = good[inner]
    flat = planar or not np.all(finite_mask(g[keep, 2]))
    heights = np.where(finite_mask(g[keep, 2]), g[keep, 2], 0.0)
    llh = np.column_stack([g[keep, :2], heights])
    plane = TangentPlane(*llh[0].tolist())
    enu = plane.from_ecef(geodetic_to_ecef(llh))
    P = np.tile(FIX_SIGMA**2 * np.eye(3), (len(keep), 1, 1))
    unknown = 0
    for k, row in enumerate(keep):
        stated, kind = r.values[row][1], r.values[row][3]
        S = 0.5 * (stated + stated.T)
        if kind > 0 and np.all(finite_mask(S)) and np.linalg.eigvalsh(S)[0] > 1e-6:
            P[k] = S
        else:
            unknown += 1
    counter.drop("gps", f"fix without a usable covariance: σ {FIX_SIGMA:g} m assumed (kept)", unknown)
    c = 2 if flat else 3
    lever = np.zeros(3) if place is None else place[:3]
    sigma = np.sqrt(P[:, 0, 0])
    return Gps(times=times[keep], positions=enu[:, :c], sigma=sigma, lever=lever[:c], covariances=P[:, :c, :c])
