"""Compilation of kernels by numba, with the compiled code in the user's cache folder.

Numba's own place for compiled code is beside the source. There it outlives an uninstall, and the folder that is left is
imported as an empty namespace package. So every kernel of the package is compiled through :func:`njit` of this module.
"""

from __future__ import annotations

import gc
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import platformdirs


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

_NAMES = 2
"""Raise it when a class that kernels take is renamed: numba looks for the old name before it sees a changed source."""


def compiled_folder() -> Path:
    """Folder of compiled code: ``NUMBA_CACHE_DIR``, or one of this numba and Python in the user's cache folder."""
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(chosen)
    version = f"numba-{numba.__version__}-python-{sys.version_info.major}.{sys.version_info.minor}-{_NAMES}"
    return Path(platformdirs.user_cache_dir("graphslam", appauthor=False)) / "compiled" / version


@cache
def keeps_compiled_code() -> bool:
    """Whether compiled code can be kept: the folder can be made, and written to."""
    folder = compiled_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def njit(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """``numba.njit`` whose compiled code is kept in :func:`compiled_folder`, where that can be written to.

    Parameters
    ----------
    function : callable, optional
        What ``@njit`` without parentheses decorates.
    **options
        Those of ``numba.njit``, without ``cache``.
    """
    if function is None:
        return lambda decorated: njit(decorated, **options)
    config: Any = numba.config
    before = config.CACHE_DIR
    config.CACHE_DIR = str(compiled_folder())  # read when a function is decorated; other packages keep theirs
    try:
        return numba.njit(cache=keeps_compiled_code(), **options)(function)
    finally:
        config.CACHE_DIR = before
