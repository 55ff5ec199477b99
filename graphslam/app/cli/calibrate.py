"""``graphslam calibrate``."""

from __future__ import annotations

from pathlib import Path

import typer

from graphslam.app.cli.run import JSON, MAX_SIZE, PRESET, READER, READER_OPTION, reader_options, run_options
from graphslam.app.cli.terminal import write_and_print
from graphslam.core.atomic import atomic_open, check_file_target
from graphslam.core.config import dump_toml


def calibrate_command(
    source: str = typer.Argument(..., help="A log: a file, a folder, or the name of a data set."),
    frontend: str | None = typer.Option(None, help="Front end that reads the log. Default: by the streams of the log."),
    quick: bool = typer.Option(False, "--quick", help="Use a part of the log, as inside a run (some seconds)."),
    reader: str | None = READER,
    reader_option: list[str] = READER_OPTION,
    preset: str | None = PRESET,
    config: Path | None = typer.Option(None, help="TOML file with options, as for a run."),
    setting: list[str] = typer.Option([], "--set", help="Set one option, as a.b=value. May be repeated."),
    seed: int = typer.Option(0, help="Seed of all random numbers; the same seed gives the same result."),
    out: Path | None = typer.Option(
        None, "--out", "-o", help="TOML file for the result; use it with `graphslam run --config FILE`."
    ),
    max_size: str | None = MAX_SIZE,
    as_json: bool = JSON,
) -> None:
    """Estimate sensor noise, biases and scale factors from a log (no ground truth needed)."""
    from graphslam.app.run.calibration import calibrate_log

    if out is not None:
        check_file_target(out)
    options = run_options(config, setting)
    given = reader_options(reader_option)
    found = calibrate_log(
        source,
        frontend=frontend,
        quick=quick,
        seed=seed,
        config=options,
        reader=reader,
        reader_options=given,
        preset=preset,
    )
    lines = [f"{f.level or '-':4}  {f.text}" for f in found.findings()]
    value, text = found.as_dict() | {"out": None if out is None else str(out)}, "\n".join(lines)

    def write() -> None:
        if out is not None:
            with atomic_open(out, "w") as file:
                file.write(dump_toml({"calibrate": found.config()}))

    note = "" if out is None else f"written to {out}: graphslam run {source} --config {out}"
    write_and_print(write, value, text, note, as_json=as_json)


COMMANDS = {"calibrate": calibrate_command}
