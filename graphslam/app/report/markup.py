"""Parts of the report's page.

A page needs no network, no script and no other file: pictures are in it, and its links lead to its own parts.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable
from typing import Any

from graphslam.core.markup import Markup, element, join


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
