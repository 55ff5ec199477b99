"""Commands ``graphslam study`` and ``graphslam terrain-tables``."""

from __future__ import annotations

from pathlib import Path

import typer

from graphslam.app.cli.run import JSON
from graphslam.app.cli.terminal import print_result, text_table
from graphslam.core.errors import ConfigError, GraphSlamError
from graphslam.core.plugins import plugins


def study(
    name: str = typer.Argument(
        ...,
        help=", ".join(plugins("graphslam.studies")) + ", or your own as module:object.",
    ),
    trials: int | None = typer.Option(None, help="Number of trials in each world. Default: by the study."),
    workers: int | None = typer.Option(None, help="Number of processes. Default: the trials run in this process."),
    cluster: str | None = typer.Option(None, help="Address of a Dask scheduler that runs the trials."),
    out: Path = typer.Option(..., help="Folder of the study. An unfinished study in it is resumed."),
    quick: bool = typer.Option(False, "--quick", help="Run the small version of the study."),
    worlds: str = typer.Option("", help="Names of worlds of the study, separated by commas. Default: all."),
    seed: int = typer.Option(0, help="Seed of all random numbers; the same seed gives the same result."),
    as_json: bool = JSON,
) -> None:
    """Run a Monte-Carlo study: all algorithms on the same data; a table, a report, plots. Resumes an unfinished one."""
    from graphslam_studies.montecarlo.study import study as run_study

    if cluster is not None and workers is not None:
        raise ConfigError("either workers or a cluster, not both: the cluster has workers of its own")
    result = run_study(
        name,
        trials,
        out=out,
        worlds=[w.strip() for w in worlds.split(",") if w.strip()] or None,
        seed=seed,
        workers=cluster or workers,
        quick=quick,
        progress=not as_json,
    )
    try:
        reports = {k: v.to_dict("records") for k, v in result.report().items()} if len(result.table) else {}
    except GraphSlamError:  # already printed, and written to report.md
        reports = {}
    failures = result.failures.to_dict("records")
    rows = [{"world": w, "runs": n} for w, n in result.runs.items()]
    text = [text_table(rows)] + [f"\n{title}\n{text_table(found)}" for title, found in reports.items()]
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
    print_result(value, "\n".join([*text, f"\nwritten to {out}: report.md, table.csv, timings.csv"]), as_json=as_json)
    if failures:
        first = failures[0]
        raise GraphSlamError(
            f"{len(failures)} trials failed, first {first['world']}/{first['run']} (seed {first['seed']}): "
            f"{first['error']}; all in {out / 'report.md'}"
        )


def terrain_tables(
    out: Path = typer.Option(..., help="File to write the tables to (.json)."),
    drives: int = typer.Option(10, help="Number of simulated drives towards each kind of target."),
    seed: int = typer.Option(10_000, help="Seed of the first drive; the others follow."),
    as_json: bool = JSON,
) -> None:
    """Learn the tables for obstacles, edges and holes in scan lines, on simulated streets that no study uses."""
    from graphslam_studies.terrain_learning import write_learnt_tables

    tables = write_learnt_tables(out, drives=drives, first_seed=seed, progress=not as_json)
    value = {"out": str(out), "threshold": tables.threshold, **tables.provenance}
    rows = [
        {"threshold": t, "false": a, "false on flat ground": b}
        for t, (a, b) in value["false_alarms_while_learning"].items()
    ]
    print_result(value, f"{text_table(rows)}\nthreshold {tables.threshold}; written to {out}", as_json=as_json)
