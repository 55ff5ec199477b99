"""How every compiled function of the package is compiled."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def without_garbage_collection() -> Iterator[None]:
    """For work that makes very many objects that live: looking through them again and again is a tenth of the time
    that compiling takes, and a fifth of the time to load the compiler.
    """
    was = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.enable()


with without_garbage_collection():
    import numba


def kernel(*, error_model: str = "python") -> Callable[[Any], Any]:
    """Compiled on first use, kept on disk, runs beside other threads.

    Nobody calls a kernel from C, and a wrapper for that would be a fifteenth of the time it takes to compile.
    """
    return numba.njit(  # type: ignore[call-overload, no-any-return]
        cache=True, nogil=True, no_cfunc_wrapper=True, error_model=error_model
    )
