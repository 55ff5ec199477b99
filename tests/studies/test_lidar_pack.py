"""Packs of 3-D lidar scans: what is read when, poses and stamps of three kinds, and what is refused."""

from __future__ import annotations

import io
import lzma
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from graphslam.core.errors import ConfigError, DataError, FormatError, GeometryError, MissingDataError
from graphslam.core.point_clouds import ArrayClouds, PointClouds
from graphslam.core.se3 import quat_to_matrix, se3_compose, se3_transform
from graphslam.io.catalog import load_recording
from graphslam_studies.io.lidar_pack import MISSING, read_lidar_pack

STEP = 0.004
COUNTS = [5, 0, 7, 3, 6]
N = len(COUNTS)


def npy(array: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


@pytest.fixture
def units(rng) -> np.ndarray:
    q = rng.integers(-3000, 3000, size=(3, sum(COUNTS))).astype(np.int16)
    q[1, 6] = MISSING  # the second point of scan 2
    return q


@pytest.fixture
def matrices(rng) -> np.ndarray:
    return np.concatenate(
        [Rotation.random(N, random_state=rng).as_matrix(), rng.normal(size=(N, 3, 1))], axis=2
    )  # (N, 3, 4)


@pytest.fixture
def bare(tmp_path: Path, units) -> Path:
    (tmp_path / "xyz_i16_planar.npy.xz").write_bytes(lzma.compress(npy(units)))
    (tmp_path / "scan_offsets.npy").write_bytes(npy(np.cumsum([0, *COUNTS])))
    return tmp_path


@pytest.fixture
def stamped(bare: Path, matrices) -> Path:
    np.savetxt(bare / "odom_poses.txt", matrices.reshape(N, 12))
    moved = matrices.copy()
    moved[:, :, 3] += 0.5
    np.savetxt(bare / "optimized_poses.txt", moved.reshape(N, 12))
    np.savetxt(bare / "times.txt", 100.0 + 0.5 * np.arange(N))
    return bare


@pytest.mark.parametrize("packed", [True, False])
def test_points_come_back_in_metres_and_only_when_asked_for(bare, units, packed):
    if not packed:
        (bare / "xyz_i16_planar.npy.xz").unlink()
        (bare / "xyz_i16_planar.npy").write_bytes(npy(np.asfortranarray(units)))
    log = read_lidar_pack(bare, step=STEP, period=0.1)
    clouds = log["clouds"]
    np.testing.assert_array_equal(clouds.counts, COUNTS)
    assert not clouds.source.decoded
    np.testing.assert_allclose(clouds.times, [0, 0.1, 0.2, 0.3, 0.4])
    ends = np.cumsum([0, *COUNTS])
    for k, points in enumerate(clouds):
        wanted = units[:, ends[k] : ends[k + 1]].T
        wanted = wanted[(wanted != MISSING).all(axis=1)] * STEP
        np.testing.assert_array_equal(points, wanted)
        assert points.dtype == np.float64
        assert points.flags.c_contiguous
    assert clouds.source.decoded
    assert len(clouds.cloud(2)) == COUNTS[2] - 1  # without the missing return
    assert set(log.streams) == {"clouds"}
    assert log.meta["stamps"].startswith("nominal")


def test_a_slice_of_the_log_reads_nothing_and_keeps_its_scans(bare, units):
    log = read_lidar_pack(bare, step=STEP, period=0.1)
    part = log.slice(0.15, 0.35)
    assert not part["clouds"].source.decoded
    np.testing.assert_array_equal(part["clouds"].counts, [7, 3])
    np.testing.assert_array_equal(part["clouds"].cloud(1), log["clouds"].cloud(3))
    back = log["clouds"].take(np.array([4]))
    np.testing.assert_array_equal(back.cloud(0), units[:, -6:].T * STEP)


def test_odometry_chains_to_the_poses_and_the_reference_is_the_other_file(stamped, matrices):
    log = read_lidar_pack(stamped, step=STEP, odometry_sigmas=(0.1, 0.02))
    odometry, reference = log["odometry"], log["reference"]
    pose = np.concatenate([matrices[0, :, 3], Rotation.from_matrix(matrices[0, :, :3]).as_quat()])
    for k in range(N):
        pose = se3_compose(pose, odometry.increments[k])
        np.testing.assert_allclose(quat_to_matrix(pose[3:]), matrices[k, :, :3], atol=1e-12)
        np.testing.assert_allclose(pose[:3], matrices[k, :, 3], atol=1e-12)
    np.testing.assert_allclose(odometry.covariances[2], np.diag([4e-4] * 3 + [1e-2] * 3))  # rotation first
    np.testing.assert_allclose(reference.positions, matrices[:, :, 3] + 0.5)
    assert log.truth is None  # the result of another program is no truth
    assert log.read == {"clouds": N, "odometry": N, "reference": N}


def test_poses_of_four_rows_carry_the_stamps(bare, matrices):
    rows = []
    for k, m in enumerate(matrices):
        rows += [",".join(f"{v:.9f}" for v in row) + "," for row in m] + [f"0.0,0.0,0.0,{1e9 + 0.5 * k:.6f},"]
    (bare / "alidarPose.csv").write_text("\n".join(rows) + "\n")
    log = read_lidar_pack(bare, step=STEP)
    np.testing.assert_allclose(log["clouds"].times, 1e9 + 0.5 * np.arange(N))
    np.testing.assert_allclose(log["reference"].positions, matrices[:, :, 3], atol=1e-8)
    assert "not independent" in log.meta["reference"]
    (bare / "alidarPose.csv").write_text("\n".join(rows[:-4]))
    with pytest.raises(DataError, match=r"alidarPose.csv: poses and scans differ in number; got 16; wanted 20 rows"):
        read_lidar_pack(bare, step=STEP)
    rows[3] = rows[2]
    (bare / "alidarPose.csv").write_text("\n".join(rows))
    with pytest.raises(FormatError, match="line 4: fourth row of a pose is no stamp"):
        read_lidar_pack(bare, step=STEP)


def test_unusable_scans_are_dropped_and_counted(stamped, matrices, units, monkeypatch):
    monkeypatch.setattr("graphslam_studies.io.lidar_pack.usable_records.__kwdefaults__", {"limit": 0.7})
    spoilt = matrices.copy()
    spoilt[0, 1, 3] = np.nan
    spoilt[2, :, :3] *= 1.3
    np.savetxt(stamped / "odom_poses.txt", spoilt.reshape(N, 12))
    (stamped / "times.txt").write_text("0\n1\n2\nnan\n4\n")
    log = read_lidar_pack(stamped, step=STEP)
    assert log.dropped == {
        "clouds: pose is not finite": 1,
        "clouds: pose is no rotation": 1,
        "clouds: stamp is not finite": 1,
    }
    np.testing.assert_array_equal(log["clouds"].times, [1.0, 4.0])
    np.testing.assert_array_equal(log["clouds"].cloud(1), units[:, -6:].T * STEP)
    np.testing.assert_allclose(log["reference"].positions, matrices[[1, 4], :, 3] + 0.5)
    assert len(log["odometry"].times) == 2


def test_too_many_unusable_scans_are_refused(stamped, matrices):
    matrices[1] = np.nan
    np.savetxt(stamped / "odom_poses.txt", matrices.reshape(N, 12))
    with pytest.raises(DataError, match=r"1 of 5 records are unusable.*pose is not finite"):
        read_lidar_pack(stamped, step=STEP)


def _cut(path: Path, keep: float) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * keep)])


def test_truncated_points_are_reported_when_they_are_needed(bare):
    _cut(bare / "xyz_i16_planar.npy.xz", 0.8)
    log = read_lidar_pack(bare, step=STEP, period=0.1)  # the stamps are still good
    with pytest.raises(
        FormatError, match=r"xyz_i16_planar.npy.xz: (points are|compressed data is) truncated or corrupt"
    ):
        log["clouds"].cloud(0)


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (b"", "truncated or corrupt"),
        (b"junk, and no array at all, but long enough to be one" * 4, "truncated or corrupt"),
        (lzma.compress(b"junk"), "truncated or corrupt"),
        (lzma.compress(npy(np.zeros((21, 3), np.int16))), "no planar int16"),
        (lzma.compress(npy(np.zeros((3, 21)))), "no planar int16"),
        (lzma.compress(npy(np.zeros((3, 20), np.int16))), "offsets do not match the points; got 21; wanted 20"),
    ],
)
def test_bad_points_are_refused(bare, content, what):
    (bare / "xyz_i16_planar.npy.xz").write_bytes(content)
    with pytest.raises(DataError, match=what):
        read_lidar_pack(bare, step=STEP, period=0.1)


@pytest.mark.parametrize(
    ("offsets", "what"),
    [
        (np.array([0, 5, 4, 12, 15, 21]), "offset 2 is impossible; got 4"),
        (np.array([1, 5, 5, 12, 15, 21]), "offset 0 is impossible; got 1"),
        (np.array([0.0, 21.0]), "wrong shape or type"),
        (np.zeros((2, 2), int), "wrong shape or type"),
        (np.array([0]), "holds no scan"),
        (np.array([0, {}], dtype=object), "truncated or corrupt"),  # a pickle is never read
    ],
)
def test_bad_offsets_are_refused(bare, offsets, what):
    np.save(bare / "scan_offsets.npy", offsets, allow_pickle=True)
    with pytest.raises(DataError, match=what):
        read_lidar_pack(bare, step=STEP, period=0.1)


def test_files_that_are_absent_or_do_not_match(stamped, tmp_path):
    (stamped / "times.txt").write_text("1\n2\n")
    with pytest.raises(DataError, match="stamps and scans differ in number; got 2; wanted 5"):
        read_lidar_pack(stamped, step=STEP)
    (stamped / "odom_poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(DataError, match="poses and scans differ in number; got 1; wanted 5 rows"):
        read_lidar_pack(stamped, step=STEP)
    (stamped / "odom_poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1\n")
    with pytest.raises(FormatError, match="line 1: line is truncated"):
        read_lidar_pack(stamped, step=STEP)
    (stamped / "scan_offsets.npy").unlink()
    with pytest.raises(MissingDataError, match="scan_offsets"):
        read_lidar_pack(stamped, step=STEP)
    (stamped / "xyz_i16_planar.npy.xz").unlink()
    (stamped / "scan_offsets.npy").write_bytes(npy(np.array([0, 1])))
    with pytest.raises(MissingDataError, match="xyz_i16_planar"):
        read_lidar_pack(stamped, step=STEP)
    with pytest.raises(MissingDataError, match="no such folder"):
        read_lidar_pack(tmp_path / "nowhere", step=STEP)


def test_what_the_files_do_not_say_must_be_given(bare):
    with pytest.raises(ConfigError, match="give step"):
        read_lidar_pack(bare, period=0.1)
    with pytest.raises(ConfigError, match="give period"):
        read_lidar_pack(bare, step=STEP)
    for wrong in ({"step": -1.0}, {"step": STEP, "period": np.nan}, {"step": STEP, "odometry_sigmas": (0.1, 0.0)}):
        with pytest.raises(ConfigError, match="wanted positive numbers"):
            read_lidar_pack(bare, **wrong)


def test_clouds_in_memory_are_checked(rng):
    points = rng.normal(size=(6, 3))
    clouds = PointClouds.from_arrays([0.0, 1.0], points, [0, 2, 6], origin=[0.1, 0, 0])
    np.testing.assert_array_equal(clouds.cloud(1), points[2:])
    np.testing.assert_array_equal(clouds.origin, [0.1, 0, 0])
    with pytest.raises(DataError, match="offsets do not match"):
        ArrayClouds(points, np.array([0, 5]))
    points[3, 1] = np.inf
    with pytest.raises(DataError, match="point 3 is not finite"):
        ArrayClouds(points, np.array([0, 6]))
    with pytest.raises(GeometryError, match="wrong shape"):
        ArrayClouds(points[:, :2], np.array([0, 6]))
    with pytest.raises(DataError, match="names scans"):
        PointClouds(times=[0.0], source=clouds.source, index=np.array([2]))
    with pytest.raises(GeometryError, match="origin is impossible"):
        PointClouds(times=[0.0, 1.0], source=clouds.source, origin=np.array([np.nan, 0, 0]))
    with pytest.raises(DataError, match="time does not increase"):
        PointClouds(times=[1.0, 1.0], source=clouds.source)


@pytest.mark.data
@pytest.mark.parametrize(
    ("card", "scans", "points", "seconds", "path"),
    [
        ("lidar3d-kitti-0005", 154, 9_373_416, 15.3, None),
        ("lidar3d-balm-hall", 177, 6_702_641, 88.0, 74.5),
        ("lidar3d-hku1", 314, 1_603_620, 123.9, 64.0),
        ("lidar3d-hku-mb", 457, 2_284_359, 259.4, 95.0),
    ],
)
def test_the_recordings(data_dir, card, scans, points, seconds, path):
    log = load_recording(card)
    clouds = log["clouds"]
    assert len(clouds) == scans
    assert clouds.counts.sum() == points
    assert not log.dropped
    assert log.duration == pytest.approx(seconds, abs=0.1)
    if path is None:
        assert set(log.streams) == {"clouds"}
    else:
        assert log["reference"].length() == pytest.approx(path, rel=0.02)


@pytest.mark.data
def test_poses_bring_scans_together_and_the_step_is_right(data_dir):
    """The recorded motion beats standing still, and a coordinate step off by a fifth is worse than the card's.

    A wrong step scales the scene about the sensor while the poses stay, so surfaces no longer meet; distances are
    counted in units of the scaled scene.
    """
    log = load_recording("lidar3d-hku1")
    poses, clouds = log["reference"].poses, log["clouds"]
    pairs = [(k, k + 6) for k in range(60, 240, 30)]

    def gap(scale: float, moved: bool) -> float:
        out = []
        for a, b in pairs:
            A, B = (scale * clouds.cloud(k) for k in (a, b))
            A = se3_transform(poses[a], A)
            B = se3_transform(poses[b if moved else a], B)
            out.append(np.median(cKDTree(A).query(B)[0]))
        return float(np.median(out)) / scale

    right = gap(1.0, True)
    assert right < 0.6 * gap(1.0, False)
    assert right < 0.9 * gap(1.2, True)
    assert right < 0.9 * gap(0.8, True)
