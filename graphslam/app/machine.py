"""What of the machine a result may depend on: threads of linear algebra, and versions of what computes.

The matrices are small and many: threads of a linear-algebra library wait for each other and cost up to ten times more
than they give. The order of their sums would also depend on the machine, and the same seed must give the same bytes.
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
    """Context in which BLAS works on one thread.

    Contexts may end in any order: the caller's setting comes back at the end of the last one.
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
    """Time since it was made, or since some seconds before, and what of it went into compilation [s]."""

    def __init__(self, before: float = 0.0) -> None:
        self._begin, self._compiled = time.perf_counter() - before, compile_seconds()

    def seconds(self) -> float:
        """All the time."""
        return time.perf_counter() - self._begin

    def compilation(self) -> float:
        """The part of it in which kernels were compiled."""
        return compile_seconds() - self._compiled


PACKAGES = ("graphslam-submaps", "gtsam", "numpy", "scipy", "numba", "matplotlib", "pandas")


def versions() -> dict[str, str]:
    """Versions of what computed the run."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found
