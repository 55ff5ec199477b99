"""Entry point of the command line, also ``python -m graphslam`` where the command is not on the path.

The command line is imported here, so that neither Ctrl-C nor a lack of memory during the imports prints a traceback.
"""

from __future__ import annotations

import os
import signal
import sys
from typing import Any, NoReturn

LEAST_MEMORY = 700
"""Address space that the imports need [MB]. With less, OpenBLAS can wait for memory without end when it is loaded."""


def _leave(*_: Any) -> None:
    os.write(2, b"graphslam: interrupted; existing files are unchanged\n")
    os._exit(130)


def _give_up(why: str) -> NoReturn:
    if sys.stderr is not None:
        sys.stderr.write(f"graphslam: {why}\n")
    sys.exit(1)


def start() -> None:
    """Entry point ``graphslam``."""
    python = signal.getsignal(signal.SIGINT)
    if python is signal.default_int_handler:  # not if it is ignored, as in the background of a shell
        signal.signal(signal.SIGINT, _leave)
    if sys.platform != "win32":
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY and limit < LEAST_MEMORY * 10**6:
            _give_up(
                f"not enough memory: the limit is {limit // 10**6} MB (ulimit -v); wanted {LEAST_MEMORY} MB or more"
            )
    try:
        from graphslam.app.cli import main as command_line
    except (ImportError, MemoryError, OSError, RuntimeError, SystemError) as error:
        text = " ".join(str(error).split()) or type(error).__name__
        _give_up(f"cannot be loaded: not enough memory, or a damaged installation. {text}")
    signal.signal(signal.SIGINT, python)
    command_line()


if __name__ == "__main__":
    start()
