"""``graphslam join`` and ``compare``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import typer

from graphslam.app.cli.run import JSON, MAX_SIZE
from graphslam.app.cli.terminal import emit, table

COLUMNS = [
    *("method", "objective", "objective_polished", "seconds", "peak_mb", "states", "landmarks", "nnz"),
    *("nees", "nees_dof", "ci"),
]


def register(app: typer.Typer) -> None:
    """Add the verbs to the command line."""
    app.command()(join)
    app.command()(compare)


def join(
    source: str = typer.Argument(..., help="Folder of submaps, folder of a run, or name of a card of submaps."),
    method: str = typer.Option(
        "eif-tree", help="Name of the method: eif-tree, eif-sequential, eif-online, ekf, isam2 or batch."
    ),
    polish: bool = typer.Option(
        False, "--polish", help="Continue from the joined map to the least-squares optimum by Gauss-Newton."
    ),
    associate: str = typer.Option(
        "given", help="How landmarks are associated: given (by their ids), nearest or joint."
    ),
    scale: float | None = typer.Option(
        None, help="Factor on the covariances of the submaps. Default: that of the run."
    ),
    workers: int | None = typer.Option(None, help="Number of processes that share the joins of eif-tree."),
    cluster: str | None = typer.Option(None, help="Address of a Dask scheduler that runs the joins of eif-tree."),
    out: Path | None = typer.Option(None, help="Folder for the results joined.npz and nodes.tum."),
    max_size: str | None = MAX_SIZE,
    as_json: bool = JSON,
) -> None:
    """Join submaps into one map with one method."""
    from graphslam.app.compare import join_json
    from graphslam.app.submap_sources import submap_source
    from graphslam.io.joined_map import write_joined
    from graphslam.join.registry import join as join_by

    s = submap_source(source)
    factor = s.covariance_scale if scale is None else scale
    estimate = join_by(
        s.submaps,
        method,
        polish=polish,
        associate=associate,
        covariance_scale=factor,
        workers=workers,
        cluster=cluster,
        progress=not as_json,
    )
    truth = s.truth if associate == "given" else None
    value = join_json(s.submaps, method, estimate, truth=truth)
    if out is not None:
        times = [m.interval[0] for m in s.submaps] + [s.submaps[-1].interval[1]]
        write_joined(out, times, estimate.poses, estimate.landmark_ids, estimate.landmarks)
    emit(value, table(value["methods"], COLUMNS), as_json=as_json)


def compare(
    source: str = typer.Argument(..., help="Folder of submaps, folder of a run, or name of a card of submaps."),
    methods: str | None = typer.Option(
        None, help="Names of methods, separated by commas. Default: all except eif-online."
    ),
    polish: bool = typer.Option(True, help="Continue from the result of every method to the least-squares optimum."),
    associate: str = typer.Option(
        "given", help="How landmarks are associated: given (by their ids), nearest or joint."
    ),
    scale: float | None = typer.Option(
        None, help="Factor on the covariances of the submaps. Default: that of the run."
    ),
    memory: bool = typer.Option(True, help="Measure the peak memory of every method in a process of its own."),
    figure: Path | None = typer.Option(None, help="PNG file for a figure that compares the objectives."),
    max_size: str | None = MAX_SIZE,
    as_json: bool = JSON,
) -> None:
    """Compare methods on the same submaps: objective, gap, time, memory, and NEES and CI where the truth is known."""
    from graphslam.app import compare as comparing
    from graphslam.app.submap_sources import submap_source

    s = submap_source(source)
    options: dict[str, Any] = {"covariance_scale": s.covariance_scale if scale is None else scale}
    names = tuple(m.strip() for m in methods.split(",")) if methods else comparing.DEFAULT_METHODS
    found = comparing.compare(
        s.submaps,
        names,
        truth=s.truth,
        polish=polish,
        associate=associate,
        memory=memory,
        progress=not as_json,
        **options,
    )
    if figure is not None:
        from graphslam.plots.comparison import plot_comparison
        from graphslam.plots.save import save

        save(plot_comparison(None, found, "objective", log=True, label="objective before polishing"), figure)
    value = comparing.methods_json(found)
    emit(value, table(value["methods"], COLUMNS), as_json=as_json)
