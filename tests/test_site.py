"""Pages of the site that are made at build time: notebooks with outputs, gallery, formulas, and the next page."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("mkdocs")
pytest.importorskip("latex2mathml")

from docs import notebook_outputs, site_pages

ROOT = Path(__file__).resolve().parents[1]
PNG = base64.b64encode(b"a picture").decode()


def cell(kind: str, name: str, source: str, *outputs: dict[str, Any]) -> dict[str, Any]:
    return {"cell_type": kind, "id": name, "source": [source], **({"outputs": list(outputs)} if kind == "code" else {})}


@pytest.fixture
def book(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A notebook whose outputs can be put into an empty cache."""
    monkeypatch.setattr(notebook_outputs, "CACHE", tmp_path / "cache")
    path = tmp_path / "20_a_book.ipynb"
    path.write_text(json.dumps({"cells": [cell("markdown", "b-title", "# A book"), cell("code", "b-one", "1 + 1")]}))
    return path


def test_page_of_a_notebook_shows_every_kind_of_output_below_its_code(book: Path) -> None:
    file = notebook_outputs.cached(book)
    file.parent.mkdir()
    shown = (
        {"output_type": "stream", "name": "stdout", "text": ["a < b\n"]},
        {"output_type": "stream", "name": "stderr", "text": ["a warning"]},
        {"output_type": "display_data", "data": {"image/png": PNG, "text/plain": "<Figure>"}},
        {"output_type": "execute_result", "data": {"text/html": "<style>x</style>\n<b>table</b>", "text/plain": "t"}},
        {"output_type": "error", "ename": "NotebookStop", "evalue": "no data", "traceback": []},
    )
    cells = [cell("markdown", "b-title", "# A book"), cell("code", "b-one", "1 + 1", *shown)]
    file.write_text(json.dumps({"cells": cells}))
    page = site_pages.Tutorial.of(book)
    assert page.pictures == {"20_a_book-b-one-2.png": b"a picture"}
    in_order = ["# A book", "quick mode", "1 + 1", "a &lt; b", 'src="20_a_book-b-one-2.png"', "<b>table</b>", "no data"]
    places = [page.text.index(part) for part in in_order]
    assert places == sorted(places)
    for absent in ("a warning", "<style", "<Figure>"):
        assert absent not in page.text
    text = site_pages.gallery([page])
    assert "[![A book](tutorials/20_a_book-b-one-2.png)](tutorials/20_a_book.md#b-one)" in text
    assert '<a id="b-one"></a>' in page.text


def test_page_without_outputs_says_so(book: Path) -> None:
    page = site_pages.Tutorial.of(book)
    assert "built without running the notebooks" in page.text
    assert "no pictures" in site_pages.gallery([page])


def test_a_change_of_notebook_or_code_or_data_makes_other_outputs(book: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("GRAPHSLAM_DATA", raising=False)
    names = {notebook_outputs.cached(book), notebook_outputs.cached(book)}
    assert len(names) == 1
    monkeypatch.setenv("GRAPHSLAM_DATA", "somewhere")
    names.add(notebook_outputs.cached(book))
    monkeypatch.setattr(notebook_outputs, "digest_of_code", lambda: b"other")
    names.add(notebook_outputs.cached(book))
    book.write_text(book.read_text() + " ")
    names.add(notebook_outputs.cached(book))
    assert len(names) == 4


def test_formulas_of_notebooks_are_on_lines_of_their_own() -> None:
    """Others are not typeset."""
    for book in sorted((ROOT / "notebooks").glob("*.ipynb")):
        cells = json.loads(book.read_text())["cells"]
        text = "\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "markdown")
        assert all(line == "$$" for line in text.split("\n") if "$$" in line), book.name


def test_formulas_are_typeset_without_a_script() -> None:
    found = site_pages.FORMULA.sub(lambda m: site_pages.typeset(m[1]), "Text\n\n$$\nx^2\n$$\n\nmore, 5 $ and $$.\n")
    assert re.search(r'<div class="formula"><math .*<msup><mi>x</mi><mn>2</mn></msup>.*</math></div>', found)
    assert "more, 5 $ and $$." in found


@pytest.mark.parametrize(
    ("part", "text", "added"),
    [("Concepts", "<p>End.</p>", True), ("Notes", "<p>End.</p>", False), ("Concepts", "<p>Next: <a>x</a></p>", False)],
)
def test_a_page_for_users_ends_with_the_next_page(part: str, text: str, added: bool) -> None:
    to = SimpleNamespace(title="A & B", file=SimpleNamespace(url_relative_to=lambda other: "b.html"))
    page = SimpleNamespace(ancestors=[SimpleNamespace(title=part)], next_page=to, content=text, file=None)
    site_pages.on_page_context({}, page, None, None)
    assert page.content.endswith('<p>Next: <a href="b.html">A &amp; B</a>.</p>') == added


def test_reference_shows_names_without_roles() -> None:
    shown = site_pages.on_page_content("for :func:<code>run</code> and :class:<code>~a.B</code>", None, None, None)
    assert shown == "for <code>run</code> and <code>a.B</code>"


def test_search_works_in_pages_from_disk_and_loads_nothing_from_elsewhere() -> None:
    config = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    assert "\n  - offline\n" in config  # writes the index as a script, which such a page may load
    [scripts] = re.findall(r"^  polyfills: \[(.*?)\]", config, re.MULTILINE)
    for name in scripts.split(", "):
        assert "//" not in name
        assert (ROOT / "docs" / name).exists()
    assert "iframe-worker" in scripts  # else the plugin adds one from a server
