"""``graphslam study``."""

from __future__ import annotations

from pathlib import Path

import typer

from graphslam.app.cli.run import JSON
from graphslam.app.cli.terminal import emit, table
from graphslam.core.errors import GraphSlamError


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    app.command()(study)


def study(
    name: str = typer.Argument(
        ..., help="combined-slam, association-ambiguity, segslam-garage (-mine, -building), or your own, module:object."
    ),
    trials: int | None = typer.Option(None, help="Trials of each world; default the study's own."),
    workers: int | None = typer.Option(None, help="Processes; default none, the trials run in this one."),
    cluster: str | None = typer.Option(None, help="Address of a Dask scheduler, instead of processes."),
    out: Path = typer.Option(..., help="Folder of the study; one that is there already is gone on with."),
    quick: bool = typer.Option(False, "--quick", help="The study's small version."),
    worlds: str = typer.Option("", help="Some of the study's worlds, separated by commas."),
    seed: int = typer.Option(0, help="Root of the seed tree."),
    as_json: bool = JSON,
) -> None:
    """Monte-Carlo study: every algorithm on the same data, one tidy table, a report and figures. Resumes by itself."""
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
