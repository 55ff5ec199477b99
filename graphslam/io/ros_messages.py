"""Conversion of ROS sensor messages to arrays; :class:`ValueError` if the size of the data is wrong.

Messages are decoded by ``rosbags``, except for Livox clouds, which are decoded from bytes for speed: a message contains
20,000 records.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphslam.core.geometry import Array
from graphslam.io.cloud_files import CloudData, clean_cloud, columns_cloud

LIVOX = ("livox_ros_driver/msg/CustomMsg", "livox_ros_driver2/msg/CustomMsg")
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def stamp_of(message: Any) -> float:
    """Stamp of a header [s]; 0 if the driver did not set it."""
    t = message.header.stamp
    return float(t.sec) + 1e-9 * float(t.nanosec)


def pose_of_message(pose: Any) -> list[float]:
    """``x y z qx qy qz qw`` of a pose, or of a transform."""
    p = getattr(pose, "position", None) or pose.translation
    q = getattr(pose, "orientation", None) or pose.rotation
    return [float(v) for v in (p.x, p.y, p.z, q.x, q.y, q.z, q.w)]


def point_cloud(m: Any) -> CloudData:
    """Points of ``sensor_msgs/PointCloud2``, in the units of the message."""
    order = ">" if m.is_bigendian else "<"
    step, width, height = int(m.point_step), int(m.width), int(m.height)
    n = width * height
    if n == 0:
        return clean_cloud(np.zeros((0, 3)))
    data = np.ascontiguousarray(m.data, dtype=np.uint8)
    row = int(m.row_step) or width * step
    if step <= 0 or row < width * step or len(data) < (height - 1) * row + width * step:
        raise ValueError(f"{len(data)} bytes for {n} points of {step}")
    names, formats, offsets = [], [], []
    for f in m.fields:
        kind = _TYPES.get(int(f.datatype))
        if kind is None or int(f.count) > 1 or f.name in names:
            continue
        if int(f.offset) + np.dtype(kind).itemsize > step:
            raise ValueError(f"field {f.name} is outside the point")
        names.append(str(f.name))
        formats.append(order + kind)
        offsets.append(int(f.offset))
    if row != width * step:  # rows end with padding
        padded = np.zeros(height * row, np.uint8)
        padded[: min(len(data), height * row)] = data[: height * row]
        data = np.ascontiguousarray(padded.reshape(height, row)[:, : width * step]).reshape(-1)
    dtype = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})
    a = np.frombuffer(data[: n * step].tobytes(), dtype, count=n)
    return columns_cloud({c: a[c] for c in names}, "message")


@dataclass(frozen=True, slots=True)
class LivoxCloud:
    """A ``CustomMsg``: stamp of its header [s], frame, and points with their field ``offset_time`` [ns]."""

    stamp: float
    frame: str
    cloud: CloudData


def livox_cloud(raw: bytes, *, ros2: bool) -> LivoxCloud:
    """Points of ``livox_ros_driver/CustomMsg`` from its bytes."""
    try:
        if ros2:
            if raw[1] != 1:
                raise ValueError("a message in big-endian order")
            body = raw[4:]
            sec, nanosec, length = struct.unpack_from("<iII", body, 0)
            at = 12 + length
            frame = body[12 : at - 1].decode("utf-8", "replace")
            at = -(-at // 8) * 8
            at += 8 + 4 + 4  # timebase, number of points, number and reserve of the lidar
            (n,) = struct.unpack_from("<I", body, at)
            at, step = at + 4, 20
        else:
            body = raw
            _, sec, nanosec, length = struct.unpack_from("<IIII", body, 0)
            at = 16 + length
            frame = body[16:at].decode("utf-8", "replace")
            at += 8 + 4 + 4
            (n,) = struct.unpack_from("<I", body, at)
            at, step = at + 4, 19
    except (struct.error, IndexError) as error:
        raise ValueError(f"message is truncated ({error})") from None
    data = body[at:].ljust(len(body) - at + step, b"\0")  # the last point has no padding
    if n * step > len(data) or (n and (n - 1) * step + 19 > len(body) - at):
        raise ValueError(f"{len(body) - at} bytes for {n} points")
    names = ["offset_time", "x", "y", "z"]
    dtype = np.dtype(
        {"names": names, "formats": ["<u4", "<f4", "<f4", "<f4"], "offsets": [0, 4, 8, 12], "itemsize": step}
    )
    a = np.frombuffer(data, dtype, count=n)
    xyz: Array = np.column_stack([a["x"], a["y"], a["z"]]).astype(np.float64)
    return LivoxCloud(sec + 1e-9 * nanosec, frame, clean_cloud(xyz, a["offset_time"].astype(np.float64), "offset_time"))
