"""Small bags, written by packages that are not ours: ROS 1 and ROS 2 by ``rosbags``, MCAP by ``mcap``."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ROS2, ROS1 = get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS1_NOETIC)
LIVOX = "livox_ros_driver2/msg/CustomMsg"
_POINT = "livox_ros_driver2/msg/CustomPoint"
_DEFINITION = (
    "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
    "livox_ros_driver2/CustomPoint[] points\n"
)
_OF_POINT = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n"
for store in (ROS1, ROS2):
    store.register({**get_types_from_msg(_DEFINITION, LIVOX), **get_types_from_msg(_OF_POINT, _POINT)})
ROS1.register({"tf2_msgs/msg/TFMessage": ROS2.fielddefs["tf2_msgs/msg/TFMessage"]})

Message = tuple[str, str, float, Any]
"""Topic, type, stamp in the bag [s], message."""


class Messages:
    """Messages of one typestore."""

    def __init__(self, ros1: bool = False) -> None:
        self.store, self.ros1 = (ROS1 if ros1 else ROS2), ros1

    def make(self, kind: str, **fields: Any) -> Any:
        return self.store.types[kind](**fields)

    def header(self, t: float, frame: str) -> Any:
        sec = int(np.floor(t))
        stamp = self.make("builtin_interfaces/msg/Time", sec=sec, nanosec=round(1e9 * (t - sec)))
        extra = {"seq": 0} if self.ros1 else {}
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **extra)

    def cloud(
        self,
        t: float,
        points: np.ndarray,
        *,
        frame: str = "lidar",
        times: np.ndarray | None = None,
        field: str = "t",
        kind: str = "<f4",
        height: int = 1,
        padding: int = 0,
    ) -> Any:
        """``PointCloud2`` with an intensity of uint16 between the coordinates and the times."""
        names = [("x", kind), ("y", kind), ("z", kind), ("intensity", kind[0] + "u2"), ("pad", "V2")]
        if times is not None:
            names.append((field, kind[0] + times.dtype.str[1:]))
        dtype = np.dtype(names)
        a = np.zeros(len(points), dtype)
        for c, v in zip("xyz", points.T):
            a[c] = v
        if times is not None:
            a[field] = times
        codes = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
        fields = [
            self.make("sensor_msgs/msg/PointField", name=n, offset=dtype.fields[n][1], datatype=codes[d[1:]], count=1)
            for n, d in names
            if n != "pad"
        ]
        width = len(points) // height
        rows = np.frombuffer(a.tobytes(), np.uint8).reshape(height, width * dtype.itemsize)
        data = np.pad(rows, ((0, 0), (0, padding))).reshape(-1)
        return self.make(
            "sensor_msgs/msg/PointCloud2",
            header=self.header(t, frame),
            height=height,
            width=width,
            fields=fields,
            is_bigendian=kind[0] == ">",
            point_step=dtype.itemsize,
            row_step=width * dtype.itemsize + padding,
            data=data,
            is_dense=False,
        )

    def livox(self, t: float, points: np.ndarray, offsets: np.ndarray, frame: str = "livox") -> Any:
        made = [
            self.make(_POINT, offset_time=int(o), x=p[0], y=p[1], z=p[2], reflectivity=3, tag=0, line=1)
            for p, o in zip(points.astype(float).tolist(), offsets)
        ]
        return self.make(
            LIVOX,
            header=self.header(t, frame),
            timebase=int(1e9 * t),
            point_num=len(made),
            lidar_id=0,
            rsvd=np.zeros(3, np.uint8),
            points=made,
        )

    def scan(self, t: float, ranges: np.ndarray, start: float, step: float, frame: str = "laser") -> Any:
        return self.make(
            "sensor_msgs/msg/LaserScan",
            header=self.header(t, frame),
            angle_min=start,
            angle_max=start + step * (len(ranges) - 1),
            angle_increment=step,
            time_increment=0.0,
            scan_time=0.1,
            range_min=0.05,
            range_max=30.0,
            ranges=ranges.astype(np.float32),
            intensities=np.zeros(0, np.float32),
        )

    def _vector(self, v: Iterable[float], kind: str = "Vector3") -> Any:
        return self.make(f"geometry_msgs/msg/{kind}", **dict(zip("xyz", map(float, v))))

    def _turn(self, q: Iterable[float]) -> Any:
        return self.make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, q))))

    def odometry(self, t: float, pose: np.ndarray, child: str = "base_link") -> Any:
        """``pose``: x, y, z, qx, qy, qz, qw."""
        kind = "geometry_msgs/msg/"
        inner = self.make(f"{kind}Pose", position=self._vector(pose[:3], "Point"), orientation=self._turn(pose[3:]))
        still = self.make(f"{kind}Twist", linear=self._vector([0, 0, 0]), angular=self._vector([0, 0, 0]))
        return self.make(
            "nav_msgs/msg/Odometry",
            header=self.header(t, "odom"),
            child_frame_id=child,
            pose=self.make(f"{kind}PoseWithCovariance", pose=inner, covariance=np.zeros(36)),
            twist=self.make(f"{kind}TwistWithCovariance", twist=still, covariance=np.zeros(36)),
        )

    def imu(self, t: float, rate: Iterable[float], force: Iterable[float], frame: str = "imu") -> Any:
        none = np.zeros(9)
        return self.make(
            "sensor_msgs/msg/Imu",
            header=self.header(t, frame),
            orientation=self._turn([0, 0, 0, 1]),
            orientation_covariance=none,
            angular_velocity=self._vector(rate),
            angular_velocity_covariance=none,
            linear_acceleration=self._vector(force),
            linear_acceleration_covariance=none,
        )

    def fix(self, t: float, place: Iterable[float], *, status: int = 0, variance: float = 4.0, kind: int = 2) -> Any:
        lat, lon, height = place
        return self.make(
            "sensor_msgs/msg/NavSatFix",
            header=self.header(t, "gps"),
            status=self.make("sensor_msgs/msg/NavSatStatus", status=status, service=1),
            latitude=lat,
            longitude=lon,
            altitude=height,
            position_covariance=(variance * np.eye(3)).reshape(-1),
            position_covariance_type=kind,
        )

    def transforms(self, t: float, pairs: Iterable[tuple[str, str, np.ndarray]]) -> Any:
        made = [
            self.make(
                "geometry_msgs/msg/TransformStamped",
                header=self.header(t, a),
                child_frame_id=b,
                transform=self.make(
                    "geometry_msgs/msg/Transform", translation=self._vector(T[:3]), rotation=self._turn(T[3:])
                ),
            )
            for a, b, T in pairs
        ]
        return self.make("tf2_msgs/msg/TFMessage", transforms=made)

    def text(self, words: str) -> Any:
        return self.make("std_msgs/msg/String", data=words)


def write_ros2(path: Path, messages: list[Message], *, mcap: bool = False, compress: str = "") -> Path:
    """A folder with metadata.yaml, by rosbags."""
    plugin = StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
    writer = Writer2(path, version=9, storage_plugin=plugin)
    if compress:
        writer.set_compression(CompressionMode[compress], CompressionFormat.ZSTD)
    with writer:
        made: dict[str, Any] = {}
        for topic, kind, t, m in messages:
            if topic not in made:
                made[topic] = writer.add_connection(topic, kind, typestore=ROS2)
            writer.write(made[topic], int(1e9 * t), ROS2.serialize_cdr(m, kind))
    return path


def write_ros1(path: Path, messages: list[Message], *, compress: str = "") -> Path:
    """A .bag file, by rosbags."""
    writer = Writer1(path)
    if compress:
        writer.set_compression(Writer1.CompressionFormat[compress])
    with writer:
        made: dict[str, Any] = {}
        for topic, kind, t, m in messages:
            if topic not in made:
                made[topic] = writer.add_connection(topic, kind, typestore=ROS1)
            writer.write(made[topic], int(1e9 * t), ROS1.serialize_ros1(m, kind))
    return path


def write_mcap(path: Path, messages: list[Message], *, other: bool = False) -> Path:
    """A single file, by mcap; ``other``: with a channel of JSON in it."""
    from mcap.writer import Writer

    with open(path, "wb") as stream:
        writer = Writer(stream, chunk_size=4096)
        writer.start(profile="ros2", library="test")
        made: dict[str, int] = {}
        for topic, kind, t, m in messages:
            if topic not in made:
                text, _ = ROS2.generate_msgdef(kind, ros_version=2)
                schema = writer.register_schema(name=kind, encoding="ros2msg", data=text.encode())
                made[topic] = writer.register_channel(topic=topic, message_encoding="cdr", schema_id=schema)
            ns = int(1e9 * t)
            writer.add_message(made[topic], log_time=ns, publish_time=ns, data=bytes(ROS2.serialize_cdr(m, kind)))
        if other:
            schema = writer.register_schema(name="Thing", encoding="jsonschema", data=b"{}")
            channel = writer.register_channel(topic="/json", message_encoding="json", schema_id=schema)
            writer.add_message(channel, log_time=5, publish_time=5, data=b"{}")
        writer.finish()
    return path
