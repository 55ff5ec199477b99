"""``graphslam loops``, ``report``, ``export``: what a finished run holds."""

from __future__ import annotations

from pathlib import Path

import typer

from graphslam.app.cli.run import JSON, MAX_SIZE
from graphslam.app.cli.terminal import emit, table

SHOWN = ("loop", "verdict", "source", "submap_i", "submap_j", "fitness", "chi2", "weight", "effect", "factor_id", "why")


def register(app: typer.Typer) -> None:
    """Add the verbs to the command line."""
    app.command()(loops)
    app.command()(report)
    app.command()(export)


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


def report(
    run: Path = typer.Argument(..., help="Folder that run, demo or merge wrote, finished or not."),
    out: Path | None = typer.Option(None, help="File of the page; default report.html in the folder."),
    show: bool = typer.Option(False, "--open", help="Show it in the browser."),
    max_size: str | None = MAX_SIZE,
    as_json: bool = JSON,
) -> None:
    """One self-contained HTML page of a run: verdict, figures, metrics, graph, loops and why, evidence, events."""
    from graphslam.app.report.report import report_and_file

    made, file = report_and_file(run, out)
    size = file.stat().st_size
    lines = [f"{file}: {size / 1e6:.2f} MB"]
    lines += [f"missing: {name} {why}" for name, why in sorted(made.problems.items())]
    if show:
        import webbrowser

        if not webbrowser.open(file.resolve().as_uri()):
            lines.append("no browser was found to show it in")
    value = {"run": str(run), "page": str(file), "kind": made.kind, "bytes": size, "missing": made.problems}
    emit(value, "\n".join(lines), as_json=as_json)


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
