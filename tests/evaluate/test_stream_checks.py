"""Raw streams: what cannot be right is said with its figure, and sound ones are left alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.errors import DataError
from graphslam.core.imu import GRAVITY
from graphslam.core.log import SensorLog
from graphslam.core.point_clouds import ArrayClouds, PointClouds
from graphslam.core.records import LaserScans, Odometry, VelocityControls
from graphslam.evaluate.stream_checks import check_streams, refuse_faulty
from graphslam.evaluate.stream_checks_beams import check_beams
from graphslam.evaluate.stream_checks_imu import check_imu, compare_turns
from graphslam_studies.faults import scans as put
from tests.faults.grid_worlds import ring_log
from tests.reference.imu_drive import drive

ALONE = SensorLog(name="one stream", streams={})


@pytest.fixture(scope="module")
def robot() -> SensorLog:
    """Turns this way and that for 40 s, with an IMU and wheels that tell the turn."""
    d = drive(np.random.default_rng(2))
    t = d.wheels.times
    turn = np.interp(t, d.imu.times, d.imu.angular_rate[:, 2])
    wheels = VelocityControls(times=t, speed=d.wheels.speed, yaw_rate=turn)
    return SensorLog(name="robot", streams={"imu": d.imu, "wheels": wheels})


def codes(log: SensorLog) -> list[str]:
    return [n.finding.code for n in check_streams(log)]


@pytest.mark.parametrize("seed", [21, 22])
def test_sound_streams_are_left_alone(seed: int, robot: SensorLog) -> None:
    assert codes(ring_log(seed)) == []
    assert [c for c in codes(robot) if c != "imu-gravity"] == []


@pytest.mark.parametrize(
    ("inject", "code", "word"),
    [
        (put.every(np.nan), "scans-silent", "no reading"),
        (put.ranges(lambda r: 1000.0 * r), "scans-silent", "millimetres"),
        (put.ranges(lambda r: 0.001 * r), "scans-unit", "kilometres"),
        (put.every(3.0), "scans-constant", "3 m"),
        (put.twice, "scans-repeated", "100 of 200"),
        (put.stuck, "scans-repeated", "driver sends scans twice"),
        (put.blind(10.0), "scans-silent", "from 12.20 s"),
        (put.no_scan, "scans-missing", "no scans"),
        (put.speed(0.0), "wheels-still", "never moves"),
    ],
)
def test_scans_and_wheels(inject: put.Inject, code: str, word: str) -> None:
    found = [n.finding for n in check_streams(inject(ring_log(21))) if n.finding.code == code]
    assert found
    assert word in found[0].text
    assert found[0].level in ("bad", "look")


def test_imu_units_limits_and_axes(robot: SensorLog) -> None:
    imu, wheels = robot["imu"], robot["wheels"]
    # gravity belongs to a unit that stands level; the reference drive is rolled and pitched widely
    level = replace(imu, specific_force=np.tile([0.0, 0.0, GRAVITY], (len(imu.times), 1)))
    assert check_imu(level, "imu", ALONE) == []
    in_g = check_imu(replace(level, specific_force=level.specific_force / GRAVITY), "imu", ALONE)
    assert [f.code for f in in_g] == ["imu-gravity"]
    assert "in g" in in_g[0].text
    limit = 0.6 * np.abs(imu.angular_rate[:, 2]).max()
    cut = check_imu(replace(level, angular_rate=np.clip(imu.angular_rate, -limit, limit)), "imu", ALONE)
    assert {f.code for f in cut} == {"imu-saturated"}
    rows = np.arange(len(imu.times))
    rows[(imu.times > 10.0) & (imu.times < 12.0)] = int(np.searchsorted(imu.times, 10.0))
    held = replace(level, angular_rate=imu.angular_rate[rows])
    assert [f.code for f in check_imu(held, "imu", ALONE)] == ["imu-stuck"]
    degrees = compare_turns(replace(imu, angular_rate=np.rad2deg(imu.angular_rate)), wheels, "imu")
    assert "57." in degrees[0].text
    assert "degrees" in degrees[0].text
    late = compare_turns(replace(imu, times=imu.times + 0.5), wheels, "imu")
    assert "s after those of the wheels" in late[0].text
    other = compare_turns(imu, replace(wheels, yaw_rate=-wheels.yaw_rate), "imu")
    assert "swapped" in other[0].text


def test_clouds() -> None:
    rng = np.random.default_rng(4)
    points = 5.0 * rng.standard_normal((400, 3))
    offsets = np.arange(0, 401, 100)
    times = np.arange(4.0)
    assert check_beams(PointClouds(times=times, source=ArrayClouds(points, offsets)), "lidar", ALONE) == []
    again = np.concatenate([points[:100]] * 4)
    assert [
        f.code for f in check_beams(PointClouds(times=times, source=ArrayClouds(again, offsets)), "lidar", ALONE)
    ] == ["scans-repeated"]
    empty = PointClouds(times=times, source=ArrayClouds(points[:0], np.zeros(5, dtype=np.int64)))
    assert [f.code for f in check_beams(empty, "lidar", ALONE)] == ["scans-silent"]


def test_losses_and_assumptions_of_the_reader_are_lines() -> None:
    log = SensorLog(
        name="log",
        streams={},
        read={"gps": 100, "laser": 100, "clouds": 100},
        dropped={
            "gps: far from all other fixes": 1,
            "gps: no fix (status)": 60,
            "laser: angles are impossible": 9,
            "laser: stamp after the clock was set back": 40,
            "clouds: point not finite": 5000,
        },
        meta={"assumed": [("look", "field of view assumed.")], "unplaced": ["clouds"]},
    )
    found = {n.finding.code: n for n in check_streams(log)}
    assert set(found) == {"clock-set-back", "mounting-unknown", "assumed", "records-left-out"}
    assert found["clock-set-back"].finding.level == "bad"
    texts = [n.finding.text for n in check_streams(log) if n.finding.code == "records-left-out"]
    assert any("1 of 100" in t and "outliers" in t for t in texts)
    assert any("9 of 100" in t for t in texts)


def test_stamps_in_another_unit_end_the_run() -> None:
    wheels = VelocityControls(times=1e9 * 0.1 * np.arange(50), speed=np.ones(50), yaw_rate=np.zeros(50))
    log = SensorLog(name="ns", streams={"wheels": wheels})
    with pytest.raises(DataError, match=r"nanoseconds, wanted seconds"):
        refuse_faulty(check_streams(log), log)


def test_records_that_came_together_say_nothing_of_a_speed() -> None:
    """As a reader mends stamps that fall back: a tenth of the records a millisecond behind the one before."""
    times = 0.1 * np.arange(400)
    times[10::10] = times[9::10][: len(times[10::10])] + 1e-3
    increments = np.tile([0.05, 0.0, 0.05], (400, 1))
    odometry = Odometry(times=times, increments=increments, covariances=np.tile(1e-4 * np.eye(3), (400, 1, 1)))
    assert codes(SensorLog(name="late", streams={"odometry": odometry})) == []
    dense = replace(odometry, times=1e-3 * np.arange(400), increments=10 * increments)
    (found,) = check_streams(SensorLog(name="dense", streams={"odometry": dense}))
    assert (found.finding.level, found.finding.code) == ("look", "stamps-dense")  # and a map is made nevertheless


@pytest.mark.parametrize(("moved", "code", "level"), [(0.0, "pause-bridged", "look"), (400.0, "clock-jump", "bad")])
def test_a_pause_of_the_recording_that_odometry_bridges_is_no_error(moved: float, code: str, level: str) -> None:
    t = 0.2 * np.arange(200)
    t[100:] += 198.0
    motion = np.tile([0.1, 0.0, 0.01], (200, 1))
    motion[97:104] = 0.0
    motion[100, 0] = moved
    odometry = Odometry(times=t, increments=motion, covariances=np.tile(1e-4 * np.eye(3), (200, 1, 1)))
    ranges = np.random.default_rng(0).uniform(1.0, 9.0, (200, 40)).astype(np.float32)
    laser = LaserScans(times=t, ranges=ranges, bearings=np.linspace(-1.5, 1.5, 40), max_range=10.0)
    log = SensorLog(name="paused", streams={"laser": laser, "odometry": odometry})
    found = [f.finding for f in check_streams(log) if "198.2 s" in f.finding.text]
    assert {(f.code, f.level) for f in found} == {(code, level)}
    assert len(found) == (1 if moved == 0.0 else 2)
