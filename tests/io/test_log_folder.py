"""Logs with the mesh they were recorded in: whole or refused."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

import graphslam as gs
from graphslam.core.errors import FormatError, GeometryError, MissingDataError
from graphslam.core.log import SensorLog
from graphslam.core.range_scans import RangeScans
from graphslam.io.log_folder import read_log_folder, read_log_mesh, write_log_folder
from graphslam.io.mesh_file import read_mesh, write_mesh
from graphslam.sim.crawler import simulate_crawler
from tests.reference.plain_mesh import hall


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
    back = read_log_folder(root)
    same(log, back)
    assert back.meta == {**log.meta, "mesh": {**log.meta["mesh"], "file": "mesh.ply"}}
    assert (back.name, back.read, back.dropped) == (log.name, log.read, log.dropped)
    vertices, triangles = read_log_mesh(root)
    assert vertices.tobytes() == mesh[0].tobytes()
    assert triangles.tobytes() == mesh[1].tobytes()
    same(log, gs.load(root))  # as any other folder
    assert {p.name for p in root.iterdir()} == {
        *("log.json", "mesh.ply", "truth.npz", "scanner.npz", "imu.npz", "wheels.npz")
    }


def test_the_same_log_gives_the_same_bytes(log: SensorLog, mesh: tuple, tmp_path: Path) -> None:
    a, b = (write_log_folder(log, tmp_path / name, mesh=mesh) for name in "ab")
    for path in a.iterdir():
        assert path.read_bytes() == (b / path.name).read_bytes()


def test_a_log_without_a_mesh_replaces_one_with(log: SensorLog, mesh: tuple, tmp_path: Path) -> None:
    root = write_log_folder(log, tmp_path / "log", mesh=mesh)
    again = read_log_folder(root)
    write_log_folder(again, root)
    assert read_log_mesh(root) is None
    assert not (root / "mesh.ply").exists()
    same(log, read_log_folder(root))


def test_what_cannot_be_written_leaves_no_log(log: SensorLog, mesh: tuple, tmp_path: Path) -> None:
    root = write_log_folder(log, tmp_path / "log", mesh=mesh)
    with pytest.raises(GeometryError, match="triangle 0 names no vertex"):
        write_log_folder(log, root, mesh=(mesh[0][:2], mesh[1]))
    with pytest.raises(MissingDataError, match=r"log\.json"):
        read_log_folder(root)
    with pytest.raises(FormatError, match="JSON"):
        write_log_folder(dataclasses.replace(log, meta={"a": float("nan")}), root, mesh=mesh)
    with pytest.raises(MissingDataError, match=r"log\.json"):
        read_log_mesh(root)


def test_a_mesh_that_is_not_the_logs_own(log: SensorLog, mesh: tuple, tmp_path: Path) -> None:
    root = write_log_folder(log, tmp_path / "log", mesh=mesh)
    write_mesh(root / "mesh.ply", mesh[0], mesh[1][:-1])
    with pytest.raises(FormatError, match="do not agree"):
        read_log_mesh(root)
    (root / "mesh.ply").unlink()
    with pytest.raises(MissingDataError, match=r"mesh\.ply"):
        read_log_mesh(root)
    index = json.loads((root / "log.json").read_text())
    index["meta"]["mesh"]["file"] = "../mesh.ply"
    (root / "log.json").write_text(json.dumps(index))
    with pytest.raises(FormatError, match="another name"):
        read_log_mesh(root)


@pytest.mark.parametrize("keep", [0.0, 0.001, 0.01, 0.5, 0.999])
def test_a_truncated_mesh_is_refused_and_named(keep: float, mesh: tuple, tmp_path: Path) -> None:
    path = tmp_path / "mesh.ply"
    write_mesh(path, *mesh)
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data))])
    with pytest.raises(FormatError, match=r"mesh\.ply"):
        read_mesh(path)
    path.write_bytes(data + b"\0")
    with pytest.raises(FormatError, match="too long"):
        read_mesh(path)


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        (b"binary_little_endian", b"binary_bigger_endian", "another kind"),
        (b"property double x", b"property float  x", "another kind"),
        (b"element vertex ", b"element vertex -", "another kind"),
        (b"ply\n", b"plx\n", "no PLY file"),
        (b"end_header\n", b"end_headed\n", "no PLY file"),
    ],
)
def test_other_meshes_are_refused(old: bytes, new: bytes, what: str, mesh: tuple, tmp_path: Path) -> None:
    path = tmp_path / "mesh.ply"
    write_mesh(path, *mesh)
    path.write_bytes(path.read_bytes().replace(old, new, 1))
    with pytest.raises(FormatError, match=what):
        read_mesh(path)


def test_impossible_meshes_in_a_file(mesh: tuple, tmp_path: Path) -> None:
    path = tmp_path / "mesh.ply"
    write_mesh(path, *mesh)
    data = path.read_bytes()
    body = data.index(b"end_header\n") + 11
    first_face = body + 24 * len(mesh[0])
    for at, new, what in (
        (body + 24, np.float64(np.nan).tobytes(), "vertex 1 of a mesh is not finite"),
        (first_face, b"\4", "face 0 is no triangle"),
        (first_face + 1, np.int32(10**6).tobytes(), "triangle 0 names no vertex"),
    ):
        path.write_bytes(data[:at] + new + data[at + len(new) :])
        with pytest.raises(FormatError, match=what):
            read_mesh(path)
    with pytest.raises(MissingDataError):
        read_mesh(tmp_path / "none.ply")


def test_streams_without_records(tmp_path: Path) -> None:
    silent = RangeScans(
        times=[], ranges=np.zeros((0, 2)), directions=np.eye(3)[:2], beam_times=[0.0, 0.0], max_range=30.0, sigma=0.1
    )
    back = read_log_folder(write_log_folder(SensorLog(name="silent", streams={"s": silent}), tmp_path / "log"))
    assert back["s"].ranges.shape == (0, 2)
