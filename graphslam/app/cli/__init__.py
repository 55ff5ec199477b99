"""The command line: commands, exit codes, and conversion of errors to one line of text.

Exit codes: 0 done; 1 a known error, one line on stderr; 2 wrong usage; 130 interrupted (143 by SIGTERM), with the
command to resume.
"""

from __future__ import annotations

import errno
import os
import shlex
import signal
import sys
import threading
from collections.abc import Callable
from typing import Any, NoReturn

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
from graphslam.app.cli.terminal import be_quiet, be_verbose, log_to_stderr, outlive_streams
from graphslam.core.errors import GraphSlamError
from graphslam.core.plugins import IN_STUDIES, load_plugin, plugins
from graphslam.core.progress import printable, shown_bars


class Interrupted(Exception):
    """Ctrl-C or SIGTERM. Typer handles ``KeyboardInterrupt`` itself and would exit without a message."""


_HOW = {int(signal.SIGINT): "interrupted", int(signal.SIGTERM): "terminated"}


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
        "relax": "Relax a run with its scans, as a skeleton network.",
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
            raise Interrupted("interrupted") from None


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


for module in (cli_run, cli_calibrate, cli_join, cli_map, cli_sessions, cli_results, cli_tools):
    for name, command in module.COMMANDS.items():
        app.command(name)(command)
app.add_typer(cli_data.app, name="data", cls=Commands)


def main() -> None:
    """The command line, from its arguments to its exit code; see :mod:`graphslam.__main__` for the entry point."""
    outlive_streams()
    heard: list[int] = []
    _hear_signals(heard)
    try:
        app()
    except BrokenPipeError:  # `graphslam … | head`
        sys.stderr.close()
        sys.exit(1)
    except (Exception, KeyboardInterrupt, SystemExit) as error:
        if isinstance(error, SystemExit) and not (heard and error.code):  # Typer exits before a command begins
            raise
        if heard:  # also if a library made another error of it, as at its import
            _fail(Interrupted(_HOW[heard[-1]]), 128 + heard[-1])
        if isinstance(error, (KeyboardInterrupt, Interrupted)):
            _fail(error, 130)
        if not isinstance(error, (GraphSlamError, OSError, MemoryError, RecursionError)) and not lacks_memory(error):
            raise
        _fail(error, 1)
    finally:
        _forget_signals()


def _fail(error: BaseException, code: int) -> NoReturn:
    _forget_signals()  # a second Ctrl-C ends the process at once
    for bar in shown_bars():
        bar.close()
    typer.echo(f"graphslam: {error_line(error)}", err=True)
    _drop_output()
    sys.exit(code)


def _forget_signals() -> None:
    if threading.current_thread() is threading.main_thread():
        for number in _HOW:
            if callable(signal.getsignal(number)):
                signal.signal(number, signal.SIG_DFL)


def _hear_signals(heard: list[int]) -> None:
    """SIGTERM ends a command as Ctrl-C does, so that no temporary file is left; ``heard`` gets the numbers.

    A signal that falls into a callback, where Python prints a traceback and goes on, is raised again.
    """
    if threading.current_thread() is not threading.main_thread():
        return

    def interrupt(number: int, _: Any) -> NoReturn:
        heard.append(number)
        raise KeyboardInterrupt

    for number in _HOW:
        if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
            signal.signal(number, interrupt)
    known = sys.unraisablehook

    def unraisable(what: Any) -> None:
        if issubclass(what.exc_type, KeyboardInterrupt):  # later: here it would be lost once more
            number = heard[-1] if heard else signal.SIGINT
            threading.Timer(0.02, os.kill, (os.getpid(), number)).start()
        elif not issubclass(what.exc_type, MemoryError):
            known(what)

    sys.unraisablehook = unraisable


_NO_MEMORY = (
    "failed to map segment", "cannot allocate memory", "can't start new thread", "bad_alloc", "bad allocation",
    "out of memory", "error return without exception set",  # the last: Python, where an import lost its error
)  # fmt: skip


def lacks_memory(error: BaseException | None) -> bool:
    """Whether the system refused memory: an import, a thread or a library says so in its own words."""
    while error is not None:
        message = str(error).lower()
        if isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM:
            return True
        if any(words in message for words in _NO_MEMORY):
            return True
        error = error.__cause__ or error.__context__
    return False


def error_line(error: BaseException) -> str:
    """Message of an error: our own unchanged, system errors with advice."""
    if isinstance(error, (KeyboardInterrupt, Interrupted)):
        return f"{str(error) or 'interrupted'}; {_go_on(sys.argv[1:])}"
    message = printable(" ".join(str(error).split()))
    if isinstance(error, GraphSlamError):
        return message
    if lacks_memory(error):  # NumPy's message has the requested size
        return f"not enough memory; use a smaller part of the data, or a machine with more memory. {message}".strip()
    if isinstance(error, RecursionError):
        return "an input file is nested too deeply; check the input files for a damaged one"
    if isinstance(error, OSError):
        files = [str(f) for f in (error.filename, error.filename2) if f is not None]
        return printable(f"{': '.join([*files, error.strerror or str(error)])}{_advice(error.errno)}")
    return message


def _advice(number: int | None) -> str:
    if number in (errno.ENOSPC, errno.EDQUOT):
        return f"; free disk space; {_go_on(sys.argv[1:])}"
    return _ADVICE.get(number or 0, "")


def _go_on(arguments: list[str]) -> str:
    """How to resume a command that did not end."""
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
    errno.EFBIG: "; increase the file size limit (ulimit -f)",
    errno.EMFILE: "; increase the limit of open files (ulimit -n)",
}


if __name__ == "__main__":
    main()
