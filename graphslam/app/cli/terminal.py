"""What the command line prints: one JSON object or a table on stdout, everything else on stderr."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import typer

from graphslam.core.findings import Finding
from graphslam.core.json_file import json_values


def print_result(value: Mapping[str, Any], text: str, *, as_json: bool) -> None:
    """Print ``value`` as one JSON object, or ``text``."""
    typer.echo(json.dumps(json_values(value), allow_nan=False) if as_json else text)


def text_table(rows: Sequence[Mapping[str, Any]], columns: Sequence[str] | None = None) -> str:
    """Rows as aligned text."""
    if not rows:
        return "(none)"
    names = list(columns or rows[0])
    cells = [names] + [[_cell(r.get(n)) for n in names] for r in rows]
    widths = [max(len(c[k]) for c in cells) for k in range(len(names))]
    return "\n".join("  ".join(c.ljust(w) for c, w in zip(line, widths)).rstrip() for line in cells)


def verdict_text(headline: Finding, findings: Sequence[Finding]) -> list[str]:
    """Lines of a verdict: what all of it says, then each finding behind its level."""
    return [f"verdict: {headline.text}", *(f"  {f.level or '-':4}  {f.text}" for f in findings)]


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return "-" if value != value else f"{value:.6g}"
    return str(value)


def log_to_stderr(verbose: bool) -> None:
    """Library messages on stderr, so that stdout holds the result alone."""
    logging.basicConfig(
        stream=sys.stderr, level=logging.INFO if verbose else logging.WARNING, format="%(message)s", force=True
    )
