"""The command line: commands, exit codes, and the one place where errors become a line of text.

Exit codes: 0 done; 1 a known error, one line on stderr; 2 wrong usage; 130 interrupted, and one line how to go on.
"""

from __future__ import annotations

import errno
import os
import shlex
import sys
from typing import Any

import typer
from typer.core import TyperGroup

import graphslam

# Before NumPy loads: thousands of small matrices, whose BLAS threads would only wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from graphslam.app.cli import calibrate as cli_calibrate
from graphslam.app.cli import data as cli_data
from graphslam.app.cli import join as cli_join
from graphslam.app.cli import map as cli_map
from graphslam.app.cli import results as cli_results
from graphslam.app.cli import run as cli_run
from graphslam.app.cli import sessions as cli_sessions
from graphslam.app.cli import tools as cli_tools
from graphslam.app.cli.terminal import log_to_stderr
from graphslam.core.errors import GraphSlamError
from graphslam.core.plugins import IN_STUDIES, load_plugin, plugins


class Interrupted(Exception):
    """Ctrl-C, under a name that Typer does not know: it would leave without a word."""


COMMANDS = "graphslam.commands"


class Verbs(TyperGroup):
    """The commands, and those of plug-ins; Ctrl-C in one of them reaches :func:`main`."""

    def list_commands(self, ctx: Any) -> list[str]:
        return [*super().list_commands(ctx), *plugins(COMMANDS)]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        own = super().get_command(ctx, cmd_name)
        if own is not None or cmd_name not in {*plugins(COMMANDS), *IN_STUDIES[COMMANDS]}:
            return own
        lone = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
        lone.command(cmd_name)(load_plugin(COMMANDS, "command", cmd_name))
        return typer.main.get_command(lone)

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            raise Interrupted from None


app = typer.Typer(
    name="graphslam",
    cls=Verbs,
    help="Globally consistent maps with an uncertainty you can trust.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # or else [m] in a help text is taken for markup and disappears
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"graphslam {graphslam.__version__}")
        raise typer.Exit()


@app.callback()
def _options(
    verbose: bool = typer.Option(False, "--verbose", "-v", help="Print progress messages on stderr."),
    version: bool = typer.Option(False, "--version", callback=_version, is_eager=True, help="Print the version."),
) -> None:
    log_to_stderr(verbose)


cli_run.add_run_commands(app)
cli_calibrate.add_calibrate_command(app)
cli_join.add_join_commands(app)
cli_map.add_map_command(app)
cli_sessions.add_session_commands(app)
cli_results.add_result_commands(app)
cli_tools.add_tool_commands(app)
app.add_typer(cli_data.app, name="data")


def main() -> None:
    """Entry point ``graphslam``."""
    try:
        app()
    except BrokenPipeError:  # `graphslam … | head`
        sys.stderr.close()
        sys.exit(1)
    except (GraphSlamError, OSError, MemoryError, RecursionError, KeyboardInterrupt, Interrupted) as error:
        _end_bars()
        typer.echo(f"graphslam: {error_line(error)}", err=True)
        _drop_output()
        sys.exit(130 if isinstance(error, (KeyboardInterrupt, Interrupted)) else 1)


def error_line(error: BaseException) -> str:
    """Message of an error: ours unchanged, those of the system with advice."""
    if isinstance(error, (KeyboardInterrupt, Interrupted)):
        return f"interrupted; {_go_on(sys.argv[1:])}"
    if isinstance(error, MemoryError):  # NumPy says how much was asked for
        return f"not enough memory; use a smaller part of the data, or a machine with more memory. {error}".strip()
    if isinstance(error, RecursionError):
        return "an input file is nested too deeply; check the input files for a damaged one"
    if isinstance(error, OSError):
        files = [str(f) for f in (error.filename, error.filename2) if f is not None]
        advice = _ADVICE.get(error.errno or 0, "")
        return f"{': '.join([*files, error.strerror or str(error)])}{advice}"
    return " ".join(str(error).split())


def _go_on(arguments: list[str]) -> str:
    """How to resume an interrupted command."""
    command = shlex.join(["graphslam", *arguments])
    verb = next((a for a in arguments if not a.startswith("-")), "")
    if verb == "run":
        again = command if "--resume" in arguments else f"{command} --resume"
        return f"finished submaps are saved; resume with: {again}"
    if verb in ("demo", "study"):
        return f"finished parts are saved; resume with: {command}"
    return "existing files are unchanged"


def _end_bars() -> None:
    """Leave no bar of progress on the line that is written next."""
    if "tqdm" in sys.modules:
        for bar in list(getattr(sys.modules["tqdm"].tqdm, "_instances", ())):
            bar.close()


def _drop_output() -> None:
    """Have nothing left that the interpreter would write, and fail to write, at its end."""
    try:
        sys.stdout.flush()
    except OSError:  # for example a full disk behind `graphslam … > file`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


_ADVICE = {
    errno.ENOSPC: "; free disk space and run the same command again: finished parts are saved",
    errno.EDQUOT: "; free disk space and run the same command again: finished parts are saved",
    errno.EFBIG: "; increase the file size limit (ulimit -f)",
    errno.EMFILE: "; increase the limit of open files (ulimit -n)",
}


if __name__ == "__main__":
    main()
