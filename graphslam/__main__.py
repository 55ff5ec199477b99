"""Entry point of the command line, also ``python -m graphslam`` where the command is not on the path.

The command line is imported here, so that neither Ctrl-C nor a lack of memory during the imports prints a traceback.
"""

from __future__ import annotations

import os
import signal
import sys
from typing import Any


def _leave(*_: Any) -> None:
    os.write(2, b"graphslam: interrupted; existing files are unchanged\n")
    os._exit(130)


def start() -> None:
    """Entry point ``graphslam``."""
    python = signal.getsignal(signal.SIGINT)
    if python is signal.default_int_handler:  # not if it is ignored, as in the background of a shell
        signal.signal(signal.SIGINT, _leave)
    try:
        from graphslam.app.cli import main as command_line
    except (ImportError, MemoryError, OSError, RuntimeError, SystemError) as error:
        text = " ".join(str(error).split()) or type(error).__name__
        if sys.stderr is not None:
            sys.stderr.write(f"graphslam: cannot be loaded: not enough memory, or a damaged installation. {text}\n")
        sys.exit(1)
    signal.signal(signal.SIGINT, python)
    command_line()


if __name__ == "__main__":
    start()
