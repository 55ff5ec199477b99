"""Readers of navigation recordings: EuRoC (IMU, Leica), KITTI fixes, smartLoc (pseudoranges); what is dropped."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from graphslam.core.errors import ConfigError, DataError, FormatError, MissingDataError
from graphslam.core.gnss import EARTH_RATE, SPEED_OF_LIGHT, Pseudoranges, TangentPlane
from graphslam.core.imu import Imu
from graphslam.core.poses import SE3
from graphslam.core.records import Gps
from graphslam.io.catalog import load_recording
from graphslam.io.euroc import read_euroc
from graphslam.io.log_store import load_log, save_log
from graphslam_studies.io.kitti_gps import read_kitti_gps
from graphslam_studies.io.smartloc import read_smartloc
from tests.faults import readers


def edited(path: Path, old: str, new: str, count: int = 1) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, count))


@pytest.fixture
def flight(tmp_path):
    readers.euroc(tmp_path)
    return tmp_path


@pytest.fixture
def drive(tmp_path):
    readers.kitti_gps(tmp_path)
    return tmp_path


@pytest.fixture
def city(tmp_path):
    readers.smartloc(tmp_path)
    return tmp_path


def test_a_flight_has_an_imu_and_a_prism(flight):
    log = load_recording(flight, late=0.01, noise_scale=3.0)
    imu, leica = log["imu"], log["leica"]
    assert isinstance(imu, Imu)
    assert isinstance(leica, Gps)
    np.testing.assert_allclose(imu.times, 0.005 * np.arange(40), atol=1e-6)
    np.testing.assert_allclose(imu.specific_force[0], [9.1, 0.1, -3.3])
    assert (imu.noise.gyro, imu.noise.gyro_walk) == (pytest.approx(5.1e-4), 2e-5)
    np.testing.assert_allclose(leica.lever, [0.07, -0.02, -0.12])
    np.testing.assert_allclose(leica.times, 0.05 * np.arange(4) - 0.01, atol=1e-6)


def test_what_a_flight_lacks_is_named(flight):
    with pytest.raises(ConfigError, match="noise_scale = 0"):
        read_euroc(flight, noise_scale=0.0)
    edited(flight / "imu0_sensor.yaml", "gyroscope_random_walk", "walk")
    with pytest.raises(FormatError, match=r"imu0_sensor.yaml: states no gyroscope_random_walk"):
        read_euroc(flight)
    readers.euroc(flight)
    edited(flight / "leica0_sensor.yaml", "data", "datum")
    with pytest.raises(FormatError, match="16"):
        read_euroc(flight)
    with pytest.raises(MissingDataError):
        read_euroc(flight / "nowhere")


def test_a_bad_reading_is_dropped_and_counted(flight):
    lines = (flight / "imu0_data.csv").read_text().splitlines()
    lines[5] = lines[5].rpartition(",")[0] + ",nan"
    (flight / "imu0_data.csv").write_text("\n".join(lines) + "\n")
    log = read_euroc(flight)
    assert dict(log.dropped) == {"imu: a number is not finite": 1}
    assert len(log["imu"].times) == 39
    assert log.read["imu"] == 40


def test_fixes_without_and_with_the_imu(drive):
    log = load_recording(drive)
    np.testing.assert_allclose(log["gps"].times, np.arange(20.0))
    np.testing.assert_allclose(log["gps"].positions[3], [3.5, 6.25, 0.1])
    np.testing.assert_allclose(log["imu"].specific_force[0], [0.0, 0.1, 9.8])
    np.testing.assert_allclose(log["imu"].angular_rate[0], [0.001, 0.0, 0.002])
    assert log["imu"].noise.accelerometer == 0.01
    (drive / "KittiEquivBiasedImu.txt").unlink()
    assert list(load_recording(drive).streams) == ["gps"]


def test_a_repeated_fix_is_counted_and_another_table_refused(drive):
    edited(drive / "KittiGps_converted.txt", "46537.25", "46536.25")
    assert dict(read_kitti_gps(drive).dropped) == {"gps: repeated stamp": 1}
    edited(drive / "KittiGps_converted.txt", "Time,X,Y,Z", "Time,lat,lon,h")
    with pytest.raises(FormatError, match="other columns"):
        read_kitti_gps(drive)


def test_pseudoranges_by_epoch_and_increments_of_the_odometry(city):
    log = load_recording(city)
    p, o = log["pseudoranges"], log["odometry"]
    assert isinstance(p, Pseudoranges)
    np.testing.assert_array_equal(p.offsets, np.arange(0, 61, 3))
    np.testing.assert_array_equal(p.ids[:3], [12, 112, 212])
    np.testing.assert_array_equal(p.systems[:3], [1, 1, 4])
    np.testing.assert_array_equal(p.take(slice(4, 6)).epochs, [0, 0, 0, 1, 1, 1])
    np.testing.assert_allclose(o.increments[1], SE3.exp(np.array([0, 0, -0.006 * 0.2, 5.8 * 0.2, 0, 0])))
    np.testing.assert_allclose(np.diag(o.covariances[1]), np.array([4e-6] * 3 + [0.0025, 0.0009, 0.0009]) * 0.04)
    path = log["reference"].poses
    np.testing.assert_allclose(path[0, :3], 0.0, atol=1e-6)
    assert np.linalg.norm(path[5, :3]) == pytest.approx(5.0)  # 5 m along y of the Earth


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("20000000.0 25 ", "20000000.0 -25 ", "variance is not positive"),
        ("14500000.0 2800000.0 21800000.0", "0 0 0", "satellite is not in an orbit"),
        ("12 1 8.5", "12.5 1 8.5", "no number of a satellite"),
        ("12 1 8.5 49", "12 1 98.5 49", "elevation or carrier-to-noise ratio is impossible"),
        ("112 1 8.5", "12 1 8.5", "the same satellite twice at one epoch"),
    ],
)
def test_a_bad_pseudorange_is_dropped_for_its_reason(city, old, new, reason):
    edited(city / "Berlin_Potsdamer_Platz_Input.txt", old, new)
    log = read_smartloc(city)
    assert dict(log.dropped) == {f"pseudoranges: {reason}": 1}
    assert len(log["pseudoranges"].ranges) == 59


def test_many_bad_pseudoranges_are_another_file(city):
    edited(city / "Berlin_Potsdamer_Platz_Input.txt", " 8.5 49", " 8.5 -1", 10)
    with pytest.raises(DataError, match="10 of 60 pseudoranges are unusable"):
        read_smartloc(city)
    edited(city / "Berlin_Potsdamer_Platz_Input.txt", "odom3", "odom4")
    with pytest.raises(FormatError, match="unknown record 'odom4'"):
        read_smartloc(city)


def test_the_turn_of_the_earth_while_a_signal_travels():
    """A receiver computes with a satellite in the axes of the arrival: the light's way is straight in those alone."""
    plane = TangentPlane(52.5, 13.4, 80.0)
    sent = np.array([[1.45e7, 2.8e6, 2.18e7], [-5.9e6, -9.5e6, 2.29e7]])
    flat = plane.from_ecef(sent)
    distance = np.linalg.norm(sent - plane.origin, axis=1)
    sagnac = EARTH_RATE / SPEED_OF_LIGHT * (sent[:, 0] * plane.origin[1] - sent[:, 1] * plane.origin[0])
    turned = plane.satellites(sent)
    np.testing.assert_allclose(np.linalg.norm(turned, axis=1) - distance, sagnac, atol=2e-3)
    assert np.all(np.linalg.norm(turned - flat, axis=1) > 50.0)


def test_uneven_fixes_and_pseudoranges_are_stored(tmp_path):
    log = readers.a_log()
    save_log(log, tmp_path / "log")
    back = load_log(tmp_path / "log")
    np.testing.assert_array_equal(back["uneven"].covariances, log["uneven"].covariances)
    np.testing.assert_array_equal(back["satellites"].satellites, log["satellites"].satellites)
    assert back["gps"].covariances is None


def test_covariances_of_fixes_are_checked():
    common = {"times": [0.0, 1.0], "positions": np.zeros((2, 3)), "sigma": np.ones(2), "lever": np.zeros(3)}
    for bad in (np.diag([1.0, 1.0, -1.0]), np.diag([1.0, 1.0, 0.0]), np.eye(3) + np.eye(3, k=1)):
        with pytest.raises(DataError, match="covariance of GPS record 1"):
            Gps(**common, covariances=np.stack([np.eye(3), bad]))
    even = Gps.upright(
        times=np.arange(2.0), positions=np.zeros((2, 3)), horizontal=1.0, vertical=3.0, lever=np.zeros(3)
    )
    np.testing.assert_array_equal(even.noise[0], np.diag([1.0, 1.0, 9.0]))
    np.testing.assert_array_equal(even.with_sigma(2.0).noise[1], 4.0 * np.eye(3))
    np.testing.assert_array_equal(even.take([1]).covariances, even.covariances[1:])


def test_the_recorded_sets(data_dir):
    flight, drive, city = (load_recording(n) for n in ("euroc-mh01-imu-leica", "gtsam-kitti-gps", "smartloc-gnss"))
    assert (len(flight["imu"].times), len(flight["leica"].times)) == (36820, 3099)
    assert flight.name == "euroc-mh01-imu-leica"
    assert len(drive["gps"].times) == 470
    p = city["pseudoranges"]
    assert (len(p.times), len(p.ranges), len(city["reference"].times)) == (1372, 20038, 1372)
    assert [dict(log.dropped) for log in (flight, drive, city)] == [{}, {}, {}]
    length = np.linalg.norm(np.diff(city["reference"].poses[:, :3], axis=0), axis=1).sum()
    assert length == pytest.approx(1549, abs=1)
