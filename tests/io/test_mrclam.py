"""Reader of MRCLAM: what a line means, what is dropped and counted, what is refused with file and line."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from graphslam.core.errors import ConfigError, DataError, FormatError, MissingDataError, UnknownNameError
from graphslam.core.geometry import se2_inverse, se2_transform, wrap_angle
from graphslam.core.log import DropCounter
from graphslam.io.catalog import load_recording
from graphslam.io.mrclam import read_mrclam

BARCODES = "# Subject # Barcode #\n 1 5\n 2 14\n 6 63\n 7 81\n"
LANDMARKS = "# subject x y sx sy\n 6 1.0 2.0 1e-4 1e-4\n 7 3.0 -1.0 1e-4 1e-4\n"
ODOMETRY = "# t v w\n" + "".join(f"{100 + 0.1 * k:.3f}\t 0.1 \t {0.01 * k:.3f}\n" for k in range(41))
MEASURED = "# t subject r b\n101.000 63 2.5 0.10\n101.000 81 3.5 -0.20\n101.200 63 2.4 0.12\n103.000 14 1.0 0.0\n"
PATH = "# t x y th\n" + "".join(f"{99 + 0.1 * k:.3f} {0.01 * k:.4f} 0.0 0.0\n" for k in range(60))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, text in (
        ("Barcodes.dat", BARCODES),
        ("Landmark_Groundtruth.dat", LANDMARKS),
        ("Robot2_Odometry.dat", ODOMETRY),
        ("Robot2_Measurement.dat", MEASURED),
        ("Robot2_Groundtruth.dat", PATH),
    ):
        (tmp_path / name).write_text(text)
    return tmp_path


def read(folder: Path, **options):
    return read_mrclam(folder, robot=2, **options)


def test_lines_become_controls_scans_and_truth(folder):
    log = read(folder, control_delay=0.25, range_bias=0.5, idle=np.inf)
    assert log.name.endswith("/robot2")
    c, o = log["controls"], log["landmarks"]
    assert c.times[3] == pytest.approx(100.55)
    assert (c.speed[3], c.yaw_rate[3]) == (0.1, 0.03)
    np.testing.assert_allclose(o.times, [101.0, 101.2, 103.0])
    np.testing.assert_array_equal(o.offsets, [0, 2, 3, 3])  # the last scan saw only another robot
    np.testing.assert_array_equal(o.ids, [6, 7, 6])
    np.testing.assert_allclose(o.ranges, [2.0, 3.0, 1.9])
    np.testing.assert_allclose(o.bearings, [0.1, -0.2, 0.12])
    assert log.truth is not None
    np.testing.assert_array_equal(log.truth.landmark_ids, [6, 7])
    np.testing.assert_allclose(log.truth.landmarks, [[1, 2], [3, -1]])
    assert dict(log.dropped) == {"landmarks: observations of other robots": 1}
    assert dict(log.read) == {"controls": 41, "landmarks": 4}


def test_blind_stretches_hold_empty_scans(folder):
    o = read(folder, control_delay=0.0, idle=0.5)["landmarks"]
    np.testing.assert_allclose(o.times, [101.0, 101.2, 101.7, 102.2, 102.7, 103.0, 103.5])
    np.testing.assert_array_equal(np.diff(o.offsets), [2, 1, 0, 0, 0, 0, 0])


def test_other_robots_are_a_stream_if_asked_for(folder):
    log = read(folder, robots=True)
    np.testing.assert_array_equal(log["robots"].ids, [2])
    assert log.of_type(type(log["robots"])) == "landmarks"  # a mapper takes the landmarks, never the robots
    assert not log.dropped


def test_compressed_files_and_missing_truth(folder):
    for name in ("Robot2_Odometry.dat", "Robot2_Measurement.dat"):
        text = (folder / name).read_bytes()
        (folder / name).unlink()
        (folder / f"{name}.gz").write_bytes(gzip.compress(text))
    (folder / "Robot2_Groundtruth.dat").unlink()
    log = read(folder)
    assert log.truth is None
    assert len(log["controls"].times) == 41


def edit(folder: Path, name: str, old: str, new: str) -> None:
    text = (folder / name).read_text()
    assert old in text
    (folder / name).write_text(text.replace(old, new, 1))


def test_isolated_bad_records_are_dropped_and_counted(folder):
    edit(folder, "Robot2_Odometry.dat", "100.700\t 0.1", "100.600\t 0.1")  # repeated stamp
    edit(folder, "Robot2_Odometry.dat", "101.300\t 0.1", "101.300\t nan")
    edit(folder, "Robot2_Measurement.dat", "101.200 63 2.4", "101.200 99 2.4")  # no such barcode
    edit(folder, "Robot2_Measurement.dat", "81 3.5", "81 -3.5")
    drops = DropCounter()
    log = read(folder, drops=drops)
    assert dict(drops.counts) == dict(log.dropped)
    assert dict(log.dropped) == {
        "controls: repeated stamp": 1,
        "controls: speed or turn rate is not finite": 1,
        "landmarks: unknown barcode": 1,
        "landmarks: range is not positive": 1,
        "landmarks: observations of other robots": 1,
    }
    np.testing.assert_array_equal(log["landmarks"].ids, [6])


@pytest.mark.parametrize(
    ("name", "old", "new", "what"),
    [
        (
            "Robot2_Odometry.dat",
            "100.300\t 0.1 \t 0.030",
            "100.300\t 0.1",
            r"Robot2_Odometry.dat, line 5.*got 2 values",
        ),
        ("Robot2_Odometry.dat", "0.040", "fast", r"Robot2_Odometry.dat, line 6: not a number; got 'fast'"),
        ("Robot2_Measurement.dat", "81 3.5 -0.20", "81 3.5", r"Robot2_Measurement.dat, line 3"),
        ("Robot2_Measurement.dat", "101.200 63", "101.200 63.5", r"line 4: barcode is no whole number"),
        ("Robot2_Measurement.dat", "101.200", "90.0", "out of order"),
        ("Robot2_Measurement.dat", "103.000", "1e24", "nothing was read for .* a stamp is wrong"),
        ("Barcodes.dat", "7 81", "7 63", "barcode is repeated"),
        ("Barcodes.dat", "7 81", "7 8.1", "no whole number"),
        ("Landmark_Groundtruth.dat", "3.0", "nan", r"Landmark_Groundtruth.dat, line 3"),
    ],
)
def test_bad_files_are_refused_with_file_and_line(folder, name, old, new, what):
    edit(folder, name, old, new)
    with pytest.raises(DataError, match=what):
        read(folder)


def test_what_is_asked_for_must_be_there(folder, tmp_path):
    assert read_mrclam(folder).name.endswith("/robot2")  # the only one there
    (folder / "Robot1_Odometry.dat").write_text("0 0 0\n")
    with pytest.raises(ConfigError, match=r"one log a robot, here of 1, 2: choose one, --reader-option robot=1"):
        read_mrclam(folder)
    with pytest.raises(ConfigError, match="one log a robot"):
        read_mrclam(folder, robot=6)
    with pytest.raises(ConfigError, match="wanted"):
        read(folder, range_sigma=0.0)
    with pytest.raises(MissingDataError, match=r"Robot3_Odometry\.dat"):
        read_mrclam(folder, robot=3)
    (folder / "Robot2_Measurement.dat").write_bytes(gzip.compress(MEASURED.encode())[:-9])
    with pytest.raises(FormatError, match="truncated or corrupt"):
        read(folder)
    with pytest.raises(MissingDataError, match="no such folder"):
        read_mrclam(tmp_path / "nowhere", robot=1)


@pytest.mark.data
def test_the_recording(data_dir):
    """Facts counted by hand from the files, and every identity checked against the Vicon truth."""
    log = load_recording("mrclam-dataset7/robot3")
    assert dict(log.read) == {"controls": 55085, "landmarks": 5399}
    assert log.dropped["landmarks: unknown barcode"] == 9
    assert log.dropped["landmarks: observations of other robots"] == 965
    assert log.dropped["controls: repeated stamp"] == 7
    o, truth = log["landmarks"], log.truth
    assert len(o.ranges) == 5399 - 9 - 965
    assert set(np.unique(o.ids)) == set(range(6, 21))
    scan = np.repeat(np.arange(len(o.times)), np.diff(o.offsets))
    pose = truth.trajectory.interpolate(o.times[scan])
    at = {int(i): p for i, p in zip(truth.landmark_ids, truth.landmarks)}
    q = se2_transform(se2_inverse(pose), np.array([at[int(i)] for i in o.ids]))
    bearing = wrap_angle(o.bearings - np.arctan2(q[:, 1], q[:, 0]))
    assert abs(np.median(bearing)) < 0.01
    assert np.mean(np.abs(bearing) < 0.05) > 0.98  # with column 2 taken for the subject nothing would fit
    assert abs(np.median(o.ranges - np.hypot(*q.T))) < 0.05


@pytest.mark.data
def test_parts_of_a_data_set_by_name(data_dir):
    assert load_recording("mrclam-dataset7", robot=4).name == load_recording("mrclam-dataset7/robot4").name
    with pytest.raises(UnknownNameError, match="robot1"):
        load_recording("mrclam-dataset7/robot9")
    with pytest.raises(ConfigError, match="robot1"):
        load_recording("mrclam-dataset7")
