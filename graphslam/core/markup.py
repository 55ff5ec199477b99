"""Safe HTML from Jinja2 templates with autoescape.

All pages and notebook tables are made with it.
"""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

if TYPE_CHECKING:
    from jinja2 import Environment

# Not allowed in HTML text: control characters, unpaired surrogates, non-characters.
_UNFIT = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff\ufffe\uffff]")
NOTHING = "–"
_ELEMENT = (
    '<{{ tag }}{% for k, v in attributes.items() %} {{ k }}="{{ v }}"{% endfor %}>'
    "{% if not void %}{% for c in children %}{{ c }}{% endfor %}</{{ tag }}>{% endif %}"
)
_TABLE = """\
<div class="wide"><table{% if class_ %} class="{{ class_ }}"{% endif %}>{% if head %}<thead><tr>{% for h in head %}\
<th scope="col">{{ h }}</th>{% endfor %}</tr></thead>{% endif %}<tbody>{% for r in rows %}\
<tr{% if r.class_ %} class="{{ r.class_ }}"{% endif %}{% for k, v in r.data.items() %} data-{{ k }}="{{ v }}"\
{% endfor %}>{% if r.name is not none %}<th scope="row">{{ r.name }}</th>{% endif %}{% for c in r.cells %}\
<td{% if c.right %} class="n"{% endif %}>{{ c.text }}</td>{% endfor %}</tr>
{% endfor %}</tbody></table></div>"""


@cache
def template_environment(package: str | None = None) -> Environment:
    """The template engine, with autoescape; optionally with the folder ``templates`` of a package."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader = None if package is None else PackageLoader(package)
    return Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=False)


@cache
def _template(source: str) -> Any:
    return template_environment().from_string(source)


def plain_text(value: Any) -> str:
    """The value as text; characters that are not allowed in HTML become ``�``."""
    return value if isinstance(value, Markup) else _UNFIT.sub("\ufffd", str(value))


def escape_text(value: Any) -> Markup:
    """The value as text of a page; markup stays as it is."""
    return value if isinstance(value, Markup) else Markup.escape(plain_text(value))


def html_element(tag: str, *children: Any, **attributes: Any) -> Markup:
    """An element; children and values of attributes are escaped. ``class_`` is the attribute ``class``.

    Examples
    --------
    >>> element("p", "a < b", class_="note")
    Markup('<p class="note">a &lt; b</p>')
    """
    given = {k.rstrip("_"): plain_text(v) for k, v in attributes.items() if v is not None and v != ""}
    inside = [plain_text(c) for c in children if c is not None]
    return Markup(
        _template(_ELEMENT).render(tag=tag, attributes=given, children=inside, void=tag in ("img", "meta", "br"))
    )


def inline_picture(png: bytes, caption: str) -> Markup:
    """A PNG inside the page."""
    src = "data:image/png;base64," + base64.b64encode(png).decode("ascii")
    return html_element("figure", html_element("img", src=src, alt=caption), html_element("figcaption", caption))


def join_parts(parts: Iterable[Any], between: str = "") -> Markup:
    """Concatenated parts, each escaped unless it is markup."""
    return Markup(between).join(escape_text(p) for p in parts if p is not None)


def value_text(value: Any) -> str:
    """A value as text of a table cell: six digits, ``–`` for None and NaN, yes and no."""
    if value is None:
        return NOTHING
    if isinstance(value, bool):
        return "yes" if value else "no"
    if hasattr(value, "tolist"):  # NumPy
        return value_text(value.tolist())
    if isinstance(value, float):
        return NOTHING if math.isnan(value) else f"{value:.6g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{k} {value_text(v)}" for k, v in value.items()) or NOTHING
    if isinstance(value, (list, tuple)):
        return ", ".join(value_text(v) for v in value) or NOTHING
    return str(value)


def is_numeric(value: Any) -> bool:
    """Whether it is a number (right-aligned)."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


@dataclass(frozen=True, slots=True)
class Row:
    """A table row with its own class and data attributes."""

    cells: Mapping[str, Any]
    class_: str = ""
    data: Mapping[str, Any] = field(default_factory=dict)


def html_table(
    rows: Sequence[Mapping[str, Any] | Row], columns: Mapping[str, str] | Sequence[str], *, class_: str = ""
) -> Markup:
    """Rows as a table.

    Parameters
    ----------
    columns : mapping or sequence of str
        Keys of the cells, or keys with their headings.
    class_ : str
        Of the table.
    """
    names = columns if isinstance(columns, Mapping) else {c: c for c in columns}
    body = []
    for r in rows:
        row = r if isinstance(r, Row) else Row(r)
        cells = [_cell(row.cells.get(k)) for k in names]
        body.append({"class_": plain_text(row.class_), "data": row.data, "name": None, "cells": cells})
    head = [plain_text(h) for h in names.values()]
    return Markup(_template(_TABLE).render(class_=class_, head=head, rows=body))


def _cell(value: Any) -> dict[str, Any]:
    return {
        "text": plain_text(value_text(value) if not isinstance(value, Markup) else value),
        "right": is_numeric(value),
    }


def pair_list(values: Mapping[str, Any]) -> Markup:
    """Names and values, one pair per line."""
    rows = [{"class_": "", "data": {}, "name": plain_text(k), "cells": [_cell(v)]} for k, v in values.items()]
    return Markup(_template(_TABLE).render(class_="", head=[], rows=rows))


def item_list(lines: Iterable[Any]) -> Markup:
    """Lines as a list."""
    return html_element("ul", join_parts((html_element("li", x) for x in lines), "\n"))
