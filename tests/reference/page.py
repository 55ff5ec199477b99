"""A page of HTML, read by the standard library's parser and held to be whole: every tag closed, in order."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path

TEMPLATES = Path(__file__).resolve().parents[2] / "graphslam" / "app" / "report" / "templates"
VIEWER = "".join((TEMPLATES / name).read_text(encoding="utf-8") for name in ("viewer.js", "curves.js"))
VOID = {"img", "meta", "br"}


@dataclass
class Table:
    """Of one section."""

    section: str
    rows: list[list[str]] = field(default_factory=list)
    classes: list[str] = field(default_factory=list)
    """Of the rows."""

    def records(self) -> list[dict[str, str]]:
        """Rows below the head, by the head's names."""
        head, *rest = self.rows
        return [dict(zip(head, r)) for r in rest]


class Page(HTMLParser):
    """Text, tables, links, pictures and tags of a page."""

    def __init__(self, html: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.tags: set[str] = set()
        self.links: list[str] = []
        self.sources: list[str] = []
        self.attributes: set[str] = set()
        self.sections: dict[str, str] = {}
        self.tables: list[Table] = []
        self.items: dict[str, list[str]] = {}
        self.verdict: list[tuple[str, str]] = []
        self.text = ""
        self.scripts: list[tuple[dict[str, str], str]] = []
        self.headline = ""
        self._headline = False
        self._section = ""
        self._item: tuple[str, str] | None = None
        self._cell: list[str] | None = None
        self.feed(html)
        self.close()
        assert not self.open, f"not closed: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {k: v or "" for k, v in attrs}
        self.tags.add(tag)
        self.attributes |= set(values)
        if tag not in VOID:
            self.open.append(tag)
        if tag == "script":
            self.scripts.append((values, ""))
        if "href" in values:
            self.links.append(values["href"])
        if "src" in values:
            self.sources.append(values["src"])
        if tag == "section":
            self._section = values["id"]
            assert self._section not in self.sections, "an id stands twice"
            self.sections[self._section] = ""
        if tag == "table":
            self.tables.append(Table(self._section))
        if tag == "tr":
            self.tables[-1].rows.append([])
            self.tables[-1].classes.append(values.get("class", ""))
        if tag in ("td", "th"):
            self._cell = []
        self._headline = "headline" in values.get("class", "").split()
        if tag == "li":
            self._item = (values.get("class", ""), "")

    def handle_endtag(self, tag: str) -> None:
        assert tag not in VOID
        assert self.open, f"</{tag}> closes nothing"
        assert self.open[-1] == tag, f"</{tag}> closes <{self.open[-1]}>"
        self.open.pop()
        self._headline = False
        if tag in ("td", "th"):
            assert self._cell is not None
            self.tables[-1].rows[-1].append("".join(self._cell))
            self._cell = None
        if tag == "li" and self._item is not None:
            self.items.setdefault(self._section, []).append(self._item[1])
            if not self._section:
                self.verdict.append(self._item)
            self._item = None
        if tag == "section":
            self._section = ""

    def handle_data(self, data: str) -> None:
        if self.open[-1:] == ["script"]:
            self.scripts[-1] = (self.scripts[-1][0], self.scripts[-1][1] + data)
            return
        self.text += data
        if self._headline:
            self.headline += data
        if self._section:
            self.sections[self._section] += data
        if self._cell is not None:
            self._cell.append(data)
        if self._item is not None:
            self._item = (self._item[0], self._item[1] + data)

    def table(self, section: str, *columns: str) -> Table:
        """The first table of a section that has these columns."""
        for t in self.tables:
            if t.section == section and t.rows and set(columns) <= set(t.rows[0]):
                return t
        raise AssertionError(f"no table with {columns} in {section}: {[t.rows[:1] for t in self.tables]}")

    def check_alone(self) -> None:
        """Nothing outside the page is asked for, and nothing in it runs but the viewer of the map and its curves."""
        assert not self.tags & {"link", "iframe", "object", "embed", "base", "form", "video", "audio"}
        viewer = [code for values, code in self.scripts if not values]
        assert viewer in ([], [VIEWER])
        data = [code for values, code in self.scripts if values == {"type": "application/json", "id": "scene"}]
        assert len(data) == len(viewer)
        assert len(self.scripts) == 2 * len(viewer)
        for code in data:
            json.loads(code)
        assert not {a for a in self.attributes if a.startswith("on")}
        assert all(x.startswith("#") and x[1:] in self.sections for x in self.links), self.links
        assert all(x.startswith("data:image/png;base64,") for x in self.sources)
