"""``graphslam merge``, ``localise``."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import typer

from graphslam.app.cli.run import JSON, MAX_SIZE
from graphslam.app.cli.terminal import emit, table


def register(app: typer.Typer) -> None:
    """Add the verbs to the command line."""
    app.command()(merge)
    app.command()(localise)


def merge(
    runs: list[Path] = typer.Argument(..., help="Run folders, at least two; the first one's base is the origin."),
    by: str = typer.Option(
        "auto", help="Landmarks: identity, constellation (their pattern). Dense submaps: places, gps. Or auto."
    ),
    solver: str = typer.Option("batch", help="isam2 or batch."),
    identity_gate: float = typer.Option(25.0, help="Split off sightings beyond this χ² (2 dof); 0 = never."),
    tolerance: float = typer.Option(0.5, help="Landmarks of two maps this near after alignment agree [m]."),
    out: Path = typer.Option(..., help="Folder for the merged map."),
    max_size: str | None = MAX_SIZE,
    as_json: bool = JSON,
) -> None:
    """Merge runs of several robots or days into one map, solved as one problem, by the landmarks they share."""
    from graphslam.app.sessions.merge import merge as merge_runs
    from graphslam.app.sessions.merge_align import By

    merged = merge_runs(runs, by=cast(By, by), solver=solver, identity_gate=identity_gate, tolerance=tolerance, out=out)
    rows = merged.metrics.to_dict("records")
    where = f"report in {out / 'report.html'}, map in {out / 'figures' / 'map.png'}"
    text = f"{table(rows, ['key', 'value', 'unit'])}\nwritten to {out}: {where}"
    emit({"out": str(out), "metrics": rows, "report": merged.report}, text, as_json=as_json)


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
