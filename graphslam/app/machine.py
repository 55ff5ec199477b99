"""Influences of the machine on a result: threads of linear algebra, and versions of the packages.

The matrices are small and many: with several threads, linear algebra takes up to ten times longer because the threads
wait for each other. The order of sums would also depend on the machine, but the same seed must give the same bytes.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from threading import Lock

from threadpoolctl import threadpool_limits

from graphslam.core.jit import compile_seconds

_open: list[object] = []
_limits: list[threadpool_limits] = []
_lock = Lock()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Context in which BLAS uses one thread.

    Contexts may end in any order; the caller's setting is restored when the last one ends.
    """
    mine = object()
    with _lock:
        if not _open:
            _limits.append(threadpool_limits(limits=1, user_api="blas"))
        _open.append(mine)
    try:
        yield
    finally:
        with _lock:
            _open.remove(mine)
            if not _open:
                _limits.pop().restore_original_limits()


class Stopwatch:
    """Time since its creation (plus ``before``), and the part of it that was compilation [s]."""

    def __init__(self, before: float = 0.0) -> None:
        self._begin, self._compiled = time.perf_counter() - before, compile_seconds()

    def seconds(self) -> float:
        """Total time [s]."""
        return time.perf_counter() - self._begin

    def compilation(self) -> float:
        """Time in which kernels were compiled [s]."""
        return compile_seconds() - self._compiled


PACKAGES = ("graphslam-submaps", "gtsam", "numpy", "scipy", "numba", "matplotlib", "pandas")


def versions() -> dict[str, str]:
    """Versions of Python and the packages that compute a run."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found
