"""Small logs after public bug reports of other programs: ``python -m tests.faults.strangers [--full] [NAME …]``.

Every stranger is right, or its fault is named: in the refusal, or in a line of ``graphslam data check``. A log that is
wrong without a word is a fault of ours. What is right is measured without a map: the returns of all scans, brought to
the room by the odometry of the log, must lie on the walls of the room. ``--full`` prints all
that ``data check`` says.
"""

from __future__ import annotations

import argparse
import re
import struct
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from graphslam.app.data_check import check_source
from graphslam.core import se3
from graphslam.core.errors import GraphSlamError
from graphslam.core.log import SensorLog
from graphslam.core.point_clouds import PointClouds
from graphslam.core.records import LaserScans, Odometry
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.stream_checks import check_streams
from graphslam.evaluate.trajectory_error import ate
from graphslam.io.catalog import load_recording
from graphslam.io.network_file import read_network
from graphslam.io.tum import embed_plane, read_tum
from graphslam_frontends.odometry.recorded import chain_odometry
from tests.io import small_sources as small
from tests.io.bag_worlds import Messages, write_ros1, write_ros2

Array = np.ndarray
T0 = 1_700_000_000.0
ROOM = np.array([6.0, 4.0, 1.5])
"""Half the size of the room [m]."""
MOUNT = np.array([0.2, 0.0, 0.3, 0.0, 0.0, 0.0, 1.0])
"""``T_base_scanner``."""
REAR = np.array([-0.3, 0.1, 0.2, 0.0, 0.0, 1.0, 0.0])
AT_BASE = np.array([0.0, 0, 0, 0, 0, 0, 1])
SCAN, CLOUD = "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/PointCloud2"


# ---- the robot in its room -------------------------------------------------------------------------------------------


def pose(t: Any) -> Array:
    """``T_room_base`` ``(n, 7)`` at times after the begin [s]: a bow to the left at 2 m/s."""
    t = np.atleast_1d(np.asarray(t, float))
    x, y = 4.0 * np.sin(0.5 * t) - 3.0, 4.0 * (1.0 - np.cos(0.5 * t)) - 1.0
    z = np.zeros(len(t))
    return np.column_stack([x, y, z, z, z, np.sin(0.25 * t), np.cos(0.25 * t)])


def rays(t: Array, directions: Array, mount: Array = MOUNT) -> Array:
    """Ranges ``(n,)`` to the walls from the scanner at times ``t`` along directions ``(n, 3)`` in its frame."""
    T = se3.se3_compose(pose(t), np.tile(mount, (len(t), 1)))
    d = se3.quat_rotate(T[:, 3:], directions)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.min(np.where(d == 0.0, np.inf, (np.sign(d) * ROOM - T[:, :3]) / d), axis=1)


def cloud(t: float, n: int = 300, lasts: float = 0.1, mount: Array = MOUNT) -> tuple[Array, Array]:
    """Points ``(n, 3)`` of one revolution that begins at ``t``, each seen at its own time, and times after ``t``."""
    after = lasts * np.arange(n) / n
    azimuth, up = 2 * np.pi * np.arange(n) / n, np.deg2rad(np.tile(np.linspace(-15, 15, 10), n // 10))
    d = np.column_stack([np.cos(up) * np.cos(azimuth), np.cos(up) * np.sin(azimuth), np.sin(up)])
    return d * rays(t + after, d, mount)[:, None], after


def scan(t: float, beams: Array, mount: Array = MOUNT) -> Array:
    """Ranges ``(n,)`` of a planar laser."""
    d = np.column_stack([np.cos(beams), np.sin(beams), np.zeros(len(beams))])
    return rays(np.full(len(beams), t), d, mount)


def off_the_walls(log: SensorLog) -> float:
    """Distance of the returns from the walls, 90 % of them [m], where the odometry of the log brings them."""
    name = log.of_type(Odometry)
    assert name is not None
    odometry = log[name]
    path = chain_odometry(odometry)
    begin = float(odometry.times[0]) - log.meta.get("begin", T0)
    T = path.poses if path.dim == 3 else embed_plane(path.poses)
    T = se3.se3_compose(np.tile(pose(begin), (len(T), 1)), T)
    inside = Trajectory(odometry.times, T)
    found = []
    for s in log.streams.values():
        if not isinstance(s, LaserScans | PointClouds):
            continue
        for k, t in enumerate(s.times.tolist()):
            if isinstance(s, LaserScans):
                r, base = s.ranges[k].astype(float), embed_plane(s.T_base_sensor[None])[0]
                xyz = (r[:, None] * np.column_stack([np.cos(s.bearings), np.sin(s.bearings), 0 * r]))[np.isfinite(r)]
                ages = np.zeros(len(xyz))
            else:
                xyz, base = s.cloud(k), s.T_base_sensor
                ages = np.zeros(len(xyz)) if (a := s.ages(k)) is None else a
            at = np.clip(t - ages, odometry.times[0], odometry.times[-1])
            P = se3.se3_compose(inside.interpolate(at), np.tile(base, (len(xyz), 1)))
            world = se3.quat_rotate(P[:, 3:], xyz) + P[:, :3]
            axes = slice(0, 2 if isinstance(s, LaserScans) else 3)
            found.append(np.min(np.abs(ROOM[axes] - np.abs(world[:, axes])), axis=1))
    off = np.concatenate(found)
    return float(np.quantile(off, 0.9)) if len(off) else np.inf


# ---- bags ------------------------------------------------------------------------------------------------------------

Rows = list[tuple[str, str, float, Any]]


def bag(
    scanner: Callable[[Messages, float], tuple[str, str, Any]] | None = None,
    *,
    ros1: bool = False,
    n: int = 24,
    change: Callable[[Messages, Rows], Rows] = lambda m, rows: rows,
    static: Array = MOUNT,
    **how: Any,
) -> Callable[[Path], Path]:
    """A bag of odometry and a scanner: ``scanner(messages, t)`` gives topic, type and message."""

    def make(root: Path) -> Path:
        m = Messages(ros1=ros1)
        pairs = [("base_link", f, static) for f in ("laser", "lidar", "imu")] + [("base_link", "rear", REAR)]
        rows: Rows = [("/tf_static", "tf2_msgs/msg/TFMessage", T0 - 0.05, m.transforms(T0, pairs))]
        for t in (0.05 * np.arange(-2, 2 * n + 3)).tolist():
            rows.append(("/odom", "nav_msgs/msg/Odometry", T0 + t, m.odometry(T0 + t, pose(t)[0])))
        for t in (0.1 * np.arange(n)).tolist():
            topic, kind, message = (scanner or laser())(m, t)
            rows.append((topic, kind, T0 + t + 0.004, message))
        rows = sorted(change(m, rows), key=lambda row: row[2])
        return write_ros1(root / "a.bag", rows) if ros1 else write_ros2(root / "a", rows, **how)

    return make


BEAMS = np.deg2rad(np.arange(-120.0, 120.5, 1.0))


def laser(
    beams: Callable[[float], Array] = lambda t: BEAMS,
    stamp: Callable[[float], float] = lambda t: T0 + t,
    change: Callable[[Array], Array] = lambda r: r,
    angle: float = 1.0,
) -> Callable[[Messages, float], tuple[str, str, Any]]:
    def make(m: Messages, t: float) -> tuple[str, str, Any]:
        b = beams(t)
        message = m.scan(stamp(t), change(scan(t, b)), angle * float(b[0]), angle * float(b[1] - b[0]))
        return "/scan", SCAN, message

    return make


def two_lasers(m: Messages, t: float) -> tuple[str, str, Any]:
    """A laser ahead and one behind, by turns on one topic."""
    rear = round(10 * t) % 2 == 1
    r = scan(t, BEAMS, REAR if rear else MOUNT)
    return "/scan", SCAN, m.scan(T0 + t, r, float(BEAMS[0]), float(BEAMS[1] - BEAMS[0]), "rear" if rear else "laser")


def two_lidars(m: Messages, t: float) -> tuple[str, str, Any]:
    """The same with clouds."""
    rear = round(10 * t) % 3 == 1
    xyz, after = cloud(t, mount=REAR if rear else MOUNT)
    return "/points", CLOUD, m.cloud(T0 + t, xyz, times=after.astype(np.float32), frame="rear" if rear else "lidar")


def lidar(
    times: Callable[[float, Array], Array | None], field: str = "t", stamp: Callable[[float], float] = lambda t: T0 + t
) -> Callable[[Messages, float], tuple[str, str, Any]]:
    """``times(t, after)`` is the field of times of the points."""

    def make(m: Messages, t: float) -> tuple[str, str, Any]:
        xyz, after = cloud(t)
        return "/points", CLOUD, m.cloud(stamp(t), xyz, times=times(t, after), field=field)

    return make


def imu(scale: float = 1.0, stamp: Callable[[float], float] = lambda t: t) -> Callable[[Messages, Rows], Rows]:
    def more(m: Messages, rows: Rows) -> Rows:
        t = 0.01 * np.arange(-10, 250)
        return rows + [
            ("/imu", "sensor_msgs/msg/Imu", T0 + x, m.imu(T0 + stamp(x), [0, 0, 0.5], [0, scale, scale * 9.81]))
            for x in t.tolist()
        ]

    return more


def fixes(place: Callable[[Array], tuple[float, float, float]], n: int = 24) -> Callable[[Messages, Rows], Rows]:
    def more(m: Messages, rows: Rows) -> Rows:
        out = [
            ("/fix", "sensor_msgs/msg/NavSatFix", T0 + t, m.fix(T0 + t, place(pose(t)[0]), variance=1e-4))
            for t in (0.1 * np.arange(n)).tolist()
        ]
        return rows + out

    return more


def broken_turns(m: Messages, rows: Rows) -> Rows:
    """Odometry whose quaternions are all zero."""
    for _, kind, _, message in rows:
        if kind == "nav_msgs/msg/Odometry":
            message.pose.pose.orientation.w = message.pose.pose.orientation.z = 0.0
    return rows


def without_index(root: Path, rename: str = "", **how: Any) -> Path:
    folder = bag(**how)(root)
    (folder / "metadata.yaml").unlink()
    if rename:
        found = next(p for p in folder.iterdir())
        found.rename(folder / rename)
    return folder


def with_index(root: Path, old: str, new: str) -> Path:
    folder = bag()(root)
    index = folder / "metadata.yaml"
    text = index.read_text()
    assert old in text
    index.write_text(text.replace(old, new))
    return folder


# ---- folders of clouds -----------------------------------------------------------------------------------------------


def folder(
    write: Callable[[Path, Array, Array, float], None], name: str = "{:.6f}.pcd", n: int = 8
) -> Callable[[Path], Path]:
    """Clouds in files named by their stamps, with TUM poses; ``write(path, xyz, after, t)``."""

    def make(root: Path) -> Path:
        out = root / "scans"
        out.mkdir()
        t = 0.1 * np.arange(n)
        for x in t.tolist():
            write(out / name.format(T0 + x), *cloud(x, mount=AT_BASE), x)
        t = np.r_[t, t[-1] + 0.1]
        np.savetxt(out / "poses.txt", np.column_stack([T0 + t, pose(t)]), fmt="%.9f")
        return out

    return make


def padded_pcd(path: Path, xyz: Array, after: Array, t: float) -> None:
    """Fields with padding, as PCL writes structures, and a field of count 0."""
    dtype = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("_", "V4"), ("t", "<u4"), ("ring", "u1"), ("__", "V15")]
    a = np.zeros(len(xyz), dtype)
    for c, v in zip("xyz", xyz.T):
        a[c] = v
    a["t"] = 1e9 * after
    head = (
        "VERSION 0.7\nFIELDS x y z _ t ring _ _\nSIZE 4 4 4 1 4 1 1 1\nTYPE F F F U U U U U\nCOUNT 1 1 1 4 1 1 0 15\n"
        f"WIDTH {len(xyz)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(xyz)}\nDATA binary\n"
    )
    path.write_bytes(head.encode() + a.tobytes())


def pcd(path: Path, xyz: Array, form: str = "binary", viewpoint: str = "0 0 0 1 0 0 0") -> None:
    n = len(xyz)
    head = (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {n}\nHEIGHT 1\n"
        f"VIEWPOINT {viewpoint}\nPOINTS {n}\nDATA {form}\n"
    )
    plain = xyz.astype("<f4").T.tobytes() if "compressed" in form else xyz.astype("<f4").tobytes()
    size = struct.pack("<II", len(plain), len(plain)) if "compressed" in form else b""
    path.write_bytes(head.encode() + size + plain)


def ply(path: Path, xyz: Array, after: Array, kind: str = "double", cut: bool = False, lists: bool = False) -> None:
    n = len(xyz)
    names = "".join(f"property {kind} {c}\n" for c in "xyz") + f"property {kind} time\n"
    head = f"ply\nformat {{}} 1.0\nelement vertex {n}\n{names}{{}}end_header\n"
    rows = np.column_stack([xyz, after])
    if cut:
        lines = [" ".join(f"{v:.9g}" for v in r) for r in rows]
        lines[n // 2] = lines[n // 2].rpartition(" ")[0].rpartition(" ")[0]
        path.write_text(head.format("ascii", "") + "\n".join(lines) + "\n")
    elif lists:
        more = "property list uchar uint view_indices\n"
        body = b"".join(r.astype("<f8").tobytes() + b"\x02" + bytes(8) for r in rows)
        path.write_bytes(head.format("binary_little_endian", more).encode() + body)
    else:
        path.write_bytes(head.format("binary_big_endian", "").encode() + rows.astype(">f8").tobytes())


def las(path: Path, xyz: Array, after: Array, begin: float) -> None:
    import laspy

    header = laspy.LasHeader(point_format=1, version="1.2")
    header.scales = np.full(3, 1e-4)
    data = laspy.LasData(header)
    data.x, data.y, data.z = xyz.T
    data.gps_time = begin + after
    data.write(str(path))


def kitti_with_gaps(root: Path) -> Path:
    """KITTI raw in which two scans are missing: no file, and an empty line in their place."""
    small.kitti_raw(root / "drive")
    folder = root / "drive" / "velodyne_points"
    lines = (folder / "timestamps.txt").read_text().splitlines()
    for k in (5, 6):
        (folder / "data" / f"{k:010d}.bin").unlink()
        lines[k] = ""
    (folder / "timestamps.txt").write_text("\n".join(lines) + "\n")
    return root / "drive"


def off_the_stamps(source: Path) -> float:
    """Difference of the stamps of clouds from what they were without two of them [s]."""
    t = load_recording(source)["clouds"].times
    wanted = small.PERIOD * np.delete(np.arange(small.STEPS), [5, 6])
    return float(np.abs(t - t[0] - wanted).max()) if len(t) == len(wanted) else np.inf


def kitti_360(root: Path) -> Path:
    """Poses by numbers of scans, from one on, of some scans only."""
    out = folder(lambda p, x, a, t: bins(p, x, 4), "{:.6f}.bin")(root)
    for k, p in enumerate(sorted(out.glob("*.bin"))):
        p.rename(out / f"{4391 + k:010d}.bin")
    T = pose(0.1 * np.arange(8))
    M = np.concatenate([se3.quat_to_matrix(T[:, 3:]), T[:, :3, None]], axis=2).reshape(8, 12)
    np.savetxt(out / "poses.txt", np.column_stack([4391 + np.arange(8), M])[1::2])
    return out


def bins(path: Path, xyz: Array, columns: int) -> None:
    more = np.column_stack([np.full(len(xyz), 100.0), np.arange(len(xyz)) % 32])
    np.column_stack([xyz, more])[:, :columns].astype("<f4").tofile(path)


def nuscenes(path: Path, xyz: Array, after: Array, t: float) -> None:
    bins(path, cloud(t, lasts=0.0, mount=AT_BASE)[0], 5)


def scaled(factor: float) -> Callable[[Messages, Rows], Rows]:
    """Positions of the odometry times a factor; 0: it never moves."""

    def change(m: Messages, rows: Rows) -> Rows:
        for _, kind, _, message in rows:
            if kind == "nav_msgs/msg/Odometry":
                p, q = message.pose.pose.position, message.pose.pose.orientation
                p.x, p.y = factor * p.x, factor * p.y
                q.z, q.w = (q.z, q.w) if factor else (0.0, 1.0)
        return rows

    return change


# ---- paths and graphs ------------------------------------------------------------------------------------------------


def path_file(change: Callable[[list[list[str]]], str], name: str = "est.txt") -> Callable[[Path], Path]:
    """A TUM table; ``change`` makes the text of rows of words."""

    def make(root: Path) -> Path:
        t = 0.1 * np.arange(20)
        rows = [[f"{v:.6f}" for v in r] for r in np.column_stack([T0 + t, pose(t)])]
        (root / name).write_text(change(rows))
        return root / name

    return make


def joined(rows: list[list[str]], separator: str = " ", end: str = "\n") -> str:
    return "".join(separator.join(r) + end for r in rows)


def off_the_path(source: Path) -> float:
    """ATE of a file of poses [m]."""
    found = read_tum(source, dim=3)
    return ate(found, Trajectory(found.times, pose(found.times - T0)), alignment="none").statistics.rmse


def graph_file(change: Callable[[list[str]], list[str]]) -> Callable[[Path], Path]:
    """A g2o file of five poses and six edges without noise."""

    def make(root: Path) -> Path:
        T = pose(0.4 * np.arange(5))
        U = np.triu(np.arange(1.0, 37.0).reshape(6, 6))
        info = " ".join(f"{v:.9g}" for v in (U.T @ U)[np.triu_indices(6)])
        row = lambda p: " ".join(f"{v:.12g}" for v in p)  # noqa: E731
        lines = [f"VERTEX_SE3:QUAT {k} {row(p)}" for k, p in enumerate(T)]
        pairs = [(0, 1), (1, 2), (2, 3), (3, 4), (0, 4), (1, 3)]
        between = se3.se3_between(T[[a for a, _ in pairs]], T[[b for _, b in pairs]])
        lines += [f"EDGE_SE3:QUAT {a} {b} {row(z)} {info}" for (a, b), z in zip(pairs, between)]
        (root / "a.g2o").write_text("\n".join(change(lines)) + "\n")
        return root / "a.g2o"

    return make


def off_the_graph(source: Path) -> float:
    """Greatest difference of poses and information matrices, which g2o orders translation first."""
    network = read_network(source)
    U = np.triu(np.arange(1.0, 37.0).reshape(6, 6))
    swap = [3, 4, 5, 0, 1, 2]
    wanted = (U.T @ U)[np.ix_(swap, swap)]
    far = float(np.abs(network.information - wanted).max())
    return max(far, float(np.abs(network.poses[:, :3] - pose(0.4 * np.arange(5))[:, :3]).max()))


# ---- landmarks -------------------------------------------------------------------------------------------------------


def tables(change: Callable[[Array, Array], Array]) -> Callable[[Path], Path]:
    """Two tables; ``change`` the rows (stamp, id, range, bearing), given the headings at their stamps."""

    def make(root: Path) -> Path:
        small.tables(root / "csv", poses=True)
        t, _, _, path = small.drive()
        rows = small.detections(t, path)
        rows = change(rows, np.interp(rows[:, 0], t, path[:, 2]))
        form = ("%.6f", "%d", "%.9g", "%.9g")
        np.savetxt(root / "csv" / "observations.csv", rows, form, ",", header="t,id,range,bearing", comments="")
        return root / "csv"

    return make


def off_the_landmarks(source: Path) -> tuple[float, str]:
    """Distance of 90 % of the observations, on the true path, from the landmark of their id [m]; and what is said."""
    log = load_recording(source)
    z, (t, _, _, path) = log["landmarks"], small.drive()
    at = np.repeat(z.times, np.diff(z.offsets))
    x, y, heading = (np.interp(at, t, c) for c in path.T)
    xy = np.column_stack([x + z.ranges * np.cos(heading + z.bearings), y + z.ranges * np.sin(heading + z.bearings)])
    far = np.linalg.norm(xy - small.LANDMARKS[np.clip(z.ids, 0, len(small.LANDMARKS) - 1)], axis=1)
    return float(np.quantile(far, 0.9)), said_of(log)


# ---- the strangers ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Stranger:
    """One input.

    Parameters
    ----------
    source : str
        The report, on GitHub.
    make : callable
        Writes the input into an empty folder and returns its path.
    outcome : str
        ``right``, ``named`` (the fault is said) or ``refused`` (with the cause).
    says : str
        Pattern of the cause; with ``right`` it must be said as well.
    error : callable or None
        Error of what was read, from the path [m], perhaps with what is said; None: :func:`off_the_walls` of the log.
    tolerance : float
    """

    name: str
    source: str
    make: Callable[[Path], Path]
    outcome: str = "right"
    says: str = ""
    error: Callable[[Path], float | tuple[float, str]] | None = None
    tolerance: float = 0.02


def said_of(log: SensorLog) -> str:
    """What ``data check`` says of a log, without the comparison of scans with the motion."""
    marked = [f.finding.text for f in check_streams(log, refusals=False) if f.finding.level in ("look", "bad")]
    return "\n".join([*marked, *log.dropped, *log.meta.get("notes", ())])


def try_stranger(s: Stranger, root: Path) -> tuple[str, str]:
    """Outcome, and what it rests on: ``right``, ``named``, ``refused``, ``cause not named`` or ``silently wrong``."""
    root.mkdir(parents=True, exist_ok=True)
    source = s.make(root)
    try:
        if s.error is not None:
            found = s.error(source)
            error, words = found if isinstance(found, tuple) else (found, "")
        else:
            log = load_recording(source)
            error, words = off_the_walls(log), said_of(log)
    except GraphSlamError as refusal:
        words = str(refusal)
        return ("refused" if s.says and re.search(s.says, words) else "cause not named"), words
    named = bool(s.says) and re.search(s.says, words) is not None
    what = f"{error:.4f} of {s.tolerance:g}\n{words}"
    if error <= s.tolerance and (named or not s.says) and s.outcome != "named":
        return "right", what
    return ("named" if named else "silently wrong"), what


def degrees(place: Array) -> tuple[float, float, float]:
    """Latitude, longitude [deg] and height of a place in the room."""
    return 48.0 + place[1] / 111_200.0, 11.0 + place[0] / 74_600.0, 500.0


GH = "https://github.com/"
STRANGERS = [
    # paths
    Stranger(
        "trailing-space",
        GH + "MichaelGrupp/evo/issues/70",
        path_file(lambda r: joined(r, end=" \n")),
        error=off_the_path,
    ),
    Stranger(
        "double-space", GH + "MichaelGrupp/evo/issues/175", path_file(lambda r: joined(r, "  ")), error=off_the_path
    ),
    Stranger(
        "nan-rows",
        GH + "MichaelGrupp/evo/issues/175#groundtruth",
        path_file(lambda r: joined([*r[:9], [r[9][0], *["NaN"] * 7], *r[10:]])),
        "refused",
        r"not finite.*|est\.txt:10",
        off_the_path,
    ),
    Stranger(
        "euroc-truth-as-tum",
        GH + "MichaelGrupp/evo/issues/379",
        path_file(
            lambda r: (
                "#timestamp,qw,qx,qy,qz\n" + joined([[str(int(1e9 * float(x[0]))), *x[4:], *x[1:4]] for x in r], ",")
            )
        ),
        "refused",
        r"columns|comma|number",
        off_the_path,
    ),
    Stranger(
        "number-first",
        GH + "mcdviral/mcdviral.github.io/issues/8",
        path_file(lambda r: joined([[str(k), *x] for k, x in enumerate(r)])),
        "refused",
        r"columns|quaternion",
        off_the_path,
    ),
    Stranger(
        "no-z",
        GH + "MichaelGrupp/evo/issues/218",
        path_file(lambda r: joined([x[:3] + x[4:] for x in r])),
        "refused",
        r"7: .*wanted 8: t x y z",
        off_the_path,
    ),
    Stranger(
        "kitti-as-tum",
        GH + "xdspacelab/openvslam/issues/244",
        path_file(lambda r: joined([x[1:] + x[1:6] for x in r])),
        "refused",
        r"12: .*wanted 8: t x y z",
        off_the_path,
    ),
    Stranger(
        "not-sorted",
        GH + "MichaelGrupp/evo/issues/70#issuecomment",
        path_file(lambda r: joined([*r[10:], *r[:10]])),
        "refused",
        r"sort the file",
        off_the_path,
    ),
    Stranger(
        "rtabmap-landmarks",
        GH + "introlab/rtabmap/issues/1199",
        path_file(
            lambda r: joined(
                [["0.000000", *x[1:], str(-17 + k)] for k, x in enumerate(r[:3])]
                + [[*x, str(k + 1)] for k, x in enumerate(r)]
            )
        ),
        error=off_the_path,
    ),
    # pose graphs
    Stranger(
        "space-in-tag",
        GH + "RainerKuemmerle/g2o/issues/358",
        graph_file(lambda r: [x.replace("SE3:", "SE3 : ") for x in r]),
        "refused",
        r"VERTEX_SE3",
        off_the_graph,
    ),
    Stranger(
        "tutorial-tags",
        GH + "RainerKuemmerle/g2o/issues/52",
        graph_file(lambda r: ["TUTORIAL_" + x for x in r]),
        "refused",
        r"TUTORIAL_VERTEX_SE3.*wanted.*VERTEX_SE2",
        off_the_graph,
    ),
    Stranger(
        "no-information",
        GH + "gisbi-kim/SC-LIO-SAM/issues/22",
        graph_file(lambda r: [" ".join(x.split()[:10]) if "EDGE" in x else x for x in r]),
        "refused",
        r"EDGE_SE3:QUAT.*9 numbers.*30",
        off_the_graph,
    ),
    Stranger(
        "parameters",
        GH + "JeffLIrion/python-graphslam/pull/85",
        graph_file(lambda r: ["PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1", *r]),
        error=off_the_graph,
    ),
    Stranger(
        "off-diagonal-information",
        GH + "borglab/gtsam/pull/1310",
        graph_file(lambda r: r),
        error=off_the_graph,
        tolerance=1e-6,
    ),
    Stranger(
        "track-points",
        GH + "JeffLIrion/python-graphslam/pull/47",
        graph_file(lambda r: [*r, "VERTEX_TRACKXYZ 9 1 2 3", "EDGE_SE3_TRACKXYZ 0 9 0 1 2 3 1 0 0 1 0 1"]),
        "refused",
        r"VERTEX_TRACKXYZ",
        off_the_graph,
    ),
    Stranger(
        "decimal-comma",
        GH + "introlab/rtabmap/pull/319",
        graph_file(lambda r: [x.replace(".", ",") for x in r]),
        "refused",
        r"decimal point",
        off_the_graph,
    ),
    # planar lasers
    Stranger(
        "other-beams-at-start",
        GH + "SteveMacenski/slam_toolbox/issues/430",
        bag(laser(lambda t: np.linspace(-2, 2, 1073 if t < 0.15 else 719 + int(10 * t) % 3))),
    ),
    Stranger(
        "one-beam-less",
        GH + "SteveMacenski/slam_toolbox/issues/63",
        bag(laser(lambda t: -np.pi + 2 * np.pi * np.arange(720) / 720)),
    ),
    Stranger(
        "both-ends",
        GH + "ldrobotSensorTeam/ldlidar_ros2/issues/1",
        bag(laser(lambda t: np.linspace(-np.pi, np.pi, 456))),
    ),
    Stranger(
        "no-stamps",
        GH + "robopeak/rplidar_ros/issues/72",
        bag(laser(stamp=lambda t: 0.0)),
        says="no stamps in its headers",
    ),
    Stranger(
        "device-clock",
        GH + "PepperlFuchs/pf_lidar_ros_driver/issues/23",
        bag(laser(stamp=lambda t: 312.5 + t)),
        "named",
        r"no time in common|clock",
    ),
    Stranger(
        "degrees", GH + "lrse/dataset2bag/issues/5", bag(laser(angle=57.29578)), "refused", r"angles are impossible"
    ),
    Stranger(
        "zero-for-nothing",
        GH + "SteveMacenski/slam_toolbox/issues/602",
        bag(laser(change=lambda r: np.where(np.arange(len(r)) % 7, r, 0.0))),
    ),
    Stranger(
        "jump-back",
        GH + "cartographer-project/cartographer/issues/1026",
        bag(laser(stamp=lambda t: T0 + t - (1.3227 if 1.45 < t < 1.55 else 0.0))),
        says=r"out of order|repeated",
    ),
    Stranger(
        "two-lasers", GH + "SICKAG/sick_scan_xd/issues/342", bag(two_lasers), says="of another frame than 'laser'"
    ),
    # clouds with times of their points
    Stranger(
        "times-before-stamp",
        GH + "PRBonn/kiss-icp/issues/94",
        bag(lidar(lambda t, a: (a - 0.0994).astype(np.float32), "time", lambda t: T0 + t + 0.0994)),
    ),
    Stranger(
        "times-zero",
        GH + "PRBonn/kiss-icp/issues/108",
        bag(lidar(lambda t, a: np.zeros(len(a), np.float32), "time")),
        "named",
        r"point times of clouds: the same for all",
    ),
    Stranger(
        "times-not-from-zero",
        GH + "ouster-lidar/ouster-ros/issues/350",
        bag(lidar(lambda t, a: (1e9 * (a + 0.0494)).astype(np.uint32), stamp=lambda t: T0 + t - 0.0494)),
    ),
    Stranger(
        "nanoseconds-for-seconds",
        GH + "davidskdds/DMSA_LiDAR_SLAM/issues/3",
        bag(lidar(lambda t, a: 1e9 * (T0 + t + a), "timestamp")),
    ),
    Stranger(
        "stamp-at-the-end",
        GH + "HViktorTsoi/PV-LIO/issues/1",
        bag(lidar(lambda t, a: T0 + t + a, "timestamp", lambda t: T0 + t + 0.1)),
    ),
    Stranger(
        "no-times",
        GH + "TixiaoShan/LIO-SAM/issues/174",
        bag(lidar(lambda t, a: None)),
        "named",
        r"point times of clouds: none",
    ),
    Stranger(
        "time-stamp", GH + "YJZLuckyBoy/liorf/issues/47", bag(lidar(lambda t, a: a.astype(np.float32), "time_stamp"))
    ),
    Stranger(
        "relative-milliseconds",
        GH + "TixiaoShan/LIO-SAM/issues/112",
        bag(lidar(lambda t, a: (1e3 * a).astype(np.float32), "time")),
    ),
    Stranger(
        "two-lidars",
        GH + "SteveMacenski/slam_toolbox/issues/462",
        bag(two_lidars),
        says="of another frame than 'lidar'",
    ),
    # files of clouds
    Stranger("pcd-padding", GH + "PDAL/PDAL/issues/3254", folder(padded_pcd)),
    Stranger(
        "pcd-not-compressed",
        GH + "MapIV/pypcd4/issues/37",
        folder(lambda p, x, a, t: pcd(p, cloud(t, lasts=0.0, mount=AT_BASE)[0], "binary_compressed")),
        "refused",
        r"compress|LZF|damaged",
    ),
    Stranger(
        "pcd-named-bin",
        GH + "isl-org/Open3D/issues/680",
        folder(lambda p, x, a, t: pcd(p, cloud(t, lasts=0.0, mount=AT_BASE)[0]), "{:.6f}.pcd.bin"),
    ),
    Stranger("ply-double", GH + "isl-org/Open3D/issues/1633", folder(lambda p, x, a, t: ply(p, x, a), "{:.6f}.ply")),
    Stranger(
        "ply-list",
        GH + "dranjan/python-plyfile/issues/83",
        folder(lambda p, x, a, t: ply(p, x, a, lists=True), "{:.6f}.ply"),
        "refused",
        r"is a list",
    ),
    Stranger(
        "ply-short-row",
        GH + "isl-org/Open3D/issues/932",
        folder(lambda p, x, a, t: ply(p, x, a, cut=True), "{:.6f}.ply"),
        "refused",
        r"damaged",
    ),
    Stranger(
        "las-adjusted-time",
        GH + "ASPRSorg/LAS/issues/40",
        folder(lambda p, x, a, t: las(p, x, a, T0 + t - 315_964_782.0 - 1e9), "{:.6f}.las"),
    ),
    # landmarks
    Stranger("landmarks", GH + "MRPT/mrpt/issues/909", tables(lambda z, h: z), error=off_the_landmarks, tolerance=0.15),
    Stranger(
        "bearing-of-a-map",
        GH + "AtsushiSakai/PythonRobotics/issues/116",
        tables(lambda z, h: np.column_stack([z[:, :3], np.arctan2(np.sin(z[:, 3] + h), np.cos(z[:, 3] + h))])),
        "named",
        r"bearings are counted from the heading",
        off_the_landmarks,
        0.15,
    ),
    Stranger(
        "one-id-for-all",
        GH + "ros-perception/ar_track_alvar/issues/93",
        tables(lambda z, h: z * [1, 0, 1, 1]),
        "named",
        r"check ids",
        off_the_landmarks,
        0.15,
    ),
    # IMU, GPS, transforms, bags
    Stranger("kitti-with-gaps", GH + "tomas789/kitti2bag/issues/4", kitti_with_gaps, error=off_the_stamps),
    Stranger(
        "kitti-360-numbers",
        GH + "autonomousvision/kitti360Scripts/issues/102",
        kitti_360,
        "refused",
        "numbers of scans",
    ),
    Stranger("nuscenes-bin", GH + "nutonomy/nuscenes-devkit/issues/17", folder(nuscenes, "{:.6f}.pcd.bin")),
    Stranger(
        "odometry-in-millimetres", GH + "izhengfan/se2lam/issues/9", bag(change=scaled(1000.0)), "named", "millimetres"
    ),
    Stranger(
        "odometry-that-stands",
        GH + "realsenseai/realsense_samples_ros/issues/5",
        bag(change=scaled(0.0)),
        "named",
        r"motion of odometry: 0 in all",
    ),
    Stranger(
        "imu-in-g",
        GH + "Livox-SDK/livox_ros_driver2/issues/157",
        bag(change=imu(1 / 9.81)),
        "named",
        r"gravity|units of g|in g\b",
    ),
    Stranger(
        "imu-jumps-back",
        GH + "hku-mars/FAST-LIVO2/issues/178",
        bag(change=imu(stamp=lambda t: t - (1.0 if 1.0 < t < 1.6 else 0.0))),
        says=r"imu: (stamp|repeated)|clock was set back",
    ),
    Stranger(
        "latitude-for-longitude",
        GH + "RoboJackets/igvc-software/issues/874",
        bag(laser(change=np.abs), n=160, change=fixes(lambda p: degrees(p[[1, 0]]), 160)),
        "named",
        r"axes are probably swapped",
    ),
    Stranger(
        "no-quaternion",
        GH + "RobotnikAutomation/rbcar_sim/issues/4",
        bag(change=broken_turns),
        "refused",
        r"no unit quaternion",
    ),
    Stranger("long-quaternion", GH + "introlab/rtabmap_ros/issues/153", bag(static=MOUNT * [1, 1, 1, 1, 1, 1, 0.999])),
    Stranger("no-metadata", GH + "ros2/rosbag2/issues/395", lambda root: without_index(root)),
    Stranger("another-name", GH + "ros2/rosbag2/issues/2021", lambda root: without_index(root, "mybag.db3")),
    Stranger("no-metadata-zstd", GH + "ros2/rosbag2/issues/990", lambda root: without_index(root, compress="FILE")),
    Stranger(
        "no-storage-identifier",
        GH + "ros2/rosbag2/issues/2175",
        lambda root: with_index(root, "storage_identifier: sqlite3", "storage_identifier: ''"),
    ),
]


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--full", action="store_true", help="all that `data check` does, and every text in full")
    a = parser.parse_args()
    counts: Counter[str] = Counter()
    for s in STRANGERS:
        if a.names and s.name not in a.names:
            continue
        with tempfile.TemporaryDirectory() as folder_:
            outcome, what = try_stranger(s, Path(folder_) / "in")
            counts[outcome] += 1
            good = "" if outcome == s.outcome else f"  (expected: {s.outcome})"
            print(f"{s.name:26}{outcome:16}{what if a.full else what.splitlines()[0][:100]}{good}", flush=True)
            if a.full and s.error is None and outcome != "refused":
                for f in check_source(next(p for p in (Path(folder_) / "in").iterdir())):
                    print(f"    {f.finding.level:5} {f.finding.text}")
    print(", ".join(f"{n} {k}" for k, n in counts.items()), f"of {sum(counts.values())}")
    sys.exit(bool(counts["silently wrong"] or counts["cause not named"]))


if __name__ == "__main__":
    main()
