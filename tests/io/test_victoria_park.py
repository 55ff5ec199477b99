"""Reader of the Victoria Park log: the real one, and what it does with bad ones."""

from __future__ import annotations

import gzip
import time
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from graphslam.core.errors import ConfigError, DataError, FormatError, GraphSlamError, MissingDataError
from graphslam.core.geometry import align_se2, se2_transform
from graphslam.core.log import DropCounter, SensorLog
from graphslam_studies.io.victoria_park import BEARINGS, LASER_POSITION, read_victoria_park
from tests.reference.dead_reckoning import integrate

SCANS, CONTROLS, FIXES = 60, 500, 40


@pytest.fixture(scope="module")
def real(data_dir: Path) -> SensorLog:
    return read_victoria_park(data_dir / "victoria_park_raw")


class Made:
    """A small log that tests spoil before they write it."""

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self.laser = np.column_stack([0.852 + 0.213 * np.arange(SCANS), rng.uniform(1, 81.9, (SCANS, 361))])
        self.drs = np.column_stack(
            [0.973 + 0.025 * np.arange(CONTROLS), rng.uniform(0, 3, CONTROLS), np.zeros(CONTROLS)]
        )
        self.gps = np.column_stack([0.2 * np.arange(FIXES), rng.normal(size=(FIXES, 2))])

    def write(self, folder: Path, *, packed: bool = True) -> Path:
        folder.mkdir(exist_ok=True)
        texts = {
            "LASER.txt": "\t".join(f"{v:.3f}" for v in self.laser.ravel()) + "\t",
            "DRS.txt": "".join(f"{a:.3f}\t{b:6.3f}\t{c:.4f}\r\n" for a, b, c in self.drs),
            "GPS.txt": "".join(f"{a:.3f}\t{b:.2f}\t{c:.2f}\r\n" for a, b, c in self.gps),
        }
        for name, text in texts.items():
            if packed:
                (folder / f"{name}.gz").write_bytes(gzip.compress(text.encode()))
            else:
                (folder / name).write_bytes(text.encode())
        return folder


@pytest.mark.data
def test_the_real_log(real: SensorLog) -> None:
    assert real.name == "victoria-park"
    assert real.read == {"laser": 7230, "controls": 61763, "gps": 948}
    assert real.dropped == {}
    laser, controls, gps = real["laser"], real["controls"], real["gps"]
    assert (laser.times[0], laser.times[-1]) == (0.852, 1545.182)
    assert laser.ranges.shape == (7230, 361)
    np.testing.assert_array_equal(laser.ranges[0, :4], [0.83, 0.84, 0.84, 0.85])
    assert np.mean(laser.ranges >= laser.max_range) == pytest.approx(0.83, abs=0.005)
    np.testing.assert_allclose(np.diff(controls.times), 0.025, atol=1e-9)
    np.testing.assert_array_equal(laser.T_base_sensor, [3.78, 0.5, 0.0])
    assert controls.geometry.wheelbase == 2.83
    # latitude comes first in the file: x is its third column
    np.testing.assert_array_equal(gps.positions[-1], [-18.53, -11.32])
    np.testing.assert_array_equal(gps.lever, LASER_POSITION)


@pytest.mark.data
def test_reading_is_fast(data_dir: Path) -> None:
    """CPU time, so that a busy machine does not fail it."""
    start = time.process_time()
    read_victoria_park(data_dir / "victoria_park_raw")
    assert time.process_time() - start < 12.0


@pytest.mark.data
def test_mat_forms_are_the_same_log_on_the_same_clock(data_dir: Path, real: SensorLog) -> None:
    other = read_victoria_park(data_dir / "victoria_park_raw", controls="mat", gps="all", gps_sigma=2.0)
    assert other.read == {"laser": 7230, "controls": 61945, "gps": 4466}
    a, b = real["controls"], other["controls"]
    n = len(a.times)
    np.testing.assert_allclose(b.times[:n], a.times, atol=1e-9)
    np.testing.assert_allclose(b.speed[:n], a.speed, atol=6e-4)
    # two calibrations of one steering sensor, linear to rounding
    np.testing.assert_allclose(b.steering[:n], 0.94412 * a.steering - 0.002464, atol=6e-5)
    good, every = real["gps"], other["gps"]
    k = np.searchsorted(every.times, good.times - 1e-6)
    np.testing.assert_allclose(every.times[k], good.times, atol=1e-9)
    np.testing.assert_allclose(every.positions[k], good.positions, atol=0.006)
    assert set(every.sigma) == {2.0}
    assert "gps" not in read_victoria_park(data_dir / "victoria_park_raw", gps="none")


@pytest.mark.data
def test_vehicle_geometry_against_gps(real: SensorLog) -> None:
    """Dead reckoning of the laser point fits the GPS; with a = 0.95, as often printed, it does not.

    Fixes before 20 s carry a common error of up to 2.4 m against those after it, so they are left out; over all
    fixes of the first 200 s the figures are 1.54 m and 2.20 m.
    """
    gps, controls = real["gps"], real["controls"]

    def rms(a: float, b: float, start: float, end: float) -> float:
        use = (gps.times > start) & (gps.times < end)
        poses = integrate(controls, gps.times[use])
        points = se2_transform(poses, np.broadcast_to([a, b], (len(poses), 2)))
        moved = se2_transform(align_se2(points, gps.positions[use]), points)
        return float(np.sqrt(np.mean(np.sum((moved - gps.positions[use]) ** 2, axis=1))))

    a, b = LASER_POSITION
    for end in (160.0, 200.0):
        assert 0.6 < rms(a, b, 20.0, end) < 0.75
        assert 1.4 < rms(0.95, b, 20.0, end) < 2.0
    assert 0.38 < rms(a, b, 30.0, 200.0) < 0.5
    assert 1.2 < rms(0.95, b, 30.0, 200.0) < 1.5
    assert 1.4 < rms(a, b, 1.0, 200.0) < 1.7
    assert 2.0 < rms(0.95, b, 1.0, 200.0) < 2.4


@pytest.mark.parametrize("packed", [True, False])
def test_small_log_plain_and_packed(tmp_path: Path, packed: bool) -> None:
    made = Made()
    log = read_victoria_park(made.write(tmp_path / "log", packed=packed))
    assert log.dropped == {}
    np.testing.assert_allclose(log["laser"].ranges, np.round(made.laser[:, 1:], 3))
    np.testing.assert_allclose(log["gps"].positions, np.round(made.gps[:, [2, 1]], 2))
    assert log["laser"].bearings[180] == pytest.approx(0.0)
    assert BEARINGS[0] == pytest.approx(-np.pi / 2)


def test_isolated_bad_records_are_dropped_and_counted(tmp_path: Path) -> None:
    made = Made()
    made.laser[3, 5:8] = np.nan  # beams
    made.laser[4, 9] = -1.0
    made.laser[10, 0] = made.laser[9, 0]  # repeated stamp
    made.laser[20, 1:] = np.nan  # a scan without a range
    made.drs[100, 0] = 0.5  # backwards
    made.drs[101, 0] = np.nan
    made.drs[102, 1] = np.inf
    made.drs[103, 2] = 2.0
    made.drs[104, 0] = 1e7  # a jump into the future costs this record only
    made.gps[7, 2] = np.nan
    drops = DropCounter()
    log = read_victoria_park(made.write(tmp_path / "log"), drops=drops)
    assert log.dropped == {
        "laser: no range is finite and positive": 1,
        "laser: repeated stamp": 1,
        "laser beams: range is not finite or not positive": 4,
        "controls: stamp is not finite": 1,
        "controls: speed or steering is not finite": 1,
        "controls: steering is beyond 1.4 rad": 1,
        "controls: stamp out of order": 2,
        "gps: position is not finite": 1,
    }
    assert drops.counts == log.dropped
    assert log.read == {"laser": SCANS, "controls": CONTROLS, "gps": FIXES}
    assert len(log["laser"].times) == SCANS - 2
    assert len(log["controls"].times) == CONTROLS - 5
    assert np.isnan(log["laser"].ranges).sum() == 4


def spoil(folder: Path, name: str, change: object) -> None:
    path = folder / f"{name}.gz"
    path.write_bytes(gzip.compress(change(gzip.decompress(path.read_bytes()))))  # type: ignore[operator]


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("LASER.txt", lambda b: b[: len(b) // 2], r"LASER.txt.gz: \d+ values do not make whole records: truncated\?"),
        ("LASER.txt", lambda b: b.replace(b"\t", b"\tx", 1), "no number; got 'x"),
        ("LASER.txt", lambda b: b"", "0 values do not make whole records"),
        ("DRS.txt", lambda b: b[:-12], "DRS.txt.gz: .*truncated"),
        ("DRS.txt", lambda b: b[: len(b) // 2 // 21 * 21], "truncated"),
        ("GPS.txt", lambda b: b"\xff\xfe\x00" + b, "not a text file"),
    ],
)
def test_truncated_and_corrupt_files(tmp_path: Path, name: str, change: object, message: str) -> None:
    folder = Made().write(tmp_path / "log")
    spoil(folder, name, change)
    with pytest.raises(DataError, match=message):
        read_victoria_park(folder)


def test_truncated_compression_missing_file_and_folder(tmp_path: Path) -> None:
    folder = Made().write(tmp_path / "log")
    packed = folder / "LASER.txt.gz"
    packed.write_bytes(packed.read_bytes()[:-2000])
    with pytest.raises(FormatError, match="truncated or corrupt"):
        read_victoria_park(folder)
    packed.unlink()
    with pytest.raises(MissingDataError, match=r"LASER\.txt"):
        read_victoria_park(folder)
    with pytest.raises(MissingDataError, match="no such folder"):
        read_victoria_park(tmp_path / "nowhere")


def test_log_that_makes_no_sense(tmp_path: Path) -> None:
    made = Made()
    made.drs = made.drs[:100]
    with pytest.raises(DataError, match=r"controls end .* s inside the laser's time"):
        read_victoria_park(made.write(tmp_path / "short"))
    made = Made()
    made.laser[:, 1:] *= 100.0
    with pytest.raises(DataError, match="are the ranges in metres"):
        read_victoria_park(made.write(tmp_path / "centimetres"))
    made = Made()
    made.drs[:, 2] = 10.0
    with pytest.raises(DataError, match=r"500 of 500 records are unusable.*steering is beyond"):
        read_victoria_park(made.write(tmp_path / "degrees"))
    made = Made()
    made.gps[20:, 0] -= 4.9
    with pytest.raises(DataError, match=r"GPS\.txt.*clock was set back"):
        read_victoria_park(made.write(tmp_path / "backwards"))


def test_options_are_checked(tmp_path: Path) -> None:
    folder = Made().write(tmp_path / "log")
    for options in ({"gps": "some"}, {"controls": "csv"}, {"gps_sigma": 0.0}, {"gps_sigma": float("nan")}):
        with pytest.raises(ConfigError):
            read_victoria_park(folder, **options)


@pytest.mark.parametrize("content", [b"", b"not a mat file at all", None])
def test_bad_mat_files(tmp_path: Path, content: bytes | None) -> None:
    folder = Made().write(tmp_path / "log")
    path = folder / "aa3_gpsx.mat"
    if content is None:
        scipy.io.savemat(path, {"timeGps": np.arange(5.0), "La_m": np.arange(4.0), "Lo_m": "text"})
    else:
        path.write_bytes(content)
    with pytest.raises(FormatError, match="aa3_gpsx"):
        read_victoria_park(folder, gps="all")


def test_truncated_mat_files_never_crash(tmp_path: Path) -> None:
    folder = Made().write(tmp_path / "log")
    path = folder / "aa3_gpsx.mat"
    n = FIXES
    scipy.io.savemat(
        path,
        {"timeGps": 20967.0 + 200 * np.arange(n), "La_m": np.arange(n) * 1.0, "Lo_m": np.arange(n) * 1.0},
        do_compression=True,
    )
    whole = path.read_bytes()
    assert read_victoria_park(folder, gps="all").read["gps"] == n
    for cut in range(1, len(whole), 37):
        path.write_bytes(whole[:cut])
        with pytest.raises(GraphSlamError, match="aa3_gpsx"):
            read_victoria_park(folder, gps="all")
