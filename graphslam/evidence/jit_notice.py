"""Progress message while the kernels are compiled, on the first use on a machine.

Compiled code is cached on disk (:func:`graphslam.core.jit.compiled_folder`). Without a message, the first use would
look like a hang.
"""

from __future__ import annotations

import inspect
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from graphslam.core.jit import COMPILING, compiling_elsewhere
from graphslam.core.progress import compiling
from graphslam.evidence.mark_kernels import mark_grids

_state = {"checked": False}


def is_compiled(kernel: Any) -> bool:
    """Whether compiled code of a kernel is on disk; also True if compilation or its disk cache is disabled."""
    if not hasattr(kernel, "stats") or kernel.stats.cache_path is None:  # NUMBA_DISABLE_JIT; see graphslam.core.jit
        return True
    source = Path(inspect.getsourcefile(kernel.py_func) or "")
    return any(Path(kernel.stats.cache_path).glob(f"{source.stem}.{kernel.py_func.__name__}-*.nbi"))


def announce_compilation() -> None:
    """Compile the kernels if they are not on disk yet, with a progress line on stderr.

    Other processes compile, and this process loads the result from disk. If no process can be started, each kernel is
    compiled at its first call.
    """
    if _state["checked"]:
        return
    _state["checked"] = True
    if not is_compiled(mark_grids) and COMPILING not in os.environ:
        with compiling(), compiling_elsewhere():
            start_compiling("all", subprocess.run)


def start_compiling(part: str, start: Any) -> Any:
    """Start ``graphslam.evidence.compile`` for ``"all"`` or ``"half"`` of the kernels; None if that fails."""
    if not sys.executable:
        return None
    here = str(Path(__file__).resolve().parents[2])
    paths = os.pathsep.join(p for p in (here, os.environ.get("PYTHONPATH", "")) if p)
    try:
        return start(
            [sys.executable, "-m", "graphslam.evidence.compile", part],
            env={**os.environ, COMPILING: "1", "PYTHONPATH": paths},
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
    except OSError:
        return None
