"""The table of the grid front ends in ``docs/notes/faults.md``; ``python -m tests.faults.grid_page`` writes it anew."""

from __future__ import annotations

from pathlib import Path

from tests.faults.grid_rows import ROWS

MARK = "<!-- grid rows -->\n"
PAGE = Path(__file__).resolve().parents[2] / "docs" / "notes" / "faults.md"


def markdown() -> str:
    """The rows as a table."""
    lines = ["| sensor | fault | in | outcome | what you see |", "|---|---|---|---|---|"]
    for row in ROWS:
        dims = ", ".join(f"{d}-D" for d in row.dims)
        sign = "" if not row.sign else f"“{row.sign}”" if row.outcome == "refused" else f"`{row.sign}`"
        sign = " or ".join(f"`{s}`" for s in row.sign.split("|")) if row.outcome == "reported" else sign
        lines.append(f"| {row.sensor} | {row.fault} | {dims} | {row.outcome} | {sign} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    head = PAGE.read_text().partition(MARK)[0]
    PAGE.write_text(head + MARK + markdown())
