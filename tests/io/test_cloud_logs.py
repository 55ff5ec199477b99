"""Folders of clouds and the layouts of KITTI: what is read is what was written, in every format."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from graphslam.core import se3
from graphslam.core.errors import ConfigError, DataError, FormatError, GraphSlamError, MissingDataError
from graphslam.core.geodesy import geodetic_to_ecef
from graphslam.core.gnss import TangentPlane
from graphslam.io import cloud_logs
from graphslam.io.catalog import load_recording
from graphslam.io.cloud_files import bin_columns, count_points, read_cloud
from graphslam.io.readers import recognise
from tests.io import small_sources as small

FORMATS = ("bin", "ply", "ply-ascii", "ply-times", "pcd", "pcd-ascii", "pcd-lzf", "las", "laz")


def chained(increments: np.ndarray) -> np.ndarray:
    out = increments.copy()
    for k in range(1, len(out)):
        out[k] = se3.se3_compose(out[k - 1], increments[k])
    return out


@pytest.mark.parametrize("form", FORMATS)
def test_points_come_out_as_they_were_written_in_the_order_of_their_numbers(form: str, tmp_path: Path) -> None:
    log = load_recording(small.cloud_folder(tmp_path / "a", form, spacing=1.0))
    assert log.meta["reader"]["name"] == "clouds"
    step = 1e-4 if form.startswith("la") else 1e-6
    for k, xyz in enumerate(small.clouds(spacing=1.0)):  # scan_10 is after scan_9
        np.testing.assert_allclose(log["clouds"].cloud(k), xyz, atol=step)
        (path,) = (tmp_path / "a").glob(f"scan_{k}.*")
        assert count_points(path) == len(xyz)
    np.testing.assert_allclose(np.diff(log["clouds"].times), 0.1)
    assert "odometry" not in log


def test_points_of_las_and_ply_keep_their_times(tmp_path: Path) -> None:
    las = load_recording(small.cloud_folder(tmp_path / "las", "las", table="tum", spacing=1.0))["clouds"]
    ply = load_recording(small.cloud_folder(tmp_path / "ply", "ply-times", table="tum", spacing=1.0))["clouds"]
    offset = small.point_times(las.source.counts[0] and len(las.cloud(0)))
    np.testing.assert_allclose(las.ages(3), -offset, atol=1e-6)  # GPS time on the clock of the poses
    np.testing.assert_allclose(ply.ages(3), -offset, atol=1e-6)  # seconds since the begin of the scan
    straight = load_recording(tmp_path / "ply", point_times=False)["clouds"]
    assert straight.ages(3) is None


@pytest.mark.parametrize("table", ["tum", "kitti"])
def test_poses_beside_clouds_are_the_odometry(table: str, tmp_path: Path) -> None:
    log = load_recording(small.cloud_folder(tmp_path / "a", "bin", table=table, spacing=1.0))
    truth = small.poses()
    want = se3.se3_between(np.tile(truth[0], (len(truth), 1)), truth)
    got = chained(log["odometry"].increments)
    assert np.abs(np.linalg.norm(se3.se3_between(got, want)[:, :3], axis=1)).max() < 1e-6
    assert log["clouds"].times[0] == (pytest.approx(small.T0) if table == "tum" else 0.0)
    assert "odometry" not in load_recording(tmp_path / "a", poses="none")


def test_stamps_of_a_table_of_names_and_of_an_option(tmp_path: Path) -> None:
    folder = small.cloud_folder(tmp_path / "a", "bin", spacing=1.0)
    assert np.diff(load_recording(folder, period=0.5)["clouds"].times)[0] == pytest.approx(0.5)
    np.savetxt(folder / "times.txt", 3.0 + 0.2 * np.arange(small.STEPS), fmt="%.6f")
    np.testing.assert_allclose(load_recording(folder)["clouds"].times[:2], [3.0, 3.2])
    (folder / "times.txt").unlink()
    for k in range(small.STEPS):
        (folder / f"scan_{k}.bin").rename(folder / f"{1_700_000_000_000_000_000 + k * 250_000_000}.bin")
    assert np.diff(load_recording(folder)["clouds"].times)[0] == pytest.approx(0.25)


def test_poses_that_do_not_go_with_the_clouds_are_refused_with_what_to_do(tmp_path: Path) -> None:
    folder = small.cloud_folder(tmp_path / "a", "bin", table="kitti", spacing=1.0)
    lines = (folder / "poses.txt").read_text().splitlines()
    (folder / "poses.txt").write_text("\n".join(lines[:-2]))
    with pytest.raises(DataError, match="poses=none"):
        load_recording(folder)
    small.tum_table(folder / "poses.txt")
    np.savetxt(folder / "times.txt", 5.0 + 0.1 * np.arange(small.STEPS))
    with pytest.raises(DataError, match="no time in common"):
        load_recording(folder)


def test_bad_points_are_dropped_and_counted_and_bad_files_too(tmp_path: Path) -> None:
    folder = small.cloud_folder(tmp_path / "a", "bin", n=40, spacing=1.0)
    xyz = small.clouds(40, 1.0)[3]
    small.write_bin(folder / "scan_3.bin", np.vstack([xyz, [np.nan] * 3, [0, 0, 0], [0, 0, 0]]))
    (folder / "scan_7.bin").write_bytes(b"")
    (folder / "scan_8.bin").write_bytes((folder / "scan_8.bin").read_bytes()[:-3])
    log = load_recording(folder)
    assert len(log["clouds"]) == 38
    np.testing.assert_allclose(log["clouds"].cloud(3), xyz)
    assert log.dropped == {
        "clouds: point not finite": 1,
        "clouds: point at the origin (no return)": 2,
        "clouds: file is damaged": 1,
        "clouds: no point in it": 1,
    }
    for k in range(10):
        (folder / f"scan_{k}.bin").write_bytes(b"123")
    with pytest.raises(FormatError, match="of 40 clouds are damaged"):
        load_recording(folder)


def test_a_large_folder_is_opened_without_decoding_it_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = small.cloud_folder(tmp_path / "a", "pcd", n=40, spacing=2.0)
    (folder / "scan_5.pcd").write_bytes((folder / "scan_5.pcd").read_bytes()[:-40])
    decoded = []

    def counted(path: Path, **options: int) -> object:
        decoded.append(path)
        return read_cloud(path, **options)

    monkeypatch.setattr(cloud_logs, "read_cloud", counted)
    monkeypatch.setattr(cloud_logs, "MOST_DECODED", 4)
    log = load_recording(folder)
    assert len(decoded) <= 4 + cloud_logs.LOOKED_AT
    assert log.dropped["clouds: file is damaged"] == 1  # by its header and its size
    np.testing.assert_allclose(log["clouds"].cloud(4), small.clouds(40, 2.0)[4], atol=1e-6)


def test_a_file_that_claims_more_than_it_holds(tmp_path: Path) -> None:
    for form in FORMATS:
        folder = small.cloud_folder(tmp_path / form, form, n=2, spacing=1.0)
        (path,) = folder.glob("scan_1.*")
        raw = path.read_bytes()
        path.write_bytes(raw[: len(raw) // 2 + 1])
        with pytest.raises(GraphSlamError):
            read_cloud(path)


def test_a_damaged_table_of_chunks_does_not_end_the_process(tmp_path: Path) -> None:
    folder = small.cloud_folder(tmp_path / "a", "laz", n=2, spacing=1.0)
    raw = bytearray((folder / "scan_0.laz").read_bytes())
    first = int.from_bytes(raw[96:100], "little")
    at = int.from_bytes(raw[first : first + 8], "little", signed=True)
    at = int.from_bytes(raw[-8:], "little") if at < 0 else at
    raw[at + 4 : at + 8] = b"\xff\xff\xff\x7f"
    (folder / "scan_0.laz").write_bytes(raw)
    with pytest.raises(FormatError, match="chunks"):
        read_cloud(folder / "scan_0.laz")


@pytest.mark.parametrize("at", [311, "end"])
def test_sizes_of_packed_points_are_checked_before_the_decoder_prints_a_panic(
    at: int | str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    folder = small.cloud_folder(tmp_path / "a", "laz", n=1, spacing=1.0)
    raw = bytearray((folder / "scan_0.laz").read_bytes())
    if at == "end":  # the packed table of chunks: the size of one chunk becomes negative
        raw[-5:] = b"\xff" * 5
    else:  # sizes of the items of a point
        raw[at : at + 6] = bytes(6)
    (tmp_path / "a.laz").write_bytes(raw)
    with pytest.raises(FormatError, match="LAZ is damaged"):
        read_cloud(tmp_path / "a.laz")
    assert capfd.readouterr().err == ""


def test_a_chunk_of_four_billion_points_is_refused_before_the_decoder_allocates_it(tmp_path: Path) -> None:
    folder = small.cloud_folder(tmp_path / "a", "laz", n=1, spacing=1.0)
    raw = (folder / "scan_0.laz").read_bytes()
    where = raw.index((50_000).to_bytes(4, "little"))  # points per chunk, in the header of the compression
    (tmp_path / "a.laz").write_bytes(raw[:where] + b"\xff\xff\xff\xf0" + raw[where + 4 :])
    with pytest.raises(FormatError, match="more data than is read"):
        read_cloud(tmp_path / "a.laz")


def test_a_las_file_that_claims_a_billion_records_is_refused_at_once(tmp_path: Path) -> None:
    folder = small.cloud_folder(tmp_path / "a", "las", n=2, spacing=1.0)
    raw = bytearray((folder / "scan_0.las").read_bytes())
    raw[100:104] = b"\xff\xff\xff\x3f"
    (folder / "scan_0.las").write_bytes(raw)
    with pytest.raises(FormatError, match="records"):
        read_cloud(folder / "scan_0.las")


def test_columns_of_bin_and_options_that_are_wrong(tmp_path: Path) -> None:
    folder = tmp_path / "a"
    folder.mkdir()
    for k, xyz in enumerate(small.clouds(3, 1.0)):
        np.column_stack([xyz, np.zeros((len(xyz), 2))]).astype("<f4").tofile(folder / f"{k}.bin")
    np.testing.assert_allclose(load_recording(folder, columns=5)["clouds"].cloud(1), small.clouds(3, 1.0)[1])
    for bad in ({"period": 0.0}, {"odometry_sigmas": (0.0, 0.1)}, {"colums": 5}):
        with pytest.raises(ConfigError):
            load_recording(folder, reader="clouds", **bad)


@pytest.mark.parametrize("columns", [3, 4, 5, 6])
def test_columns_of_bin_are_identified_by_content(tmp_path: Path, columns: int) -> None:
    rng = np.random.default_rng(columns)
    for k in range(6):
        n = 60 * int(rng.integers(10, 20))  # whole points for 3, 4, 5 and 6 columns
        far, beam, turn = rng.uniform(2, 20, n), rng.integers(0, 16, n), rng.uniform(-np.pi, np.pi, n)
        tilt = np.deg2rad(2.0 * beam - 15.0)
        xyz = far[:, None] * np.column_stack([np.cos(tilt) * np.cos(turn), np.cos(tilt) * np.sin(turn), np.sin(tilt)])
        more = np.column_stack([rng.uniform(0, 1, n), beam, (turn + np.pi) / 62.8])
        np.column_stack([xyz, more])[:, :columns].astype("<f4").tofile(tmp_path / f"{k}.bin")
    log = load_recording(tmp_path)
    np.testing.assert_allclose(log["clouds"].cloud(5), xyz, rtol=1e-6)
    notes = [n for n in log.meta["notes"] if "columns" in n]
    assert bool(notes) == (columns != 4)
    assert all(f"of {columns} columns" in n for n in notes)


def test_bin_files_that_say_nothing_of_their_columns_are_those_of_kitti(tmp_path: Path) -> None:
    for k in range(3):
        np.random.default_rng(k).normal(size=6000).astype("<f4").tofile(tmp_path / f"{k}.bin")
    assert bin_columns(sorted(tmp_path.iterdir())) == 4
    assert bin_columns([]) == 4


def test_kitti_odometry_brings_poses_of_the_camera_to_the_lidar(tmp_path: Path) -> None:
    log = load_recording(small.kitti_odometry(tmp_path / "00"))
    assert log.meta["reader"]["name"] == "kitti"
    truth = small.poses()
    want = se3.se3_between(np.tile(truth[0], (len(truth), 1)), truth)
    got = chained(log["odometry"].increments)
    assert np.linalg.norm(se3.se3_between(got, want)[:, :3], axis=1).max() < 1e-5
    np.testing.assert_allclose(np.diff(log["clouds"].times), 0.1)


def test_kitti_raw_has_fixes_and_imu(tmp_path: Path) -> None:
    log = load_recording(small.kitti_raw(tmp_path / "drive"))
    assert set(log.streams) == {"clouds", "gps", "imu"}
    assert log["clouds"].times[1] - log["clouds"].times[0] == pytest.approx(0.1)
    pose = small.poses()
    llh = np.column_stack([49.0 + pose[:, 1] / 111e3, 8.4 + pose[:, 0] / 73e3, 116.0 + pose[:, 2]])
    plane = TangentPlane(*llh[0].tolist())
    np.testing.assert_allclose(log["gps"].positions, plane.from_ecef(geodetic_to_ecef(llh)), atol=1e-4)
    np.testing.assert_allclose(log["imu"].angular_rate[:, 2], 0.5)


def test_what_is_nearly_a_log_says_what_is_missing(tmp_path: Path) -> None:
    folder = small.cloud_folder(tmp_path / "one", "ply", n=1, spacing=1.0)
    with pytest.raises(MissingDataError, match="one cloud is no log"):
        recognise(folder)
    for name in ("a", "b"):
        small.kitti_odometry(tmp_path / "many" / name, 3)
    with pytest.raises(MissingDataError, match="one of them"):
        recognise(tmp_path / "many")
    for name in ("x", "y"):
        small.cloud_folder(tmp_path / "two" / name, "ply", n=3, spacing=1.0)
    with pytest.raises(MissingDataError, match="one of them"):
        recognise(tmp_path / "two")


def test_names_that_are_seconds_give_order_and_stamps(tmp_path: Path) -> None:
    folder = small.cloud_folder(tmp_path / "a", "ply", n=12, spacing=2.0)
    stamps = 1700000000.0 + 0.25 * np.arange(12)
    for k, t in enumerate(stamps):  # as a program writes floats: .0, .25, .5, .75
        (folder / f"scan_{k}.ply").rename(folder / f"{t}.ply")
    log = load_recording(folder)
    np.testing.assert_allclose(log["clouds"].times, stamps)
    for k in (0, 1, 7, 11):
        np.testing.assert_allclose(log["clouds"].cloud(k), small.clouds(12, 2.0)[k], atol=1e-6)


def test_a_table_of_stamps_and_matrices_is_a_table_of_poses(tmp_path: Path) -> None:
    folder = small.cloud_folder(tmp_path / "a", "bin", n=12, spacing=2.0)
    stamps = 1_700_000_000_000_000_000 + 100_000_000 * np.arange(12)
    M = np.concatenate([se3.quat_to_matrix(small.poses(12)[:, 3:]), small.poses(12)[:, :3, None]], axis=2)
    rows = [f"{t}," + ",".join(f"{v:.9f}" for v in m.reshape(-1)) for t, m in zip(stamps, M)]
    (folder / "global_pose.csv").write_text("\n".join(rows) + "\n")
    for k, t in enumerate(stamps):
        (folder / f"scan_{k}.bin").rename(folder / f"{t}.bin")
    log = load_recording(folder)
    np.testing.assert_allclose(log["reference"].poses, small.poses(12), atol=1e-6)
    assert any("global_pose.csv" in text for _, text in log.meta["assumed"])
    (folder / "other.csv").write_text("\n".join("1 2 3 4 5 6 7 8 9 10" for _ in range(5)) + "\n")
    assert ("look", "other.csv is not read: a table of 10 columns, of no known kind.") in load_recording(folder).meta[
        "assumed"
    ]


def test_scans_that_are_cut_at_the_ends_are_left_out(tmp_path: Path) -> None:
    folder = small.cloud_folder(tmp_path / "a", "bin", n=12, spacing=2.0)
    for k in (0, 5, 11):
        small.write_bin(folder / f"scan_{k}.bin", small.clouds(12, 2.0)[k][:3])
    log = load_recording(folder)
    assert len(log["clouds"]) == 10  # the small one in the middle may be a wall that is near
    assert sum(n for k, n in log.dropped.items() if "scan is cut" in k) == 2


def test_kitti_poses_without_tr_are_identified_by_the_direction_of_motion(tmp_path: Path) -> None:
    folder = small.kitti_odometry(tmp_path / "00")
    whole = load_recording(folder)["reference"]
    (folder / "calib.txt").write_text("P0: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    log = load_recording(folder)
    (level, text), *_ = [row for row in log.meta["assumed"] if "Tr" in row[1]]
    assert level == "look"
    assert "those of a camera" in text
    turned = [se3.quat_to_matrix(p[3:][None])[0] for p in (whole.poses[-1], log["reference"].poses[-1])]
    angle = np.arccos(np.clip((np.trace(turned[0].T @ turned[1]) - 1) / 2, -1, 1))
    assert angle < 0.05  # without the axes of the camera: 120 degrees
