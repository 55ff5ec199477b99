"""``graphslam loops``, ``report``, ``export``: outputs of a finished run."""

from __future__ import annotations

from pathlib import Path

import typer

from graphslam.app.cli.run import JSON, MAX_SIZE
from graphslam.app.cli.terminal import print_result, text_table

SHOWN = ("loop", "verdict", "source", "submap_i", "submap_j", "fitness", "chi2", "weight", "effect", "factor_id", "why")


def loops_command(
    run: Path = typer.Argument(..., help="Folder of a finished run."),
    history: bool = typer.Option(False, help="Show all decisions, also replaced ones."),
    every: bool = typer.Option(False, "--all", help="Show also the candidates that the registration rejected."),
    undo: int | None = typer.Option(
        None, help="Remove the loop closure with this number, solve again, and update the run."
    ),
    redo: int | None = typer.Option(None, help="Add the loop closure with this number again after --undo."),
    max_size: str | None = MAX_SIZE,
    as_json: bool = JSON,
) -> None:
    """List the loop closures of a run: source, gates, χ², weight, effect, and the reason of each decision."""
    from graphslam.app.run.files import loops_of_run
    from graphslam.app.run.loops import redo_loop, undo_loop
    from graphslam.core.errors import ConfigError

    if undo is not None and redo is not None:
        raise ConfigError("--undo and --redo exclude each other; give one of them")
    if undo is not None:
        ledger = undo_loop(run, undo, progress=not as_json)
    elif redo is not None:
        ledger = redo_loop(run, redo, progress=not as_json)
    else:
        ledger = loops_of_run(run)
    rows = ledger.rows(history=history)
    counts = ledger.counts()
    shown = rows if every or as_json else [r for r in rows if not str(r["why"]).startswith("registration")]
    hidden = len(rows) - len(shown)
    summary = ", ".join(f"{n} {verdict}" for verdict, n in sorted(counts.items())) or "none"
    text = f"{text_table(shown, SHOWN)}\nloops: {summary}"
    if hidden:
        text += f"; {hidden} refused by their registration are not shown (--all)"
    print_result({"run": str(run), "counts": counts, "loops": rows}, text, as_json=as_json)


def report_command(
    run: Path = typer.Argument(..., help="Folder of run, demo or merge; the run may be unfinished."),
    out: Path | None = typer.Option(
        None, "--out", "-o", help="HTML file to write. Default: report.html in the folder."
    ),
    show: bool = typer.Option(False, "--open", help="Open the page in the browser."),
    max_size: str | None = MAX_SIZE,
    as_json: bool = JSON,
) -> None:
    """Write one self-contained HTML page of a run: verdict, plots, metrics, graph, loop closures, ledger, events."""
    from graphslam.app.report.report import report_and_file
    from graphslam.core.errors import FormatError

    made, file = report_and_file(run, out)
    size = file.stat().st_size
    lines = [f"{file}: {size / 1e6:.2f} MB"]
    lines += [f"missing: {name} {why}" for name, why in sorted(made.problems.items())]
    if show:
        import webbrowser

        if not webbrowser.open(file.resolve().as_uri()):
            lines.append("no browser found; open the file by hand")
    value = {"run": str(run), "page": str(file), "kind": made.kind, "bytes": size, "missing": made.problems}
    print_result(value, "\n".join(lines), as_json=as_json)
    if made.damage:
        raise FormatError(f"the result is damaged: {made.damage}", where=str(run))


def export_command(
    run: Path = typer.Argument(..., help="Folder of a finished run."),
    format: str = typer.Option(
        "tum",
        help="Path: tum or kitti. Map on the globe: kml, or geojson for GIS programs. Floor plans: nav2. "
        "Points: las, or in tiles autoware. For Foxglove: mcap. For ros2 bag play: ros2.",
    ),
    datum: str | None = typer.Option(
        None,
        help="Origin of the GPS frame as LAT,LON in degrees (WGS 84); without GPS, of the first pose. "
        "For kml, geojson, las and autoware.",
    ),
    heading: float | None = typer.Option(
        None, help="Without GPS: heading of the first pose in degrees, clockwise from north."
    ),
    confidence: float = typer.Option(0.95, help="Confidence of the landmark ellipses, between 0 and 1."),
    out: Path | None = typer.Option(
        None,
        "--out",
        "-o",
        help="File to write; folder for nav2, autoware and ros2. Default: a file in the folder of the run.",
    ),
    max_size: str | None = MAX_SIZE,
    as_json: bool = JSON,
) -> None:
    """Export a run for other programs: path, map on the globe, floor plans, points, bag."""
    from graphslam.app.export import export as export_run
    from graphslam.app.export import parse_datum

    place = None if datum is None else parse_datum(datum)
    file = export_run(run, place, format=format, heading=heading, confidence=confidence, out=out)
    print_result({"file": str(file), "format": format}, f"written to {file}", as_json=as_json)


COMMANDS = {"loops": loops_command, "report": report_command, "export": export_command}
