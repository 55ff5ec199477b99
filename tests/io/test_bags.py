"""Bags of ROS 1 and 2 and MCAP: what comes out of them is what was put in, whatever is wrong beside it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from graphslam.core import se3
from graphslam.core.errors import ConfigError, DataError, MissingDataError
from graphslam.core.geometry import se2_between
from graphslam.core.records import LaserScans
from graphslam.io.catalog import load_recording
from tests.io.bag_worlds import LIVOX, Messages, write_mcap, write_ros1, write_ros2

N = 12
T0 = 1.7e9
MOUNT = np.array([0.2, 0.1, 1.0, 0.0, 0.0, np.sin(0.25), np.cos(0.25)])


def poses() -> np.ndarray:
    t = 0.1 * np.arange(N)
    return np.column_stack([t, 0.1 * t, np.zeros((N, 3)), np.sin(0.1 * t), np.cos(0.1 * t)])


def clouds() -> np.ndarray:
    return np.random.default_rng(0).uniform(-9, 9, (N, 60, 3)).round(3)


def world(m: Messages, **cloud: object) -> list:
    """A lidar with times of points, odometry, IMU, GPS and transforms; and a topic that nobody reads."""
    out = [("/tf_static", "tf2_msgs/msg/TFMessage", T0, m.transforms(T0, [
        ("base_link", "lidar", MOUNT), ("lidar", "imu", np.array([0, 0, 0.1, 0, 0, 0, 1.0])),
    ]))]  # fmt: skip
    ages = (np.arange(60) * 1_500_000).astype(np.uint32)
    for k, (pose, xyz) in enumerate(zip(poses(), clouds())):
        t = T0 + 0.1 * k
        points = np.vstack([xyz[:58], [[np.nan] * 3, [0, 0, 0]]])
        out += [
            ("/points", "sensor_msgs/msg/PointCloud2", t + 0.02, m.cloud(t, points, times=ages, **cloud)),
            ("/odom", "nav_msgs/msg/Odometry", t, m.odometry(t, pose)),
            ("/imu", "sensor_msgs/msg/Imu", t, m.imu(t, [0, 0, 0.2], [0, 0, 9.8])),
            (
                "/fix",
                "sensor_msgs/msg/NavSatFix",
                t,
                m.fix(t, (50 + 1e-5 * k, 8.0, 100.0), status=-(k == 3)),
            ),
            ("/chatter", "std_msgs/msg/String", t, m.text("hello")),
        ]
    return out


def written(folder: Path, form: str, messages: list) -> Path:
    if form.startswith("ros1"):
        return write_ros1(folder / "a.bag", messages, compress=form[5:])
    if form.startswith("mcap"):
        return write_mcap(folder / "a.mcap", messages, other=form == "mcap-json")
    folder = write_ros2(folder / "a", messages, mcap="mcap" in form, compress=form.partition(":")[2])
    return next(folder.glob("*.db3")) if form == "db3" else folder


FORMS = ["ros1", "ros1:BZ2", "ros1:LZ4", "ros2", "ros2:FILE", "ros2:MESSAGE", "ros2-mcap", "db3", "mcap", "mcap-json"]


@pytest.mark.parametrize("form", FORMS)
def test_every_form_holds_the_same(tmp_path: Path, form: str) -> None:
    path = written(tmp_path, form, world(Messages(form.startswith("ros1"))))
    log = load_recording(path)
    assert log.meta["reader"]["name"] == "ros-bag"
    assert set(log.streams) == {"clouds", "odometry", "imu", "gps"}
    c = log["clouds"]
    np.testing.assert_allclose(c.times, T0 + 0.1 * np.arange(N), atol=1e-6)
    np.testing.assert_allclose(c.cloud(5), clouds()[5, :58], atol=1e-6)
    np.testing.assert_allclose(c.ages(5), -1.5e-3 * np.arange(58), atol=1e-7)
    np.testing.assert_allclose(c.T_base_sensor, MOUNT)
    np.testing.assert_allclose(log["imu"].T_base_imu[:3], MOUNT[:3] + [0, 0, 0.1])
    np.testing.assert_allclose(log["odometry"].increments[1:, 0].sum(), 1.1, atol=0.02)
    assert len(log["gps"].times) == N - 1
    np.testing.assert_allclose(np.diff(log["gps"].positions[:, 1])[:2], 1.112, atol=0.01)
    assert log["gps"].covariances[0, 0, 0] == pytest.approx(4.0)
    assert log.dropped["clouds: point not finite"] == N
    assert log.dropped["clouds: point at the origin (no return)"] == N
    assert log.dropped["gps: no fix (status)"] == 1
    assert log.dropped["bag: /chatter (std_msgs/msg/String) of a type that is not read"] == N


@pytest.mark.parametrize(
    "change",
    [
        {"kind": ">f4"},
        {"kind": "<f8"},
        {"height": 4, "padding": 8},
        {"field": "offset_time"},
    ],
    ids=str,
)
def test_layouts_of_clouds(tmp_path: Path, change: dict) -> None:
    c = load_recording(written(tmp_path, "ros2", world(Messages(), **change)))["clouds"]
    np.testing.assert_allclose(c.cloud(2), clouds()[2, :58], atol=1e-6)
    np.testing.assert_allclose(c.ages(2), -1.5e-3 * np.arange(58), atol=1e-7)


@pytest.mark.parametrize(
    ("times", "field", "ages"),
    [
        (lambda t: np.linspace(0, 0.09, 60).astype(np.float32), "time", lambda x: -x),  # offsets [s]
        (lambda t: np.linspace(-0.09, 0, 60).astype(np.float32), "time", lambda x: -x + 0.09),  # stamped at the end
        (lambda t: t + np.linspace(0, 0.09, 60), "timestamp", lambda x: -x),  # on the clock of the stamps [s]
        (lambda t: 1e9 * (t + np.linspace(0, 0.09, 60)), "timestamp", lambda x: -x),  # the same in ns
        (lambda t: np.linspace(0, 9e4, 60).astype(np.uint32), "t", lambda x: -x),  # µs
        (lambda t: np.zeros(60, np.float32), "time", None),  # a driver that fills nothing in
    ],
)
def test_times_of_points(tmp_path: Path, times, field, ages) -> None:
    m = Messages()
    messages = [
        (
            "/p",
            "sensor_msgs/msg/PointCloud2",
            T0 + 0.1 * k,
            m.cloud(T0 + 0.1 * k, xyz, times=times(T0 + 0.1 * k), field=field),
        )
        for k, xyz in enumerate(clouds())
    ]
    c = load_recording(written(tmp_path, "ros2", messages))["clouds"]
    if ages is None:
        assert c.ages(1) is None
    else:
        np.testing.assert_allclose(c.ages(1), ages(np.linspace(0, 0.09, 60)), atol=2e-6)


@pytest.mark.parametrize("ros1", [False, True])
def test_livox(tmp_path: Path, ros1: bool) -> None:
    m = Messages(ros1)
    offsets = np.arange(60) * 1_600_000
    messages = [
        ("/livox/lidar", LIVOX, T0 + 0.1 * k, m.livox(T0 + 0.1 * k, p, offsets)) for k, p in enumerate(clouds())
    ]
    c = load_recording(written(tmp_path, "ros1" if ros1 else "ros2", messages))["clouds"]
    np.testing.assert_allclose(c.cloud(3), clouds()[3], atol=1e-6)
    np.testing.assert_allclose(c.ages(3), -1.6e-3 * np.arange(60), atol=1e-7)
    np.testing.assert_allclose(c.times, T0 + 0.1 * np.arange(N), atol=1e-6)


def laser_world(m: Messages, *, mount: np.ndarray | None = None, tf: bool = False, step: float = 0.1) -> list:
    place = np.array([0.3, 0, 0.2, 0, 0, 0, 1.0]) if mount is None else mount
    out = [("/tf_static", "tf2_msgs/msg/TFMessage", T0, m.transforms(T0, [("base_link", "laser", place)]))]
    for k, pose in enumerate(poses()):
        t = T0 + 0.1 * k
        ranges = np.arange(1.0, 21.0) + 0.01 * k
        ranges[3] = np.inf
        out.append(("/scan", "sensor_msgs/msg/LaserScan", t, m.scan(t, ranges, -10 * step, step)))
        if tf:
            out.append(("/tf", "tf2_msgs/msg/TFMessage", t, m.transforms(t, [("odom", "base_link", pose)])))
        else:
            out.append(("/odom", "nav_msgs/msg/Odometry", t, m.odometry(t, pose)))
    return out


@pytest.mark.parametrize("tf", [False, True])
def test_planar_laser(tmp_path: Path, tf: bool) -> None:
    log = load_recording(written(tmp_path, "ros2", laser_world(Messages(), tf=tf)))
    laser, odometry = log["laser"], log["odometry"]
    assert laser.ranges.shape == (N, 20)
    np.testing.assert_allclose(laser.bearings, -1.0 + 0.1 * np.arange(20), atol=1e-6)
    np.testing.assert_allclose(laser.T_base_sensor, [0.3, 0, 0])
    assert (laser.max_range, laser.ranges[0, 0], laser.ranges[0, 3]) == (30.0, 1.0, np.inf)
    flat = np.column_stack([poses()[:, :2], 0.2 * 0.1 * np.arange(N)])
    np.testing.assert_allclose(odometry.increments[1:], se2_between(flat[:-1], flat[1:]), atol=1e-9)


def test_a_laser_upside_down_and_one_that_counts_backwards(tmp_path: Path) -> None:
    down = np.array([0.3, 0, 0.2, 1.0, 0, 0, 0])  # half a turn about x
    a = load_recording(written(tmp_path, "ros2", laser_world(Messages(), mount=down)))["laser"]
    (tmp_path / "b").mkdir()
    b = load_recording(written(tmp_path / "b", "ros2", laser_world(Messages(), step=-0.1)))["laser"]
    for laser in (a, b):
        np.testing.assert_allclose(laser.bearings, -0.9 + 0.1 * np.arange(20), atol=1e-6)
        np.testing.assert_allclose(laser.ranges[0][::-1][:3], [1.0, 2.0, 3.0])
        np.testing.assert_allclose(laser.T_base_sensor, [0.3, 0, 0], atol=1e-9)


def test_times_of_beams_that_are_not_used_are_reported(tmp_path: Path) -> None:
    messages = laser_world(Messages())
    assert "time_increment" not in str(load_recording(written(tmp_path, "ros2", messages)).meta["notes"])
    for _, kind, _, message in messages:
        if kind == "sensor_msgs/msg/LaserScan":
            object.__setattr__(message, "time_increment", 0.002)
    (tmp_path / "b").mkdir()
    notes = str(load_recording(written(tmp_path / "b", "ros2", messages)).meta["notes"])
    assert "not used: time_increment of the laser (a scan lasts 0.038 s)" in notes


def test_two_lidars_of_which_one_is_chosen(tmp_path: Path) -> None:
    m = Messages()
    messages = [
        (f"/{name}/points", "sensor_msgs/msg/PointCloud2", T0 + 0.1 * k, m.cloud(T0 + 0.1 * k, xyz + shift, frame=name))
        for k, xyz in enumerate(clouds())
        for name, shift in (("front", 0.0), ("rear", 50.0))
        if name == "front" or k > 1
    ]
    path = written(tmp_path, "ros2", messages)
    log = load_recording(path)
    assert log["clouds"].cloud(0).max() < 10
    assert "clouds from /front/points (also /rear/points (10): option clouds=)" in log.meta["notes"]
    assert log.dropped["bag: /rear/points (sensor_msgs/msg/PointCloud2) not chosen"] == 10
    assert load_recording(path, clouds="/rear/points")["clouds"].cloud(0).min() > 40
    with pytest.raises(ConfigError, match=r"no topic '/side' of clouds in a; there are: /front/points, /rear/points"):
        load_recording(path, clouds="/side")


def test_a_depth_camera_is_no_lidar(tmp_path: Path) -> None:
    m = Messages()
    depth = [
        ("/camera/depth/points", "sensor_msgs/msg/PointCloud2", T0 + 0.1 * k, m.cloud(T0 + 0.1 * k, xyz))
        for k, xyz in enumerate(clouds())
    ]
    log = load_recording(written(tmp_path, "ros2", laser_world(m) + depth))
    assert isinstance(log["laser"], LaserScans)
    assert "clouds" not in log


def test_what_is_missing_is_reported_and_replaced(tmp_path: Path) -> None:
    m = Messages()
    messages = [w for w in world(m) if w[0] != "/tf_static"]
    for _, _, _, message in messages:
        if hasattr(message, "header") and hasattr(message, "point_step"):
            object.__setattr__(message, "header", m.header(0.0, "lidar"))
    log = load_recording(written(tmp_path, "ros2", messages))
    notes = " ".join(log.meta["notes"])
    assert "no transform from 'base_link' to 'lidar'" in notes
    assert "clouds has no stamps in its headers: times of the bag are used" in notes
    assert "imu left out: no transform from 'base_link' to 'imu'" in notes
    np.testing.assert_allclose(log["clouds"].times, T0 + 0.02 + 0.1 * np.arange(N), atol=1e-6)
    placed = load_recording(tmp_path / "a", mount=[0.5, 0, 0, 0, 0, np.pi / 2])["clouds"].T_base_sensor
    np.testing.assert_allclose(placed, [0.5, 0, 0, 0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-12)


def test_fixes_without_covariance_or_place(tmp_path: Path) -> None:
    m = Messages()
    fixes = []
    for k in range(N):
        place = (0.0, 0.0, 0.0) if k == 2 else (np.nan, 8.0, 1.0) if k == 4 else (50.0, 8.0, 1.0)
        fixes.append(("/fix", "sensor_msgs/msg/NavSatFix", T0 + k, m.fix(T0 + k, place, kind=0 if k == 6 else 2)))
    log = load_recording(written(tmp_path, "ros2", fixes))
    assert len(log["gps"].times) == N - 2
    assert log.dropped["gps: latitude and longitude are 0"] == 1
    assert log.dropped["gps: no place on Earth"] == 1
    assert log.dropped["gps: fix without a usable covariance: σ 5 m assumed (kept)"] == 1
    none = [(a, b, t, m.fix(t, (50.0, 8.0, 1.0), status=-1)) for a, b, t, _ in fixes]
    (tmp_path / "none").mkdir()
    with pytest.raises(DataError, match="no fix"):
        load_recording(written(tmp_path / "none", "ros2", none))


@pytest.mark.parametrize("name", ["a.bag", "a.db3", "a.mcap"])
def test_a_file_that_is_empty_or_something_else(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(b"")
    with pytest.raises(MissingDataError, match="which is empty; wanted a bag that is whole"):
        load_recording(path)
    path.write_bytes(b"something else" * 100)
    with pytest.raises(MissingDataError, match="does not begin like one"):
        load_recording(path)


def test_bags_without_a_scanner(tmp_path: Path) -> None:
    m = Messages()
    talk = [("/chatter", "std_msgs/msg/String", T0 + k, m.text("hello")) for k in range(3)]
    with pytest.raises(MissingDataError, match=r"no scanner in this bag; got 3 std_msgs/msg/String"):
        load_recording(written(tmp_path, "ros2", talk))
    (tmp_path / "two").mkdir()
    written(tmp_path / "two", "mcap", talk)
    (tmp_path / "two/a.mcap").rename(tmp_path / "two/b.mcap")
    written(tmp_path / "two", "mcap", talk)
    with pytest.raises(MissingDataError, match=r"2 bags here; got a.mcap, b.mcap; wanted one"):
        load_recording(tmp_path / "two")


def test_clouds_without_a_point(tmp_path: Path) -> None:
    m = Messages()
    empty = [("/p", "sensor_msgs/msg/PointCloud2", T0 + k, m.cloud(T0 + k, np.zeros((0, 3)))) for k in range(5)]
    with pytest.raises(DataError, match="all clouds are empty"):
        load_recording(written(tmp_path, "ros2", empty))


def test_a_message_whose_fields_do_not_fit(tmp_path: Path) -> None:
    messages = world(Messages())
    bad = [m for t, _, _, m in messages if t == "/points"][4]
    object.__setattr__(bad, "width", 10**9)
    log = load_recording(written(tmp_path, "ros2", messages))
    assert len(log["clouds"].times) == N - 1
    assert any(k.startswith("clouds: message cannot be decoded") for k in log.dropped)


def timed(times, *, every: float = 0.1, n: int = N) -> list:
    """Clouds whose 60 points have the times ``times(k)`` in a field of float64, or none where that is None."""
    m = Messages()
    return [
        (
            "/p",
            "sensor_msgs/msg/PointCloud2",
            T0 + every * k,
            m.cloud(T0 + every * k, xyz, times=times(k), field="time"),
        )
        for k, xyz in enumerate(clouds()[:n])
    ]


@pytest.mark.parametrize(
    ("unit", "every", "sweep"),
    [
        (0.1, 0.1, 0.1),  # shares of a scan
        (1e-5, 0.1, 0.1),  # ticks of 10 µs
        (1e-3, 0.1, 0.05),  # ms, of a lidar twice as fast as its messages
        (1.0, 1.0, 0.98),  # s, of a slow one
    ],
)
def test_the_unit_of_point_times_follows_from_the_spacing_of_scans(tmp_path: Path, unit, every, sweep) -> None:
    path = written(tmp_path, "ros2", timed(lambda k: np.linspace(0, sweep / unit, 60), every=every))
    log = load_recording(path)
    np.testing.assert_allclose(log["clouds"].ages(3), -np.linspace(0, sweep, 60), atol=1e-6 * sweep)
    assert log.meta["point_times"] == "used"
    assert bool(log.meta["assumed"]) == (unit not in (1.0, 1e-3))  # an unusual unit is a line of the verdict


def test_times_of_points_that_fit_no_unit_are_not_used(tmp_path: Path) -> None:
    log = load_recording(written(tmp_path, "ros2", timed(lambda k: np.linspace(0, 0.4, 60))))
    assert log["clouds"].ages(3) is None
    assert log.meta["point_times"] == "unclear"
    ((level, text),) = log.meta["assumed"]
    assert level == "look"
    assert "span 0.4: no unit fits" in text


def test_a_first_scan_that_is_cut_does_not_take_the_times_of_the_others(tmp_path: Path) -> None:
    whole = np.linspace(0, 0.09, 60)
    path = written(tmp_path, "ros2", timed(lambda k: np.zeros(60) if k == 0 else whole))
    log = load_recording(path)
    assert log["clouds"].ages(0) is None
    np.testing.assert_allclose(log["clouds"].ages(1), -whole, atol=1e-7)


def test_one_altitude_that_is_missing_costs_one_fix(tmp_path: Path) -> None:
    m = Messages()
    heights = 100.0 + np.arange(N)
    heights[4] = np.nan
    fixes = [
        ("/fix", "sensor_msgs/msg/NavSatFix", T0 + k, m.fix(T0 + k, (50.0, 8.0, h), kind=2))
        for k, h in enumerate(heights)
    ]
    log = load_recording(written(tmp_path, "ros2", fixes))
    assert log.dropped["gps: altitude is not finite"] == 1
    np.testing.assert_allclose(log["gps"].positions[:, 2], np.delete(heights, 4) - 100.0, atol=1e-6)


def test_a_first_fix_that_is_far_from_all_others_is_not_the_origin(tmp_path: Path) -> None:
    m = Messages()
    fixes = []
    for k in range(N):
        place = (50.15, 8.0, 100.0) if k == 0 else (50.0 + 1e-5 * k, 8.0, 100.0)
        fixes.append(("/fix", "sensor_msgs/msg/NavSatFix", T0 + k, m.fix(T0 + k, place, kind=2)))
    log = load_recording(written(tmp_path, "ros2", fixes))
    assert np.linalg.norm(log["gps"].positions, axis=1).max() < 20.0
    assert len(log["gps"].times) == N - 1
    assert log.dropped["gps: far from all other fixes"] == 1


def moving_world(m: Messages, parent: str, child: str, cloud_frame: str) -> list:
    """A lidar, and the way of its base as a transform; clouds in the frame of the base, or in that of the odometry."""
    out = [("/tf_static", "tf2_msgs/msg/TFMessage", T0, m.transforms(T0, [(child, "lidar", MOUNT)]))]
    for k, (pose, xyz) in enumerate(zip(poses() * [3, 3, 3, 1, 1, 1, 1], clouds())):
        t = T0 + 0.1 * k
        if cloud_frame == parent:
            xyz = se3.quat_rotate(np.tile(pose[3:], (len(xyz), 1)), xyz) + pose[:3]
        out += [
            ("/points", "sensor_msgs/msg/PointCloud2", t, m.cloud(t, xyz, frame=cloud_frame)),
            ("/tf", "tf2_msgs/msg/TFMessage", t, m.transforms(t, [(parent, child, pose)])),
        ]
    return out


def test_clouds_in_the_frame_of_the_odometry_are_brought_to_the_base(tmp_path: Path) -> None:
    log = load_recording(written(tmp_path, "ros2", moving_world(Messages(), "odom", "base_link", "odom")))
    assert log.meta["unplaced"] == []
    np.testing.assert_allclose(log["clouds"].T_base_sensor, [0, 0, 0, 0, 0, 0, 1])
    for k in (0, 5, N - 1):
        np.testing.assert_allclose(log["clouds"].cloud(k), clouds()[k], atol=1e-4)
    assert any("which moves" in n for n in log.meta["notes"])


@pytest.mark.parametrize(("parent", "child"), [("r1/odom", "r1/base_link"), ("start", "hull")])
def test_odometry_from_transforms_of_other_names(tmp_path: Path, parent: str, child: str) -> None:
    log = load_recording(written(tmp_path, "ros2", moving_world(Messages(), parent, child, "lidar")))
    length = np.linalg.norm(log["odometry"].increments[1:, :3], axis=1).sum()
    assert length == pytest.approx(0.3 * np.hypot(1, 0.1) * (N - 1), rel=1e-3)
    assert log.meta["base_frame"] == child
    np.testing.assert_allclose(log["clouds"].T_base_sensor, MOUNT, atol=1e-6)
    with pytest.raises(ConfigError, match=f"moving transforms: {parent}"):
        load_recording(tmp_path / "a", odometry="tf:nowhere")


def test_a_joint_is_no_odometry(tmp_path: Path) -> None:
    m = Messages()
    turning = []
    for k, xyz in enumerate(clouds()):
        t, a = T0 + 0.1 * k, 0.2 * k
        pose = np.array([0.1, 0, 0.5, 0, 0, np.sin(a / 2), np.cos(a / 2)])
        turning += [
            ("/points", "sensor_msgs/msg/PointCloud2", t, m.cloud(t, xyz)),
            ("/tf", "tf2_msgs/msg/TFMessage", t, m.transforms(t, [("platform", "lidar", pose)])),
        ]
    assert "odometry" not in load_recording(written(tmp_path, "ros2", turning))
