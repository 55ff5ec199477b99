"""``graphslam solve``, ``relax``, ``eval``, ``options``, ``init``, ``doctor``."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, cast, get_args

import typer

from graphslam.app.cli.run import JSON, MAX_SIZE, READER, READER_OPTION, reader_options
from graphslam.app.cli.terminal import print_result, text_table, write_and_print
from graphslam.core.atomic import atomic_open, check_file_target
from graphslam.core.errors import ConfigError, DataError, GraphSlamError, MissingDataError, UnknownNameError


def solve_command(
    file: str = typer.Argument(
        ..., help="Pose-graph file (.g2o, .graph or .txt, also .xz, .gz, .bz2), or DATA-SET/FILE."
    ),
    solver: str = typer.Option("lm", help="Name of the solver: lm, isam2, gnc or pcg."),
    noise: str = typer.Option(
        "auto", help="Noise columns of TORO and iSAM files: covariance, information, sqrt-information or toro."
    ),
    repair: bool = typer.Option(
        False,
        "--repair",
        help="Replace indefinite information matrices by the nearest valid ones instead of refusing the file.",
    ),
    create_missing: bool = typer.Option(
        False, "--create-missing", help="Add vertices that only edges mention instead of refusing the file."
    ),
    out: Path | None = typer.Option(None, "--out", "-o", help="g2o file to write the solution to."),
    starts: str | None = typer.Option(
        None, help="Initial values: all, or names such as chordal,tree. Default: one, and others only in case of doubt."
    ),
    certify: bool = typer.Option(
        False, "--certify", help="Check whether the solution is certified as the global optimum."
    ),
    max_size: str | None = MAX_SIZE,
    as_json: bool = JSON,
) -> None:
    """Solve a pose-graph file, and check whether the solution is at its optimum."""
    from graphslam.app.solve_file import solution_json
    from graphslam.core.atomic import check_file_target
    from graphslam.io.catalog import load_recording
    from graphslam.io.g2o import write_g2o
    from graphslam.io.network_file import read_network
    from graphslam.solve.network.solve import solve_network

    if out is not None:
        check_file_target(out)
    path = Path(file)
    if not path.is_file():
        found = load_recording(file)
        if not isinstance(found, Path) or not found.is_file():
            raise MissingDataError(
                f"{file} is not a pose-graph file", wanted="a file, or data-set/file such as posegraphs/intel"
            )
        path = found
    names = None if starts is None else "all" if starts == "all" else starts.split(",")
    network = read_network(path, noise=cast(Any, noise), repair=repair, create_missing=create_missing)
    solution = solve_network(network, solver, starts=names, certificate=certify)
    value = solution_json(solution)
    text = "\n".join(f"{k:20} {v}" for k, v in value.items())
    if out is None:
        return print_result(value, text, as_json=as_json)

    def write() -> None:
        write_g2o(out, solution.to_network())

    write_and_print(write, {**value, "out": str(out)}, text, f"{'out':20} {out}", as_json=as_json)


def relax_command(
    run: Path = typer.Argument(..., help="Folder of a finished run whose front end uses scans."),
    out: Path | None = typer.Option(None, "--out", "-o", help="TUM file to write the relaxed path to."),
    save_plot: Path | None = typer.Option(None, help="Picture of the scans along graph and relaxed path (PNG)."),
    as_json: bool = JSON,
) -> None:
    """Relax the path of a run with its scans, as a skeleton network of poses, beside the graph of the run."""
    from graphslam.app.run.skeleton import relax_run
    from graphslam.core.atomic import check_file_target
    from graphslam.io.tum import write_tum

    for file in (out, save_plot):
        if file is not None:
            check_file_target(file)
    made = relax_run(run, None if as_json else lambda text: typer.echo(text, err=True))
    s = made.skeleton
    facts: dict[str, Any] = {
        "poses": s.problem.poses,
        "measurements": s.problem.measurements,
        "landmarks": s.problem.landmarks,
        "outliers": s.outliers,
        "fixes": s.fixes,
        "fixes_left": s.fixes_left,
        "sigma": s.sigma,
        "chi2": s.relaxation.chi2,
        "moved": list(s.moved),
    }
    text = text_table(made.rows) + "\n\n" + "\n".join(f"{k:20} {v}" for k, v in facts.items())
    value: dict[str, Any] = {"run": str(run), "paths": made.rows, **facts}

    def write() -> None:
        if out is not None:
            write_tum(out, s.path)
        if save_plot is not None:
            from graphslam.plots.refined import plot_scans_along
            from graphslam.plots.save import save_figure

            points = {k: s.cloud.world(p.poses) for k, p in made.paths.items()}
            save_figure(plot_scans_along(points, made.paths, title=f"scans of {run.name}"), save_plot)

    files = [str(f) for f in (out, save_plot) if f is not None]
    written = f"written to {', '.join(files)}" if files else "nothing written; --out writes the path"
    write_and_print(write, {**value, "files": files}, text, written, as_json=as_json)


def evaluate_command(
    estimate: Path = typer.Argument(..., help="Estimated path: a TUM or KITTI file, or the folder of a run."),
    reference: Path = typer.Argument(..., help="Reference path: a TUM or KITTI file."),
    align: str = typer.Option("se", help="Alignment before the error is measured: none, origin, se or sim."),
    delta: float = typer.Option(10.0, help="Distance [m] or time [s] over which the relative error is measured."),
    delta_unit: str = typer.Option("m", help="Unit of --delta: m or s."),
    max_diff: float = typer.Option(0.01, help="Largest time difference of poses that are compared [s]."),
    plot: bool = typer.Option(False, "--plot", "-p", help="Show both paths and the error over time."),
    save_plot: Path | None = typer.Option(None, help="Picture of both paths and the error over time (PNG)."),
    max_size: str | None = MAX_SIZE,
    as_json: bool = JSON,
) -> None:
    """Measure the absolute and the relative trajectory error (ATE, RPE) of a path.

    NEES: of the path of a run, whose covariances are known, in the frame of the first common pose.
    """
    from graphslam.app.run.outputs import read_run_folder
    from graphslam.evaluate.path_consistency import path_nees
    from graphslam.evaluate.trajectory_error import Alignment, ate, rpe
    from graphslam.io.tum import read_path

    est = read_run_folder(estimate).trajectory if estimate.is_dir() else read_path(estimate)
    ref = read_path(reference)
    known = {"align": (align, get_args(Alignment)), "delta-unit": (delta_unit, ("m", "s"))}
    for option, (given, allowed) in known.items():
        if given not in allowed:
            raise UnknownNameError(f"--{option}", given, allowed)
    absolute = ate(est, ref, alignment=cast(Alignment, align), max_diff=max_diff)
    unit = cast(Literal["m", "s"], delta_unit)
    value: dict[str, Any] = {"ate": absolute.as_row(), "rpe": None}
    try:
        value["rpe"] = rpe(est, ref, delta=delta, unit=unit, scale=align == "sim", max_diff=max_diff).as_row()
    except DataError as error:  # a path shorter than delta still has an absolute error
        typer.echo(f"no relative error: {error}; choose another --delta", err=True)
    errors = {k: v for k, v in value.items() if v}
    text = text_table([{"": k, **{name: v.get(k) for name, v in errors.items()}} for k in value["ate"]])
    if est.covariances is not None:
        value["nees"] = path_nees(est, ref, max_diff=max_diff)
        text += "\n\n" + text_table([{"": k, "nees": v} for k, v in value["nees"].items()])
    if plot or save_plot is not None:
        from graphslam.plots.save import save_figure, show_figure
        from graphslam.plots.trajectory import plot_trajectory_error

        axes = plot_trajectory_error(absolute.aligned(est), ref, absolute)
        if save_plot is not None:
            save_figure(axes, save_plot)
            text += f"\nwritten to {save_plot}"
        if plot:
            show_figure(axes)
    print_result(value, text, as_json=as_json)


def options_command(
    frontend: str | None = typer.Argument(None, help="Front end. Default: the options that every run has."),
    as_json: bool = JSON,
) -> None:
    """List the options of a run or of a front end: name, default and meaning of each; and its presets."""
    from dataclasses import asdict

    from graphslam.app.option_table import option_rows
    from graphslam.app.run.config import preset_names

    rows = option_rows(frontend)
    text = "\n".join(f"{r.option} = {r.default}\n    {r.meaning}" for r in rows)
    presets = [] if frontend is None else preset_names(frontend)
    if presets:
        text += f"\npresets (--preset NAME): {', '.join(presets)}"
    print_result({"options": [asdict(r) for r in rows], "presets": presets}, text, as_json=as_json)


def init_command(
    source: str = typer.Argument(..., help="A log: a file, a folder, or the name of a data set."),
    frontend: str | None = typer.Option(None, help="Front end that reads the log. Default: by the streams of the log."),
    reader: str | None = READER,
    reader_option: list[str] = READER_OPTION,
    out: Path = typer.Option(Path("graphslam.toml"), "--out", "-o", help="TOML file to write."),
    force: bool = typer.Option(False, "--force", "-f", help="Replace an existing file."),
    max_size: str | None = MAX_SIZE,
    as_json: bool = JSON,
) -> None:
    """Write a commented file of options for a log: meaning and value of each, the values of the preset marked."""
    from graphslam.app.config_file import config_file
    from graphslam.app.run.source import load

    if out.exists() and not force:
        raise ConfigError(f"{out} is there; give another name (-o), or replace it (--force)")
    check_file_target(out)
    text = config_file(load(source, reader=reader, **reader_options(reader_option)), source, frontend)
    with atomic_open(out, "w") as file:
        file.write(text)
    print_result({"file": str(out)}, f"written to {out}: graphslam run {source} --config {out}", as_json=as_json)


def doctor_command(
    clear_compiled: bool = typer.Option(
        False, "--clear-compiled", help="Delete the compiled code; it is compiled again at its next use."
    ),
    as_json: bool = JSON,
) -> None:
    """Check the installation: versions, missing system libraries, and what to install."""
    from graphslam.app.doctor import examine_installation
    from graphslam.core.jit import clear_compiled_code

    if clear_compiled:
        clear_compiled_code()
    findings = examine_installation()
    rows = [{"check": f.name, "state": f.state, "detail": f.detail} for f in findings]
    print_result({"checks": rows}, text_table(rows), as_json=as_json)
    for state, what in (("missing", "required parts are missing"), ("conflict", "installs are in conflict")):
        bad = [f.name for f in findings if f.state == state]
        if bad:
            raise GraphSlamError(f"{len(bad)} {what}: {', '.join(bad)}")


COMMANDS = {
    "solve": solve_command,
    "relax": relax_command,
    "eval": evaluate_command,
    "options": options_command,
    "init": init_command,
    "doctor": doctor_command,
}
