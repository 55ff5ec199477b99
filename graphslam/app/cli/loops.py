"""``graphslam loops``."""

from __future__ import annotations

from pathlib import Path

import typer

from graphslam.app.cli.run import JSON, MAX_SIZE
from graphslam.app.cli.terminal import emit, table

SHOWN = ("loop", "verdict", "source", "submap_i", "submap_j", "fitness", "chi2", "weight", "effect", "factor_id", "why")


def register(app: typer.Typer) -> None:
    """Add the verbs to the command line."""
    app.command()(loops)


def loops(
    run: Path = typer.Argument(..., help="Folder of a finished run."),
    history: bool = typer.Option(False, help="Every decision, not only those in force."),
    every: bool = typer.Option(False, "--all", help="Also what the registration refused."),
    undo: int | None = typer.Option(None, help="Take this loop out, solve again, and write the run anew."),
    redo: int | None = typer.Option(None, help="Take in again a loop that was undone."),
    max_size: str | None = MAX_SIZE,
    as_json: bool = JSON,
) -> None:
    """Loops of a run: where each came from, its gates, χ², weight and effect, accepted or not, and why."""
    from graphslam.app.run.files import loops_of_run
    from graphslam.app.run.loops import redo_loop, undo_loop
    from graphslam.core.errors import ConfigError

    if undo is not None and redo is not None:
        raise ConfigError("--undo and --redo together; give one of them")
    if undo is not None:
        ledger = undo_loop(run, undo, progress=not as_json)
    elif redo is not None:
        ledger = redo_loop(run, redo, progress=not as_json)
    else:
        ledger = loops_of_run(run)
    frame = ledger.table(history=history)
    rows = [{str(k): v for k, v in row.items()} for row in frame.to_dict("records")]
    counts = ledger.counts()
    shown = rows if every or as_json else [r for r in rows if not str(r["why"]).startswith("registration")]
    hidden = len(rows) - len(shown)
    said = ", ".join(f"{n} {verdict}" for verdict, n in sorted(counts.items())) or "none"
    text = f"{table(shown, SHOWN)}\nloops: {said}"
    if hidden:
        text += f"; {hidden} refused by their registration are not shown (--all)"
    emit({"run": str(run), "counts": counts, "loops": rows}, text, as_json=as_json)
