"""Messages that strangers did not understand: what, where, got, wanted, what to do; or none, as it is read now."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graphslam.app.data_check import check_source, check_summary
from graphslam.app.run.summary import ADVICE
from graphslam.core.errors import GraphSlamError
from graphslam.core.records import Gps, check_times
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.stream_checks import check_streams, refuse_faulty
from graphslam.evaluate.trajectory_error import ate
from graphslam.graph.factor_graph import FactorGraph
from graphslam.io.bags import read_bag
from graphslam.io.catalog import locate
from graphslam.io.g2o import read_g2o
from graphslam.io.landmark_tables import read_landmark_tables
from graphslam.io.network_file import read_network
from graphslam.io.tum import read_tum
from graphslam_studies.io.tuc import read_tuc
from tests.faults.readers import tuc
from tests.io import small_sources as small
from tests.io.bag_worlds import Messages, write_ros1, write_ros2

Case = Callable[[Path], Any]
KEY = (ord("x") << 56) + 7  # gtsam.symbol("x", 7)
I3 = "1 0 0 1 0 1"
PAIR = f"VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 {I3}\n"


def text(name: str, content: str, read: Callable[[Path], Any]) -> Case:
    """Read a file with this content."""

    def do(root: Path) -> Any:
        (root / name).write_text(content)
        return read(root / name)

    return do


def checked(make: Callable[[Path], Any]) -> Case:
    """The lines of ``data check`` on what is made."""

    def do(root: Path) -> str:
        found = check_source(make(root))
        return "\n".join([*(f.finding.text for f in found), check_summary(found)])

    return do


def stamps(factor: float) -> Case:
    def do(root: Path) -> Any:
        log = read_landmark_tables(small.tables(root / "csv", factor={"t": factor}))
        return refuse_faulty(check_streams(log), log)

    return do


def cut_bag(keep: float) -> Case:
    """A ROS 1 bag of which the first part is left."""

    def do(root: Path) -> Any:
        m = Messages(ros1=True)
        rows = [("/scan", "sensor_msgs/msg/LaserScan", t, m.scan(t, np.full(20, 3.0), -1, 0.1)) for t in small.stamps()]
        data = write_ros1(root / "whole.bag", rows).read_bytes()
        (root / "cut.bag").write_bytes(data[: int(keep * len(data))])
        return read_bag(root / "cut.bag")

    return do


def zstd_bag(root: Path) -> Any:
    """Messages compressed one by one, without metadata.yaml, which says so."""
    m = Messages()
    rows = [("/scan", "sensor_msgs/msg/LaserScan", t, m.scan(t, np.full(20, 3.0), -1, 0.1)) for t in small.stamps()]
    write_ros2(root / "bag", rows, compress="MESSAGE")
    (root / "bag" / "metadata.yaml").unlink()
    return len(read_bag(next((root / "bag").glob("*.db3")))["laser"].times)


def pose_rows(stamp: str, more: str = "") -> str:
    return "".join(f"{stamp.format(k)} {k} 0 0 0 0 0 1{more}\n" for k in range(4))


def paths(root: Path) -> Any:
    flat = Trajectory(np.arange(4.0), np.zeros((4, 3)))
    deep = Trajectory(np.arange(4.0), np.tile([0.0, 0, 1, 0, 0, 0, 1], (4, 1)))
    return ate(flat, deep)


def flat_fixes(root: Path) -> Any:
    fixes = Gps(times=np.arange(6.0), positions=np.zeros((6, 2)), sigma=np.ones(6), lever=np.zeros(2))
    return FactorGraph(dim=3).add_sensor(fixes, stream="gps")


def table(odometry: str, seen: str = "t,id,range,bearing\n1,1,2,0\n2,1,2,0\n") -> Case:
    def do(root: Path) -> Any:
        (root / "odometry.csv").write_text(odometry)
        (root / "observations.csv").write_text(seen)
        return read_landmark_tables(root)

    return do


def feet(root: Path) -> Path:
    """Bearings from the left side of the robot."""
    small.tables(root / "csv")
    path = root / "csv" / "observations.csv"
    head, *rows = path.read_text().splitlines()
    turned = [f"{r.rpartition(',')[0]},{float(r.rpartition(',')[2]) - np.pi / 2}" for r in rows]
    path.write_text("\n".join([head, *turned]) + "\n")
    return root / "csv"


def of_a_map(root: Path) -> Path:
    for k, xyz in enumerate(small.clouds(4)):
        (root / "las").mkdir(exist_ok=True)
        small.write_las(root / "las" / f"{k}.las", xyz)
        import laspy

        las = laspy.read(root / "las" / f"{k}.las")
        las.header.offsets = np.array([452_000.0, 5_411_000.0, 110.0])
        las.write(root / "las" / f"{k}.las")
    return root / "las"


def not_there(root: Path) -> Any:
    return locate("tuc-slam-lecture-hall")


def corridor(root: Path) -> Any:
    tuc(root)
    for p in list(root.iterdir()):
        p.rename(root / p.name.replace("Lecture_Hall", "Corridor"))
    return len(read_tuc(root).times)


READ = "is read"
CASES: dict[str, tuple[Case, str | tuple[str, ...]]] = {
    "GTSAM keys": (
        text("a.g2o", PAIR.replace(" 1 1 0 0", f" {KEY} 1 0 0", 1).replace("0 1 1", f"0 {KEY} 1"), read_g2o),
        READ,
    ),
    "an id that is too large": (
        text("a.g2o", PAIR.replace("SE2 1 ", f"SE2 {2**63} "), read_g2o),
        ("vertex id", "a.g2o:2", str(2**63), "whole numbers from 0 to 2⁶³"),
    ),
    "EDGE3": (
        text("a.graph", "VERTEX3 0 0 0 0 0 0 0\nVERTEX3 1 1 0 0 0 0 0\nEDGE3 0 1 1 0 0 0 0 0\n", read_network),
        READ,
    ),
    "no record of a network": (
        text("a.graph", "NODE 1 2 3\n", read_network),
        ("not a pose network", "a.graph", "records NODE", "VERTEX2, EDGE2, EDGE3"),
    ),
    "byte-order mark": (text("a.g2o", "\ufeff" + PAIR, read_network), READ),
    "indefinite information": (
        text("a.g2o", PAIR.replace(I3, "1 0 0 -1 0 1"), read_network),
        ("indefinite: 0 -> 1", "a.g2o", "smallest eigenvalue -1", "--repair (repair=True)"),
    ),
    "noise columns": (
        text("a.graph", "VERTEX2 0 0 0 0\nVERTEX2 1 1 0 0\nEDGE2 0 1 1 0 0 1 2 3 4 5 6\n", read_network),
        ("meaning of the noise columns", "a.graph:3", "--noise covariance", "(in Python noise=…)"),
    ),
    "a network is no log": (
        checked(lambda p: Path(text("a.g2o", PAIR, lambda q: q)(p))),
        ("a.g2o: not a sensor log", "`graphslam solve` checks pose-graph files", "Nothing was checked"),
    ),
    "fixes of another dimension": (
        flat_fixes,
        ("GPS positions and map differ in dimension", "gps", "2-D positions", "--set gps.use=none"),
    ),
    "stamps in nanoseconds": (stamps(1e9), ("stamp interval of controls", "1e+08 s", "nanoseconds", "wanted seconds")),
    "stamps in microseconds": (
        stamps(1e6),
        ("stamp interval of controls", "1e+05 s", "microseconds", "wanted seconds"),
    ),
    "decimal comma": (
        text("a.tum", pose_rows("1,{}"), read_tum),
        ("not a number", "a.tum:1", "1,0", "numbers with a decimal point; time in seconds"),
    ),
    "date as a stamp": (
        table("t,v,w\n" + "".join(f"2024-01-01T00:00:0{k},1,0\n" for k in range(4))),
        ("4 of 4 values in the column of t", "odometry.csv", "2024-01-01T00:00:00", "times in seconds"),
    ),
    "13 columns": (
        text("a.tum", pose_rows("{}", " 0 0 0 0 0"), read_tum),
        ("wrong number of columns", "a.tum:1", "13:", "8: t x y z qx qy qz qw"),
    ),
    "a stamp that is not finite": (
        lambda p: check_times([1.0, np.nan], where="odometry"),
        ("stamp of record 1 is not finite", "odometry", "nan", "seconds, with a decimal point"),
    ),
    "time that does not increase": (
        text("a.tum", pose_rows("1311868229.57{}") + "1311868228 0 0 0 0 0 0 1\n", read_tum),
        ("stamps do not increase", "a.tum:5", "1311868228.0 after 1311868229.573", "sort the file"),
    ),
    "records out of order": (
        lambda p: check_times([1.0, 3.0, 2.0], where="odometry"),
        ("does not increase at record 2", "odometry", "2.000000 after 3.000000", "sort the records"),
    ),
    "plane and space": (
        paths,
        ("estimate and reference differ in dimension", "estimate in 2-D, reference in 3-D", "dim=3"),
    ),
    "a bag without its end": (cut_bag(0.05), ("no message is found in this bag", "cut.bag", "bytes", "rosbag reindex")),
    "a bag that ends early": (cut_bag(0.8), READ),
    "messages in zstd": (zstd_bag, READ),
    "landmarks that move": (
        checked(feet),
        (
            "shift of landmarks of landmarks",
            "% of their range",
            "bearings seem to count from the left side",
            "wanted from ahead",
        ),
    ),
    "scale, or field of view": (
        lambda p: ADVICE["distance-disagrees"],
        ("scale of the odometry", "field of view", "maximum range of the scanner"),
    ),
    "LAS in UTM": (
        checked(of_a_map),
        ("median range of clouds", "e+06 m", "coordinates of a map (UTM)", "in the frame of its scanner"),
    ),
    "data that are not there": (
        not_there,
        (
            "files of data set 'tuc-slam-lecture-hall' are missing",
            "tuc",
            "first LICENSE.txt",
            "a copy from https://",
            "(no direct download)",
        ),
    ),
    "another place of a data set": (corridor, READ),
}


@pytest.mark.parametrize("name", CASES)
def test_messages(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    case, wanted = CASES[name]
    monkeypatch.setenv("GRAPHSLAM_DATA", "")
    monkeypatch.setenv("GRAPHSLAM_CACHE", str(tmp_path / "none"))
    if wanted == READ:
        assert case(tmp_path) is not None
        return
    try:
        message = str(case(tmp_path))
    except GraphSlamError as error:
        message = str(error)
    for words in wanted:
        assert words in message
