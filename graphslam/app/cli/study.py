"""``graphslam study``."""

from __future__ import annotations

from pathlib import Path

import typer

from graphslam.app.cli.run import JSON
from graphslam.app.cli.terminal import emit, table
from graphslam.app.studies import STUDIES
from graphslam.core.errors import GraphSlamError


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    app.command()(study)


def study(
    name: str = typer.Argument(
        ...,
        help=", ".join(STUDIES) + ", or your own as module:object.",
    ),
    trials: int | None = typer.Option(None, help="Number of trials in each world. Default: that of the study."),
    workers: int | None = typer.Option(None, help="Number of processes. Default: the trials run in this process."),
    cluster: str | None = typer.Option(None, help="Address of a Dask scheduler that runs the trials."),
    out: Path = typer.Option(..., help="Folder of the study. If it holds an unfinished study, that one is continued."),
    quick: bool = typer.Option(False, "--quick", help="Run the small version of the study."),
    worlds: str = typer.Option("", help="Names of worlds of the study, separated by commas. Default: all."),
    seed: int = typer.Option(0, help="Seed of all random numbers; the same seed gives the same result."),
    as_json: bool = JSON,
) -> None:
    """Run a Monte-Carlo study: all algorithms on the same data, one table, a report, figures. It resumes itself."""
    from graphslam.app.studies.study import study as run_study

    result = run_study(
        name,
        trials,
        out=out,
        worlds=[w.strip() for w in worlds.split(",") if w.strip()] or None,
        seed=seed,
        workers=workers,
        cluster=cluster,
        quick=quick,
        progress=not as_json,
    )
    try:
        reports = {k: v.to_dict("records") for k, v in result.report().items()} if len(result.table) else {}
    except GraphSlamError:  # already said, and written in report.md
        reports = {}
    failures = result.failures.to_dict("records")
    rows = [{"world": w, "runs": n} for w, n in result.runs.items()]
    text = [table(rows)] + [f"\n{title}\n{table(found)}" for title, found in reports.items()]
    value = {
        "out": str(out),
        "name": result.identity["name"],
        "seed": seed,
        "quick": quick,
        "runs": result.runs,
        "failures": failures,
        "reports": reports,
        "figures": sorted(str(p) for p in (out / "figures").glob("*.png")),
    }
    emit(value, "\n".join([*text, f"\nwritten to {out}: report.md, table.csv, timings.csv"]), as_json=as_json)
    if failures:
        first = failures[0]
        raise GraphSlamError(
            f"{len(failures)} trials failed, first {first['world']}/{first['run']} (seed {first['seed']}): "
            f"{first['error']}; all in {out / 'report.md'}"
        )
