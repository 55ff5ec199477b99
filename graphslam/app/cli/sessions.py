"""``graphslam merge``, ``localise``."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import typer

from graphslam.app.cli.run import JSON, MAX_SIZE, READER, READER_OPTION, reader_options
from graphslam.app.cli.terminal import print_result, text_table


def merge_command(
    runs: list[Path] = typer.Argument(
        ..., help="Folders of at least two runs. The first pose of the first run is the origin."
    ),
    by: str = typer.Option(
        "auto",
        help="How runs are aligned. Landmarks: identity or constellation. Dense submaps: places or gps. Or auto.",
    ),
    solver: str = typer.Option("batch", help="Name of the solver: isam2, lm, batch, gnc or pcg."),
    identity_gate: float = typer.Option(
        25.0, help="Observations with a larger χ² (2 degrees of freedom) become separate landmarks. 0: never."
    ),
    tolerance: float = typer.Option(0.5, help="Largest distance of matching landmarks after alignment [m]."),
    surface: bool = typer.Option(
        False, "--surface", help="Dense 3-D submaps: also write the surface of all sessions (re-reads their logs)."
    ),
    voxel: float = typer.Option(0.05, help="With --surface: edge of its voxels [m]."),
    colour: str = typer.Option("session", help="With --surface: session, height, piece, or sigma."),
    out: Path = typer.Option(..., "--out", "-o", help="Folder for the merged map."),
    max_size: str | None = MAX_SIZE,
    as_json: bool = JSON,
) -> None:
    """Merge runs of several robots or days into one map, which is solved as one problem."""
    from graphslam.app.sessions.merge import merge as merge_runs
    from graphslam.app.sessions.merge_align import By
    from graphslam.maps.surface.piece import SurfaceConfig

    merged = merge_runs(
        runs, by=cast(By, by), solver=solver, identity_gate=identity_gate, tolerance=tolerance, out=out,
        surface=SurfaceConfig(voxel=voxel) if surface else None, colour=colour,
    )  # fmt: skip
    rows = merged.metric_rows
    where = f"report in {out / 'report.html'}, map in {out / 'figures' / 'map.png'}"
    text = f"{text_table(rows, ['key', 'value', 'unit'])}\nwritten to {out}: {where}"
    print_result({"out": str(out), "metrics": rows, "report": merged.report}, text, as_json=as_json)


def localise_command(
    run: Path = typer.Argument(..., help="Folder of a run with dense submaps: the map."),
    source: str = typer.Argument(
        ..., help="Submaps to localise: folder of another run, folder of a log, or name of a data set."
    ),
    submap: list[int] = typer.Option([], help="Localise only the submap with this key. May be repeated."),
    begin: float | None = typer.Option(None, help="Use a log from this time on [s]."),
    end: float | None = typer.Option(None, help="Use a log up to this time [s]."),
    reader: str | None = READER,
    reader_option: list[str] = READER_OPTION,
    max_size: str | None = MAX_SIZE,
    as_json: bool = JSON,
) -> None:
    """Localise submaps, or a part of a log, in a saved map: poses with covariances, and all candidates."""
    from graphslam.app.sessions.localise import localise as find
    from graphslam.app.sessions.localise import source_of

    query = source_of(source, submap, begin, end, reader=reader, reader_options=reader_options(reader_option))
    found = find(run, query, progress=not as_json)
    rows = found.rows()
    columns = ["submap_map", "submap_here", "score", "accepted", "why"]
    text = f"{text_table(rows, columns)}\n{found!r}"
    value = {
        "found": found.found,
        "why": found.why,
        "T_map_base": found.T_map_base,
        "covariance": found.covariance,
        "T_map_end": found.T_map_end,
        "end_covariance": found.end_covariance,
        "candidates": rows,
    }
    print_result(value, text, as_json=as_json)


COMMANDS = {"merge": merge_command, "localise": localise_command}
