"""Writer of ROS 2 bags and of MCAP files, by the packages ``rosbags`` and ``mcap``, without ROS."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from graphslam.core.atomic import atomic_open
from graphslam.core.extras import import_extra
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array
from graphslam.core.output_folder import output_folder
from graphslam.core.se3 import matrix_to_quat, quat_to_matrix
from graphslam.io.tum import embed_plane

BagForm = Literal["mcap", "ros2"]
KIND = "bag"
"""See :func:`~graphslam.core.output_folder.check_folder_target`."""
_FLAT = 0.02
"""Height of the ellipses of a planar map [m]."""


@dataclass(frozen=True, slots=True)
class BagRecord:
    """One message.

    Parameters
    ----------
    topic : str
    message : Any
        Of :class:`MessageFactory`.
    time : int
        Log time [ns].
    latched : bool
        A late subscriber gets the last message of the topic, too (durability *transient local*).
    """

    topic: str
    message: Any
    time: int
    latched: bool = False


class MessageFactory:
    """Makes messages of ROS 2 (Humble) with the types of ``rosbags``."""

    def __init__(self) -> None:
        import_extra("rosbags", "a bag")
        from rosbags.typesys import Stores, get_typestore

        self.store = get_typestore(Stores.ROS2_HUMBLE)

    def make(self, kind: str, **fields: Any) -> Any:
        """A message of a type such as ``geometry_msgs/Point``."""
        return self.store.types[kind.replace("/", "/msg/")](**fields)

    def header(self, time: int, frame: str) -> Any:
        """Header with a stamp [ns]."""
        return self.make("std_msgs/Header", stamp=self.duration(time, "Time"), frame_id=frame)

    def duration(self, time: int, kind: str = "Duration") -> Any:
        """Seconds and nanoseconds of a time [ns]."""
        return self.make(f"builtin_interfaces/{kind}", sec=time // 10**9, nanosec=time % 10**9)

    def vector(self, xyz: Array, kind: str = "Vector3") -> Any:
        """``geometry_msgs/Vector3`` or ``Point``."""
        x, y, z = (float(v) for v in xyz)
        return self.make(f"geometry_msgs/{kind}", x=x, y=y, z=z)

    def quaternion(self, q: Array) -> Any:
        """Of ``(4,)`` x y z w."""
        x, y, z, w = (float(v) for v in q)
        return self.make("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w)

    def pose(self, T: Array) -> Any:
        """Of ``(7,)``."""
        return self.make("geometry_msgs/Pose", position=self.vector(T[:3], "Point"), orientation=self.quaternion(T[3:]))

    def transforms(self, time: int, frame: str, child: str, T_frame_child: Array) -> Any:
        """``tf2_msgs/TFMessage`` with one transform ``(7,)``."""
        turn = self.quaternion(T_frame_child[3:])
        T = self.make("geometry_msgs/Transform", translation=self.vector(T_frame_child[:3]), rotation=turn)
        head = self.header(time, frame)
        one = self.make("geometry_msgs/TransformStamped", header=head, child_frame_id=child, transform=T)
        return self.make("tf2_msgs/TFMessage", transforms=[one])

    def cloud(self, time: int, frame: str, points: Array) -> Any:
        """``sensor_msgs/PointCloud2`` of ``(n, 3)`` [m], float32."""
        rows, n = np.ascontiguousarray(points, dtype="<f4"), len(points)
        fields = [
            self.make("sensor_msgs/PointField", name=c, offset=4 * k, datatype=7, count=1) for k, c in enumerate("xyz")
        ]
        return self.make(
            "sensor_msgs/PointCloud2", header=self.header(time, frame), height=1, width=n, fields=fields,
            is_bigendian=False, point_step=12, row_step=12 * n, data=rows.view(np.uint8).reshape(-1), is_dense=True,
        )  # fmt: skip

    def occupancy(self, time: int, frame: str, cells: Array, origin: Array, resolution: float) -> Any:
        """``nav_msgs/OccupancyGrid`` of ``(height, width)`` int8: 0 free, 100 occupied, -1 unknown.

        Parameters
        ----------
        origin : (7,)
            Pose of the lower left corner.
        """
        info = self.make(
            "nav_msgs/MapMetaData", map_load_time=self.duration(time, "Time"), resolution=resolution,
            width=cells.shape[1], height=cells.shape[0], origin=self.pose(origin),
        )  # fmt: skip
        data = np.ascontiguousarray(cells, dtype=np.int8).reshape(-1)
        return self.make("nav_msgs/OccupancyGrid", header=self.header(time, frame), info=info, data=data)

    def marker(
        self, head: Any, name: str, number: int, kind: int, pose: Array, scale: Sequence[float], **more: Any
    ) -> Any:
        """``visualization_msgs/Marker`` that stays.

        Parameters
        ----------
        kind : int
            2 sphere, 3 cylinder, 5 list of lines, 7 list of spheres.
        **more
            ``points``: ``(n, 3)``; ``colour``: red, green, blue, alpha.
        """
        r, g, b, a = more.get("colour", (0.0, 0.0, 0.0, 1.0))
        nothing = np.zeros(0, dtype=np.uint8)
        texture = self.make("sensor_msgs/CompressedImage", header=head, format="", data=nothing)
        mesh = self.make("visualization_msgs/MeshFile", filename="", data=nothing)
        points = [self.vector(p, "Point") for p in more.get("points", ())]
        return self.make(
            "visualization_msgs/Marker", header=head, ns=name, id=number, type=kind, action=0, pose=self.pose(pose),
            scale=self.vector(np.asarray(scale)), color=self.make("std_msgs/ColorRGBA", r=r, g=g, b=b, a=a),
            lifetime=self.duration(0), frame_locked=False, points=points, colors=[], texture_resource="",
            texture=texture, uv_coordinates=[], text="", mesh_resource="", mesh_file=mesh,
            mesh_use_embedded_materials=False,
        )  # fmt: skip


def write_bag(
    path: str | os.PathLike[str], records: Iterable[BagRecord], form: BagForm, factory: MessageFactory
) -> None:
    """Write messages beside ``path`` and swap the whole: an MCAP file, or a bag folder of ROS 2 (SQLite).

    Raises
    ------
    OutputError
        There is no place for the output.
    """
    target, rows = Path(path), sorted(records, key=lambda r: r.time)
    if form == "mcap":
        _write_mcap(target, rows, factory)
        return
    with output_folder(target, KIND, last=("metadata.yaml",)) as staged:
        made = staged / target.name  # the file in a bag has the name of its folder
        _write_ros2(made, rows, factory)
        for part in made.iterdir():
            part.rename(staged / part.name)
        made.rmdir()


def _write_mcap(target: Path, records: Sequence[BagRecord], factory: MessageFactory) -> None:
    writer_module = import_extra("mcap.writer", "an MCAP file")
    with atomic_open(target) as stream:
        writer = writer_module.Writer(stream)
        writer.start(profile="ros2", library="graphslam")

        def channel(topic: str, kind: str, latched: bool) -> int:
            text, _ = factory.store.generate_msgdef(kind, ros_version=2)
            schema = writer.register_schema(name=kind, encoding="ros2msg", data=text.encode())
            return int(writer.register_channel(topic=topic, message_encoding="cdr", schema_id=schema))

        for to, r, data in _serialised(records, factory, channel):
            writer.add_message(to, log_time=r.time, publish_time=r.time, data=data)
        writer.finish()


def _write_ros2(folder: Path, records: Sequence[BagRecord], factory: MessageFactory) -> None:
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
    from rosbags.rosbag2 import Writer

    ever = QosTime(2147483647, 4294967295)
    kept = Qos(
        QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, ever, ever,
        QosLiveliness.AUTOMATIC, ever, False,
    )  # fmt: skip
    with Writer(folder, version=9) as writer:

        def channel(topic: str, kind: str, latched: bool) -> Any:
            profiles = [kept] if latched else []
            return writer.add_connection(topic, kind, typestore=factory.store, offered_qos_profiles=profiles)

        for to, r, data in _serialised(records, factory, channel):
            writer.write(to, r.time, data)


def _serialised(
    records: Sequence[BagRecord], factory: MessageFactory, channel: Callable[[str, str, bool], Any]
) -> Iterable[tuple[Any, BagRecord, bytes]]:
    channels: dict[str, Any] = {}
    for r in records:
        kind = r.message.__msgtype__
        if r.topic not in channels:
            channels[r.topic] = channel(r.topic, kind, r.latched)
        yield channels[r.topic], r, bytes(factory.store.serialize_cdr(r.message, kind))


def ros_covariances(poses: Array, covariances: Array) -> Array:
    """Covariances ``(n, 6, 6)`` of ROS: x, y, z and rotations about x, y, z, all along the axes of the map.

    Parameters
    ----------
    poses : (n, 3) or (n, 7)
    covariances : (n, 3, 3) or (n, 6, 6)
        Right tangents.
    """
    n, plane = len(poses), poses.shape[1] == 3
    rows = [0, 1, 5] if plane else [3, 4, 5, 0, 1, 2]  # right tangent → x, y, z, rotations
    own = np.zeros((n, 6, 6))
    own[np.ix_(range(n), rows, rows)] = covariances
    R = quat_to_matrix(embed_plane(poses)[:, 3:] if plane else poses[:, 3:])
    turn = np.zeros((n, 6, 6))
    turn[:, :3, :3] = turn[:, 3:, 3:] = R
    return np.asarray(turn @ own @ np.swapaxes(turn, 1, 2))


def ellipsoid(centre: Array, covariance: Array, confidence: float) -> tuple[Array, Array]:
    """Pose ``(7,)`` and diameters ``(3,)`` [m] of the ellipse or the ellipsoid of a point; flat in the plane."""
    d = len(centre)
    values, axes = np.linalg.eigh(covariance)
    turn = np.eye(3)
    turn[:d, :d] = axes
    turn[:, 0] *= np.sign(np.linalg.det(turn))  # a rotation, not a reflection
    size = 2.0 * np.sqrt(chi2_quantile(confidence, d) * np.maximum(values, 0.0))
    at = np.concatenate([centre, np.zeros(3 - d)])
    return np.concatenate([at, matrix_to_quat(turn)]), np.concatenate([size, [_FLAT] * (3 - d)])
