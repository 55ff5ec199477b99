"""Outputs: their target is checked before the work, they are replaced whole, and nothing of others is deleted."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from graphslam.app.folders.generations import is_empty
from graphslam.core import output_folder as outputs
from graphslam.core.atomic import atomic_open, check_file_target, part_path, read_npz, write_npz
from graphslam.core.errors import FormatError, OutputError, RunFolderError
from graphslam.core.lock import LOCK, is_lock
from graphslam.core.npz import read_arrays
from graphslam.core.output_folder import LISTED, check_folder_target, output_folder
from graphslam.core.reading import read_bytes
from graphslam.io.autoware import write_autoware
from graphslam.io.text_records import write_text


@pytest.mark.parametrize("name", ["", ".", "/", "..", "a/..", "folder", "pipe", "missing/x.toml", "file/x.toml"])
def test_what_is_no_regular_file_is_refused_before_and_while_it_is_written(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    Path("folder").mkdir()
    Path("file").write_text("mine")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(OutputError):
        check_file_target(name)
    with pytest.raises(OutputError), atomic_open(name) as stream:
        stream.write(b"x")
    assert sorted(tmp_path.rglob("*")) == before
    assert Path("pipe").is_fifo()


def test_an_error_of_the_system_names_the_file_and_leaves_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    (tmp_path / "a").write_text("old")
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=r"No space left on device.*/a'") as caught, atomic_open(tmp_path / "a") as stream:
        stream.write(b"new")
    assert caught.value.errno == errno.ENOSPC
    assert [p.name for p in tmp_path.iterdir()] == ["a"]
    assert (tmp_path / "a").read_text() == "old"


def test_temporary_files_of_killed_writers_of_the_same_file_are_removed(tmp_path: Path) -> None:
    done = subprocess.Popen([sys.executable, "-c", ""])
    done.wait()
    mine, other = part_path(tmp_path / "a.toml"), part_path(tmp_path / "b.toml")
    dead = mine.with_name(mine.name.replace(f".{os.getpid()}-", f".{done.pid}-"))
    for path in (mine, other, dead):
        path.touch()
    check_file_target(tmp_path / "a.toml")
    assert sorted(tmp_path.iterdir()) == sorted([mine, other])


def test_a_compressed_file_has_the_same_bytes_at_any_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_text(tmp_path / "a.gz", "text")
    first = (tmp_path / "a.gz").read_bytes()
    monkeypatch.setattr(time, "time", lambda: 1e9)
    write_text(tmp_path / "a.gz", "text")
    assert (tmp_path / "a.gz").read_bytes() == first


def made(home: Path, *names: str, text: str = "new", kind: str = "log") -> Path:
    with output_folder(home, kind, last=("index",)) as folder:
        for name in names:
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_text(text)
    return home


def seen(home: Path) -> dict[str, str]:
    files = {p.relative_to(home).as_posix(): p.read_text() for p in home.rglob("*") if p.is_file()}
    return {n: t for n, t in files.items() if n not in (LOCK, LISTED)}


def test_an_output_replaces_the_earlier_one_and_nothing_else(tmp_path: Path) -> None:
    home = made(tmp_path / "out", "a", "sub/b", "index", text="old")
    (home / "mine.txt").write_text("mine")
    (home / "sub" / "mine.txt").write_text("mine")
    made(home, "a", "index")
    assert seen(home) == {"a": "new", "index": "new", "mine.txt": "mine", "sub/mine.txt": "mine"}
    with pytest.raises(OutputError, match=r"mine\.txt: was not written by graphslam"):
        made(home, "mine.txt", "index", text="third")
    assert seen(home) == {"a": "new", "index": "new", "mine.txt": "mine", "sub/mine.txt": "mine"}
    with pytest.raises(OutputError, match="holds a log; wanted"):
        check_folder_target(home, "joined map")


def fail_in(folder: Path) -> None:
    with output_folder(folder, "log", last=("index",)) as new:
        (new / "index").write_text("new")
        raise ZeroDivisionError


def test_a_failure_leaves_the_old_output_or_no_folder(tmp_path: Path) -> None:
    home = made(tmp_path / "old", "index", text="old")
    for folder in (home, tmp_path / "fresh"):
        with pytest.raises(ZeroDivisionError):
            fail_in(folder)
    assert seen(home) == {"index": "old"}
    assert not (tmp_path / "fresh").exists()


@pytest.mark.parametrize(("text", "accepted"), [("", True), ("graphslam: this fol", True), ("mine", False)])
def test_a_lock_that_a_full_disk_cut_off_is_no_file_of_another(text: str, accepted: bool, tmp_path: Path) -> None:
    (tmp_path / LOCK).write_text(text)
    assert is_empty(tmp_path) is accepted
    if accepted:
        assert seen(made(tmp_path, "index")) == {"index": "new"}
    else:
        with pytest.raises(OutputError, match="such as a lock"):
            made(tmp_path, "index")


def test_a_folder_that_another_process_has_just_made_is_left_to_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between the check of the target and the lock: its lock file was removed, and then both processes failed."""
    home = tmp_path / "out"

    def busy(folder: Path) -> None:
        folder.mkdir()
        (folder / LOCK).write_text("graphslam: this folder is written by process 1\n")
        raise RunFolderError("process 1 is writing into it")

    monkeypatch.setattr(outputs, "lock_folder", busy)
    with pytest.raises(RunFolderError), output_folder(home, "log", last=()):
        raise AssertionError("not reached")
    assert is_lock(home / LOCK)


@pytest.mark.parametrize("after", range(1, 9))
def test_no_moment_of_the_change_shows_files_of_both_with_an_index(after: int, tmp_path: Path) -> None:
    """Ended before the k-th change; then there is no index, or all is old, or all is new. The next writer goes on."""
    home = made(tmp_path / "out", "a", "b", "index", text="old")
    code = (
        "import os, sys\nfrom graphslam.core.output_folder import output_folder\n"
        "count = 0\n"
        "def hook(event, arguments):\n"
        "    global count\n"
        "    count += event in ('os.remove', 'os.rename') and moving\n"
        "    if count == int(sys.argv[2]): os._exit(9)\n"
        "moving = False\nsys.addaudithook(hook)\n"
        "with output_folder(sys.argv[1], 'log', last=('index',)) as folder:\n"
        "    [(folder / n).write_text('new') for n in ('a', 'c', 'index')]\n"
        "    moving = True\n"
    )
    subprocess.run([sys.executable, "-c", code, str(home), str(after)], check=False)
    found = seen(home)
    parts = {n: t for n, t in found.items() if not n.startswith(".")}
    if "index" in parts:
        assert parts in (dict.fromkeys(("a", "b", "index"), "old"), dict.fromkeys(("a", "c", "index"), "new"))
    made(home, "a", "index", text="third")
    assert seen(home) == {"a": "third", "index": "third"}


def test_a_folder_of_others_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    for path in (tmp_path, tmp_path / "mine.txt", tmp_path / "mine.txt" / "below", Path("/")):
        with pytest.raises(OutputError):
            check_folder_target(path, "log")
        with pytest.raises(OutputError):
            made(path, "index")
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.parametrize("name", ["../mine.txt", "/etc/passwd", "link/mine.txt", ""])
def test_a_list_of_files_from_somebody_else_deletes_nothing_outside(name: str, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    home = made(tmp_path / "out", "index")
    (home / "link").symlink_to(tmp_path)
    listed = json.loads((home / LISTED).read_text())
    (home / LISTED).write_text(json.dumps({**listed, "files": [name]}))
    with pytest.raises(FormatError, match="leads out of its folder"):
        made(home, "index")
    assert (tmp_path / "mine.txt").read_text() == "mine"


def test_tiles_of_an_earlier_map_go_and_clouds_of_the_user_stay(tmp_path: Path) -> None:
    points = np.array([[-1.0, -1.0, 0.0], [50.0, 1.0, 0.0]])
    root = write_autoware(tmp_path / "map", points, datum=(35.0, 139.0))
    (root / "pointcloud_map.pcd" / "mine.pcd").write_text("mine")
    (root / "lanelet2_map.osm").write_text("mine")
    write_autoware(root, points[:1])
    assert sorted(p.name for p in (root / "pointcloud_map.pcd").iterdir()) == ["-20_-20.pcd", "mine.pcd"]
    assert (root / "lanelet2_map.osm").read_text() == "mine"
    assert (root / "map_projector_info.yaml").read_text() == "projector_type: Local\n"


def test_a_pipe_among_the_inputs_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for read in (read_bytes, read_arrays):
        with pytest.raises(FormatError, match="pipe, socket or device; wanted a regular file"):
            read(tmp_path / "pipe")
    assert not is_lock(tmp_path / "pipe")


def test_a_file_that_may_not_be_read_is_not_called_corrupt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_npz(tmp_path / "a.npz", {"format": "x"})

    def refused(*_: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr("zipfile.ZipFile", refused)
    with pytest.raises(Exception, match="cannot be read \\(Permission denied\\)"):
        read_npz(tmp_path / "a.npz", fmt="x")
