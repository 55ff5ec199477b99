"""``graphslam data check``: planted faults are named, with the line that a user needs, and sound sources pass."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from graphslam.app.cli import app
from graphslam.core.imu import Imu, ImuNoise
from graphslam.core.log import SensorLog
from graphslam.core.records import Gps
from graphslam.io.log_store import save_log
from graphslam_studies.faults import scans as put
from tests.faults.grid_worlds import ring_log
from tests.io import small_sources as small
from tests.io.bag_worlds import Messages, write_mcap


def checked(source: Path) -> tuple[int, list[dict[str, str]]]:
    """Exit code and lines."""
    done = CliRunner().invoke(app, ["data", "check", str(source), "--json"])
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return done.exit_code, json.loads(done.stdout)["lines"]


def faults(lines: list[dict[str, str]]) -> dict[str, str]:
    return {r["code"]: r["text"] for r in lines if r["level"] in ("bad", "look")}


# ---- scanner and wheels ----------------------------------------------------------------------------------------------


def with_imu(log: SensorLog) -> SensorLog:
    """A gyro beside the wheels, for which gravity is up."""
    w = log["wheels"]
    rng = np.random.default_rng(1)
    n = len(w.times)
    rate = np.column_stack([0.002 * rng.standard_normal((n, 2)), w.yaw_rate + 0.002 * rng.standard_normal(n)])
    force = np.array([0.0, 0.0, 9.80665]) + 0.02 * rng.standard_normal((n, 3))
    noise = ImuNoise(
        gyro=1e-3, gyro_bias=1e-2, gyro_walk=1e-4, accelerometer=1e-2, accelerometer_bias=0.1, accelerometer_walk=1e-3
    )
    imu = Imu(times=w.times, angular_rate=rate, specific_force=force, noise=noise)
    return replace(log, streams={**log.streams, "imu": imu})


def set_forward(seconds: float) -> put.Inject:
    """The clock of all streams is set forward in the middle of the drive."""

    def inject(log: SensorLog) -> SensorLog:
        moved = {
            n: replace(s, times=np.where(s.times < 15.0, s.times, s.times + seconds)) for n, s in log.streams.items()
        }
        return put.put(log, **moved)

    return inject


def millimetres(log: SensorLog) -> SensorLog:
    s = log["scanner"]
    return put.put(log, scanner=replace(s, ranges=1000.0 * s.ranges, max_range=1000.0 * s.max_range))


def degrees_of_gyro(log: SensorLog) -> SensorLog:
    i = with_imu(log)["imu"]
    return put.put(with_imu(log), imu=replace(i, angular_rate=np.rad2deg(i.angular_rate)))


def fixes_in_degrees(log: SensorLog) -> SensorLog:
    assert log.truth is not None
    t = log.truth.trajectory.times[::20]
    p = log.truth.trajectory.interpolate(t)[:, :2]
    fixes = Gps(times=t, positions=p / [73e3, 111e3] + [8.4, 49.0], sigma=np.full(len(t), 0.1), lever=np.zeros(2))
    return put.put(log, gps=fixes)


SOUND = [put.clean, with_imu]
PLANTED: list[tuple[str, Callable[[SensorLog], SensorLog], str, str]] = [
    ("ranges in millimetres", millimetres, "scans-unit", "millimetres"),
    ("mirrored scans", put.mirrored, "turn-disagrees", "mirrored"),
    ("turns of the wrong sign", put.yaw_rate(-1.0), "turn-disagrees", "wrong sign"),
    ("yaw rate in degrees", put.yaw_rate(180.0 / np.pi), "turn-unit", "degrees"),
    ("speed in km/h", put.speed(3.6), "distance-disagrees", "km/h"),
    ("scanner that looks back", put.mounted(yaw=180.0), "distance-disagrees", "backwards"),
    ("scanner turned by 20 degrees", put.mounted(yaw=20.0), "mounting-disagrees", "T_base_sensor"),
    ("stuck scanner", put.stuck, "scans-repeated", "stuck"),
    ("stuck wheels", put.speed(0.0), "wheels-still", "connected"),
    ("clock set forward", set_forward(100.0), "clock-jump", "100"),
    ("scanner on another clock", put.late("scanner", 1000.0), "no-common-time", "zeros"),
    ("scans half a second late", put.late("scanner", 0.6), "clocks-disagree", "clocks"),
    ("accelerometer in g", lambda log: put.in_g(with_imu(log)), "imu-gravity", "in g"),
    ("gyro in degrees", degrees_of_gyro, "turns-disagree", "degrees"),
    ("fixes in degrees", fixes_in_degrees, "gps-scale", "longitude"),
]


@pytest.mark.parametrize("change", SOUND, ids=["laser", "imu"])
def test_a_sound_log_passes(change: Callable[[SensorLog], SensorLog], tmp_path: Path) -> None:
    save_log(change(ring_log(11)), tmp_path / "log")
    code, lines = checked(tmp_path / "log")
    assert code == 0
    assert faults(lines) == {}


@pytest.mark.parametrize(("what", "change", "code", "word"), PLANTED, ids=[p[0] for p in PLANTED])
def test_a_planted_fault_is_named(
    what: str, change: Callable[[SensorLog], SensorLog], code: str, word: str, tmp_path: Path
) -> None:
    save_log(change(ring_log(11)), tmp_path / "log")
    exit_code, lines = checked(tmp_path / "log")
    assert exit_code == 1, what
    assert code in faults(lines)
    assert word in faults(lines)[code]


# ---- tables ----------------------------------------------------------------------------------------------------------

IN_TABLES: list[tuple[str, dict[str, float], str, str]] = [
    ("bearings in degrees", {"bearing": 180.0 / np.pi}, "observations-and-motion", "bearings seem to be in degrees"),
    ("bearings to the right", {"bearing": -1.0}, "observations-and-motion", "opposite signs"),
    ("ranges in millimetres", {"range": 1000.0}, "observations-and-motion", "millimetres"),
    ("speeds in km/h", {"v": 3.6}, "observations-and-motion", "km/h"),
    ("speeds in mm/s", {"v": 1000.0}, "observations-and-motion", "millimetres"),
    (
        "yaw rates in degrees",
        {"w": 180.0 / np.pi},
        "observations-and-motion",
        "yaw rates or headings seem to be in degrees",
    ),
    ("stamps in milliseconds", {"t": 1000.0}, "stamps-unit", "milliseconds"),
]


def test_sound_tables_pass(tmp_path: Path) -> None:
    code, lines = checked(small.tables(tmp_path / "robot"))
    assert (code, faults(lines)) == (0, {})


@pytest.mark.parametrize(("what", "factor", "code", "word"), IN_TABLES, ids=[p[0] for p in IN_TABLES])
def test_a_fault_in_tables_is_named(what: str, factor: dict[str, float], code: str, word: str, tmp_path: Path) -> None:
    exit_code, lines = checked(small.tables(tmp_path / "robot", factor=factor))
    assert exit_code == 1, what
    assert code in faults(lines)
    assert word in faults(lines)[code]


def test_headings_in_degrees_and_stamps_out_of_order(tmp_path: Path) -> None:
    t, _, _, pose = small.drive()
    folder = small.tables(tmp_path / "robot", poses=True)
    assert faults(checked(folder)[1]) == {}
    twice = np.repeat(np.column_stack([t, pose]), np.where(np.arange(len(t)) % 50 == 9, 2, 1), axis=0)
    np.savetxt(folder / "odometry.csv", twice, delimiter=",", header="t,x,y,theta", comments="")
    code, lines = checked(folder)
    assert (code, list(faults(lines))) == (0, ["stamps-order"])  # the copies are dropped
    rows = np.column_stack([t, pose * [1, 1, 180.0 / np.pi]])
    for k in range(20, len(rows), 60):
        rows[[k, k + 1]] = rows[[k + 1, k]]
    np.savetxt(folder / "odometry.csv", rows, delimiter=",", header="t,x,y,theta", comments="")
    found = faults(checked(folder)[1])
    assert "degrees" in found["turn-unit"]
    assert "out of order" in found["stamps-order"]
    rows = np.column_stack([t, pose[:, :2], 0.5 * np.pi - pose[:, 2]])
    np.savetxt(folder / "odometry.csv", rows, delimiter=",", header="t,x,y,theta", comments="")
    assert "counted from x" in faults(checked(folder)[1])["heading-not-ahead"]
    rows = np.column_stack([1e-3 * t, pose])
    np.savetxt(folder / "odometry.csv", rows, delimiter=",", header="t,x,y,theta", comments="")
    assert {"stamps-unit", "unreadable"} & faults(checked(folder)[1]).keys()


# ---- clouds and bags -------------------------------------------------------------------------------------------------


def ply_with_one_time(folder: Path) -> None:
    """The field of times is there, and the driver never fills it."""
    for k, xyz in enumerate(small.clouds(16)):
        table = np.column_stack([xyz, np.zeros(len(xyz))]).astype("<f4")
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(xyz)}\n"
        head += "".join(f"property float {c}\n" for c in "xyzt") + "end_header\n"
        (folder / f"scan_{k}.ply").write_bytes(head.encode() + table.tobytes())


def test_clouds_with_their_poses_pass_and_poses_the_wrong_way_round_do_not(tmp_path: Path) -> None:
    folder = small.cloud_folder(tmp_path / "a", "ply-times", table="tum", n=120, spacing=0.4)
    assert faults(checked(folder)[1]) == {}
    rows = np.loadtxt(folder / "poses.txt")
    rows[:, 4:8] = rows[:, [7, 4, 5, 6]]  # w first
    np.savetxt(folder / "poses.txt", rows, fmt="%.9f")
    code, lines = checked(folder)
    assert code == 1
    assert {"turn-disagrees", "distance-disagrees", "scans-unlike", "mounting-disagrees"} & faults(lines).keys()


def test_one_time_for_all_points_of_a_scan(tmp_path: Path) -> None:
    folder = small.cloud_folder(tmp_path / "a", "ply", table="tum", n=16)
    assert "point times of clouds: none" in faults(checked(folder)[1])["points-without-times"]
    ply_with_one_time(folder)
    code, lines = checked(folder)
    assert code == 1
    assert "same for all points" in faults(lines)["points-without-times"]


def test_a_bag_without_transforms_and_a_bag_of_packets(tmp_path: Path) -> None:
    m = Messages()
    messages = [
        ("/points", "sensor_msgs/msg/PointCloud2", t, m.cloud(t, xyz, frame="lidar"))
        for t, xyz in zip(small.stamps(), small.clouds(spacing=0.5))
    ]
    odometry = [
        ("/odom", "nav_msgs/msg/Odometry", t, m.odometry(t, pose, child="base"))
        for t, pose in zip(small.stamps(), small.poses())
    ]
    write_mcap(tmp_path / "a.mcap", [*messages, *odometry])
    assert "tf_static" in faults(checked(tmp_path / "a.mcap")[1])["mounting-unknown"]
    text = [("/velodyne_packets", "std_msgs/msg/String", t, m.text("raw")) for t in small.stamps()]
    code, lines = checked(write_mcap(tmp_path / "b.mcap", text))
    assert code == 1
    assert "no scanner in this bag" in faults(lines)["unreadable"]


def test_what_cannot_be_read_is_a_line_and_what_is_not_there_an_error(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.jpg").write_bytes(b"\xff\xd8")
    code, lines = checked(tmp_path / "photos")
    assert code == 1
    assert "images" in faults(lines)["unreadable"]
    done = CliRunner().invoke(app, ["data", "check", str(tmp_path / "nowhere")])
    assert done.exit_code != 0
