"""Independent tasks on several threads, for kernels and functions that release the GIL; results keep their order."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any

_pools: dict[int, ThreadPoolExecutor] = {}
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pools.clear)  # a forked process has none of the threads


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_tasks(work: Callable[..., Any], items: Iterable[tuple[Any, ...]], threads: int | None = None) -> list[Any]:
    """``[work(*item) for item in items]``, computed on several threads.

    Parameters
    ----------
    items : iterable
        Read in the calling thread, a few items ahead of the work, so that their arrays are not all in memory.
    threads : int, optional
        Default: one per core. A task must not call this function.
    """
    n = cores() if threads is None else threads
    if n == 1:
        return [work(*item) for item in items]
    if n not in _pools:
        _pools[n] = ThreadPoolExecutor(n, thread_name_prefix="graphslam")
    out: list[Any] = []
    pending: deque[Future[Any]] = deque()
    try:
        for item in items:
            pending.append(_pools[n].submit(work, *item))
            if len(pending) > 2 * n:
                out.append(pending.popleft().result())
        return out + [f.result() for f in pending]
    finally:
        wait(pending)  # after an error, too: the tasks write to arrays of the caller
