"""Archives that are damaged or lie are refused with clear words, and cost nothing."""

from __future__ import annotations

import contextlib
import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graphslam.core.errors import FormatError, MissingDataError
from graphslam.evidence.formats import load_npz
from graphslam.evidence.layout import UNKNOWN
from graphslam.evidence.pool import GridPool
from tests.reference.evidence_maps import cube, grid_of_map, map_of_grid


@pytest.fixture
def archive(tmp_path: Path) -> dict[str, np.ndarray]:
    """Arrays of a good file: a brick, a cube of 32³ and one of 8³."""
    grid_of_map(cube((0, 0, 0), 32, 9) | cube((40, 40, 40), 8, -3) | {(-1, 0, 0): 2}).save(tmp_path / "good.npz")
    with np.load(tmp_path / "good.npz") as good:
        return {name: good[name] for name in good.files}


def i32(*rows: Any) -> np.ndarray:
    return np.array(rows, np.int32)


CHANGES: dict[str, tuple[dict[str, Any], str]] = {
    "another format": ({"format": "graphslam.evidence/2"}, r"unknown format; got 'graphslam.evidence/2'"),
    "no model": ({"model": None}, "array 'model' is missing"),
    "no values": ({"values": None}, "array 'values' is missing"),
    "model of four": ({"model": np.ones(4)}, r"'model' has the wrong shape or type; got \(4,\) float64; wanted \(5,\)"),
    "model NaN": ({"model": np.full(5, np.nan)}, "array 'model' is impossible"),
    "model of hits that free": ({"model": np.array([0.4, 0.4, 0.1, 0.9, 0.5])}, "array 'model' is impossible"),
    "voxel size 0": ({"voxel_size": np.float64(0)}, "voxel size is impossible; got 0.0"),
    "voxel size inf": ({"voxel_size": np.float64(np.inf)}, "voxel size is impossible"),
    "voxel size large": ({"voxel_size": np.float64(1e300)}, "voxel size is impossible"),
    "voxel size text": ({"voxel_size": "0.1"}, "'voxel_size' has the wrong shape or type"),
    "dimension 4": ({"dim": np.int64(4)}, "dimension is impossible; got 4"),
    "dimension 2": ({"dim": np.int64(2)}, "2-D grid has voxels beside the layer"),
    "levels 9": ({"levels": np.int64(9)}, "number of levels is impossible; got 9"),
    "levels too few": (
        {"levels": np.int64(2), "bricks": i32([-9, 0, 0])},
        "72 from the origin do not fit the 2 levels",
    ),
    "levels negative": ({"levels": np.int64(-1)}, "number of levels is impossible"),
    "bricks flat": ({"bricks": i32(1, 2, 3)}, "'bricks' has the wrong shape"),
    "bricks float": ({"bricks": np.zeros((1, 3))}, r"'bricks' .* got \(1, 3\) float64"),
    "bricks more than values": ({"bricks": i32([0, 0, 9], [1, 0, 9])}, r"'values' .* wanted \(2, 512\) int16"),
    "brick far": ({"bricks": i32([2**31 - 1, 0, 0])}, "do not fit"),
    "brick far below": ({"bricks": i32([0, -(2**31), 0])}, "do not fit"),
    "brick unknown": ({"values": np.full((1, 512), UNKNOWN, np.int16)}, "unknown voxels is listed"),
    "brick in a cube": ({"bricks": i32([3, 3, 3])}, "a cube overlaps another piece"),
    "brick twice": ({"bricks": i32([9, 0, 0], [9, 0, 0]), "values": np.ones((2, 512), np.int16)}, "not in ascending"),
    "cubes unordered": ({"cubes": i32([5, 5, 5], [0, 0, 0])}, "cubes are not in ascending order"),
    "cube in a cube": ({"cubes": i32([0, 0, 0], [1, 1, 1])}, "a cube overlaps another piece"),
    "cube askew": ({"cubes": i32([0, 0, 1], [5, 5, 5])}, "does not begin at a multiple of its edge"),
    "cube too small": ({"cube_log_edges": np.array([2, 3], np.uint8)}, "edge of a cube is impossible"),
    "cube too large": ({"cube_log_edges": np.array([255, 3], np.uint8)}, "edge of a cube is impossible"),
    "cube beyond": ({"cube_log_edges": np.array([13, 3], np.uint8)}, "8192 from the origin do not fit the 5 levels"),
    "cube unknown": ({"cube_values": np.array([5, UNKNOWN], np.int16)}, "unknown voxels is listed"),
    "cube values short": ({"cube_values": np.array([5], np.int16)}, r"'cube_values' .* wanted \(2,\) int16"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_every_field_is_checked(archive: dict[str, np.ndarray], tmp_path: Path, name: str) -> None:
    change, message = CHANGES[name]
    path = tmp_path / "bad.npz"
    np.savez_compressed(path, **{k: v for k, v in {**archive, **change}.items() if v is not None})
    pool = GridPool()
    with pytest.raises(FormatError, match=message) as caught:
        load_npz(path, pool=pool)
    assert str(path) in str(caught.value)
    assert pool.used_nodes == pool.used_bricks == 0
    np.savez_compressed(path, **archive)  # and without the change it is read
    assert len(map_of_grid(load_npz(path, pool=pool))) == 32**3 + 512 + 1


def test_truncated_and_damaged_archives_are_refused(rng: np.random.Generator, tmp_path: Path) -> None:
    path = tmp_path / "bad.npz"
    grid_of_map({(0, 0, 0): 1}).save(path)
    data = path.read_bytes()
    for n in range(0, len(data), 37):
        path.write_bytes(data[:n])
        with pytest.raises(FormatError):
            load_npz(path)
    for _ in range(100):
        damaged = bytearray(data)
        damaged[rng.integers(len(data))] ^= 1 << rng.integers(8)
        path.write_bytes(damaged)
        with contextlib.suppress(FormatError):
            assert map_of_grid(load_npz(path)) == {(0, 0, 0): 1}  # a date or a comment of the archive
    with pytest.raises(MissingDataError):
        load_npz(tmp_path / "none.npz")
    np.save(tmp_path / "array.npy", np.zeros(3))
    with pytest.raises(FormatError):
        load_npz(tmp_path / "array.npy")


def npy(header: str, body: bytes) -> bytes:
    text = header.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + body


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("{'descr': '<i2', 'fortran_order': False, 'shape': (99999999999, 512), }", r"values\.npy has the shape"),
        ("{'descr': '<i2', 'fortran_order': False, 'shape': (-1, 512), }", "corrupt"),
        ("{'descr': '|O', 'fortran_order': False, 'shape': (1, 512), }", "corrupt"),
        ("__import__('os').abort()", "corrupt"),
    ],
)
def test_headers_that_lie_cost_nothing(
    archive: dict[str, np.ndarray], tmp_path: Path, header: str, message: str
) -> None:
    path = tmp_path / "bad.npz"
    with zipfile.ZipFile(path, "w") as out:
        for name, value in archive.items():
            stream = io.BytesIO()
            np.save(stream, value)
            out.writestr(f"{name}.npy", stream.getvalue() if name != "values" else npy(header, b"\0" * 1024))
    with pytest.raises(FormatError, match=message):
        load_npz(path)


def test_an_archive_that_claims_more_than_it_can_hold_is_refused(
    archive: dict[str, np.ndarray], tmp_path: Path
) -> None:
    path = tmp_path / "bad.npz"
    np.savez_compressed(path, **archive)
    data = bytearray(path.read_bytes())
    entries = [k for k in range(len(data)) if data[k : k + 4] == b"PK\1\2"]  # of the central directory
    at = next(k for k in entries if data[k + 46 : k + 56] == b"values.npy")
    data[at + 24 : at + 28] = (2**32 - 2).to_bytes(4, "little")  # uncompressed size
    path.write_bytes(data)
    with pytest.raises(FormatError, match="claims 4294967294 bytes"):
        load_npz(path)
