"""The command line: commands, exit codes, and conversion of errors to one line of text.

Exit codes: 0 done; 1 a known error, one line on stderr; 2 wrong usage; 130 interrupted, with the command to resume.
"""

from __future__ import annotations

import errno
import os
import shlex
import sys
from collections.abc import Callable
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
from graphslam.app.cli.terminal import be_quiet, be_verbose, log_to_stderr, outlive_stderr
from graphslam.core.errors import GraphSlamError
from graphslam.core.plugins import IN_STUDIES, load_plugin, plugins
from graphslam.core.progress import printable, shown_bars


class Interrupted(Exception):
    """Ctrl-C. Typer handles ``KeyboardInterrupt`` itself and would exit without a message."""


COMMANDS = "graphslam.commands"
GROUPS = {
    "Map": {
        "run": "Map a log: submaps, graph, solution, verdict.",
        "init": "Write a commented file of options for a log.",
        "calibrate": "Estimate noise, biases and scales of sensors from a log.",
        "report": "Write one HTML page of a run.",
        "map": "Make the map of a run again, its terrain or surface.",
        "export": "Export a run: tum, kml, nav2, mcap, ros2, ...",
        "demo": "Simulate a garage with two levels and map it.",
    },
    "Solve and compare": {
        "join": "Join submaps into one map with one method.",
        "compare": "Compare methods on the same submaps.",
        "loops": "List the loop closures of a run; undo one.",
        "solve": "Solve a pose-graph file.",
        "eval": "Compare a path with a reference: ATE, RPE, NEES.",
    },
    "Data": {
        "data": "Data sets and logs: list, download, check.",
        "simulate": "Simulate a robot and write its log with ground truth.",
    },
    "Advanced": {
        "merge": "Merge runs of several robots or days.",
        "localise": "Localise a log or submaps in a saved map.",
        "relax": "Relax a pose graph that is larger than memory.",
        "options": "List the options of a run or of a front end.",
        "doctor": "Check the installation.",
        "study": "Run a Monte-Carlo study.",
        "terrain-tables": "Learn the tables of the terrain from drives.",
    },
}
"""Commands by group, with their line in ``graphslam --help``; other commands of plug-ins are listed last."""


def _volume() -> list[Any]:
    """Options of every command, before and after its name. Their callbacks act; they are not passed to the command."""

    def when_given(action: Callable[[], None]) -> Callable[[bool], None]:
        return lambda given: action() if given else None

    def options(
        verbose: bool = typer.Option(
            *(False, "--verbose", "-v"), callback=when_given(be_verbose), help="Print progress messages on stderr."
        ),
        quiet: bool = typer.Option(
            *(False, "--quiet", "-q"), callback=when_given(be_quiet), help="Print the result and errors only."
        ),
    ) -> None: ...

    made = typer.Typer(add_completion=False)
    made.command()(options)
    params: list[Any] = typer.main.get_command(made).params
    for p in params:
        p.expose_value = False
    return params


class Commands(TyperGroup):
    """A group of commands that all have ``-v`` and ``-q``."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.params = [*self.params, *_volume()]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        found = self.find(ctx, cmd_name)
        if found is not None and "verbose" not in {p.name for p in found.params}:
            found.params = [*found.params, *_volume()]
        return found

    def find(self, ctx: Any, name: str) -> Any:
        """The command of that name, or None."""
        return super().get_command(ctx, name)


class AllCommands(Commands):
    """All commands with those of plug-ins; Ctrl-C in one of them is passed on to :func:`main`."""

    def list_commands(self, ctx: Any) -> list[str]:
        return [*super().list_commands(ctx), *plugins(COMMANDS)]

    def find(self, ctx: Any, name: str) -> Any:
        own = super().find(ctx, name)
        if own is not None or name not in {*plugins(COMMANDS), *IN_STUDIES[COMMANDS]}:
            return own
        lone = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
        lone.command(name)(load_plugin(COMMANDS, "command", name))
        return typer.main.get_command(lone)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """See click: the commands by group, one line each."""
        there = self.list_commands(ctx)
        others = [n for n in there if not any(n in lines for lines in GROUPS.values())]
        groups = {**GROUPS, "Plug-ins": {n: self.get_command(ctx, n).get_short_help_str(60) for n in others}}
        for title, lines in groups.items():
            rows = [(n, text) for n, text in lines.items() if n in there]
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)

    def main(self, *args: Any, **options: Any) -> Any:
        log_to_stderr()
        return super().main(*args, **options)

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            raise Interrupted from None


app = typer.Typer(
    name="graphslam",
    cls=AllCommands,
    help="Globally consistent maps with an uncertainty you can trust.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # otherwise [m] in a help text is parsed as markup and disappears
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"graphslam {graphslam.__version__}")
        raise typer.Exit()


@app.callback()
def _options(
    version: bool = typer.Option(False, "--version", callback=_version, is_eager=True, help="Print the version."),
) -> None:
    """Options before the name of a command."""


cli_run.add_run_commands(app)
cli_calibrate.add_calibrate_command(app)
cli_join.add_join_commands(app)
cli_map.add_map_command(app)
cli_sessions.add_session_commands(app)
cli_results.add_result_commands(app)
cli_tools.add_tool_commands(app)
app.add_typer(cli_data.app, name="data", cls=Commands)


def main() -> None:
    """Entry point ``graphslam``."""
    outlive_stderr()
    try:
        app()
    except BrokenPipeError:  # `graphslam … | head`
        sys.stderr.close()
        sys.exit(1)
    except (GraphSlamError, OSError, MemoryError, RecursionError, KeyboardInterrupt, Interrupted) as error:
        for bar in shown_bars():
            bar.close()
        typer.echo(f"graphslam: {error_line(error)}", err=True)
        _drop_output()
        sys.exit(130 if isinstance(error, (KeyboardInterrupt, Interrupted)) else 1)


def error_line(error: BaseException) -> str:
    """Message of an error: our own unchanged, system errors with advice."""
    if isinstance(error, (KeyboardInterrupt, Interrupted)):
        return f"interrupted; {_go_on(sys.argv[1:])}"
    if isinstance(error, MemoryError):  # NumPy's message has the requested size
        return f"not enough memory; use a smaller part of the data, or a machine with more memory. {error}".strip()
    if isinstance(error, RecursionError):
        return "an input file is nested too deeply; check the input files for a damaged one"
    if isinstance(error, OSError):
        files = [str(f) for f in (error.filename, error.filename2) if f is not None]
        advice = _ADVICE.get(error.errno or 0, "")
        return printable(f"{': '.join([*files, error.strerror or str(error)])}{advice}")
    return printable(" ".join(str(error).split()))


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


def _drop_output() -> None:
    """Flush standard output; if this fails, discard it, so that the interpreter does not fail at exit."""
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
