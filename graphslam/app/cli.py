"""The command line: verbs, exit codes, and the one place where errors become a line of text.

Exit codes: 0 done; 1 a known error, one line on stderr; 2 wrong usage.
"""

from __future__ import annotations

import os
import sys

import typer

import graphslam

# Before NumPy loads: thousands of small matrices, whose BLAS threads would only wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from graphslam.app import (
    cli_data,
    cli_export,
    cli_join,
    cli_localise,
    cli_loops,
    cli_map,
    cli_merge,
    cli_report,
    cli_run,
    cli_study,
    cli_tools,
)
from graphslam.app.terminal import log_to_stderr
from graphslam.core.errors import GraphSlamError

app = typer.Typer(
    name="graphslam",
    help="Globally consistent maps with an uncertainty you can trust.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"graphslam {graphslam.__version__}")
        raise typer.Exit()


@app.callback()
def _options(
    verbose: bool = typer.Option(False, "--verbose", "-v", help="Say on stderr what is being done."),
    version: bool = typer.Option(False, "--version", callback=_version, is_eager=True, help="Print the version."),
) -> None:
    log_to_stderr(verbose)


cli_run.register(app)
cli_join.register(app)
cli_map.register(app)
cli_merge.register(app)
cli_loops.register(app)
cli_report.register(app)
cli_localise.register(app)
cli_export.register(app)
cli_study.register(app)
cli_tools.register(app)
app.add_typer(cli_data.app, name="data")


def main() -> None:
    """Entry point ``graphslam``."""
    try:
        app()
    except GraphSlamError as error:
        typer.echo(f"graphslam: {' '.join(str(error).split())}", err=True)
        sys.exit(1)
    except BrokenPipeError:  # `graphslam … | head`
        sys.stderr.close()
        sys.exit(1)
    except KeyboardInterrupt:
        typer.echo("graphslam: interrupted", err=True)
        sys.exit(1)


if __name__ == "__main__":
    main()
