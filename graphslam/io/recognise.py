"""Recognition of sources for each reader of this package: first lines, magic bytes, headers, layouts of folders.

:data:`BUILT_IN` is in the order in which readers are tried: unambiguous formats first. Readers are imported on use.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from pathlib import Path

from graphslam.io.reader import Reader
from graphslam.io.source_probe import ReaderMatch, SourceProbe, file_ending

CARMEN_SCANS = re.compile(r"^(FLASER|RLASER|ROBOTLASER\d|RAWLASER\d)\b")
CARMEN_OTHER = re.compile(r"^(PARAM|ODOM|TRUEPOS|SYNC|# message formats|# robot-id)\b")
NETWORK = re.compile(r"^(VERTEX|EDGE|ODOMETRY \d|LANDMARK \d|EQUIV|FIX )")
CLOUD_ENDINGS = (".bin", ".ply", ".pcd", ".las", ".laz")
SQLITE, MCAP, BAG1, ZSTD = b"SQLite format 3\0", b"\x89MCAP0\r\n", b"#ROSBAG V", b"\x28\xb5\x2f\xfd"


def parse_numbers(line: str) -> list[float] | None:
    """Numbers of a line, separated by white space, commas or semicolons; None if it contains anything else."""
    words = [w for w in re.split(r"[\s,;]+", line.strip()) if w]
    try:
        return [float(w) for w in words]
    except ValueError:
        return None


def first_rows(look: SourceProbe, path: Path, most: int = 20) -> list[list[float]]:
    """Numbers of the first lines, without comments and one header line; empty if a line contains anything else."""
    lines = [s for s in look.lines(path, most) if not s.lstrip().startswith(("#", "%"))]
    found = [parse_numbers(s) for s in lines]
    if found and found[0] is None:
        found = found[1:]
    return [] if any(r is None for r in found) else [r for r in found if r is not None]


def is_tum(look: SourceProbe, path: Path) -> bool:
    """Rows of stamp, position and unit quaternion, optionally with a pose number at the end (RTAB-Map)?"""
    rows = first_rows(look, path)
    return bool(rows) and all(len(r) in (8, 9) and abs(math.hypot(*r[4:8]) - 1.0) < 0.025 for r in rows)


def is_kitti_poses(look: SourceProbe, path: Path) -> bool:
    """Rows of a 3×4 pose matrix?"""
    return _matrices(first_rows(look, path), 0)


def is_stamped_matrices(look: SourceProbe, path: Path) -> bool:
    """Rows of a stamp or scan number, and a 3×4 pose matrix (MulRan, KITTI-360)?"""
    return _matrices(first_rows(look, path), 1)


def _matrices(rows: list[list[float]], first: int) -> bool:
    return bool(rows) and all(
        len(r) == first + 12
        and all(abs(math.hypot(*r[a : a + 3]) - 1.0) < 0.025 for a in (first, first + 4, first + 8))
        for r in rows
    )


def bag_kind(look: SourceProbe, path: Path) -> str:
    """``ROS 1 bag``, ``ROS 2 bag (sqlite3)``, ``MCAP``; empty if it is none of them."""
    head = look.head(path)
    if head.startswith(BAG1):
        return "ROS 1 bag"
    if head.startswith(MCAP) or (head.startswith(ZSTD) and file_ending(path) == ".mcap"):
        return "MCAP"
    return "ROS 2 bag (sqlite3)" if head.startswith((SQLITE, ZSTD)) and file_ending(path) == ".db3" else ""


# --- one function per reader --------------------------------------------------------------------------------------


def _json_format(look: SourceProbe, names: tuple[str, ...], form: str) -> Path | None:
    for name in names:
        path = look.path / name
        if path.is_file():
            try:
                value = json.loads(path.read_bytes())
            except (ValueError, OSError, RecursionError):
                return path  # its reader reports the error
            if not isinstance(value, dict) or str(value.get("format", form)).startswith(form):
                return path
    return None


def _log_store(look: SourceProbe) -> ReaderMatch | None:
    return ReaderMatch("a log of graphslam") if _json_format(look, ("log.json",), "graphslam.log/") else None


def _submap_store(look: SourceProbe) -> ReaderMatch | None:
    found = _json_format(look, ("index.json", "submaps/index.json"), "graphslam.submaps/")
    return ReaderMatch("submaps of graphslam") if found else None


def euroc_tables(look: SourceProbe) -> dict[str, Path]:
    """Tables of a EuRoC recording by kind, from their headers: ``imu``, ``leica``, ``vicon``, ``truth``."""
    out: dict[str, Path] = {}
    marks = {"w_RS_S_x": "imu", "p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q": "truth", "p_RS_R_x": "leica"}
    for p in look.by_ending.get(".csv", []):
        first = (look.lines(p, 1) or [""])[0]
        if first.lstrip("# ").startswith("timestamp"):
            joined = re.sub(r",\s+", ",", first)
            kind = next((k for mark, k in marks.items() if mark in joined), None)
            if kind == "truth" and "vicon" in str(p).lower():
                kind = "vicon"
            if kind is not None:
                out.setdefault(kind, p)
    return out


def _euroc(look: SourceProbe) -> ReaderMatch | None:
    found = euroc_tables(look)
    if not found:
        return None
    text = "EuRoC: " + ", ".join(f"{k} ({look.relative(p)})" for k, p in found.items())
    return (
        ReaderMatch(text)
        if "imu" in found and look.path.is_dir()
        else ReaderMatch(text, "a folder with imu0's data.csv in it")
    )


def _bag(look: SourceProbe) -> ReaderMatch | None:
    candidates = [p for e in (".bag", ".db3", ".mcap", ".active", "") for p in look.by_ending.get(e, [])]
    if look.path.is_file():
        candidates = [look.path]
    kinds = [(p, k) for p in candidates[:200] if (k := bag_kind(look, p))]
    index = look.named("metadata.yaml")
    if index is not None and look.lines(index, 1)[:1] == ["rosbag2_bagfile_information:"]:
        return ReaderMatch(f"ROS 2 bag {look.relative(index.parent) if index.parent != look.path else look.path.name}")
    if not kinds:
        empty = [p for p in look.files if file_ending(p) in (".bag", ".db3", ".mcap")]
        if not empty:
            return None
        what = "is empty" if empty[0].stat().st_size == 0 else "does not begin like one"
        return ReaderMatch(f"a bag by its name, {look.relative(empty[0])}, which {what}", "a bag that is whole")
    text = f"{kinds[0][1]} {look.relative(kinds[0][0])}"
    return ReaderMatch(text if len(kinds) == 1 else f"{text} and {len(kinds) - 1} more files")


def _kitti(look: SourceProbe) -> ReaderMatch | None:
    clouds = [p for p in look.by_ending.get(".bin", []) if p.parent.name in ("velodyne", "data")]
    clouds = [p for p in clouds if p.parent.name == "velodyne" or p.parent.parent.name.startswith("velodyne_points")]
    oxts = [p for p in look.by_ending.get(".txt", []) if p.parent.name == "data" and p.parent.parent.name == "oxts"]
    if look.path.is_file() or not (clouds or oxts):
        return None
    folders = sorted({p.parent for p in clouds})
    text = f"KITTI {'raw' if oxts or any(f.name == 'data' for f in folders) else 'odometry'}, {len(clouds)} clouds"
    if not clouds:
        return ReaderMatch(
            f"KITTI raw: {len(oxts)} records of oxts and no cloud", "velodyne_points/data/*.bin beside oxts"
        )
    if len(folders) > 1:
        names = ", ".join(look.relative(f) for f in folders[:4])
        return ReaderMatch(f"{text} in {len(folders)} drives", f"one of them: {names}")
    return ReaderMatch(text)


def _carmen(look: SourceProbe) -> ReaderMatch | None:
    for p in sorted(look.texts, key=lambda p: "-corrected" in p.name):
        tags = {m[1] for s in look.lines(p, 4000) if (m := CARMEN_SCANS.match(s))}
        if tags:
            return ReaderMatch(f"CARMEN log {look.relative(p)}: {', '.join(sorted(tags))}")
    for p in look.texts:
        if sum(bool(CARMEN_OTHER.match(s)) for s in look.lines(p, 50)) > 3:
            return ReaderMatch(f"CARMEN log {look.relative(p)}")
    return None


def _tables(look: SourceProbe) -> ReaderMatch | None:
    from graphslam.io.landmark_tables import claim_tables

    return claim_tables(look)


def cloud_folder(look: SourceProbe) -> tuple[list[Path], str]:
    """The largest group of clouds with the same folder and file name extension, and the extension."""
    groups: dict[tuple[Path, str], list[Path]] = {}
    for e in CLOUD_ENDINGS:
        for p in look.by_ending.get(e, []):
            groups.setdefault((p.parent, e), []).append(p)
    if not groups:
        return [], ""
    (_, e), found = max(groups.items(), key=lambda g: (len(g[1]), -len(g[0][0].parts), str(g[0])))
    return found, e


def _clouds(look: SourceProbe) -> ReaderMatch | None:
    found, e = cloud_folder(look)
    if not found:
        return None
    where = look.relative(found[0].parent) if look.path.is_dir() and found[0].parent != look.path else ""
    text = f"{len(found)} cloud{'s' if len(found) > 1 else ''} ({e[1:].upper()}{f', in {where}' if where else ''})"
    head = look.head(found[0])
    if e == ".ply" and b"element vertex" in head and re.search(rb"element face [1-9]", head) and len(found) == 1:
        return ReaderMatch(f"{text}, a surface", "scans, one file each")
    if len(found) == 1:
        return ReaderMatch(text, "a folder with one cloud a scan, in the order of their names: one cloud is no log")
    folders = Counter(p.parent for p in look.by_ending[e])
    alike = sorted(f for f, n in folders.items() if 2 * n >= len(found))
    if len(alike) > 1:
        names = ", ".join(look.relative(f) for f in alike[:4])
        return ReaderMatch(
            f"folders of {e[1:].upper()} clouds: {len(alike)}", f"one of them, for they are no one log: {names}"
        )
    poses = pose_file(look)
    return ReaderMatch(f"{text}, poses in {look.relative(poses)}" if poses else f"{text}, no poses")


def pose_file(look: SourceProbe) -> Path | None:
    """A table of poses next to clouds: TUM, KITTI, or stamps with matrices; None if there is none."""
    some = [p for p in look.texts if file_ending(p) not in CLOUD_ENDINGS]
    clouds, _ = cloud_folder(look)
    beside = {look.path, *(c.parent for c in clouds[:1]), *(c.parent.parent for c in clouds[:1])}
    some = [p for p in some if p.parent in beside or p.parent.name.startswith("pose")]
    good = [p for p in some if is_tum(look, p) or is_kitti_poses(look, p) or is_stamped_matrices(look, p)]
    first = ("poses.txt", "poses.tum", "odom_poses.txt", "trajectory.tum", "trajectory.txt", "odometry.txt")
    return min(good, key=lambda p: (p.name not in first, len(p.parts), p), default=None)


def _network(look: SourceProbe) -> ReaderMatch | None:
    found = [p for p in look.texts if any(NETWORK.match(s) for s in look.lines(p, 50))]
    if not found:
        return None
    text = f"a pose network, {look.relative(found[0])}"
    return (
        ReaderMatch(text) if look.path.is_file() else ReaderMatch(text, f"the file itself: graphslam solve {found[0]}")
    )


def _tum(look: SourceProbe) -> ReaderMatch | None:
    path = next((p for p in look.texts if is_tum(look, p)), None)
    return ReaderMatch(f"a TUM trajectory, {look.relative(path)}") if path else None


_IO = "graphslam.io"
BUILT_IN: dict[str, Reader] = {
    "log-store": Reader("log of graphslam: a folder with log.json", f"{_IO}.log_store:load_log", _log_store),
    "submap-store": Reader(
        "submaps of graphslam: a run, or a folder with index.json",
        f"{_IO}.submap_store:read_submaps",
        _submap_store,
    ),
    "euroc": Reader(
        "EuRoC (ASL) without cameras: data.csv of imu0, perhaps of leica0 or vicon0, and ground truth",
        f"{_IO}.euroc:read_euroc",
        _euroc,
    ),
    "ros-bag": Reader(
        "ROS 1 bag, ROS 2 bag (sqlite3, MCAP) or MCAP of ROS messages: laser, clouds, IMU, odometry, GPS, tf_static",
        f"{_IO}.bags:read_bag",
        _bag,
    ),
    "kitti": Reader(
        "KITTI odometry (velodyne/, times.txt, poses) and raw (velodyne_points/, oxts/)",
        f"{_IO}.kitti:read_kitti",
        _kitti,
    ),
    "carmen": Reader("CARMEN log: FLASER, ROBOTLASER1 or RAWLASER1, with ODOM", f"{_IO}.carmen:read_carmen", _carmen),
    "landmark-tables": Reader(
        "CSV: odometry.csv (t, v, w or t, x, y, theta) and observations.csv (t, id, range, bearing)",
        f"{_IO}.landmark_tables:read_landmark_tables",
        _tables,
    ),
    "clouds": Reader(
        "folder of clouds, one file a scan: BIN, PLY, PCD, LAS or LAZ, with or without poses (TUM, KITTI) and times",
        f"{_IO}.cloud_logs:read_clouds",
        _clouds,
    ),
    "pose-network": Reader(
        "pose network, g2o, TORO or iSAM, for graphslam solve", f"{_IO}.network_file:network_path", _network
    ),
    "tum": Reader("TUM trajectory as odometry: t x y z qx qy qz qw", f"{_IO}.tum:read_tum_log", _tum),
}
