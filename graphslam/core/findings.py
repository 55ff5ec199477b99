"""Statements of a run about itself, as a user without truth sees them: the lines of its verdict."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, cast

Level = Literal["good", "look", "bad", ""]
"""``good``: checked and right. ``look``: may be wrong. ``bad``: wrong, the map is not to be trusted. Empty: a fact."""
LEVELS: tuple[Level, ...] = ("", "good", "look", "bad")
"""In order of how much they weigh."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of a verdict.

    Parameters
    ----------
    level : {"good", "look", "bad", ""}
    code : str
        Name of the check, the same in every run, for programs that read a verdict: ``"gps-not-used"``.
    text : str
        A full sentence with the figures and, where something is wrong, what to do about it.
    """

    level: Level
    code: str
    text: str

    def as_row(self) -> dict[str, str]:
        """JSON object of this line."""
        return {"level": self.level, "code": self.code, "text": self.text}

    @classmethod
    def from_row(cls, row: Any) -> Finding | None:
        """Finding of a JSON object; None if it is none."""
        if not isinstance(row, Mapping) or not all(isinstance(row.get(k), str) for k in ("level", "code", "text")):
            return None
        if row["level"] not in LEVELS:
            return None
        return cls(cast(Level, row["level"]), row["code"], row["text"])


def worst(findings: Iterable[Finding]) -> Level:
    """The level that weighs most among the findings."""
    return max((f.level for f in findings), key=LEVELS.index, default="")


def headline(findings: Iterable[Finding]) -> Finding:
    """What all findings together say, as one sentence."""
    found = list(findings)
    level = worst(found)
    n = sum(f.level == level for f in found)
    points = f"the {n} points" if n > 1 else "the point"
    if level == "bad":
        text = f"Do not trust this map before you have looked at {points} marked “bad”."
    elif level == "look":
        text = f"Nothing is known to be wrong; look at {points} marked “look”."
    else:
        text = "Nothing that this run can check speaks against the map."
    return Finding(level or "good", "headline", text)


def verdict_json(findings: Iterable[Finding]) -> dict[str, Any]:
    """All findings as one JSON object: ``level``, ``headline``, and ``lines`` of ``level, code, text``."""
    found = list(findings)
    said = headline(found)
    return {"level": said.level, "headline": said.text, "lines": [f.as_row() for f in found]}


def findings_of_json(value: Any) -> list[Finding]:
    """Findings of the JSON object that :func:`verdict_json` makes; what is none of ours is left out."""
    lines = value.get("lines") if isinstance(value, Mapping) else None
    return [f for row in (lines if isinstance(lines, list) else []) if (f := Finding.from_row(row))]
