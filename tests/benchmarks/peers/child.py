"""One measured work in a process of its own; without imports of this project, as it also runs in environments of peers.

A work is a function of a folder of inputs. It imports and reads what it needs, and returns the function that is
measured, which returns figures by name, and arrays as ``path`` or ``poses``.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

Work = Callable[[Path], Callable[[], "dict[str, Any]"]]
REPEATED = {"grid", "octomap", "bonxai", "ate", "evo", "register", "open3d"}
"""Works that are short: the first call is ``cold``, the second ``work``."""


def cpu() -> float:
    """CPU time of this process and its children [s]."""
    return time.process_time() + sum(os.times()[2:4])


def peak() -> float:
    """Peak memory of this process [MB]."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024.0


def main(works: dict[str, Work]) -> None:
    """Arguments: work, folder of inputs, file of figures (an array goes beside it)."""
    name, folder, out = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3])
    call = works[name](folder)
    figures = {}
    for what in ("cold", "work") if name in REPEATED else ("work",):
        begin, wall = cpu(), time.perf_counter()
        result = call()
        figures |= {what: cpu() - begin, "elapsed": time.perf_counter() - wall}
    for key, value in result.items():
        if isinstance(value, np.ndarray):
            np.save(out.with_suffix(f".{key}.npy"), value)
        else:
            figures[key] = value
    out.write_text(json.dumps(figures | {"whole": cpu(), "peak": peak()}))
