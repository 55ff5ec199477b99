"""HTML that is safe by its making: whatever is not markup yet is escaped where it becomes markup.

Pages and the tables that notebooks show are made with it, and with nothing else.
"""

from __future__ import annotations

import html
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


def frame(rows: Any) -> Markup:
    """A pandas table, in full."""
    return table(rows.to_dict("records"), {c: str(c) for c in rows.columns})
