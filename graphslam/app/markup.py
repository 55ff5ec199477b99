"""HTML that is safe by its making: whatever is not markup yet is escaped where it becomes markup.

A page needs no network, no script and no other file: pictures are in it, and its links lead to its own parts.
"""

from __future__ import annotations

import base64
import html
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

_VOID = frozenset({"img", "meta", "br"})
# What HTML allows in no text at all: control characters, halves of surrogate pairs, non-characters.
_UNFIT = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff\ufffe\uffff]")
NOTHING = "–"


class Markup(str):
    """Text that is HTML already; everything else is text."""

    __slots__ = ()


def escape(value: Any) -> Markup:
    """The value as text of a page; markup stays as it is. Characters that no page may hold become ``�``."""
    if isinstance(value, Markup):
        return value
    return Markup(html.escape(_UNFIT.sub("\ufffd", str(value)), quote=True))


def element(tag: str, *children: Any, **attributes: Any) -> Markup:
    """An element; children and values of attributes are escaped. ``class_`` is the attribute ``class``.

    Examples
    --------
    >>> element("p", "a < b", class_="note")
    '<p class="note">a &lt; b</p>'
    """
    said = "".join(f' {k.rstrip("_")}="{escape(v)}"' for k, v in attributes.items() if v is not None and v != "")
    if tag in _VOID:
        return Markup(f"<{tag}{said}>")
    return Markup(f"<{tag}{said}>{join(children)}</{tag}>")


def join(parts: Iterable[Any], between: str = "") -> Markup:
    """Parts after each other, each escaped unless it is markup."""
    return Markup(escape(between).join(escape(p) for p in parts if p is not None))


def figure_text(value: Any) -> str:
    """A value as a cell of a table shows it: six digits, ``–`` for none and not-a-number, yes and no."""
    if value is None:
        return NOTHING
    if isinstance(value, bool):
        return "yes" if value else "no"
    if hasattr(value, "tolist"):  # NumPy
        return figure_text(value.tolist())
    if isinstance(value, float):
        return NOTHING if math.isnan(value) else f"{value:.6g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{k} {figure_text(v)}" for k, v in value.items()) or NOTHING
    if isinstance(value, (list, tuple)):
        return ", ".join(figure_text(v) for v in value) or NOTHING
    return str(value)


def is_figure(value: Any) -> bool:
    """Is it a number, which stands to the right of its cell?"""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


@dataclass(frozen=True, slots=True)
class Row:
    """A row of a table with a class of its own."""

    cells: Mapping[str, Any]
    class_: str = ""


def table(
    rows: Sequence[Mapping[str, Any] | Row], columns: Mapping[str, str] | Sequence[str], *, class_: str = ""
) -> Markup:
    """Rows as a table.

    Parameters
    ----------
    rows : sequence of mapping or Row
    columns : mapping or sequence of str
        Keys of the cells, or keys with their headings.
    class_ : str
        Of the table.
    """
    names = columns if isinstance(columns, Mapping) else {c: c for c in columns}
    head = element("tr", *(element("th", heading, scope="col") for heading in names.values()))
    body = []
    for r in rows:
        row = r if isinstance(r, Row) else Row(r)
        cells = (row.cells.get(k) for k in names)
        body.append(element("tr", *(_cell(v) for v in cells), class_=row.class_))
    return element(
        "div",
        element("table", element("thead", head), element("tbody", join(body, "\n")), class_=class_),
        class_="wide",
    )


def _cell(value: Any) -> Markup:
    if isinstance(value, Markup):
        return element("td", value)
    return element("td", figure_text(value), class_="n" if is_figure(value) else None)


def pairs(values: Mapping[str, Any]) -> Markup:
    """Names and values, one pair a line."""
    rows = [element("tr", element("th", k, scope="row"), _cell(v)) for k, v in values.items()]
    return element("div", element("table", element("tbody", join(rows, "\n"))), class_="wide")


def items(lines: Iterable[Any]) -> Markup:
    """Lines as a list."""
    return element("ul", join((element("li", x) for x in lines), "\n"))


def folded(summary: str, body: Markup) -> Markup:
    """What is opened by hand."""
    return element("details", element("summary", summary), body)


def note(*text: Any) -> Markup:
    """A remark."""
    return element("p", *text, class_="note")


def missing(*text: Any) -> Markup:
    """That something is not there, and why."""
    return element("p", "Missing: ", *text, class_="missing")


def section(name: str, title: str, *parts: Any) -> Markup:
    """A part of the page, under a name that links lead to."""
    return element("section", element("h2", title), join(parts, "\n"), id=name)


def picture(png: bytes, caption: str) -> Markup:
    """A PNG inside the page."""
    src = "data:image/png;base64," + base64.b64encode(png).decode("ascii")
    return element("figure", element("img", src=src, alt=caption), element("figcaption", caption))


def compact(value: Any) -> str:
    """A value as one line of JSON."""
    return json.dumps(value, ensure_ascii=False, default=str)


STYLE = Markup(
    """
body { font: 15px/1.45 system-ui, sans-serif; color: #1a1a1a; background: #fff; margin: 0 auto; max-width: 75rem;
  padding: 1rem 1.5rem 4rem; }
h1 { font-size: 1.5rem; margin: 0.5rem 0; } h2 { font-size: 1.15rem; margin: 2.2rem 0 0.5rem; }
h3 { font-size: 1rem; margin: 1.2rem 0 0.3rem; }
nav a { margin-right: 0.9rem; white-space: nowrap; }
table { border-collapse: collapse; font-size: 0.86rem; } .wide { overflow-x: auto; margin: 0.4rem 0; }
th, td { text-align: left; vertical-align: top; padding: 0.15rem 0.7rem 0.15rem 0; border-bottom: 1px solid #e3e3e3; }
th { font-weight: 600; } td.n { text-align: right; font-variant-numeric: tabular-nums; }
.headline { font-size: 1.1rem; font-weight: 600; } .headline.bad { color: #b04a00; }
.verdict { list-style: none; padding: 0; } .verdict li { padding: 0.25rem 0.6rem; border-left: 5px solid #6b6b6b;
  margin: 0.25rem 0; background: #f6f6f6; }
.verdict li.good { border-color: #009e73; } .verdict li.look { border-color: #e69f00; }
.verdict li.bad { border-color: #d55e00; background: #fdf1ea; }
.note { color: #555; max-width: 60rem; } .missing { color: #8a4b00; }
tr.rejected td, tr.undone td, tr.switched-off td { color: #6b6b6b; } tr.undone td, tr.switched-off td
  { text-decoration: line-through; } tr.undone td:nth-child(2), tr.undone td:last-child,
  tr.switched-off td:nth-child(2), tr.switched-off td:last-child { text-decoration: none; color: #d55e00; }
figure { margin: 0.8rem 0; } img { max-width: 100%; height: auto; border: 1px solid #e3e3e3; }
figcaption { color: #555; font-size: 0.86rem; } summary { cursor: pointer; margin: 0.4rem 0; }
pre { background: #f6f6f6; padding: 0.6rem; overflow-x: auto; font-size: 0.82rem; }
"""
)


def page(title: str, body: Iterable[Any]) -> str:
    """A whole page."""
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("title", title),
        Markup(f"<style>{STYLE}</style>"),
    )
    return f'<!DOCTYPE html>\n<html lang="en">\n{head}\n{element("body", join(body, chr(10)))}\n</html>\n'
