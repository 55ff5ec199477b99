"""Reader of Plaza: which interval a record is about, ranges without bearings, truth, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy.io

from graphslam.core.errors import ConfigError, DataError, FormatError, MissingDataError
from graphslam.core.geometry import se2_between, se2_compose
from graphslam.io.catalog import load_recording
from graphslam.io.plaza import read_plaza
from graphslam_frontends.odometry.motion import MotionNoise, dead_reckoned_increments

T = 10.0 + 0.2 * np.arange(1, 31)
D, A = np.linspace(0.1, 0.4, 30), 0.02 * np.cos(np.arange(30))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    np.savetxt(tmp_path / "Plaza1_DR.txt", np.column_stack([T, D, A]))
    rows = [(11.0, 2, 5, 20.0), (11.5, 2, 0, 30.0), (11.5, 2, 1, 12.0), (11.2, 2, 6, 8.0), (16.5, 2, 1, 9.0)]
    np.savetxt(tmp_path / "Plaza1_TD.txt", rows)
    poses = np.zeros((31, 3))
    for k in range(30):
        poses[k + 1] = se2_compose(poses[k], [D[k], 0.0, A[k]])
    gt = np.column_stack([np.concatenate([[9.99], T]), poses])
    scipy.io.savemat(tmp_path / "Plaza1_.mat", {"GT": gt, "TL": np.array([[6, 1.0, 2.0], [0, 3.0, 4.0]])})
    return tmp_path


def test_a_record_is_about_the_interval_before_its_stamp(folder):
    log = read_plaza(folder)
    stamps = np.concatenate([[9.99], T])
    got, _ = dead_reckoned_increments(log, stamps, MotionNoise())
    np.testing.assert_allclose(np.hypot(*got.increments[1:, :2].T), D, rtol=1e-3)  # arc and chord
    np.testing.assert_allclose(got.increments[1:, 2], A, atol=1e-12)
    after, _ = dead_reckoned_increments(log, T[-1] + np.array([0.0, 5.0]), MotionNoise())
    np.testing.assert_array_equal(after.increments[1], 0.0)  # nothing is known to move after the last record


def test_ranges_are_sorted_grouped_and_without_bearings(folder):
    log = read_plaza(folder, range_bias=2.0, range_sigma=0.7)
    o = log["landmarks"]
    np.testing.assert_allclose(o.times, [11.0, 11.2, 11.5])
    np.testing.assert_array_equal(o.offsets, [0, 1, 2, 4])
    np.testing.assert_array_equal(o.ids, [5, 6, 0, 1])
    np.testing.assert_allclose(o.ranges, [18.0, 6.0, 28.0, 10.0])
    assert not o.has_bearing.any()
    np.testing.assert_array_equal(o.sigmas[:, 0], 0.7)
    np.testing.assert_array_equal(log.truth.landmark_ids, [0, 6])
    np.testing.assert_allclose(log.truth.landmarks, [[3, 4], [1, 2]])


@pytest.fixture
def lenient(monkeypatch):
    monkeypatch.setattr("graphslam.io.plaza.MAX_DROPPED", 0.5)


def test_bad_ranges_are_counted(folder, lenient):
    log = read_plaza(folder, range_bias=8.5)
    assert dict(log.dropped) == {
        "landmarks: stamp outside the time of the controls": 1,
        "landmarks: range is not positive": 1,
    }


def test_without_the_mat_file_there_is_no_truth(folder):
    (folder / "Plaza1_.mat").unlink()
    log = read_plaza(folder)
    assert log.truth is None
    assert log["controls"].times[0] == pytest.approx(10.0)  # one usual step before the first record


@pytest.fixture(autouse=True)
def _five_ranges_allow_one_bad(monkeypatch):
    monkeypatch.setattr("graphslam.io.plaza.MAX_DROPPED", 0.2)


@pytest.mark.parametrize(
    ("name", "text", "what"),
    [
        ("Plaza1_DR.txt", "1 2\n", "line 1: line is truncated"),
        ("Plaza1_DR.txt", "1 2 3\n", "too few records"),
        ("Plaza1_TD.txt", "11 2 5 x\n", "line 1: not a number"),
        ("Plaza1_TD.txt", "11 2 5.5 3\n", "beacon has no number"),
        ("Plaza1_TD.txt", "", "holds no range"),
        ("Plaza1_TD.txt", "11 2 5 nan\n12 2 5 3\n", "1 of 2 ranges are unusable"),
        ("Plaza1_.mat", "junk", "not a MATLAB file"),
    ],
)
def test_bad_files_are_refused(folder, name, text, what):
    (folder / name).write_text(text)
    with pytest.raises(DataError, match=what):
        read_plaza(folder)


def test_what_is_asked_for_must_be_possible(folder, tmp_path):
    with pytest.raises(ConfigError):
        read_plaza(folder, range_sigma=-1.0)
    with pytest.raises(MissingDataError, match=r"Plaza2_DR\.txt"):
        read_plaza(folder, prefix="Plaza2")
    with pytest.raises(MissingDataError):
        read_plaza(tmp_path / "nowhere")
    scipy.io.savemat(folder / "Plaza1_.mat", {"GT": np.zeros((3, 2)), "TL": np.zeros((1, 3))})
    with pytest.raises(FormatError, match="GT has the wrong shape"):
        read_plaza(folder)


@pytest.mark.parametrize("beacon", [[6, np.nan, 2.0], [6, 1.0, np.inf], [0.5, 1.0, 2.0], [1e20, 1.0, 2.0]])
def test_a_beacon_must_have_a_number_and_a_place(folder, beacon):
    gt = scipy.io.loadmat(folder / "Plaza1_.mat")["GT"]
    scipy.io.savemat(folder / "Plaza1_.mat", {"GT": gt, "TL": np.array([[0, 3.0, 4.0], beacon])})
    with pytest.raises(FormatError, match="row 1 of TL is no beacon"):
        read_plaza(folder)


@pytest.mark.data
def test_the_recording(data_dir):
    log = load_recording("plaza1")
    assert dict(log.read) == {"controls": 9657, "landmarks": 3529}
    assert not log.dropped
    assert len(log["landmarks"].ranges) == 3529
    truth = log.truth.trajectory
    got, _ = dead_reckoned_increments(log, truth.times, MotionNoise())
    u = se2_between(truth.poses[:-1], truth.poses[1:])
    # the headings of the truth are the sums of the recorded changes (the files say so by agreeing to rounding)
    np.testing.assert_allclose(got.increments[1:, 2], u[:, 2], atol=2e-6)
    assert np.corrcoef(got.increments[1:, 0], u[:, 0])[0, 1] > 0.95
    assert truth.length() == pytest.approx(1861, abs=60)
