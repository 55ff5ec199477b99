"""``graphslam export``."""

from __future__ import annotations

from pathlib import Path

import typer

from graphslam.app.cli.run import JSON, MAX_SIZE
from graphslam.app.cli.terminal import emit


def register(app: typer.Typer) -> None:
    """Add the verbs to the command line."""
    app.command()(export)


def export(
    run: Path = typer.Argument(..., help="Run folder."),
    format: str = typer.Option("kml", help="kml (Google Earth) or geojson (GIS)."),
    datum: str = typer.Option(
        ..., help="LAT,LON of the origin of the GPS frame (of the first base without GPS), degrees WGS 84."
    ),
    heading: float | None = typer.Option(
        None, help="Without GPS: where the first base looks, degrees clockwise from north."
    ),
    confidence: float = typer.Option(0.95, help="Of the landmarks' ellipses."),
    out: Path | None = typer.Option(None, help="File; default map.FORMAT in the run folder."),
    max_size: str | None = MAX_SIZE,
    as_json: bool = JSON,
) -> None:
    """Path, landmarks with ellipses and GPS of a run on the globe."""
    from graphslam.app.export import export as export_run
    from graphslam.app.export import parse_datum

    file = export_run(run, parse_datum(datum), format=format, heading=heading, confidence=confidence, out=out)
    emit({"file": str(file), "format": format}, f"written to {file}", as_json=as_json)
