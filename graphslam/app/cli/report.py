"""``graphslam report``."""

from __future__ import annotations

from pathlib import Path

import typer

from graphslam.app.cli.run import JSON, MAX_SIZE
from graphslam.app.cli.terminal import emit


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    app.command()(report)


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
