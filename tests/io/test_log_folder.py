"""Logs with the mesh they were recorded in: whole or refused."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import graphslam as gs
from graphslam.core.errors import FormatError, GeometryError, OutputError
from graphslam.core.lock import LOCK
from graphslam.core.log import SensorLog
from graphslam.core.output_folder import LISTED
from graphslam.core.range_scans import RangeScans
from graphslam.io.log_folder import write_log_folder
from graphslam.io.log_store import load_log
from graphslam.sim.crawler import simulate_crawler
from tests.reference.plain_mesh import hall
from tests.reference.ply import read_mesh


@pytest.fixture(scope="module")
def log() -> SensorLog:
    return simulate_crawler(hall([[0, 0, 0], [4, 0, 0]]), 5)


@pytest.fixture
def mesh() -> tuple[np.ndarray, np.ndarray]:
    return hall().vertices + 1.0 / 3.0, hall().triangles


def same(a: SensorLog, b: SensorLog) -> None:
    assert list(a.streams) == list(b.streams)
    pairs = [(a[k], b[k]) for k in a.streams] + [(a.truth.trajectory, b.truth.trajectory)]
    for x, y in pairs:
        assert type(x) is type(y)
        for f in dataclasses.fields(x):
            u, v = getattr(x, f.name), getattr(y, f.name)
            if isinstance(u, np.ndarray):
                assert (u.dtype, u.shape, u.tobytes()) == (v.dtype, v.shape, v.tobytes()), f.name
            else:
                assert u == v, f.name


def test_a_crawlers_log_comes_back_bit_for_bit(log: SensorLog, mesh: tuple, tmp_path: Path) -> None:
    root = write_log_folder(log, tmp_path / "log", mesh=mesh)
    back = load_log(root)
    same(log, back)
    assert back.meta == {**log.meta, "mesh": {**log.meta["mesh"], "file": "mesh.ply"}}
    assert (back.name, back.read, back.dropped) == (log.name, log.read, log.dropped)
    vertices, triangles = read_mesh(root / "mesh.ply")
    assert vertices.tobytes() == mesh[0].tobytes()
    assert triangles.tobytes() == mesh[1].tobytes()
    same(log, gs.load(root))  # as any other folder
    assert {p.name for p in root.iterdir()} == {
        *("log.json", "mesh.ply", "truth.npz", "scanner.npz", "imu.npz", "wheels.npz", LOCK, LISTED)
    }


def test_the_same_log_gives_the_same_bytes(log: SensorLog, mesh: tuple, tmp_path: Path) -> None:
    a, b = (write_log_folder(log, tmp_path / name, mesh=mesh) for name in "ab")
    for path in a.iterdir():
        assert path.read_bytes() == (b / path.name).read_bytes()


def test_a_log_without_a_mesh_replaces_one_with(log: SensorLog, mesh: tuple, tmp_path: Path) -> None:
    root = write_log_folder(log, tmp_path / "log", mesh=mesh)
    again = load_log(root)
    write_log_folder(again, root)
    assert not (root / "mesh.ply").exists()
    same(log, load_log(root))


def test_what_cannot_be_written_leaves_the_old_log(log: SensorLog, mesh: tuple, tmp_path: Path) -> None:
    root = write_log_folder(log, tmp_path / "log", mesh=mesh)
    with pytest.raises(GeometryError, match="triangle 0 names no vertex"):
        write_log_folder(log, root, mesh=(mesh[0][:2], mesh[1]))
    same(log, load_log(root))
    with pytest.raises(FormatError, match="JSON"):
        write_log_folder(dataclasses.replace(log, meta={"a": float("nan")}), root, mesh=mesh)


def test_streams_without_records(tmp_path: Path) -> None:
    silent = RangeScans(
        times=[], ranges=np.zeros((0, 2)), directions=np.eye(3)[:2], beam_times=[0.0, 0.0], max_range=30.0, sigma=0.1
    )
    back = load_log(write_log_folder(SensorLog(name="silent", streams={"s": silent}), tmp_path / "log"))
    assert back["s"].ranges.shape == (0, 2)


def test_a_folder_with_other_files_is_refused_and_left_as_it_is(log: SensorLog, tmp_path: Path) -> None:
    """A run folder, the root of the disk or the working folder (``--out ''``) is no place for a log."""
    (tmp_path / "config.toml").write_text("seed = 1\n")
    with pytest.raises(OutputError, match=r"holds other files, such as config\.toml; wanted a new or empty folder"):
        write_log_folder(log, tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["config.toml"]
