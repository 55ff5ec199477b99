"""Findings: the lines of the verdict of a run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, cast

from graphslam.core.markup import html_element, join_parts

Level = Literal["good", "look", "bad", ""]
"""``good``: checked and right. ``look``: may be wrong. ``bad``: wrong, do not use the map. Empty: information."""
LEVELS: tuple[Level, ...] = ("", "good", "look", "bad")
"""Ascending severity."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of a verdict.

    Parameters
    ----------
    level : {"good", "look", "bad", ""}
    code : str
        Name of the check, the same in every run, for programs that read a verdict: ``"gps-not-used"``.
    text : str
        A full sentence with the values and, if something is wrong, what to do.
    """

    level: Level
    code: str
    text: str

    def as_row(self) -> dict[str, str]:
        """JSON object of this line."""
        return {"level": self.level, "code": self.code, "text": self.text}

    @classmethod
    def from_row(cls, row: Any) -> Finding | None:
        """Finding of a JSON object; None if it is invalid."""
        if not isinstance(row, Mapping) or not all(isinstance(row.get(k), str) for k in ("level", "code", "text")):
            return None
        if row["level"] not in LEVELS:
            return None
        return cls(cast(Level, row["level"]), row["code"], row["text"])


class Findings(list[Finding]):
    """Lines of a verdict; printed as text, displayed as a list in a notebook."""

    def __str__(self) -> str:
        return "\n".join(f"{f.level or '-':4}  {f.text}" for f in self)

    def _repr_html_(self) -> str:
        rows = [html_element("li", html_element("b", f"{f.level or 'info'}: "), f.text) for f in self]
        return html_element("ul", join_parts(rows))


def worst_level(findings: Iterable[Finding]) -> Level:
    """The highest severity among the findings."""
    return max((f.level for f in findings), key=LEVELS.index, default="")


def verdict_json(headline: Finding, findings: Iterable[Finding]) -> dict[str, Any]:
    """All findings as one JSON object: ``level``, ``headline``, and ``lines`` of ``level, code, text``."""
    return {"level": headline.level, "headline": headline.text, "lines": [f.as_row() for f in findings]}


def headline_of_json(value: Any) -> Finding | None:
    """The first line of the JSON object that :func:`verdict_json` makes; None if there is none."""
    row = value if isinstance(value, Mapping) else {}
    return Finding.from_row({"level": row.get("level"), "code": "headline", "text": row.get("headline")})


def findings_of_json(value: Any) -> Findings:
    """Findings of the JSON object that :func:`verdict_json` makes; invalid entries are ignored."""
    lines = value.get("lines") if isinstance(value, Mapping) else None
    return Findings(f for row in (lines if isinstance(lines, list) else []) if (f := Finding.from_row(row)))
