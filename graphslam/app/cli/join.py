"""``graphslam join`` and ``compare``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import typer

from graphslam.app.cli.run import JSON, MAX_SIZE
from graphslam.app.cli.terminal import print_result, text_table, verdict_text, write_and_print
from graphslam.core.atomic import atomic_open, check_file_target

SUBMAPS = typer.Argument(
    ..., help="Folder of submaps, folder of a run, name of a data set of submaps, or pose-graph file."
)
ASSOCIATE = typer.Option("given", help="How landmarks are associated: given (by their ids), nearest or joint.")
SCALE = typer.Option(None, help="Factor on the covariances of the submaps. Default: the value of the run.")
SUBMAP_POSES = typer.Option(
    None, "--submap-poses", help="Cut a pose-graph file into submaps with this number of poses."
)


def join_command(
    source: str = SUBMAPS,
    method: str = typer.Option("eif-tree", help="Name of the method: eif-tree, eif-sequential, ekf, isam2 or batch."),
    polish: bool = typer.Option(True, help="Refine the joined map to the least-squares optimum."),
    associate: str = ASSOCIATE,
    scale: float | None = SCALE,
    workers: int | None = typer.Option(None, help="Number of processes for eif-tree."),
    cluster: str | None = typer.Option(None, help="Address of a Dask scheduler that runs the joins of eif-tree."),
    submap_poses: int | None = SUBMAP_POSES,
    out: Path | None = typer.Option(None, "--out", "-o", help="Folder for the results joined.npz and nodes.tum."),
    max_size: str | None = MAX_SIZE,
    as_json: bool = JSON,
) -> None:
    """Join submaps into one map with one method, refine it, and check its covariances."""
    import numpy as np

    from graphslam.app.compare import JSON_COLUMNS, join_json, submap_keys
    from graphslam.app.join_verdict import join_headline, join_verdict
    from graphslam.app.submap_sources import submap_source
    from graphslam.core.cluster import check_address
    from graphslam.core.output_folder import check_folder_target
    from graphslam.core.trajectory import Trajectory
    from graphslam.io.joined_map import KIND, write_joined
    from graphslam.join.registry import compile_method, methods_for, prepare_submaps
    from graphslam.join.registry import join_by_method as join_by

    if out is not None:
        check_folder_target(out, KIND)
    if cluster is not None:
        check_address(cluster)
    s = submap_source(source, submap_poses=submap_poses)
    factor = s.covariance_scale if scale is None else scale
    material = prepare_submaps(s.material, associate=associate, covariance_scale=factor)
    available = methods_for(material)
    available.check(method)
    compile_method(material, method, polish=polish)  # so that the printed time excludes compilation
    filters = method in available.joiners
    estimate = own = join_by(
        material,
        method,
        polish=polish and not filters,
        associate=associate,
        workers=workers,
        cluster=cluster,
        progress=not as_json,
    )
    if polish and filters:
        estimate = available.polish(material, own)
    truth = s.truth if associate == "given" else None
    value: dict[str, Any] = join_json(material, method, estimate, truth=truth, own=own if polish and filters else None)
    plain = isinstance(material, Sequence)
    found = join_verdict(value["methods"][0], estimate)
    length = Trajectory(np.arange(len(estimate.poses), dtype=np.float64), estimate.poses).length()
    headline = join_headline(value["methods"][0], found, submaps=len(submap_keys(material)), length=length)
    value |= {"headline": headline.text, "verdict": [f.as_row() for f in found]}
    text = "\n".join([text_table(value["methods"], JSON_COLUMNS), *verdict_text(headline, found)])
    if out is None:
        return print_result(value, text, as_json=as_json)

    def write() -> None:
        write_joined(out, s.times, estimate, "vector" if plain else "tangent")

    write_and_print(write, {**value, "out": str(out)}, text, f"written to {out}", as_json=as_json)


def compare_command(
    source: str = SUBMAPS,
    methods: str | None = typer.Option(
        None, help="Names of methods, separated by commas. Default: isam2, batch, eif-tree, eif-sequential, ekf."
    ),
    polish: bool = typer.Option(True, help="Refine the result of every method to the least-squares optimum."),
    associate: str = ASSOCIATE,
    scale: float | None = SCALE,
    memory: bool = typer.Option(True, help="Measure the peak memory of every method in a process of its own."),
    submap_poses: int | None = SUBMAP_POSES,
    figure: Path | None = typer.Option(None, help="PNG file for a plot of the methods before and after refinement."),
    max_size: str | None = MAX_SIZE,
    as_json: bool = JSON,
) -> None:
    """Compare methods on the same submaps: objective, NEES and CI before and after refinement, time, and memory."""
    from graphslam.app import compare as comparing
    from graphslam.app.join_verdict import compare_verdict
    from graphslam.app.submap_sources import submap_source
    from graphslam.app.verdict.figures import CONFIDENCE
    from graphslam.evaluate.residual_consistency import two_sided_bounds

    if figure is not None:
        check_file_target(figure)
    s = submap_source(source, submap_poses=submap_poses)
    options: dict[str, Any] = {"covariance_scale": s.covariance_scale if scale is None else scale}
    names = tuple(m.strip() for m in methods.split(",")) if methods else comparing.default_methods(s.material)
    found = comparing.compare_methods(
        s.material,
        names,
        truth=s.truth,
        polish=polish,
        associate=associate,
        memory=memory,
        progress=not as_json,
        **options,
    )
    value: dict[str, Any] = comparing.methods_json(found)
    findings = compare_verdict(value["methods"])
    value["verdict"] = [f.as_row() for f in findings]
    text = [text_table(comparing.comparison_rows(value["methods"])), *(f.text for f in findings)]
    if s.truth is None:
        text.append("NEES and CI: not tested — these submaps have no ground truth.")
    elif n := found["nees_dof"].iloc[0]:
        low, high, _ = two_sided_bounds(1.0, float(n), CONFIDENCE)
        text.append(f"NEES/n of a consistent map: [{low:.3g}, {high:.3g}] in 95 % of the runs (n = {n}).")
    if figure is None:
        return print_result(value, "\n".join(text), as_json=as_json)
    from graphslam.plots.comparison import comparison_figure
    from graphslam.plots.save import figure_png

    def write() -> None:
        with atomic_open(figure) as stream:
            stream.write(figure_png(comparison_figure(found)))

    value["figure"] = str(figure)
    write_and_print(write, value, "\n".join(text), f"plot: {figure}", as_json=as_json, key="figure")


COMMANDS = {"join": join_command, "compare": compare_command}
