"""Folders whose files are one state: committed by one rename, read as one, written by one process at a time."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from graphslam.app.folders import generations
from graphslam.app.folders.generations import check_same, current_outputs, is_empty, new_generation, read_consistently
from graphslam.core.atomic import part_path
from graphslam.core.errors import FormatError, RunFolderError
from graphslam.core.lock import LOCK, lock_folder
from graphslam_studies.montecarlo.study import study
from tests.app.cli.test_cli import graphslam

PART = ".run.json.4711-0123abcd.part"


def commit(folder: Path) -> None:
    with new_generation(folder) as new:
        new.write_text("ledger.csv", "l")


def plain(folder: Path) -> dict[str, str]:
    names = ("run.json", "map.npz", "figures/map.png", "report.html")
    return {n: (folder / n).read_text() for n in names if (folder / n).exists()}


def test_plain_paths_show_one_state(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with new_generation(tmp_path) as new:
        new.write_text("run.json", "1")
        (new.figures / "map.png").write_text("one")
        assert plain(tmp_path) == {}
    assert plain(tmp_path) == {"run.json": "1", "figures/map.png": "one"}
    assert current_outputs(tmp_path) == tmp_path / "generations" / "000001"
    seen = []

    def read(root: Path) -> str:  # another state is committed while this one is read
        if not seen:
            with new_generation(tmp_path) as new:
                new.write_text("run.json", "2")
                new.write_text("report.html", "page")
        seen.append(root.name)
        return (root / "figures" / "map.png").read_text() if len(seen) == 1 else (root / "run.json").read_text()

    assert read_consistently(tmp_path, read) == "2"
    assert seen == ["000001", "000002"]
    assert plain(tmp_path) == {"run.json": "2", "report.html": "page"}
    assert not (tmp_path / "figures" / "map.png").is_symlink()  # nor a link that leads nowhere
    assert [p.name for p in (tmp_path / "generations").iterdir()] == ["000002"]
    with pytest.raises(FileNotFoundError), new_generation(tmp_path) as new:
        (new.path / "run.json").write_text((tmp_path / "nowhere").read_text())
    assert plain(tmp_path) == {"run.json": "2", "report.html": "page"}
    assert [p.name for p in (tmp_path / "generations").iterdir()] == ["000002"]
    with new_generation(tmp_path) as new:
        new.write_text("map.npz", "m")
        new.adopt(drop=["rep*"])
    assert plain(tmp_path) == {"run.json": "2", "map.npz": "m"}
    assert (tmp_path / "notes.txt").read_text() == "mine"
    moved = tmp_path.with_name("moved")
    tmp_path.rename(moved)
    assert plain(moved) == {"run.json": "2", "map.npz": "m"}
    moved.rename(tmp_path)


@pytest.mark.parametrize("followed", [True, False])
def test_copies_and_folders_of_older_versions_become_generations(followed: bool, tmp_path: Path) -> None:
    old = tmp_path / "old"
    with new_generation(old) as new:
        new.write_text("run.json", "1")
        (new.figures / "map.png").write_text("one")
    folder = Path(shutil.copytree(old, tmp_path / "new", symlinks=not followed))
    (folder / "figures" / "own.svg").write_text("mine")
    (folder / "figures" / "progress.png").write_text("on the way")
    assert current_outputs(folder) == (folder if followed else folder / "generations" / "000001")
    assert plain(folder) == {"run.json": "1", "figures/map.png": "one"}
    with new_generation(folder) as new:
        assert new.before is not None
        new.write_text("report.html", "page")
        new.adopt()
    assert plain(folder) == {"run.json": "1", "figures/map.png": "one", "report.html": "page"}
    assert all((folder / n).is_symlink() for n in plain(folder))
    assert len(list((folder / "generations").iterdir())) == 1
    assert (folder / "figures" / "own.svg").read_text() == "mine"
    assert (folder / "figures" / "progress.png").read_text() == "on the way"
    assert plain(old) == {"run.json": "1", "figures/map.png": "one"}


def test_without_links_files_are_plain(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(generations, "_has_links", lambda _: False)
    for text in ("1", "2"):
        with new_generation(tmp_path) as new:
            new.write_text("run.json", text)
            if text == "1":
                new.write_text("map.npz", "m")
                new.write_text("ledger.csv", "l")
            else:
                new.adopt(drop=["led*"])
    assert plain(tmp_path) == {"run.json": "2", "map.npz": "m"}
    assert sorted(p.name for p in tmp_path.iterdir()) == [LOCK, "map.npz", "run.json"]


def test_ids_of_two_states_are_reported(tmp_path: Path) -> None:
    check_same((tmp_path / "run.json", "a"), (tmp_path / "map.npz", "a"), (tmp_path / "older.npz", None))
    with pytest.raises(FormatError, match=r"map\.npz: does not belong to the same state as run\.json.* b; wanted a"):
        check_same((tmp_path / "run.json", "a"), (tmp_path / "map.npz", "b"))


def test_one_writer_at_a_time(tmp_path: Path) -> None:
    code = (
        "import sys, time\nfrom graphslam.core.lock import lock_folder\n"
        "with lock_folder(sys.argv[1]):\n    print('held', flush=True)\n    time.sleep(100)"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with (
            pytest.raises(RunFolderError, match=rf"process {other.pid} on \S+ is writing into it"),
            lock_folder(tmp_path),
        ):
            pass
        with pytest.raises(RunFolderError, match=str(other.pid)), new_generation(tmp_path):
            pass
        other.kill()
        other.wait()
    assert str(other.pid) in (tmp_path / LOCK).read_text()  # the dead one's name blocks nobody
    with lock_folder(tmp_path), lock_folder(tmp_path):
        assert str(os.getpid()) in (tmp_path / LOCK).read_text()
    commit(tmp_path)


def test_the_second_process_gets_one_line(tmp_path: Path) -> None:
    (tmp_path / "config.toml").write_text("")
    command = [sys.executable, "-m", "graphslam", "report", str(tmp_path)]  # a thread may lock its folder again
    with lock_folder(tmp_path):
        done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 1
    assert re.fullmatch(rf"graphslam: .*process {os.getpid()} on \S+ is writing into it.*\n", done.stderr)
    done = graphslam("report", tmp_path)
    assert done.returncode == 0, done.stderr


def test_what_a_kill_leaves_is_swept_and_nothing_else(tmp_path: Path) -> None:
    ours, foreign = (
        part_path(tmp_path / "run.json").name,
        [".notes.part", ".a.12-xyz.part", "x.part", ".b.1-0123abcd.p"],
    )
    commit(tmp_path)
    for name in (ours, PART, *foreign):
        (tmp_path / name).write_text("half")
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / PART).write_text("half")
    (tmp_path / "generations" / "000099").mkdir()
    (tmp_path / "generations" / "000099" / "run.json").write_text("never committed")
    (tmp_path / "generations" / "mine").mkdir()
    (tmp_path / "to-nowhere").symlink_to("nowhere")
    commit(tmp_path)
    left = {p.name for p in tmp_path.iterdir()}
    assert left >= {*foreign, "deep", "to-nowhere"}
    assert not left & {ours, PART}
    assert (tmp_path / "deep" / PART).exists()
    assert sorted(p.name for p in (tmp_path / "generations").iterdir())[1:] == ["mine"]


def test_a_folder_with_the_leavings_of_a_kill_is_empty(tmp_path: Path) -> None:
    (tmp_path / PART).write_text("half")
    assert is_empty(tmp_path)
    with lock_folder(tmp_path):
        (tmp_path / "generations" / "000001").mkdir(parents=True)
        (tmp_path / "run.json").symlink_to("current/run.json")
        assert is_empty(tmp_path)
    (tmp_path / ".notes.part").write_text("mine")
    assert not is_empty(tmp_path)


def test_a_study_leaves_a_folder_of_somebody_else_alone(tmp_path: Path) -> None:
    planted = [tmp_path / ".thesis.part", tmp_path / PART, tmp_path / "deep" / PART, tmp_path / "thesis.tex"]
    for p in planted:
        p.parent.mkdir(exist_ok=True)
        p.write_text("years of work")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(RunFolderError, match="not empty and not a study"):
        study("tests.reference.small_study:STUDY", 1, out=tmp_path, progress=False)
    assert sorted(tmp_path.rglob("*")) == before  # not even a lock
    assert all(p.read_text() == "years of work" for p in planted)
