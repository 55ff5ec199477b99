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
    source: str = typer.Argument(..., help="Submap store, run folder, or a card of submaps."),
    method: str = typer.Option("eif-tree", help="eif-tree, eif-sequential, eif-online, ekf, isam2 or batch."),
    polish: bool = typer.Option(False, "--polish", help="Gauss-Newton from the joined map to the optimum."),
    associate: str = typer.Option("given", help="given ids, or recognise landmarks: nearest or joint."),
    scale: float | None = typer.Option(None, help="Factor on the submap covariances; default: the run's own."),
    workers: int | None = typer.Option(None, help="Processes that share the joins of eif-tree."),
    cluster: str | None = typer.Option(None, help="Address of a Dask scheduler to send the joins of eif-tree to."),
    out: Path | None = typer.Option(None, help="Folder for joined.npz and nodes.tum."),
    max_size: str | None = MAX_SIZE,
    as_json: bool = JSON,
) -> None:
    """Join submaps into one map by one method."""
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
    source: str = typer.Argument(..., help="Submap store, run folder, or a card of submaps."),
    methods: str | None = typer.Option(None, help="Comma-separated; default: all but eif-online."),
    polish: bool = typer.Option(True, help="Take every method on to the least-squares optimum."),
    associate: str = typer.Option("given", help="given ids, or recognise landmarks: nearest or joint."),
    scale: float | None = typer.Option(None, help="Factor on the submap covariances; default: the run's own."),
    memory: bool = typer.Option(True, help="Measure peak memory in a process per method."),
    figure: Path | None = typer.Option(None, help="PNG of objectives side by side."),
    max_size: str | None = MAX_SIZE,
    as_json: bool = JSON,
) -> None:
    """Every method on the same submaps: objective, gap, time, memory, non-zeros, NEES and CI where truth is known."""
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
