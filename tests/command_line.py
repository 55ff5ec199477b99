"""The command line in this process: what the package imports and compiles is there already, which takes seconds."""

from __future__ import annotations

import io
import logging
import signal
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout

import pytest

from graphslam.app.cli import main
from graphslam.core.progress import Bar


def graphslam(*args: object) -> subprocess.CompletedProcess[str]:
    """Exit code and texts of a command; what it does to logging and to signals is undone.

    A command leaves Ctrl-C as the system handles it: the process would end at the next one.
    """
    root, hidden = logging.getLogger(), Bar.hidden
    signals = {n: h for n in (signal.SIGINT, signal.SIGTERM) if (h := signal.getsignal(n)) is not None}
    handlers, level = root.handlers[:], root.level
    out, err, command = io.StringIO(), io.StringIO(), ["graphslam", *map(str, args)]
    with redirect_stdout(out), redirect_stderr(err), pytest.MonkeyPatch.context() as m:
        m.setattr(sys, "argv", command)
        m.setattr(sys, "unraisablehook", sys.unraisablehook)
        with pytest.raises(SystemExit) as ended:
            main()
    root.handlers[:], Bar.hidden = handlers, hidden
    root.setLevel(level)
    for number, handler in signals.items():
        signal.signal(number, handler)
    code = ended.value.code
    return subprocess.CompletedProcess(command, code if isinstance(code, int) else 0, out.getvalue(), err.getvalue())
