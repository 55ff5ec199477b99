"""Six sources as a newcomer would bring them, made of recorded sets: ``python -m tests.io.newcomer OUT``.

A CARMEN file, a KITTI-style folder of BIN without poses, a folder of PLY (by ``plyfile``) with TUM poses, a ROS 2
bag (``rosbags``), an MCAP file (``mcap``), and two CSV tables. Recorded data stay out of the repository.
"""

from __future__ import annotations

import argparse
import bz2
from pathlib import Path

import numpy as np

from graphslam.core import se3
from graphslam.core.geometry import se2_compose
from graphslam.io.catalog import load_recording, locate
from tests.io.bag_worlds import Messages, write_mcap, write_ros2


def carmen(out: Path) -> None:
    """The log of MIT CSAIL as one plain file of another name."""
    raw = bz2.decompress((locate("radish-mit-csail") / "mit-csail.clf.bz2").read_bytes())
    (out / "my-robot.log").write_bytes(raw)


def bins(out: Path, scans: int = 154) -> None:
    """KITTI 0005 as float32 x y z intensity, one file a scan."""
    folder = out / "drive" / "velodyne"
    folder.mkdir(parents=True)
    clouds = load_recording("lidar3d-kitti-0005")["clouds"]
    for k in range(min(scans, len(clouds))):
        xyz = clouds.cloud(k)
        np.column_stack([xyz, np.zeros(len(xyz))]).astype("<f4").tofile(folder / f"{k:06d}.bin")


def plys(out: Path, scans: int = 160) -> None:
    """HKU 1 as PLY in double precision, with TUM poses beside them."""
    import plyfile

    folder = out / "scans"
    folder.mkdir(parents=True)
    log = load_recording("lidar3d-hku1")
    clouds, poses = log["clouds"], se3_chain(log["odometry"].increments)
    rows = []
    for k in range(min(scans, len(clouds))):
        a = np.array([tuple(p) for p in clouds.cloud(k)], dtype=[("x", "f8"), ("y", "f8"), ("z", "f8")])
        plyfile.PlyData([plyfile.PlyElement.describe(a, "vertex")]).write(str(folder / f"scan_{k}.ply"))
        rows.append([clouds.times[k], *poses[k]])
    np.savetxt(out / "scans" / "poses.txt", rows, fmt="%.9f", header="timestamp tx ty tz qx qy qz qw")


def se3_chain(increments: np.ndarray) -> np.ndarray:
    """Poses ``(n, 7)`` of motions."""
    out = increments.copy()
    for k in range(1, len(out)):
        out[k] = se3.se3_compose(out[k - 1], increments[k])
    return out


def ros2(out: Path, seconds: float = 300.0) -> None:
    """Freiburg 079 as LaserScan and Odometry, by rosbags."""
    log = load_recording("radish-fr079")
    laser, odometry, m = log["laser"], log["odometry"], Messages()
    pose, messages = np.zeros(3), []
    place = np.array([*laser.T_base_sensor[:2], 0.2, 0, 0, 0, 1.0])
    messages.append(
        ("/tf_static", "tf2_msgs/msg/TFMessage", laser.times[0], m.transforms(0.0, [("base_link", "laser", place)]))
    )
    step = float(laser.bearings[1] - laser.bearings[0])
    for k in range(int(np.searchsorted(laser.times, laser.times[0] + seconds))):
        t = float(laser.times[k])
        pose = se2_compose(pose, odometry.increments[k])
        full = np.array([pose[0], pose[1], 0, 0, 0, np.sin(pose[2] / 2), np.cos(pose[2] / 2)])
        messages.append(("/odom", "nav_msgs/msg/Odometry", t, m.odometry(t, full)))
        messages.append(
            ("/scan", "sensor_msgs/msg/LaserScan", t, m.scan(t, laser.ranges[k], float(laser.bearings[0]), step))
        )
        messages.append(("/battery", "std_msgs/msg/String", t, m.text("12 V")))
    write_ros2(out / "office_bag", messages)


def mcap(out: Path, scans: int = 200) -> None:
    """HKU main building as PointCloud2 alone, by mcap."""
    clouds, m = load_recording("lidar3d-hku-mb")["clouds"], Messages()
    messages = [
        ("/livox/points", "sensor_msgs/msg/PointCloud2", t, m.cloud(t, clouds.cloud(k), frame="livox"))
        for k, t in enumerate(clouds.times[:scans].tolist())
    ]
    write_mcap(out / "building.mcap", messages)


def tables(out: Path) -> None:
    """Robot 2 of MRCLAM as CSV with headers, semicolons and units."""
    folder = out / "robot_csv"
    folder.mkdir(parents=True)
    log = load_recording("mrclam-dataset7", robot=2)
    c, z = log["controls"], log["landmarks"]
    np.savetxt(
        folder / "odometry.csv",
        np.column_stack([c.times, c.speed, c.yaw_rate]),
        delimiter=";",
        fmt="%.9g" if c.times[0] < 1e6 else ("%.6f", "%.9g", "%.9g"),
        header="Time [s];V [m/s];W [rad/s]",
        comments="",
    )
    rows = np.column_stack([np.repeat(z.times, np.diff(z.offsets)), z.ids, z.ranges, np.rad2deg(z.bearings)])
    np.savetxt(
        folder / "observations.csv",
        rows,
        delimiter=";",
        fmt=("%.6f", "%d", "%.9g", "%.9g"),
        header="t [s];id;range [m];bearing [deg]",
        comments="",
    )


SOURCES = {
    "carmen": (carmen, "my-robot.log"),
    "bin": (bins, "drive"),
    "ply": (plys, "scans"),
    "ros2": (ros2, "office_bag"),
    "mcap": (mcap, "building.mcap"),
    "csv": (tables, "robot_csv"),
}
"""How each is made, and its path below the folder."""


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--only", choices=SOURCES, action="append")
    a = parser.parse_args()
    a.out.mkdir(parents=True, exist_ok=True)
    for name in a.only or SOURCES:
        SOURCES[name][0](a.out)


if __name__ == "__main__":
    main()
