"""HTML parts of the report page.

The page needs no network and no other file: it includes pictures, style, and the script of its map and curves.
"""

from __future__ import annotations

import base64
import hashlib
import json
from importlib.resources import files
from typing import Any

from graphslam.core.markup import Markup, html_element, join_parts, template_environment

SCRIPTS = ("viewer.js", "curves.js")
"""Joined to the only script of a page."""


def folded_section(summary: str, body: Markup) -> Markup:
    """A section that is collapsed until the user opens it."""
    return html_element("details", html_element("summary", summary), body)


def remark(*text: Any) -> Markup:
    """A note."""
    return html_element("p", *text, class_="note")


def missing_note(*text: Any) -> Markup:
    """A note that something is missing, and why."""
    return html_element("p", "Missing: ", *text, class_="missing")


def page_section(name: str, title: str, *parts: Any) -> Markup:
    """A section of the page with an anchor for links."""
    return html_element("section", html_element("h2", title), join_parts(parts, "\n"), id=name)


def compact_json(value: Any) -> str:
    """A value as one line of JSON."""
    return json.dumps(value, ensure_ascii=False, default=str)


def whole_page(**values: Any) -> str:
    """The complete page: ``title``, ``headline``, ``findings``, ``parts``, ``scene`` in the template ``page.html``."""
    pages = template_environment("graphslam.app.report")
    templates = files("graphslam.app.report") / "templates"
    viewer = "".join((templates / name).read_text(encoding="utf-8") for name in SCRIPTS)
    digest = base64.b64encode(hashlib.sha256(viewer.encode()).digest()).decode("ascii")
    return pages.get_template("page.html").render(viewer=Markup(viewer), digest=digest, **values) + "\n"
