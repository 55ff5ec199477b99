"""Says that kernels are being compiled, the one time they are.

Compiled code is kept on disk (:func:`graphslam.core.jit.compiled_folder`), so only the first use on a machine
waits; a first use that waits in silence looks like a hang.
"""

from __future__ import annotations

import inspect
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from graphslam.evidence.mark_kernels import mark_grids

COMPILING = "GRAPHSLAM_COMPILING"
"""Set in the environment of processes that compile, so that they start none of their own."""
_state = {"checked": False}


def is_compiled(kernel: Any) -> bool:
    """Whether compiled code of a kernel lies on disk that is not older than its source; true also where nothing is
    compiled.
    """
    if not hasattr(kernel, "stats"):  # NUMBA_DISABLE_JIT
        return True
    source = Path(inspect.getsourcefile(kernel.py_func) or "")
    found = Path(kernel.stats.cache_path).glob(f"{source.stem}.{kernel.py_func.__name__}-*.nbi")
    try:
        return max((f.stat().st_mtime for f in found), default=0.0) >= source.stat().st_mtime
    except OSError:  # another process is replacing them
        return True


def announce_compilation() -> None:
    """If this machine has not compiled the kernels yet, have them compiled, with a line of progress on stderr.

    Other processes do it, and this one then loads their work from disk; where none can be started, kernels are compiled
    at their use.
    """
    if _state["checked"]:
        return
    _state["checked"] = True
    if not is_compiled(mark_grids) and COMPILING not in os.environ:
        start_compiling("all", subprocess.run)


def start_compiling(part: str, start: Any) -> Any:
    """Start ``graphslam.evidence.compile`` for ``"all"`` or ``"half"`` of the kernels; None where that cannot be."""
    if not sys.executable:
        return None
    here = str(Path(__file__).resolve().parents[2])
    paths = os.pathsep.join(p for p in (here, os.environ.get("PYTHONPATH", "")) if p)
    try:
        return start(
            [sys.executable, "-m", "graphslam.evidence.compile", part],
            env={**os.environ, COMPILING: "1", "PYTHONPATH": paths},
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=None if part == "all" else subprocess.DEVNULL,
        )  # fmt: skip
    except OSError:
        return None
