"""Peak memory of a join, measured in its own process with the kernel's count of resident pages.

Tracing Python's allocations would not see the memory of SuperLU, LAPACK and gtsam, and would slow down the timed code.
So each method runs once more in a new interpreter. It loads the submaps and every module, resets the kernel's
high-water mark, joins, and reports the rise of the mark. Only on Linux; on other systems there is no value.
"""

from __future__ import annotations

import gc
import logging
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import TracebackType

import graphslam
from graphslam.core.errors import ConfigError
from graphslam.core.heap import trim_heap
from graphslam.io.submap_store import read_submaps, write_submaps
from graphslam.join.registry import Material, compile_method, join_by_method

logger = logging.getLogger(__name__)

_TIMEOUT_S = 3600.0
_GRAPH = "graph.npz"
"""File of a graph with all its factors."""


class MemoryProbe:
    """Context for :meth:`measure`, the peak memory of methods on the same submaps.

    Use it after all timing, because the measuring processes use all cores.

    Parameters
    ----------
    submaps : sequence of Submap, JoinProblem or None
        None: measure nothing.
    """

    def __init__(self, submaps: Material | None) -> None:
        self._submaps = submaps if Path("/proc/self/clear_refs").exists() else None
        self._folder: tempfile.TemporaryDirectory[str] | None = None

    def __enter__(self) -> MemoryProbe:
        if self._submaps is not None:
            self._folder = tempfile.TemporaryDirectory(prefix="graphslam-")
            if isinstance(self._submaps, Sequence):
                write_submaps(self._folder.name, list(self._submaps))
            else:
                try:
                    self._submaps.save(Path(self._folder.name) / _GRAPH)
                except ConfigError as error:
                    logger.warning("peak memory is not measured: %s", error)
                    self._folder.cleanup()
                    self._folder = None
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._folder is not None:
            self._folder.cleanup()

    def measure(self, methods: Sequence[str], *, polish: bool) -> list[float | None]:
        """Peak growth of resident memory [MB = 10⁶ bytes] while each method joins; None if unknown.

        The processes share nothing; one process per core runs at the same time.
        """
        if self._folder is None:
            return [None] * len(methods)
        with ThreadPoolExecutor(max(1, os.cpu_count() or 1)) as pool:
            return list(pool.map(lambda method: self._measure(method, polish), methods))

    def _measure(self, method: str, polish: bool) -> float | None:
        assert self._folder is not None
        command = [sys.executable, "-m", "graphslam.app.memory", self._folder.name, method, str(int(polish))]
        paths = [str(Path(graphslam.__file__).resolve().parents[1]), os.environ.get("PYTHONPATH", "")]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in paths if p)}
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, check=True, env=environment, timeout=_TIMEOUT_S
            )
            megabytes = float(done.stdout.strip().splitlines()[-1])
        except (subprocess.SubprocessError, ValueError, IndexError) as error:
            logger.warning("peak memory of %s could not be measured: %s", method, error)
            return None
        return megabytes if math.isfinite(megabytes) else None


def _status(field: str) -> int:
    """A field of ``/proc/self/status`` in bytes."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field + ":"):
            return 1024 * int(line.split()[1])
    raise ValueError(f"/proc/self/status has no {field}")


def _read(folder: Path) -> Material:
    if not (folder / _GRAPH).is_file():
        return read_submaps(folder)
    from graphslam.join.graph_problem import JoinProblem

    return JoinProblem.load(folder / _GRAPH)


def _measure_here(folder: str, method: str, polish: bool) -> float:
    """Load, compile, free memory, reset the high-water mark, join, read the mark [MB]."""
    submaps = _read(Path(folder))
    compile_method(submaps, method, polish=polish)  # also loads modules and thread pools
    gc.collect()
    trim_heap()  # otherwise the join would reuse freed memory, which the mark does not count
    before = _status("VmRSS")
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return math.nan
    result = join_by_method(submaps, method, polish=polish)
    peak = _status("VmHWM")
    assert result.states > 0
    return max(peak - before, 0) / 1e6


def measure_and_print(arguments: Sequence[str]) -> None:
    """Entry of the measuring process: folder, method, polish (0 or 1); prints the value to standard output."""
    folder, method, polish = arguments
    sys.stdout.write(f"{_measure_here(folder, method, polish == '1')}\n")


if __name__ == "__main__":
    measure_and_print(sys.argv[1:])
