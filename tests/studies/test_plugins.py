"""The studies plug in by entry points; without them every name of theirs gives one line that says what to install."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from collections.abc import Callable
from importlib.metadata import EntryPoints, entry_points
from pathlib import Path
from typing import Any

import pytest

import graphslam as gs
from graphslam.app.run.front_ends import check_name, make_front_end
from graphslam.core import plugins
from graphslam.core.errors import MissingExtraError, UnknownNameError
from graphslam.io.cards import list_cards
from graphslam.io.readers import find_reader, list_readers

ROOT = Path(__file__).resolve().parents[2]
HOW = r"is part of graphslam-studies, which is not installed; wanted pip install ./notebooks/studies"


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """The wheel without the studies."""

    def rest(group: str) -> EntryPoints:
        return EntryPoints(e for e in entry_points(group=group) if not e.value.startswith("graphslam_studies"))

    monkeypatch.setattr(plugins, "entry_points", rest)


def test_names_to_install_are_those_of_the_studies() -> None:
    project = tomllib.loads((ROOT / "notebooks" / "studies" / "pyproject.toml").read_text())["project"]
    groups = {group: set(names) for group, names in project["entry-points"].items()}
    for through_others in ("graphslam.studies", "graphslam.presets", "graphslam.identities"):
        del groups[through_others]  # asked for through those that are listed
    assert {group: set(names) for group, names in plugins.IN_STUDIES.items()} == groups


def test_what_is_installed_or_removed_meanwhile_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    assert "own-world" not in plugins.plugins("graphslam.worlds")
    info = tmp_path / "own-0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: own\nVersion: 0\n")
    (info / "entry_points.txt").write_text("[graphslam.worlds]\nown-world = own:World\n")
    assert "own-world" in plugins.plugins("graphslam.worlds")
    info.rename(tmp_path / "gone")
    assert "own-world" not in plugins.plugins("graphslam.worlds")


@pytest.mark.usefixtures("alone")
@pytest.mark.parametrize(
    "call", [lambda: gs.study("charts"), lambda: gs.open_study("a"), lambda: gs.find_study("charts")]
)
def test_functions_say_what_to_install(call: Callable[[], Any]) -> None:
    with pytest.raises(MissingExtraError, match=HOW):
        call()


@pytest.mark.usefixtures("alone")
@pytest.mark.parametrize(
    ("call", "what"),
    [
        (lambda: gs.simulate("mine"), "world 'mine'"),
        (lambda: gs.simulate("point-field"), "world 'point-field'"),
        (lambda: make_front_end("ekf-slam", {}), "front end 'ekf-slam'"),
        (lambda: check_name("rbpf-slam"), "front end 'rbpf-slam'"),
        (lambda: find_reader("mrclam"), "reader 'mrclam'"),
    ],
)
def test_names_that_moved_say_what_to_install(call: Callable[[], Any], what: str) -> None:
    list_readers.cache_clear()
    try:
        with pytest.raises(MissingExtraError, match=f"^{what} {HOW}"):
            call()
    finally:
        list_readers.cache_clear()


def test_cards_name_the_distribution_of_their_reader() -> None:
    inside = set(plugins.IN_STUDIES["graphslam.readers"])
    assert {c.name: c.plugin for c in list_cards() if c.reader in inside or c.plugin} == {
        c.name: plugins.STUDIES for c in list_cards() if c.reader in inside
    }


@pytest.mark.usefixtures("alone")
@pytest.mark.parametrize("name", ["plaza1", "mrclam-dataset7/robot1", "lidar3d-hku1"])
def test_a_card_says_what_reads_it(name: str) -> None:
    list_readers.cache_clear()
    try:
        with pytest.raises(MissingExtraError, match=HOW):
            gs.load(name)
    finally:
        list_readers.cache_clear()


@pytest.mark.usefixtures("alone")
def test_commands_say_what_to_install() -> None:
    from typer.main import get_command

    from graphslam.app.cli import app

    group: Any = get_command(app)
    assert not {"study", "terrain-tables"} & set(group.list_commands(None))
    for name in ("study", "terrain-tables"):
        with pytest.raises(MissingExtraError, match=HOW):
            group.get_command(None, name)
    assert group.get_command(None, "no-such-command") is None


def test_an_unknown_study_is_one_line() -> None:
    with pytest.raises(UnknownNameError, match=r"unknown study 'chart'; did you mean charts\?"):
        gs.find_study("chart")


def test_help_of_a_study_lists_names_and_imports_no_study() -> None:
    code = (
        "import sys; from graphslam.app.cli import main; sys.argv = ['graphslam', 'study', '--help']\n"
        "try: main()\nexcept SystemExit: pass\n"
        "heavy = {'gtsam', 'numba', 'scipy', 'matplotlib', 'graphslam_studies.charts'}\n"
        "print(sorted(heavy & set(sys.modules)), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "charts" in done.stdout
    assert "withheld-fixes" in done.stdout
    assert done.stderr.strip() == "[]"
