"""``graphslam run``, ``demo``, ``simulate``."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import typer

from graphslam.app.cli.terminal import print_result, text_table, verdict_text
from graphslam.core.atomic import check_file_target
from graphslam.core.config import merge_options, parse_setting, read_toml
from graphslam.core.reading import set_size_limit


def _limit(size: str | None) -> str | None:
    """Set the size limit for this process: a number of bytes, with K, M or G for 10³, 10⁶ or 10⁹ bytes."""
    if size is not None:
        found = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?) ?([kKmMgG]?)B?", size.strip())
        n = 0 if found is None else int(float(found[1]) * 1000 ** " KMG".index(found[2].upper() or " "))
        if n <= 0:
            raise typer.BadParameter(f"{size!r}; wanted for example 500M or 4G")
        set_size_limit(n)
    return size


MAX_SIZE = typer.Option(
    None,
    "--max-size",
    callback=_limit,
    help="Largest decompressed size of one input file, for example 8G. Default: 2G.",
)
READER = typer.Option(None, help="Name of the reader (`graphslam data readers`). Default: detected from the content.")
READER_OPTION = typer.Option(
    [], "--reader-option", help="Option of the reader, as name=value (`graphslam data readers NAME`). May be repeated."
)
PRESET = typer.Option(None, help="Name of the preset, or none. Default: by the data set, or by its kind.")


def reader_options(settings: list[str]) -> dict[str, Any]:
    """Options of a reader by name."""
    values: dict[str, Any] = {}
    for text in settings:
        values |= parse_setting(text)
    return values


JSON = typer.Option(False, "--json", help="Print one JSON object on stdout, and nothing else.")


SHORT = (
    *("submaps", "landmarks_confirmed", "objective", "converged", "join_chi2_per_dof", "join_dof"),
    *("check_rmse", "check_nis_value", "check_nis_dof", "check_power"),
    *("gps_rmse", "gps_withheld_rmse", "path_rmse", "path_rmse_aligned", "landmark_rmse_aligned"),
    *("nees_per_dof", "nees_dof", "ci", "map_entropy", "seconds_total", "times_real_time"),
)
"""Metrics that are printed without ``--all``."""
EVERY = typer.Option(False, "--all", help="Print all metrics. Default: a summary.")


def run_command(
    source: str = typer.Argument(..., help="A log: a file, a folder, or the name of a data set."),
    frontend: list[str] = typer.Option(
        [],
        help="Name of the front end that makes submaps from the log. Default: by the streams of the log. "
        "Twice: one of landmarks and one of planar scans, each in the intervals that suit it.",
    ),
    solver: str = typer.Option("isam2", help="Name of the solver: isam2, lm, batch, gnc or pcg."),
    reader: str | None = READER,
    reader_option: list[str] = READER_OPTION,
    preset: str | None = PRESET,
    config: Path | None = typer.Option(None, help="TOML file with options; they replace those of the preset."),
    setting: list[str] = typer.Option([], "--set", help="Set one option, as a.b=value. May be repeated."),
    control: Path | None = typer.Option(None, help="CSV file of control points and distances; they enter the graph."),
    check: Path | None = typer.Option(None, help="CSV file of check points and distances; they test the result."),
    seed: int = typer.Option(0, help="Seed of all random numbers; the same seed gives the same result."),
    out: Path = typer.Option(..., "--out", "-o", help="Folder for the results of the run."),
    resume: bool = typer.Option(False, "--resume", help="Continue an interrupted run after its last finished submap."),
    saved: list[Path] = typer.Option(
        [], "--continue", help="Folder of an earlier run; both become one graph in OUT/continued. May be repeated."
    ),
    live: bool = typer.Option(False, "--live", help="Show the map in the viewer Rerun during the run."),
    live_file: Path | None = typer.Option(
        None,
        "--record",
        help="Record the viewer data to a file; replay it with `rerun FILE`.",
    ),
    max_size: str | None = MAX_SIZE,
    every: bool = EVERY,
    as_json: bool = JSON,
) -> None:
    """Make a map from a recorded log: submaps, factor graph, solution, map, and a verdict on its consistency."""
    from graphslam.app.run.pipeline import run as run_pipeline
    from graphslam.app.run.run_bar import RunBar
    from graphslam.app.run.source import load

    if live_file is not None:
        check_file_target(live_file)
    options = run_options(config, setting)
    if preset is not None:
        options["preset"] = preset
    options |= {name: str(file) for name, file in (("control", control), ("check", check)) if file is not None}
    log: Any = source
    if reader is not None or reader_option:
        log = load(source, reader=reader, **reader_options(reader_option))
    observers: list[Any] = []
    if live or live_file is not None:
        from graphslam.app.live import LiveView

        observers = [LiveView(source, file) for file in ([None] if live else []) + ([live_file] if live_file else [])]
    result = run_pipeline(
        log,
        frontend=frontend or None,
        solver=solver,
        seed=seed,
        out=out,
        config=options,
        resume=resume,
        progress=[RunBar(not as_json), *observers],
    )
    rows = result.metric_rows
    value = {"out": str(out), "verdict": result.report["verdict"], "metrics": rows, "report": result.report}
    text = _summary(result, out, every)
    if saved:
        from graphslam.app.sessions.merge import continue_runs

        joined = continue_runs(saved, result, out / "continued")
        value["continued"] = joined.report
        text += "\n".join(["", *metric_lines(joined, every), ""])
        text += f"{joined!r}, in {out / 'continued'}: report in {out / 'continued' / 'report.html'}"
    print_result(value, text, as_json=as_json)


def run_options(config: Path | None, settings: list[str]) -> dict[str, Any]:
    """Options of a TOML file, overridden by single settings."""
    values: dict[str, Any] = read_toml(config) if config else {}
    values.pop("run", None)  # so that the config.toml of another run can be used unchanged
    for text in settings:
        values = merge_options(values, parse_setting(text))
    return values


def metric_lines(result: Any, every: bool) -> list[str]:
    """Table of the metrics of a run, and the number of hidden ones."""
    rows = result.metric_rows
    shown = [r for r in rows if every or r["key"] in SHORT]
    left = len(rows) - len(shown)
    more = [f"({left} more metrics: --all, or metrics.json)"] if left else []
    return [text_table(shown, ["key", "value", "unit"]), *more]


def _summary(result: Any, out: Path, every: bool = False) -> str:
    dropped = result.report["records_dropped"]
    lines = metric_lines(result, every)
    lines += [f"dropped {n} {what}" for what, n in dropped.items()]
    lines += [*time_notes(result.report, len(result.submaps)), *join_note(result)]
    lines += ["", *verdict_text(result.headline, result.verdict), ""]
    lines.append(f"written to {out}: report in {out / 'report.html'}, map in {out / 'figures' / 'map.png'}")
    return "\n".join(lines)


def time_notes(report: Mapping[str, Any], submaps: int) -> list[str]:
    """Notes on the times of a run: submaps of an earlier session are not included, compilation is."""
    resumed, compilation = report["resumed_submaps"], report["seconds"].get("compilation", 0.0)
    lines = []
    if resumed >= submaps:
        lines.append(f"resumed: all {submaps} submaps were read from the run folder, none computed")
    elif resumed:
        lines.append(f"resumed: {resumed} of {submaps} submaps were read from the run folder and are in no time above")
    if compilation >= 1.0:
        lines.append(f"seconds_total includes {compilation:.0f} s of compilation (first run only)")
    return lines


CAUSES = frozenset(
    {"residuals", "calibration", "observations-not-used", "motion-gap", "particles", "gps-mirrored", "gps-scale"}
    | {"gps-correlated", "ranges-constant", "bearings-degrees", "steering-degrees", "scans-repeated", "ranges-and-path"}
)
"""Codes of findings that explain disagreement between submaps."""


def join_note(result: Any) -> list[str]:
    """Advice if χ²/dof of the join is significantly above or below 1."""
    from graphslam.app.verdict.figures import CERTAIN
    from graphslam.evaluate.residual_consistency import two_sided_bounds

    m = {r["key"]: r["value"] for r in result.metric_rows}
    chi2, dof = m.get("join_chi2_per_dof"), m.get("join_dof", 0.0)
    if chi2 is None or not dof > 0:
        return []
    low, high, verdict = two_sided_bounds(chi2, dof, CERTAIN)
    if verdict == "consistent":
        return []
    text = (
        f"note: χ²/dof of the join: {chi2:.3g} [{low:.3g}, {high:.3g} in 999 of 1000 consistent runs; {dof:.4g} dof]. "
    )
    causes = [f.code for f in result.verdict if f.code in CAUSES and f.level in ("look", "bad")]
    if verdict == "overconfident" and causes:
        named = ", ".join(f"“{c}”" for c in dict.fromkeys(causes))
        return [f"{text}The verdict names a cause ({named}): correct it before you scale covariances"]
    scale = result.report["covariance_scale"] * chi2
    return [f"{text}If there is no other cause, use --set backend.covariance_scale={scale:.2g}"]


def demo_command(
    out: Path = typer.Option(
        Path("demo-run"), "--out", "-o", help="Folder for the results. An unfinished demo in it is resumed."
    ),
    seed: int = typer.Option(0, help="Seed for sensor noise, clutter and the filter."),
    preset: str = typer.Option("garage", help="World of the demo: garage, or quick for a small one."),
    every: bool = EVERY,
    as_json: bool = JSON,
) -> None:
    """Simulate a robot in a garage with two levels, map it with SegSLAM, and solve one factor graph."""
    from graphslam.app.demo import run_demo

    result = run_demo(out, seed=seed, preset=preset, progress=not as_json)
    rows = result.metric_rows
    text = (
        f"{chr(10).join(metric_lines(result, every))}"
        f"\n\n{chr(10).join(verdict_text(result.headline, result.verdict))}"
        f"\n\nplots: {', '.join(str(p) for p in sorted((out / 'figures').glob('*.png')))}"
        f"\nreport: {out / 'report.html'}"
        f"\nmap: {out / 'map.ply'} (points), {out / 'map.bt'} (OctoMap), floor plans {out}/map-level*.yaml"
    )
    value = {"out": str(out), "verdict": result.report["verdict"], "metrics": rows, "report": result.report}
    print_result(value, text, as_json=as_json)


def simulate_command(
    world: str = typer.Argument(
        ...,
        help="Name of the world: mixed, landmark-field, garage or court; of the studies: campus, point-field, mine or "
        "building.",
    ),
    out: Path = typer.Option(..., "--out", "-o", help="Folder for the log, with the true path and map."),
    seed: int = typer.Option(0, help="Seed for sensor noise and for movable objects in the world."),
    layout: str | None = typer.Option(
        None,
        help="Layout of the garage: A, B, C or D; of the mine: once or twice round. drawn-17: random, seed 17.",
    ),
    preset: str | None = typer.Option(
        None,
        help="Landmark field: A, B, C, demo or quick. Campus: full, three-blocks, block or quick. "
        "Mixed: full or quick. Other worlds: light, full or two-scanners.",
    ),
    world_seed: int | None = typer.Option(
        None, help="Seed of the place: sessions with the same --world-seed and different --seed share a place."
    ),
    setting: list[str] = typer.Option(
        [], "--set", help="Set one parameter of the world or the robot, as name=value. May be repeated."
    ),
    as_json: bool = JSON,
) -> None:
    """Simulate a robot in a world and write its log, with ground truth and all noise parameters."""
    from graphslam.app.worlds import simulate as make
    from graphslam.app.worlds import write_simulated
    from graphslam.core.output_folder import check_folder_target
    from graphslam.io.log_folder import KIND

    check_folder_target(out, KIND)
    changes: dict[str, Any] = {}
    for text in setting:
        changes |= parse_setting(text)
    place = {} if world_seed is None else {"world_seed": world_seed}
    log = make(world, seed=seed, preset=preset, layout=layout, progress=not as_json, **place, **changes)
    write_simulated(log, out)
    streams = {name: len(s.times) for name, s in log.streams.items()}
    rows = [{"stream": k, "records": v} for k, v in streams.items()]
    value = {
        "out": str(out),
        "world": world,
        "seed": seed,
        "duration": log.duration,
        "streams": streams,
        "meta": log.meta,
    }
    print_result(value, f"{text_table(rows)}\n{log.duration:.1f} s written to {out}", as_json=as_json)


COMMANDS = {"run": run_command, "demo": demo_command, "simulate": simulate_command}
