"""CSV of odometry and detections, dialects of CARMEN, TUM and EuRoC: recognised by content, read as written."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from graphslam.core.errors import ConfigError, DataError, FormatError, MissingDataError
from graphslam.io.catalog import load_recording
from graphslam.io.readers import recognise
from tests.io import small_sources as small


def test_speeds_and_observations(tmp_path: Path) -> None:
    log = load_recording(small.tables(tmp_path / "robot"))
    t, _, w, pose = small.drive()
    np.testing.assert_allclose(log["controls"].times, t, atol=1e-9)
    np.testing.assert_allclose(log["controls"].yaw_rate, w)
    rows = small.detections(t, pose)
    z = log["landmarks"]
    np.testing.assert_allclose(z.ranges, rows[:, 2], rtol=1e-8)
    np.testing.assert_allclose(z.bearings, rows[:, 3], rtol=1e-7, atol=1e-12)
    assert z.ids is not None
    np.testing.assert_array_equal(z.ids, rows[:, 1])
    np.testing.assert_array_equal(z.offsets[1:-1], np.flatnonzero(np.diff(rows[:, 0])) + 1)


def test_poses_units_separators_comments_and_columns_in_any_order(tmp_path: Path) -> None:
    folder = tmp_path / "robot"
    folder.mkdir()
    t, _, _, pose = small.drive(8.0)
    rows = np.column_stack([np.rad2deg(pose[:, 2]), 100.0 * pose[:, :2], 1e3 * t, np.zeros(len(t))])
    head = "# made by hand\nYaw [deg]; X (cm) ;y_cm; Time [ms]; battery"
    np.savetxt(folder / "wheels.csv", rows, delimiter=";", header=head, comments="")
    seen = small.detections(t, pose)
    np.savetxt(
        folder / "tags.txt",
        np.column_stack([np.rad2deg(seen[:, 3]), seen[:, 2], seen[:, 0]]),
        delimiter="\t",
        header="bearing (deg)\tdistance\tstamp",
        comments="",
    )
    log = load_recording(folder)
    np.testing.assert_allclose(log["odometry"].times, t, atol=1e-9)
    assert np.linalg.norm(log["odometry"].increments[1:, :2], axis=1) == pytest.approx(0.05, rel=1e-3)
    assert log["landmarks"].ids is None
    np.testing.assert_allclose(log["landmarks"].bearings, seen[:, 3], atol=1e-9)


def test_ranges_alone_have_no_bearing(tmp_path: Path) -> None:
    folder = small.tables(tmp_path / "robot")
    rows = np.loadtxt(folder / "observations.csv", delimiter=",", skiprows=1)[:, :3]
    np.savetxt(folder / "observations.csv", rows, delimiter=",", header="t,id,range", comments="")
    assert not load_recording(folder)["landmarks"].has_bearing.any()


def test_records_left_out_are_counted_under_the_stream_they_were_of(tmp_path: Path) -> None:
    root = small.tables(tmp_path / "robot")
    lines = (root / "odometry.csv").read_text().splitlines()
    (root / "odometry.csv").write_text("\n".join([*lines[:30], lines[29], *lines[30:]]) + "\n")
    log = load_recording(root)
    assert log.dropped == {"controls: repeated stamp": 1}
    assert log.read["controls"] == len(log["controls"].times) + 1


def test_tables_that_lack_something_say_what(tmp_path: Path) -> None:
    folder = small.tables(tmp_path / "robot")
    (folder / "observations.csv").unlink()
    with pytest.raises(MissingDataError, match="observations"):
        recognise(folder)
    small.tables(folder)
    lines = (folder / "observations.csv").read_text().splitlines()
    (folder / "observations.csv").write_text("\n".join([lines[0], *(f"9{s}" for s in lines[1:])]))
    with pytest.raises(DataError, match="one clock"):
        load_recording(folder)
    small.tables(folder)
    with pytest.raises(ConfigError):
        load_recording(folder, range_sigma=-1.0)
    assert load_recording(folder, range_sigma=0.7)["landmarks"].sigmas[0, 0] == 0.7


def test_a_null_byte_after_the_tag_of_a_line_of_carmen_is_a_bad_line(tmp_path: Path) -> None:
    path = small.carmen(tmp_path / "robot.log", n=60)
    path.write_text(path.read_text().replace("ROBOTLASER1 ", "ROBOTLASER1\0 ", 1))
    log = load_recording(path, reader="carmen")
    assert log.dropped["laser: number of beams is impossible"] == 1
    assert len(log["laser"].times) == 59


@pytest.mark.parametrize("dialect", ["FLASER", "ROBOTLASER1", "RAWLASER1"])
def test_dialects_of_carmen_say_the_same(dialect: str, tmp_path: Path) -> None:
    log = load_recording(small.carmen(tmp_path / "robot.log", dialect))
    assert log.meta["reader"]["name"] == "carmen"
    laser, odometry = log["laser"], log["odometry"]
    n = len(laser.times)
    assert n >= 39  # a scan before the first pose, or after the last one, has none
    step = np.linalg.norm(odometry.increments[1:, :2], axis=1)
    np.testing.assert_allclose(step, 0.1, atol=1e-6)
    first = 40 - n if dialect == "RAWLASER1" else 0
    pose = np.array([0.1 * first - 2.0, 0.0, 0.01 * first])
    want = small.planar_ranges(pose, laser.bearings)
    np.testing.assert_allclose(laser.ranges[0], want, atol=2e-3)


def test_scans_of_other_beams_are_put_on_those_of_most(tmp_path: Path) -> None:
    log = load_recording(small.carmen(tmp_path / "robot.log", mixed=True))
    assert log["laser"].ranges.shape == (40, 181)
    seen = log["laser"].ranges[4]
    want = small.planar_ranges(np.array([0.4 - 2.0, 0.0, 0.04]), log["laser"].bearings)
    off = np.abs(seen - want)  # a beam is taken from up to a degree beside
    assert np.nanmedian(off) < 0.02
    assert np.nanmax(off) < 0.5
    assert any("mapped to the" in k or "other beams" in k for k in log.dropped)


def test_a_tum_table_is_odometry_and_a_file_of_any_name_will_do(tmp_path: Path) -> None:
    small.tum_table(tmp_path / "somewhere.dat")
    log = load_recording(tmp_path / "somewhere.dat")
    assert log.meta["reader"]["name"] == "tum"
    np.testing.assert_allclose(np.linalg.norm(log["odometry"].increments[1:, :2], axis=1), 0.2, atol=1e-6)


def test_euroc_in_the_layout_of_the_asl(tmp_path: Path) -> None:
    log = load_recording(small.euroc(tmp_path / "MH_01"))
    assert log.meta["reader"]["name"] == "euroc"
    assert np.diff(log["imu"].times)[0] == pytest.approx(0.005, abs=1e-6)
    np.testing.assert_allclose(log["imu"].specific_force[0], [9.81, 0.0, 0.2])
    np.testing.assert_allclose(log["reference"].poses[0], [1, 2, 3, 0, 0, 0, 1])


def test_a_named_reader_is_taken_before_what_is_recognised(tmp_path: Path) -> None:
    folder = small.cloud_folder(tmp_path / "a", "bin", table="tum", spacing=1.0)
    assert load_recording(folder).meta["reader"]["also"] == ["tum: a TUM trajectory, poses.txt"]
    log = load_recording(folder, reader="tum")
    assert set(log.streams) == {"odometry"} or "clouds" not in log


def test_names_of_landmarks_are_numbered(tmp_path: Path) -> None:
    folder = small.tables(tmp_path / "robot")
    plain = load_recording(folder)["landmarks"].ids
    rows = (folder / "observations.csv").read_text().splitlines()
    k = rows[0].replace(" ", "").lstrip("#").split(",").index("id")
    named = [r.split(",") for r in rows]
    for words in named[1:]:
        words[k] = f"tag_{float(words[k]):04.0f}"
    (folder / "observations.csv").write_text("\n".join(",".join(w) for w in named) + "\n")
    ids = load_recording(folder)["landmarks"].ids
    np.testing.assert_array_equal(ids, np.unique(plain, return_inverse=True)[1])


@pytest.mark.parametrize("stamp", ["2026-01-01T00:00:{:06.3f}Z", "{:.3f}"])
def test_dates_and_decimal_commas_are_refused_with_the_column_and_what_is_wanted(tmp_path: Path, stamp: str) -> None:
    t, _, _, pose = small.drive(8.0)
    rows = [";".join([stamp.format(a).replace(".", ","), *(f"{v:.3f}" for v in p)]) for a, p in zip(t, pose)]
    (tmp_path / "odometry.csv").write_text("t;x;y;theta\n" + "\n".join(rows) + "\n")
    (tmp_path / "observations.csv").write_text("t,id,range,bearing\n0.1,1,2.0,0.1\n")
    with pytest.raises(
        FormatError, match=r"values in the column of t are no numbers; got '.*,.*'; wanted numbers with a"
    ):
        load_recording(tmp_path)


def test_a_file_that_no_reader_knows_is_described(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("1,2,3\n4,5,6\n")
    with pytest.raises(FormatError, match=r"no reader knows this file; .* first line '1,2,3'"):
        load_recording(tmp_path / "a.csv")


def test_a_pipe_is_refused_as_what_it_is(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.bag")
    with pytest.raises(MissingDataError, match=r"neither a file nor a folder; got a pipe"):
        load_recording(tmp_path / "a.bag")
