"""Finding, checking and loading recorded data."""

from __future__ import annotations

import bz2
import gzip
import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graphslam.core.errors import DataError, FormatError, MissingDataError, UnknownNameError
from graphslam.core.log import SensorLog
from graphslam.core.records import Gps, LandmarkObservations
from graphslam.core.submap import Submap
from graphslam.io import catalog
from graphslam.io.cards import Card, CardFile, find_card
from graphslam.io.catalog import check_files, data_roots, load_recording, locate


def sha(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def toy_card(**change: object) -> Card:
    content = b"0 1 2\n" * 50
    files = (
        CardFile(
            path="a.txt.gz",
            bytes=len(packed := gzip.compress(content, mtime=0)),
            sha256=sha(packed),
            content_bytes=len(content),
            content_sha256=sha(content),
        ),
        CardFile(path="sub/b.bin", bytes=3, sha256=sha(b"abc")),
        CardFile(path="note.txt", bytes=4, sha256=sha(b"note"), optional=True),
    )
    texts = dict.fromkeys(("title", "records", "obtained_from", "citation", "licence", "terms"), "text")
    made = Card(
        name="toy", kind="sensor-log", folder="toy", source="https://example.org", caveats=(), files=files, **texts
    )
    return replace(made, **change)  # type: ignore[arg-type]


def write_toy(root: Path, *, plain: bool = False) -> None:
    content = b"0 1 2\n" * 50
    (root / "toy/sub").mkdir(parents=True, exist_ok=True)
    if plain:
        (root / "toy/a.txt").write_bytes(content)
    else:
        (root / "toy/a.txt.gz").write_bytes(gzip.compress(content, mtime=0))
    (root / "toy/sub/b.bin").write_bytes(b"abc")


@pytest.fixture
def roots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path, Path]:
    """Two data folders and a cache, all empty."""
    one, two, cache = tmp_path / "one", tmp_path / "two", tmp_path / "cache"
    monkeypatch.setenv("GRAPHSLAM_DATA", f"{one}:{two}")
    monkeypatch.setenv("GRAPHSLAM_CACHE", str(cache))
    return one, two, cache


def test_roots_in_order(roots: tuple[Path, Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    assert data_roots() == list(roots)
    monkeypatch.delenv("GRAPHSLAM_CACHE")
    assert "graphslam" in str(data_roots()[-1])


@pytest.mark.parametrize("plain", [False, True])
@pytest.mark.parametrize("where", [0, 1, 2])
def test_locate_and_check(roots: tuple[Path, Path, Path], where: int, plain: bool) -> None:
    c = toy_card()
    assert [k.state for k in check_files(c)] == ["missing"] * 3
    write_toy(roots[where], plain=plain)
    assert locate(c) == roots[where] / "toy"
    assert [k.state for k in check_files(c)] == ["ok", "ok", "missing"]
    (roots[where] / "toy/sub/b.bin").write_bytes(b"abd")
    assert [k.state for k in check_files(c)] == ["ok", "differs", "missing"]
    target = roots[where] / ("toy/a.txt" if plain else "toy/a.txt.gz")
    target.write_bytes(target.read_bytes()[:-1])
    assert [k.state for k in check_files(c)] == ["differs", "differs", "missing"]


def test_missing_data_says_how_to_get_it(roots: tuple[Path, Path, Path]) -> None:
    write_toy(roots[0])
    (roots[0] / "toy/sub/b.bin").unlink()
    with pytest.raises(MissingDataError, match=r"1 of 2 files of .*'toy' are missing, first sub/b.bin.*example.org"):
        locate(toy_card())
    linked = replace(toy_card().files[1], url="https://example.org/b.bin")
    with pytest.raises(MissingDataError, match="graphslam data fetch toy"):
        locate(toy_card(files=(linked,)))
    with pytest.raises(UnknownNameError):
        locate("no-such-set")


def test_load_from_a_path(roots: tuple[Path, Path, Path], tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="data set or path"):
        load_recording(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(FormatError, match="no reader knows this folder; got an empty folder"):
        load_recording(tmp_path / "empty")
    file = tmp_path / "graph.g2o"
    file.write_text("VERTEX_SE2 0 0 0 0\n")
    assert load_recording(file) == file


def test_load_of_a_card(roots: tuple[Path, Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    c = toy_card()
    monkeypatch.setattr(catalog, "list_cards", lambda: (c,))
    monkeypatch.setattr(catalog, "find_card", lambda name: c)
    write_toy(roots[1])
    with pytest.raises(DataError, match="no reader for data set 'toy'"):
        load_recording("toy")
    assert load_recording("toy/sub/b") == roots[1] / "toy/sub/b.bin"
    assert load_recording("toy/a.txt") == roots[1] / "toy/a.txt.gz"
    with pytest.raises(MissingDataError, match="no such file"):
        load_recording("toy/note.txt")
    with pytest.raises(UnknownNameError, match="file of data set 'toy' 'c'"):
        load_recording("toy/c")


def test_folders_are_distinguished_by_what_they_hold(tmp_path: Path, rng: np.random.Generator) -> None:
    from graphslam.core.submap import LandmarkMap
    from graphslam.io.log_store import save_log
    from graphslam.io.submap_store import write_submaps

    sub = Submap.from_landmarks(
        0,
        LandmarkMap(ids=[1], exit_pose=[1.0, 0, 0], positions=rng.normal(size=(1, 2)), covariance=np.eye(5)),
    )
    write_submaps(tmp_path / "run", [sub])
    for folder in (tmp_path / "run", tmp_path / "run/submaps"):
        (back,) = load_recording(folder)
        np.testing.assert_array_equal(back.landmarks.positions, sub.landmarks.positions)
    fixes = Gps(times=[0.0, 1.0], positions=np.zeros((2, 2)), sigma=[1.0, 1.0], lever=[0.0, 0.0])
    save_log(SensorLog(name="made", streams={"gps": fixes}), tmp_path / "log")
    assert load_recording(tmp_path / "log").name == "made"


def test_catalogue_imports_nothing_heavy() -> None:
    import subprocess
    import sys

    heavy = ("gtsam", "numba", "scipy", "pooch", "pandas")
    code = f"import sys, graphslam.io.catalog; print([m for m in {heavy} if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


@pytest.mark.data
def test_recorded_data_by_name(data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GRAPHSLAM_DATA", str(data_dir))
    log = load_recording("victoria-park", gps="none")
    assert isinstance(log, SensorLog)
    assert set(log.streams) == {"laser", "controls"}
    again = load_recording(data_dir / "victoria_park_raw", gps="none")
    np.testing.assert_array_equal(again["laser"].times, log["laser"].times)
    assert len(load_recording("victoria-park-local-maps")) == 200
    assert isinstance(load_recording("victoria-park-detections"), LandmarkObservations)
    assert load_recording("victoria-park-graph") == data_dir / "victoria_park_graph/victoria_park.txt.gz"
    assert load_recording("posegraphs/intel") == data_dir / "posegraphs/intel.g2o.xz"
    assert load_recording("posegraphs/intel.g2o") == data_dir / "posegraphs/intel.g2o.xz"
    with pytest.raises(DataError, match=r"name one.*posegraphs/sphere2500"):
        load_recording("posegraphs")
    assert {k.state for k in check_files("victoria-park")} == {"ok"}
    assert find_card("victoria-park").fetchable


def test_packed_form_of_other_compressions() -> None:
    content = bz2.compress(b"x")
    assert CardFile(path="a.clf.bz2", bytes=len(content), sha256=sha(content)).plain_path is None
