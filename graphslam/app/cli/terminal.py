"""Output of the command line: one JSON object or a table on stdout, everything else on stderr."""

from __future__ import annotations

import io
import json
import logging
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import typer

from graphslam.core.errors import GraphSlamError
from graphslam.core.findings import Finding, Findings
from graphslam.core.json_file import json_values
from graphslam.core.progress import Bar, printable


def print_result(value: Mapping[str, Any], text: str, *, as_json: bool) -> None:
    """Print ``value`` as one JSON object, or ``text``."""
    typer.echo(json.dumps(json_values(value), allow_nan=False) if as_json else printable(text))


def write_and_print(
    write: Callable[[], Any], value: Mapping[str, Any], text: str, written: str, *, as_json: bool, key: str = "out"
) -> None:
    """Write the file of a result, and print the result, also if the file could not be written.

    Parameters
    ----------
    written : str
        Last line of the text if the file was written.
    key : str
        Of the file in ``value``; None there if it was not written.
    """
    failed: Exception | None = None
    try:
        write()
    except (GraphSlamError, OSError, MemoryError) as error:
        failed = error
    print_result(
        {**value, key: None} if failed else value,
        text if failed or not written else f"{text}\n{written}",
        as_json=as_json,
    )
    if failed is not None:
        raise failed


def text_table(rows: Sequence[Mapping[str, Any]], columns: Sequence[str] | None = None) -> str:
    """Rows as aligned text."""
    if not rows:
        return "(none)"
    names = list(columns or rows[0])
    cells = [names] + [[_cell(r.get(n)) for n in names] for r in rows]
    widths = [max(len(c[k]) for c in cells) for k in range(len(names))]
    return "\n".join("  ".join(c.ljust(w) for c, w in zip(line, widths)).rstrip() for line in cells)


def verdict_text(headline: Finding, findings: Sequence[Finding]) -> list[str]:
    """Lines of a verdict: the headline, then each finding with its level."""
    return [f"verdict: {headline.text}", *(f"  {line}" for line in str(Findings(findings)).splitlines())]


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return "-" if value != value else f"{value:.6g}"
    return str(value)


class _Messages(logging.StreamHandler):
    """Messages of the library, printed above a progress bar and without control characters."""

    def format(self, record: logging.LogRecord) -> str:
        return printable(super().format(record))

    def emit(self, record: logging.LogRecord) -> None:
        with Bar.external_write_mode(file=self.stream):
            super().emit(record)


def log_to_stderr() -> None:
    """Print warnings and errors of the library on stderr, so that stdout has only the result."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s", handlers=[_Messages(sys.stderr)], force=True)
    Bar.hidden = False


def be_verbose() -> None:
    """Print progress messages too."""
    logging.getLogger().setLevel(logging.INFO)


def be_quiet() -> None:
    """Print errors only, and no progress bar."""
    logging.getLogger().setLevel(logging.ERROR)
    Bar.hidden = True


class _Lost(io.FileIO):
    """Stderr; failed writes are ignored."""

    def write(self, data: Any) -> int:
        try:
            return super().write(data) or 0
        except OSError:
            return len(data)


def outlive_streams() -> None:
    """Continue if stderr is closed, full, or a broken pipe: messages are lost, the result is not. A closed stdout is
    the wish of the caller: the result is then in the files only."""
    if sys.stdout is None:  # otherwise the next opened file would get descriptor 1
        try:
            os.fstat(1)
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115
    if sys.stderr is None:
        try:
            os.fstat(2)
        except OSError:  # closed: otherwise the next opened file would get descriptor 2 and the messages
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115
    elif sys.stderr is sys.__stderr__:
        kept = io.BufferedWriter(_Lost(2, "w", closefd=False))
        sys.stderr = io.TextIOWrapper(kept, sys.__stderr__.encoding, "backslashreplace", line_buffering=True)
