"""Folders that somebody else made choose neither what is imported, nor which other files are read."""

from __future__ import annotations

import ast
import json
import os
import shutil
import sys
from pathlib import Path

import pytest

from graphslam.app.folders.generations import new_generation
from graphslam.app.report.report import make_report
from graphslam.app.run.folder import RunFolder
from graphslam.app.run.loops import loops_of_run
from graphslam.app.run.outputs import read_run_folder
from graphslam.app.submap_sources import submap_source
from graphslam.core.errors import FormatError, GraphSlamError, RunFolderError, UnknownNameError
from graphslam.core.lock import lock_folder
from graphslam.io.log_store import load_log
from graphslam.io.submap_store import read_submaps
from graphslam_studies.montecarlo.study import open_study
from tests.faults.readers import a_log_folder, run_folder, study_folder, submap_store

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted([*ROOT.glob("graphslam/**/*.py"), *ROOT.glob("frontends/**/*.py")])
TRAP = "from pathlib import Path\nPath(__file__).with_name('sprung').touch()\n"


@pytest.fixture
def trap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A module that can be imported and tells if it was; the file is what it leaves behind."""
    (tmp_path / "a_trap.py").write_text(TRAP)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    yield tmp_path / "sprung"
    sys.modules.pop("a_trap", None)


def test_a_study_folder_imports_nothing(tmp_path: Path, trap: Path) -> None:
    folder = tmp_path / "study"
    folder.mkdir()
    study_folder(folder)
    facts = json.loads((folder / "study.json").read_text())
    for name in ("a_trap:study", "a_trap", "os:system"):
        (folder / "study.json").write_text(json.dumps({**facts, "name": name}))
        with pytest.raises(UnknownNameError, match="unknown study"):
            open_study(folder)
    assert not trap.exists()
    with pytest.raises(GraphSlamError):
        open_study(folder, "a_trap:study")  # what the user names is imported, and is no study
    assert trap.exists()


def test_a_run_folder_imports_nothing(tmp_path: Path, trap: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    run_folder(folder)
    file = (folder / "run.json").resolve()
    facts = json.loads(file.read_text())
    file.write_text(json.dumps({**facts, "frontend": "a_trap:Front", "source": "a_trap:log"}))
    assert read_run_folder(folder).name == "a_trap:log"
    assert not trap.exists()


@pytest.mark.parametrize("name", ["../secret.npz", "/etc/passwd", "..", "", "a/b.npz", "a\\\\b.npz", "\u202eb.npz"])
def test_names_lead_nowhere_else(tmp_path: Path, name: str) -> None:
    (tmp_path / "log").mkdir()
    a_log_folder(tmp_path / "log")
    submap_store(tmp_path / "run")
    for file, key, read in (
        (tmp_path / "log/log.json", "streams", lambda: load_log(tmp_path / "log")),
        (tmp_path / "run/submaps/index.json", "submaps", lambda: read_submaps(tmp_path / "run")),
    ):
        facts = json.loads(file.read_text())
        facts[key][0]["file"] = name
        file.write_text(json.dumps(facts))
        with pytest.raises(FormatError, match="leads out of its folder"):
            read()


def test_links_lead_nowhere_else(tmp_path: Path) -> None:
    for place, file, read in (
        ("log", "log/gps.npz", lambda: load_log(tmp_path / "log")),
        ("log", "log/log.json", lambda: load_log(tmp_path / "log")),
        ("run", "run/submaps/000001.npz", lambda: read_submaps(tmp_path / "run")),
    ):
        shutil.rmtree(tmp_path / place, ignore_errors=True)
        (tmp_path / place).mkdir()
        {"log": a_log_folder, "run": submap_store}[place](tmp_path / place)
        read()
        moved = tmp_path / f"outside-{place}"
        os.rename(tmp_path / file, moved)
        (tmp_path / file).symlink_to(moved)
        with pytest.raises(FormatError, match="leads out of its folder"):
            read()


OF_A_STATE = ("map.npz", "events.jsonl", "run.json", "metrics.json", "timings.json", "ledger.csv", "association.npz")
OF_A_RUN = ("config.toml", "submaps", "submaps/index.json")


@pytest.mark.parametrize("plain", [False, True])
@pytest.mark.parametrize("name", [*OF_A_STATE, *OF_A_RUN, "figures", "generations"])
def test_links_of_a_run_lead_nowhere_else(name: str, plain: bool, tmp_path: Path) -> None:
    """Neither the readers nor the writers follow them; ``plain``: a copy without links of its own."""
    (tmp_path / "made").mkdir()
    run_folder(tmp_path / "made")
    folder = Path(shutil.copytree(tmp_path / "made", tmp_path / "run", symlinks=not plain))
    own = folder / "current" if name in OF_A_STATE and not plain else folder
    read_run_folder(folder)
    (folder / "figures").mkdir(exist_ok=True)
    (own / name).rename(tmp_path / "outside")
    (own / name).symlink_to(tmp_path / "outside")
    before = tree(tmp_path / "outside")
    for read in (read_run_folder, make_report, submap_source, loops_of_run):
        with pytest.raises(FormatError, match="leads out of its folder"):
            read(folder)
    with pytest.raises(FormatError, match="leads out of its folder"), new_generation(folder):
        pass
    with pytest.raises(FormatError, match="leads out of its folder"), RunFolder.start(folder, {}, resume=True):
        pass
    assert tree(tmp_path / "outside") == before


def tree(path: Path) -> dict[Path, bytes]:
    """Bytes of a file, or of every file of a folder."""
    files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
    return {p: p.read_bytes() for p in files}


def test_links_that_no_reader_of_ours_follows_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "made").mkdir()
    run_folder(tmp_path / "made")
    (tmp_path / "run").symlink_to(tmp_path / "made")
    (tmp_path / "run" / "log").symlink_to(ROOT)
    assert len(read_run_folder(tmp_path / "run").submaps)


def test_links_of_a_study_lead_nowhere_else(tmp_path: Path) -> None:
    for name in ("study.json", "trials", "trials/A", "trials/A/000001.npz"):
        folder = tmp_path / name.replace("/", "-")
        folder.mkdir()
        study_folder(folder)
        outside = folder.with_suffix(".outside")
        (folder / name).rename(outside)
        (folder / name).symlink_to(outside)
        with pytest.raises(FormatError, match="leads out of its folder"):
            open_study(folder)


def test_a_lock_that_is_a_link_is_not_written(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / ".lock").symlink_to(tmp_path / "mine.txt")
    with pytest.raises(RunFolderError, match="cannot be written"), lock_folder(tmp_path / "run"):
        pass
    assert (tmp_path / "mine.txt").read_text() == "mine"


# name of a call, or of a module -> why it stands nowhere in the package
FORBIDDEN = {
    "pickle", "pickle.load", "pickle.loads", "pickle.Unpickler", "cPickle",
    "dill", "shelve", "marshal", "joblib", "cloudpickle", "eval", "exec", "compile", "os.system",
    "yaml.load", "pd.read_pickle", "pandas.read_pickle", "np.loadtxt", "np.genfromtxt", "np.fromfile", "__import__",
}  # fmt: skip


# it asks whether a trial can be sent to another process; it loads none
DUMPS = {"executors.py": {"pickle"}}


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_nothing_is_unpickled_or_evaluated(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            assert not FORBIDDEN & {a.name.split(".")[0] for a in node.names} - DUMPS.get(path.name, set()), path
        elif isinstance(node, ast.ImportFrom):
            assert (node.module or "").split(".")[0] not in FORBIDDEN, path
        elif isinstance(node, ast.Call):
            assert ast.unparse(node.func) not in FORBIDDEN, f"{path}:{node.lineno}"
            for k in node.keywords:
                allowed = k.arg not in ("allow_pickle", "shell") or ast.unparse(k.value) == "False"
                assert allowed, f"{path}:{node.lineno}"
            if ast.unparse(node.func) in ("np.load", "np.lib.format.read_array"):
                assert any(k.arg == "allow_pickle" for k in node.keywords), f"{path}:{node.lineno}"
