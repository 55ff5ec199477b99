"""Peak memory of joins, each measured in its own process with the kernel's count of resident pages.

Tracing Python's allocations would not see the memory of SuperLU, LAPACK and gtsam, and would slow down the timed code.
So a new interpreter loads the submaps and is forked for each method. The fork loads what the method needs, resets the
kernel's high-water mark, joins, and reports the rise of the mark. Only on Linux; on other systems there is no value.
"""

from __future__ import annotations

import gc
import json
import logging
import math
import multiprocessing
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from types import TracebackType
from typing import TypeVar

import graphslam
from graphslam.core.errors import ConfigError
from graphslam.core.heap import trim_heap
from graphslam.io.submap_store import read_submaps, write_submaps
from graphslam.join.registry import Material, compile_method, join_by_method

logger = logging.getLogger(__name__)
T = TypeVar("T")

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

        One process per core runs at the same time.
        """
        if self._folder is None:
            return [None] * len(methods)
        command = [sys.executable, "-m", "graphslam.app.memory", self._folder.name, str(int(polish)), *methods]
        paths = [str(Path(graphslam.__file__).resolve().parents[1]), os.environ.get("PYTHONPATH", "")]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in paths if p)}
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, check=True, env=environment, timeout=_TIMEOUT_S
            )
            found = json.loads(done.stdout.strip().splitlines()[-1])
        except (subprocess.SubprocessError, OSError, ValueError, IndexError) as error:
            found = [str(error)] * len(methods)
        for method, value in zip(methods, found):
            if isinstance(value, str):
                logger.warning("peak memory of %s could not be measured: %s", method, value)
        return [v if isinstance(v, float) and math.isfinite(v) else None for v in found]


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


def peak_growth(work: Callable[[], T]) -> tuple[T, float | None]:
    """Result of ``work()``, and the peak growth of the resident memory of this process meanwhile [MB].

    None if the system does not tell. Free memory is returned to the system first: otherwise the work would reuse it,
    which the mark does not count.
    """
    gc.collect()
    trim_heap()
    try:
        before = _status("VmRSS")
        Path("/proc/self/clear_refs").write_text("5")
    except (OSError, ValueError):
        return work(), None
    result = work()
    return result, max(_status("VmHWM") - before, 0) / 1e6


def _measure_here(submaps: Material, method: str, polish: bool) -> float:
    """Compile, free memory, reset the high-water mark, join, read the mark [MB]."""
    compile_method(submaps, method, polish=polish)  # also loads modules and thread pools
    result, grown = peak_growth(lambda: join_by_method(submaps, method, polish=polish))
    assert result.states > 0
    return math.nan if grown is None else grown


def _answer(end: Connection, submaps: Material, method: str, polish: bool) -> None:
    """In a fork: send the value, or why there is none."""
    try:
        end.send(_measure_here(submaps, method, polish))
    except Exception as error:
        end.send(f"{type(error).__name__}: {error}")


def measure_and_print(arguments: Sequence[str]) -> None:
    """Entry of the measuring process: folder, polish (0 or 1), methods; prints a JSON list to standard output.

    The process has loaded the submaps, but has not joined anything, so that it has no threads when it is forked.
    """
    folder, polish, *methods = arguments
    submaps, fork, out = _read(Path(folder)), multiprocessing.get_context("fork"), []
    cores = max(1, os.cpu_count() or 1)
    for some in (methods[k : k + cores] for k in range(0, len(methods), cores)):
        started = []
        for method in some:
            here, there = fork.Pipe(duplex=False)
            process = fork.Process(target=_answer, args=(there, submaps, method, polish == "1"))
            process.start()
            there.close()
            started.append((process, here))
        for process, here in started:
            try:
                out.append(here.recv())
            except EOFError:
                out.append("its process ended")
            process.join()
    sys.stdout.write(json.dumps(out) + "\n")


if __name__ == "__main__":
    measure_and_print(sys.argv[1:])
