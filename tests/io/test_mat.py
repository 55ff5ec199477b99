"""MATLAB files: what SciPy writes is read, and what claims too much is refused before memory is taken for it."""

from __future__ import annotations

import struct
import tracemalloc
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io

from graphslam.core.errors import FormatError, MissingDataError
from graphslam.core.reading import size_limit
from graphslam_studies.io.mat import read_mat

HEAD = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H2s", 0x0100, b"IM")


def element(kind: int, body: bytes, size: int | None = None) -> bytes:
    return struct.pack("<II", kind, len(body) if size is None else size) + body + bytes(-len(body) % 8)


def matrix(shape: tuple[int, ...], numbers: bytes, *, of: int = 6, kind: int = 9) -> bytes:
    """One array named ``a``."""
    parts = element(6, struct.pack("<II", of, 0)) + element(5, struct.pack(f"<{len(shape)}i", *shape))
    return element(14, parts + element(1, b"a") + element(kind, numbers))


def packed(data: bytes) -> bytes:
    inner = zlib.compress(data)
    return struct.pack("<II", 15, len(inner)) + inner


@pytest.mark.parametrize("packing", [False, True])
@pytest.mark.parametrize(
    "a",
    [
        *(np.arange(6.0).reshape(2, 3), np.array([[np.nan, np.inf, -1.5]]), np.zeros((0, 3)), np.ones((2, 3, 4), "f4")),
        *(np.arange(256, dtype="u1"), np.array([[-(2**40), 2**62]]), np.array([[7]], dtype=np.int16)),
    ],
)
def test_arrays_come_back_as_scipy_writes_them(a: np.ndarray, packing: bool, tmp_path: Path) -> None:
    content: dict[str, Any] = {"before": "text", "a": a, "after": np.eye(2)}
    scipy.io.savemat(tmp_path / "a.mat", content, do_compression=packing)
    after, found = read_mat(tmp_path / "a.mat", "after", "a")
    np.testing.assert_array_equal(found, scipy.io.loadmat(tmp_path / "a.mat")["a"])
    np.testing.assert_array_equal(after, np.eye(2))
    assert found.dtype == np.float64


def test_the_other_byte_order(tmp_path: Path) -> None:
    parts = struct.pack(">IIII", 6, 8, 6, 0) + struct.pack(">IIii", 5, 8, 1, 2) + struct.pack(">HHc3x", 1, 1, b"a")
    parts += struct.pack(">IIdd", 9, 16, 1.5, -2.0)
    head = HEAD[:124] + struct.pack(">H2s", 0x0100, b"MI")
    (tmp_path / "a.mat").write_bytes(head + struct.pack(">II", 14, len(parts)) + parts)
    assert read_mat(tmp_path / "a.mat", "a")[0].tolist() == [[1.5, -2.0]]


@pytest.mark.parametrize("a", ["text", np.array([[1j]]), {"b": 1.0}, np.array([[1.0], ["x"]], dtype=object)])
def test_what_is_no_real_array_is_named(a: Any, tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "a.mat", {"a": a})
    with pytest.raises(FormatError, match=r"no numeric array 'a'.*something else"):
        read_mat(tmp_path / "a.mat", "a")
    with pytest.raises(FormatError, match=r"no numeric array 'b'.*nothing"):
        read_mat(tmp_path / "a.mat", "b")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"junk",
        HEAD[:124] + struct.pack("<H2s", 0x0200, b"IM"),  # version 7.3 is another format
        HEAD + matrix((1, 2), struct.pack("<dd", 1, 2))[:-1],
        HEAD + matrix((1, 3), struct.pack("<dd", 1, 2)),
        HEAD + matrix((-1, -2), struct.pack("<dd", 1, 2)),
        HEAD + matrix((2**31 - 1, 2**31 - 1), b""),
        HEAD + matrix((1, 2), struct.pack("<dd", 1, 2), kind=16),
        HEAD + element(14, element(6, b"")),
        HEAD + element(14, b"", 2**32 - 1),
        HEAD + packed(matrix((1, 1), struct.pack("<d", 1)))[:-3],
        HEAD + element(15, b"no zlib"),
        HEAD + element(9, bytes(8)),
    ],
)
def test_what_is_damaged_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.mat").write_bytes(content)
    with pytest.raises(FormatError, match=r"a\.mat: not a MATLAB file, or truncated"):
        read_mat(tmp_path / "a.mat", "a")


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(MissingDataError, match="no such file"):
        read_mat(tmp_path / "a.mat", "a")


@pytest.mark.parametrize("number", [1e31, -1e308])
def test_numbers_that_are_too_large_are_refused(number: float, tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "a.mat", {"a": np.array([1.0, number])})
    with pytest.raises(FormatError, match=r"array 'a' holds a number too large.*at most 1e\+30"):
        read_mat(tmp_path / "a.mat", "a")


def test_the_limit_counts_what_is_unpacked(tmp_path: Path) -> None:
    """Many small arrays count together, small numbers count as the large ones they become, and cells are not made."""
    zeros = packed(matrix((1, 1_000_000), bytes(1_000_000), kind=2))
    cells = packed(matrix((30_000, 30_000), b"", of=1))
    for content in (zeros, zeros * 30, packed(matrix((1, 20_000_000), bytes(20_000_000), kind=2))):
        (tmp_path / "a.mat").write_bytes(HEAD + content)
        assert len(content) < 40_000
        tracemalloc.start()
        with size_limit(7_000_000), pytest.raises(FormatError, match="--max-size"):
            read_mat(tmp_path / "a.mat", "a")
        held = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert held < 30_000_000
    (tmp_path / "a.mat").write_bytes(HEAD + cells)
    with pytest.raises(FormatError, match="no numeric array 'a'"):
        read_mat(tmp_path / "a.mat", "a")
