"""``graphslam localise``."""

from __future__ import annotations

from pathlib import Path

import typer

from graphslam.app.cli.run import JSON, MAX_SIZE
from graphslam.app.cli.terminal import emit, table


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    app.command()(localise)


def localise(
    run: Path = typer.Argument(..., help="Run folder of dense submaps: the map."),
    source: str = typer.Argument(..., help="What is to be found: another run folder, a log folder, or a card."),
    submap: list[int] = typer.Option([], help="Of a run folder, only the submap of this key; may be repeated."),
    begin: float | None = typer.Option(None, help="Of a log, from this time on [s]."),
    end: float | None = typer.Option(None, help="Of a log, up to this time [s]."),
    max_size: str | None = MAX_SIZE,
    as_json: bool = JSON,
) -> None:
    """Find submaps, or a stretch of a log, in a saved map: pose with covariance, every candidate, and why not."""
    from graphslam.app.sessions.localise import localise as find
    from graphslam.app.sessions.localise import source_of

    found = find(run, source_of(source, submap, begin, end), progress=not as_json)
    rows = found.rows()
    columns = ["submap_map", "submap_here", "score", "accepted", "why"]
    text = f"{table(rows, columns)}\n{found!r}"
    value = {
        "found": found.found,
        "why": found.why,
        "T_map_base": found.T_map_base,
        "covariance": found.covariance,
        "T_map_end": found.T_map_end,
        "end_covariance": found.end_covariance,
        "candidates": rows,
    }
    emit(value, text, as_json=as_json)
