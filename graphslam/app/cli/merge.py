"""``graphslam merge``."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import typer

from graphslam.app.cli.run import JSON, MAX_SIZE
from graphslam.app.cli.terminal import emit, table


def register(app: typer.Typer) -> None:
    """Add the verbs to the command line."""
    app.command()(merge)


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
