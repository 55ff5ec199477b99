"""Notebooks: stripped in the repository, made of public names, and each one runs to its end in quick mode."""

from __future__ import annotations

import ast
import importlib
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import nbformat
import pytest
from jupyter_core.utils import run_sync
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError

import graphslam
import graphslam_studies
from graphslam.core.errors import UnknownNameError
from graphslam_studies.io.notebook import NotebookStop, load_or_stop

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
NEEDS_DATA = {"01_victoria_park"}
USES_DATA = {"07_one_set_of_submaps"}  # runs without as well, and says what it left out
ABSOLUTE = re.compile(r"(?<![\w./])/(?:home|root|Users|tmp|work|mnt|media|opt|usr|var|srv|data)\b|\b[A-Za-z]:\\\\")
TIMEOUT_S = 900
every_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)


def execute(path: Path, where: Path, kernel: NotebookClient | None = None, **environment: str) -> Any:
    """Run a notebook in an empty folder; returns it with its outputs.

    In a kernel of its own, or in one that other notebooks have used: its names and settings are then as in a new one,
    but modules that it imports may be loaded already.
    """
    book = nbformat.read(path, as_version=4)
    env = {
        **os.environ,
        "GRAPHSLAM_QUICK": "1",
        "GRAPHSLAM_CACHE": str(where / "cache"),
        "MPLBACKEND": "module://matplotlib_inline.backend_inline",
        **environment,
    }
    client = NotebookClient(
        book, timeout=TIMEOUT_S, kernel_name="python3", resources={"metadata": {"path": str(where)}}
    )
    try:
        if kernel is None:
            client.execute(env=env)
        else:
            client.km, client.kc = kernel.km, kernel.kc
            first = nbformat.v4.new_code_cell(AS_NEW.format(env=env, where=str(where)))
            book.cells.insert(0, first)
            client.execute(cleanup_kc=False)
            book.cells.remove(first)
    except CellExecutionError as error:
        error.book = book  # type: ignore[attr-defined]
        raise
    return book


AS_NEW = """%reset -f
import os, warnings
import matplotlib
from matplotlib import pyplot
os.environ.clear()
os.environ.update({env!r})
os.chdir({where!r})
pyplot.close("all")
matplotlib.rcdefaults()
get_ipython().run_line_magic("matplotlib", "inline")
with warnings.catch_warnings():
    pass  # each warning is shown once more
%reset -f
"""


@pytest.fixture(scope="module")
def kernel() -> Iterator[NotebookClient]:
    """A kernel for one notebook after the other: starting one and importing the package takes three seconds."""
    client = NotebookClient(nbformat.v4.new_notebook(), timeout=TIMEOUT_S, kernel_name="python3")
    client.create_kernel_manager()
    client.start_new_kernel(env={**os.environ, "MPLBACKEND": "module://matplotlib_inline.backend_inline"})
    client.start_new_kernel_client()
    yield client
    client.kc.stop_channels()
    run_sync(client.km.shutdown_kernel)(now=True)


def outputs(book: Any) -> list[Any]:
    return [o for c in book.cells if c.cell_type == "code" for o in c.outputs]


OURS = ("graphslam", "graphslam_studies")
ROOMS = {
    f"{package.__name__}.{p.parent.name}"
    for package in (graphslam, graphslam_studies)
    for p in Path(str(package.__file__)).parent.glob("*/__init__.py")
}


def imported(source: str) -> list[tuple[str, str]]:
    """What a cell takes from the package: module and name, the name empty for a module taken as a whole."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [(a.name, "") for a in node.names if a.name.split(".")[0] in OURS]
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in OURS:
            found += [(str(node.module), a.name) for a in node.names]
    return found


def internal(module: str, name: str) -> bool:
    """Is this import none of ``import graphslam``, the face of a room, and the errors?"""
    if module == "graphslam":
        return bool(name) and name not in graphslam.__all__
    if module == "graphslam.core.errors":
        return False
    room = importlib.import_module(module) if module in ROOMS else None
    return room is None or name not in getattr(room, "__all__", ())


@every_notebook
def test_a_notebook_imports_no_internal_module(path: Path) -> None:
    code = [c.source for c in nbformat.read(path, as_version=4).cells if c.cell_type == "code"]
    assert [found for source in code for found in imported(source) if internal(*found)] == []


def test_internal_imports_are_found() -> None:
    for line in (
        "from graphslam_studies.plots.scans import plot_scan",
        "import graphslam.app.verbs",
        "from graphslam import io",
    ):
        assert any(internal(*found) for found in imported(line)), line
    for line in (
        "import graphslam as gs",
        "from graphslam_studies.plots import plot_scan",
        "from graphslam import simulate",
    ):
        assert not any(internal(*found) for found in imported(line)), line


@every_notebook
def test_a_lecture_has_a_setting_to_change_and_exercises(path: Path) -> None:
    cells = nbformat.read(path, as_version=4).cells
    assert sum(bool(re.search(r"\bplot_settings\(", c.source)) for c in cells if c.cell_type == "code") == 1
    assert sum("**Change a parameter.**" in c.source for c in cells if c.cell_type == "markdown") == 1
    assert sum("## Exercises" in c.source for c in cells if c.cell_type == "markdown") == 1


def test_there_are_notebooks() -> None:
    assert {
        "00_five_minute_tour",
        "01_victoria_park",
        "02_what_a_submap_is",
        "03_copy_on_write",
        "04_segslam_garage",
        "05_from_segmap_to_map",
        "06_consistency_study",
        "07_one_set_of_submaps",
        "08_outdoors_and_indoors",
        "09_ten_to_the_eighth",
        "10_where_to_drive",
        "11_your_lidar",
        "12_is_this_map_to_be_trusted",
        "13_everything_in_one_graph",
        "14_check_points",
    } <= {p.stem for p in NOTEBOOKS}


@every_notebook
def test_notebook_is_stripped(path: Path) -> None:
    book = nbformat.read(path, as_version=4)
    nbformat.validate(book)
    assert (book.nbformat, book.nbformat_minor) >= (4, 5)  # cells have ids
    assert book.metadata.kernelspec.name == "python3"
    assert set(book.metadata) == {"kernelspec", "language_info"}
    assert dict(book.metadata.language_info) == {"name": "python"}  # no version of a machine
    for cell in book.cells:
        assert not cell.metadata, cell.id
        assert re.fullmatch(r"[a-z]+-[a-z0-9]+", cell.id), f"{cell.id}: an id that nobody chose"
        if cell.cell_type == "code":
            assert cell.outputs == [], cell.id
            assert cell.execution_count is None, cell.id
            assert len(cell.source.splitlines()) <= 25, f"{cell.id} is too long to read"
    assert not ABSOLUTE.search(path.read_text(encoding="utf-8"))


@every_notebook
def test_first_cell_says_what_and_how_long(path: Path) -> None:
    first = nbformat.read(path, as_version=4).cells[0]
    assert first.cell_type == "markdown"
    assert first.source.startswith("# ")
    for phrase in ("You will learn", "You need", "It takes"):
        assert f"**{phrase}**" in first.source


def test_absolute_paths_are_found() -> None:
    for text in ('open("/home/me/x")', "'/tmp/y'", r"C:\\Users\\me"):
        assert ABSOLUTE.search(text), text
    for text in ("NEES/dof", "docs/data.md", "a/b/tmp", "https://example.org/data/x"):
        assert not ABSOLUTE.search(text), text


@every_notebook
def test_notebook_runs(path: Path, tmp_path: Path, kernel: NotebookClient, request: pytest.FixtureRequest) -> None:
    data = {}
    if path.stem in NEEDS_DATA | USES_DATA:
        data["GRAPHSLAM_DATA"] = str(request.getfixturevalue("data_dir"))
    book = execute(path, tmp_path, kernel, **data)
    found = outputs(book)
    pictures = [o["data"]["image/png"] for o in found if "image/png" in o.get("data", {})]
    assert len(pictures) >= 5
    assert len(set(pictures)) == len(pictures), "a figure is drawn twice"
    text = "".join(o.text for o in found if o.output_type == "stream")
    assert "Warning" not in text, text
    assert "skipped" not in text, text
    left = {p.name for p in tmp_path.iterdir()}
    assert left <= {"cache"}, f"the notebook litters: {left}"


def test_a_notebook_without_its_data_ends_in_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(CellExecutionError) as caught:
        execute(FOLDER / "01_victoria_park.ipynb", tmp_path, GRAPHSLAM_DATA=str(tmp_path / "nothing"))
    book = caught.value.book  # type: ignore[attr-defined]
    (error,) = [o for o in outputs(book) if o.output_type == "error"]
    assert error.ename == "NotebookStop"
    assert len(error.traceback) <= 8
    assert "graphslam data fetch victoria-park" in "\n".join(error.traceback)
    assert "GRAPHSLAM_DATA" in "\n".join(error.traceback)
    ran = [c.id for c in book.cells if c.cell_type == "code" and c.execution_count is not None]
    assert ran[-1] == "vp-load"


def test_a_notebook_that_can_do_without_says_what_it_left_out(tmp_path: Path) -> None:
    book = nbformat.read(FOLDER / "07_one_set_of_submaps.ipynb", as_version=4)
    kept = [c for c in book.cells if c.id == "one-imports" or c.id.startswith("one-park")]
    assert len(kept) >= 4
    book.cells = kept
    part = tmp_path / "part.ipynb"
    nbformat.write(book, part)
    found = outputs(execute(part, tmp_path, GRAPHSLAM_DATA=str(tmp_path / "nothing")))
    assert not any("image/png" in o.get("data", {}) for o in found)
    text = "".join(o.text for o in found if o.output_type == "stream")
    assert "skipped: section 6 needs the data set victoria-park-local-maps" in text


def test_stop_says_the_terms_and_refuses_unknown_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GRAPHSLAM_DATA", str(tmp_path))
    monkeypatch.setenv("GRAPHSLAM_CACHE", str(tmp_path))
    with pytest.raises(NotebookStop) as caught:
        load_or_stop("radish-intel")  # a card without a direct download
    text = str(caught.value)
    assert "CC BY" in text
    assert "no direct download" in text
    assert caught.value._render_traceback_() == text.splitlines()
    with pytest.raises(UnknownNameError):
        load_or_stop("victoria-prak")
