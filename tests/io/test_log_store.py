"""Logs on disk: exact round trips of every stream kind, and clear refusal of every damaged file."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graphslam.core.atomic import atomic_open, write_npz
from graphslam.core.errors import FormatError, MissingDataError
from graphslam.core.imu import Imu, ImuNoise
from graphslam.core.log import SensorLog, Truth
from graphslam.core.point_clouds import PointClouds
from graphslam.core.range_scans import RangeScans
from graphslam.core.records import (
    AckermannGeometry,
    Gps,
    LandmarkObservations,
    LaserScans,
    Odometry,
    SteeringControls,
    VelocityControls,
)
from graphslam.core.trajectory import Trajectory
from graphslam.io.log_store import load_log, save_log
from graphslam.sim.landmark_field import landmark_field_preset, simulate_landmark_field


@pytest.fixture
def full_log(rng: np.random.Generator) -> SensorLog:
    return every_kind(rng)


def every_kind(rng: np.random.Generator) -> SensorLog:
    """One stream of every kind, with awkward values: float32 ranges, nan, infinite limits, no ids, empty streams."""
    t = np.cumsum(rng.uniform(0.01, 0.3, 5))
    poses3 = np.column_stack([rng.normal(size=(5, 3)), np.tile([0, 0, 0, 1.0], (5, 1))])
    obs: dict[str, Any] = {
        "times": t,
        "offsets": [0, 2, 2, 3, 3, 4],
        "ranges": rng.uniform(1, 30, 4),
        "bearings": rng.normal(size=4),
        "sigmas": rng.uniform(0.1, 1, (4, 2)),
    }
    ranges = rng.uniform(0, 80, (5, 7)).astype(np.float32)
    ranges[2, 3] = np.nan
    bearings = np.linspace(-1.5, 1.5, 7)
    d = rng.normal(size=(7, 3))
    spinning: dict[str, Any] = {
        "times": t,
        "ranges": ranges.astype(np.float64),
        "directions": d / np.linalg.norm(d, axis=1, keepdims=True),
        "beam_times": np.sort(rng.uniform(0, 0.01, 7)),
        "max_range": 0.1 + 0.2,
        "sigma": 0.025,
    }
    noise = ImuNoise(**{f.name: float(rng.uniform(0, 1)) for f in dataclasses.fields(ImuNoise)})
    inertia: dict[str, Any] = {
        "times": t,
        "angular_rate": rng.normal(size=(5, 3)),
        "specific_force": rng.normal(size=(5, 3)),
    }
    mount = [0.1, 0.2, 0.3, *(d[0] / np.linalg.norm(d[0])), 0.0]
    car = AckermannGeometry(wheelbase=2.83, encoder_offset=0.76, model="rear-axle")
    return SensorLog(
        name="every kind ±",
        streams={
            "laser": LaserScans(
                times=t, ranges=ranges, bearings=bearings, max_range=80.0, T_base_sensor=[3.78, 0.5, 0.1]
            ),
            "controls": SteeringControls(times=t, speed=rng.normal(size=5), steering=rng.normal(size=5), geometry=car),
            "velocity": VelocityControls(times=t, speed=rng.normal(size=5), yaw_rate=rng.normal(size=5)),
            "odometry": Odometry(times=t, increments=rng.normal(size=(5, 3)), covariances=rng.normal(size=(5, 3, 3))),
            "odometry3": Odometry(times=t, increments=poses3, covariances=rng.normal(size=(5, 6, 6))),
            "gps": Gps(times=t, positions=rng.normal(size=(5, 2)), sigma=rng.uniform(1, 2, 5), lever=[1.0, 2.0]),
            "gps3": Gps(times=t, positions=rng.normal(size=(5, 3)), sigma=rng.uniform(1, 2, 5), lever=[1.0, 2.0, 3.0]),
            "trees": LandmarkObservations(**obs),
            "trees-known": LandmarkObservations(
                **obs, ids=[3, -1, 2**60, 0], max_range=30.0, field_of_view=(-1.0, 2.0), T_base_sensor=[1.0, 0.0, 0.0]
            ),
            "scanner": RangeScans(
                **{**spinning, "ranges": ranges},
                T_base_mount=mount,
                spin=rng.normal(size=5),
                spin_rate=rng.normal(size=5),
            ),
            "scanner-still": RangeScans(**spinning),
            "imu": Imu(**inertia, noise=noise, attitude=rng.normal(size=(5, 2)), T_base_imu=mount),
            "imu-blind": Imu(**inertia, noise=noise),
            "clouds": PointClouds.from_arrays(
                t, rng.normal(size=(4, 3)), [0, 0, 1, 1, 4, 4], origin=[1.0, 2.0, 3.0], T_base_sensor=mount
            ),
            "path": Trajectory(t, rng.normal(size=(5, 3)), rng.normal(size=(5, 3, 3))),
            "path3": Trajectory(t, poses3),
            "silent": Gps(times=np.zeros(0), positions=np.zeros((0, 2)), sigma=np.zeros(0), lever=[0.0, 0.0]),
        },
        truth=Truth(
            trajectory=Trajectory(t, rng.normal(size=(5, 3)), rng.normal(size=(5, 3, 3))),
            landmark_ids=np.array([3, 7]),
            landmarks=rng.normal(size=(2, 2)),
        ),
        read={"gps": 7},
        dropped={"gps: sigma is zero": 2},
        meta={"seed": 3, "noise": {"range": 0.1 + 0.2}, "list": [1, None, "ü"]},
    )


def assert_same(a: Any, b: Any, where: str = "") -> None:
    assert type(a) is type(b), where
    if dataclasses.is_dataclass(a):
        for f in dataclasses.fields(a):
            assert_same(getattr(a, f.name), getattr(b, f.name), f"{where}.{f.name}")
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype, where
        assert a.shape == b.shape, where
        assert a.tobytes() == b.tobytes(), where
    elif isinstance(a, dict):
        assert list(a) == list(b), where
        for k in a:
            assert_same(a[k], b[k], f"{where}[{k}]")
    else:
        assert a == b, where


def test_every_kind_comes_back_bit_for_bit(full_log: SensorLog, tmp_path: Path) -> None:
    assert_same(full_log, load_log(save_log(full_log, tmp_path / "log")))


def test_clouds_that_are_a_part_of_a_source_are_stored_alone(rng: np.random.Generator, tmp_path: Path) -> None:
    whole = PointClouds.from_arrays(np.arange(4.0), rng.normal(size=(10, 3)), [0, 3, 3, 8, 10])
    part = whole.take([0, 2])
    back = load_log(save_log(SensorLog(name="part", streams={"clouds": part}), tmp_path / "log"))["clouds"]
    assert [c.tobytes() for c in back] == [c.tobytes() for c in part]
    assert len(back.source.points) == 8
    assert_same(back.times, part.times)


def test_a_kind_that_cannot_be_stored_is_refused(full_log: SensorLog, tmp_path: Path) -> None:
    class Sonar(Gps):
        pass

    odd = Sonar(**{f.name: getattr(full_log["gps"], f.name) for f in dataclasses.fields(Gps)})
    with pytest.raises(FormatError, match="Sonar"):
        save_log(dataclasses.replace(full_log, streams={"odd": odd}), tmp_path / "log")


def test_a_simulated_log_comes_back_and_has_stable_bytes(tmp_path: Path) -> None:
    log = simulate_landmark_field(landmark_field_preset("quick", gps_rate=1.0), 0)
    a, b = save_log(log, tmp_path / "a"), save_log(log, tmp_path / "b")
    assert_same(log, load_log(a))
    for name in ("log.json", "controls.npz", "landmarks.npz", "gps.npz", "truth.npz"):
        assert (a / name).read_bytes() == (b / name).read_bytes()


def test_a_log_without_truth_has_none(full_log: SensorLog, tmp_path: Path) -> None:
    root = save_log(full_log, tmp_path / "log")
    save_log(dataclasses.replace(full_log, truth=None), root)  # replaces the older log
    assert load_log(root).truth is None


def test_no_log_at_all(tmp_path: Path) -> None:
    with pytest.raises(MissingDataError, match=r"log\.json"):
        load_log(tmp_path / "nothing")


def test_a_missing_stream_file_is_named(full_log: SensorLog, tmp_path: Path) -> None:
    root = save_log(full_log, tmp_path / "log")
    (root / "gps.npz").unlink()
    with pytest.raises(MissingDataError, match=r"gps\.npz"):
        load_log(root)


@pytest.mark.parametrize("name", ["laser.npz", "truth.npz"])
@pytest.mark.parametrize("keep", [0.0, 0.1, 0.5, 0.9, 0.99])
def test_truncated_archive_is_refused_and_named(name: str, keep: float, full_log: SensorLog, tmp_path: Path) -> None:
    path = save_log(full_log, tmp_path / "log") / name
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data))])
    with pytest.raises(FormatError, match=name):
        load_log(path.parent)


def test_a_flipped_byte_anywhere_is_an_error_or_harmless(full_log: SensorLog, tmp_path: Path) -> None:
    """Damage gives a FormatError, or touches only what nobody reads; never a wrong number."""
    path = save_log(full_log, tmp_path / "log") / "gps.npz"
    data = path.read_bytes()
    refused = 0
    for k in range(0, len(data), 7):
        path.write_bytes(data[:k] + bytes([data[k] ^ 0x55]) + data[k + 1 :])
        try:
            again = load_log(path.parent)
        except (FormatError, MissingDataError):
            refused += 1
        else:
            assert_same(full_log["gps"], again["gps"])
    assert refused > 0.5 * len(range(0, len(data), 7))


def test_pickled_objects_are_never_loaded(full_log: SensorLog, tmp_path: Path) -> None:
    root = save_log(full_log, tmp_path / "log")
    arrays = dict(np.load(root / "gps.npz"))
    arrays["times"] = np.array([{"evil": 1}] * 5, dtype=object)
    np.savez(root / "gps.npz", **arrays)
    with pytest.raises(FormatError, match=r"gps\.npz"):
        load_log(root)
    with pytest.raises(FormatError, match="Python objects"):
        write_npz(tmp_path / "x.npz", {"a": np.array([None])})


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda j: j.update(format="graphslam.log/2"), "unknown format"),
        (lambda j: j.pop("format"), "unknown format"),
        (lambda j: j.pop("streams"), "'streams' is missing"),
        (lambda j: j.update(meta=3), "not a mapping of meta"),
        (lambda j: j["streams"][0].update(file="../laser.npz"), "leads out"),
        (lambda j: j["streams"][0].update(file="/etc/passwd"), "leads out"),
        (lambda j: j["streams"][0].update(kind="sonar"), "unknown stream kind"),
        (lambda j: j["streams"][0].update(kind="gps"), "unknown stream kind"),
        (lambda j: j["streams"][0].update(records=4), "wrong number of records"),
        (lambda j: j["streams"].append(3), "not a mapping of streams"),
        (lambda j: j.update(truth="gps.npz"), "unknown format"),
    ],
)
def test_a_strange_index_is_refused(change: Any, what: str, full_log: SensorLog, tmp_path: Path) -> None:
    root = save_log(full_log, tmp_path / "log")
    index = json.loads((root / "log.json").read_text())
    change(index)
    (root / "log.json").write_text(json.dumps(index))
    with pytest.raises(FormatError, match=what):
        load_log(root)


@pytest.mark.parametrize("text", ["", "{", "[]", "\x00\xff", '{"format": "graphslam.log/1"'])
def test_a_broken_index_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "log.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(FormatError, match=r"log\.json"):
        load_log(tmp_path)


@pytest.mark.parametrize(
    ("array", "value", "what"),
    [
        ("times", [2.0, 1.0, 3.0, 4.0, 5.0], "does not increase"),
        ("sigma", [1.0, 0.0, 1.0, 1.0, 1.0], "not positive"),
        ("positions", np.full((5, 2), np.nan), "not finite"),
        ("positions", np.zeros((5, 2, 2)), "wrong shape"),
        ("times", ["a"] * 5, ".times. has the wrong shape or type"),
        ("lever", None, "'lever' is missing"),
    ],
)
def test_impossible_records_in_a_file_are_the_files_fault(
    array: str, value: Any, what: str, full_log: SensorLog, tmp_path: Path
) -> None:
    root = save_log(full_log, tmp_path / "log")
    arrays = dict(np.load(root / "gps.npz"))
    if value is None:
        del arrays[array]
    else:
        arrays[array] = np.asarray(value)
    write_npz(root / "gps.npz", arrays)
    with pytest.raises(FormatError, match=what) as error:
        load_log(root)
    assert "gps.npz" in str(error.value)


def test_impossible_records_of_every_further_kind(full_log: SensorLog, tmp_path: Path) -> None:
    root = save_log(full_log, tmp_path / "log")
    changes: list[tuple[str, str, Any]] = [
        ("scanner", "directions", np.zeros((7, 3))),
        ("scanner", "sigma", -1.0),
        ("scanner", "spin", np.zeros(4)),
        ("imu", "noise_gyro", -1.0),
        ("imu", "attitude", np.zeros((5, 3))),
        ("imu", "specific_force", np.full((5, 3), np.inf)),
        ("clouds", "offsets", [0, 0, 1, 1, 4, 5]),
        ("clouds", "points", np.full((4, 3), np.nan)),
        ("path", "poses", np.zeros((5, 4))),
        ("velocity", "yaw_rate", np.zeros(3)),
    ]
    for name, array, value in changes:
        path = root / f"{name}.npz"
        good = path.read_bytes()
        write_npz(path, {**dict(np.load(path)), array: np.asarray(value)})
        with pytest.raises(FormatError) as error:
            load_log(root)
        assert path.name in str(error.value), array
        path.write_bytes(good)
    assert_same(full_log, load_log(root))


@pytest.mark.parametrize("name", ["../gps", "a/b", "", "truth", ".hidden", "log.json/.."])
def test_stream_names_that_are_no_file_names_are_refused(name: str, full_log: SensorLog, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="stream name"):
        save_log(dataclasses.replace(full_log, streams={name: full_log["gps"]}), tmp_path / "log")


def test_meta_that_is_not_json_is_refused_and_leaves_no_log(full_log: SensorLog, tmp_path: Path) -> None:
    for meta in ({"a": np.zeros(3)}, {"a": float("nan")}):
        with pytest.raises(FormatError, match="JSON"):
            save_log(dataclasses.replace(full_log, meta=meta), tmp_path / "log")
        with pytest.raises(MissingDataError):
            load_log(tmp_path / "log")


def test_a_failed_write_leaves_the_old_file_and_no_rubbish(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("old")

    def write_half() -> None:
        with atomic_open(path, "w") as stream:
            stream.write("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        write_half()
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["file"]
    with atomic_open(path, "w") as stream:
        stream.write("new")
    assert path.read_text() == "new"
