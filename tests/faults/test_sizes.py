"""Small files that unpack to large ones are refused at the limit, at once and without the memory they would take."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from graphslam.app.cli import app
from graphslam.core.atomic import read_npz
from graphslam.core.errors import ConfigError, FormatError
from graphslam.core.reading import MAX_SIZE, read_text, set_size_limit, size_limit
from graphslam.io.g2o import read_g2o
from graphslam.io.network_file import read_network

VERTICES = "".join(f"VERTEX_SE2 {k} {k} 0 0\n" for k in range(3))
EDGES = "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\nEDGE_SE2 1 2 1 0 0 1 0 0 1 0 1\n"
LARGE = (VERTICES + EDGES).encode() + b" \n" * 20_000_000  # 40 MB of nothing


@pytest.mark.parametrize(
    ("pack", "ending"),
    [(lambda b: gzip.compress(b, 1), "gz"), (lambda b: lzma.compress(b, preset=0), "xz"), (bz2.compress, "bz2")],
)
def test_compressed_text_is_read_up_to_the_limit(pack: Callable[[bytes], bytes], ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"a.g2o.{ending}"
    path.write_bytes(pack(LARGE))
    assert path.stat().st_size < 300_000
    tracemalloc.start()
    with pytest.raises(FormatError, match=r"more than 4,000,000 bytes .* --max-size .* max_size"):
        read_network(path, max_size=4_000_000)
    held = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert held < 12_000_000
    with size_limit(50_000_000):
        assert len(read_text(path)) == len(LARGE)


def test_streams_after_each_other_count_together(tmp_path: Path) -> None:
    path = tmp_path / "a.txt.gz"
    path.write_bytes(gzip.compress(b"a" * 700) + gzip.compress(b"b" * 700))
    assert read_text(path) == "a" * 700 + "b" * 700
    with size_limit(1000), pytest.raises(FormatError, match="more than 1,000 bytes"):
        read_text(path)
    path.write_bytes(lzma.compress(b"a" * 700) + b"\0" * 8 + lzma.compress(b"b" * 700))
    assert len(read_text(path)) == 1400


def test_archives_are_refused_before_anything_is_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez_compressed(path, format="f", a=np.zeros(5_000_000), b=np.zeros(5_000_000))
    assert path.stat().st_size < 100_000
    tracemalloc.start()
    with size_limit(10_000_000), pytest.raises(FormatError, match="--max-size"):
        read_npz(path, fmt="f")
    held = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert held < 1_000_000
    assert len(read_npz(path, fmt="f")["b"]) == 5_000_000


def test_a_member_that_claims_more_than_it_can_hold_is_refused_without_memory(tmp_path: Path) -> None:
    """Headers of array and archive agree on 1 GB, below the limit, in a hundred bytes."""
    path, shape = tmp_path / "a.npz", 125_000_000
    head = f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({shape},), }}".ljust(117).encode() + b"\n"
    data = b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", data)
    raw = path.read_bytes()
    at = raw.rindex(b"PK\x01\x02") + 24  # of the size in the archive's directory
    path.write_bytes(raw[:at] + (len(data) + 8 * shape).to_bytes(4, "little") + raw[at + 4 :])
    tracemalloc.start()
    with pytest.raises(FormatError, match="truncated or corrupt"):
        read_npz(path, fmt="f")
    held = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert held < 1_000_000


def test_packings_that_numpy_does_not_write_are_refused(tmp_path: Path) -> None:
    """LZMA packs zeros 7,000 to 1, which the check of claimed sizes would not know."""
    stream = io.BytesIO()
    np.save(stream, np.zeros(10))
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_LZMA) as archive:
        archive.writestr("a.npy", stream.getvalue())
    with pytest.raises(FormatError, match="packed in another way"):
        read_npz(tmp_path / "a.npz", fmt="f")


def test_an_xz_header_that_asks_for_a_large_dictionary_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.g2o.xz"
    filters = [{"id": lzma.FILTER_LZMA2, "preset": 0, "dict_size": 1 << 29}]
    compressor = lzma.LZMACompressor(filters=filters, check=lzma.CHECK_NONE)
    path.write_bytes(compressor.compress(b"VERTEX_SE2 0 0 0 0\n") + compressor.flush())
    with pytest.raises(FormatError, match="emory usage limit"):
        read_g2o(path)


def test_the_command_line_has_the_option(tmp_path: Path) -> None:
    path = tmp_path / "a.g2o.gz"
    path.write_bytes(gzip.compress(LARGE, 1))
    try:
        done = CliRunner().invoke(app, ["solve", str(path), "--max-size", "1M"])
        assert isinstance(done.exception, FormatError)
        assert "more than 1,000,000 bytes" in str(done.exception)
        done = CliRunner().invoke(app, ["solve", str(path), "--max-size", "0.05G", "--json"])
        assert done.exit_code == 0
        assert CliRunner().invoke(app, ["solve", str(path), "--max-size", "many"]).exit_code == 2
    finally:
        set_size_limit(MAX_SIZE)


def test_an_impossible_limit_is_refused() -> None:
    with pytest.raises(ConfigError, match="max_size"), size_limit(0):
        pass


def test_edges_to_a_vertex_that_is_not_there_name_it(tmp_path: Path) -> None:
    path = tmp_path / "a.g2o"
    path.write_text(VERTICES + EDGES + "EDGE_SE2 2 77 1 0 0 1 0 0 1 0 1\n")
    with pytest.raises(FormatError, match=r"a\.g2o:6: an edge names vertex 77, .*--create-missing"):
        read_network(path)
    made = read_network(path, create_missing=True)
    assert made.ids.tolist() == [0, 1, 2, 77]
    assert made.has_initial.tolist() == [True] * 3 + [False]
    done = CliRunner().invoke(app, ["solve", str(path), "--create-missing", "--json"])
    assert done.exit_code == 0, done.output
    path.write_text(EDGES)  # a file of edges alone is one of the known kinds
    assert len(read_network(path)) == 3


@pytest.mark.parametrize("number", ["nan", "inf", "1e308", "-1e300", "1e31"])
def test_numbers_that_cannot_be_used_are_refused(number: str, tmp_path: Path) -> None:
    path = tmp_path / "a.g2o"
    path.write_text(VERTICES + EDGES.replace("1 0 0 1", f"{number} 0 0 1", 1))
    with pytest.raises(FormatError, match=r"a\.g2o:4: EDGE_SE2 record holds"):
        read_network(path)
