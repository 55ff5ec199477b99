"""Compilation of kernels by numba, with a cache in the user's cache folder.

By default numba caches in the folder of the source. There the cache remains after an uninstall, and the remaining
folder is imported as an empty namespace package. So all kernels are compiled with :func:`njit` of this module.
"""

from __future__ import annotations

import contextlib
import gc
import hashlib
import logging
import multiprocessing
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from typing import Any

import platformdirs

from graphslam.core.progress import show_compiling


@contextmanager
def without_garbage_collection() -> Iterator[None]:
    """Disable garbage collection: it takes a tenth of the compile time, and a fifth of the time to load the
    compiler."""
    was = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.enable()


with without_garbage_collection():
    import numba
    from numba.core import caching, event
    from numba.extending import register_jitable

logger = logging.getLogger(__name__)

MOST_BYTES = 1_000_000_000
"""Largest size of the compiled code of all versions."""
UNUSED_SECONDS = 30 * 86_400.0
"""Compiled code of another version of numba or Python is deleted if it was not used for this time."""
_IMPORTED = re.compile(r"^from (graphslam[\w.]*) import", re.MULTILINE)


class _Compilations(event.Listener):
    """Compile time of this process; progress bars show the compilation. Garbage is collected after it."""

    def __init__(self) -> None:
        self.seconds, self._depth, self._since = 0.0, 0, 0.0
        self._uncollected = contextlib.ExitStack()

    def on_start(self, event: Any) -> None:
        self._depth += 1
        if self._depth == 1:
            self._since = time.perf_counter()
            self._uncollected.enter_context(without_garbage_collection())
            show_compiling(True)

    def on_end(self, event: Any) -> None:
        self._depth -= 1
        if self._depth == 0:
            self.seconds += time.perf_counter() - self._since
            self._uncollected.close()
            show_compiling(False)


_compilations = _Compilations()
event.register("numba:compile", _compilations)


def compile_seconds() -> float:
    """Time of this process for compiling kernels [s]."""
    return _compilations.seconds


def compiled_root() -> Path:
    """Folder of the compiled code of all versions."""
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(chosen)
    return Path(platformdirs.user_cache_dir("graphslam", appauthor=False)) / "compiled"


def compiled_folder() -> Path:
    """Folder of compiled code: ``NUMBA_CACHE_DIR``, or a folder per numba and Python version in the user's cache
    folder."""
    if os.environ.get("NUMBA_CACHE_DIR"):
        return compiled_root()
    return compiled_root() / f"numba-{numba.__version__}-python-{sys.version_info.major}.{sys.version_info.minor}"


def compiled_code() -> tuple[int, int]:
    """Number of compiled functions in :func:`compiled_root`, and the size of all its files [bytes]."""
    files = list(_files(compiled_root()))
    return sum(f.suffix == ".nbc" for _, _, f in files), sum(size for _, size, _ in files)


def clear_compiled_code() -> None:
    """Delete the compiled code of all versions; running processes keep their loaded code.

    A folder given by ``NUMBA_CACHE_DIR`` can contain code of other packages and is not changed.
    """
    if not os.environ.get("NUMBA_CACHE_DIR"):
        shutil.rmtree(compiled_root(), ignore_errors=True)


def trim_compiled_code(root: Path, current: Path) -> None:
    """Delete versions that were not used for a month, then the oldest files until the rest is within the size limit.

    Other processes may do the same concurrently; they recompile deleted code.
    """
    oldest = time.time() - UNUSED_SECONDS
    with contextlib.suppress(OSError):
        for folder in root.iterdir():
            if folder != current and folder.is_dir() and folder.stat().st_mtime < oldest:
                shutil.rmtree(folder, ignore_errors=True)
    files = sorted(_files(root))
    size = sum(s for _, s, _ in files)
    for _, s, file in files:
        if size <= MOST_BYTES:
            return
        with contextlib.suppress(OSError):
            file.unlink()
        size -= s


def _files(root: Path) -> Iterator[tuple[float, int, Path]]:
    """Time, size and path of each file below a folder."""
    for folder, _, names in os.walk(root):
        for file in (Path(folder, n) for n in names):
            with contextlib.suppress(OSError):  # another process has deleted it
                yield file.stat().st_mtime, file.stat().st_size, file


@cache
def unwritable() -> str:
    """Reason why :func:`compiled_folder` is not writable; empty if it is."""
    folder = compiled_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)  # the version is in use
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        return error.strerror or str(error)
    return ""


@cache
def _warn_not_kept(why: str) -> None:
    if multiprocessing.parent_process() is None:
        logger.warning(
            "compiled code cannot be kept in %s (%s): kernels are compiled again at every start, up to a minute; "
            "make the folder writable or set NUMBA_CACHE_DIR to one that is",
            compiled_folder(),
            why,
        )


@cache
def _trim_once() -> None:
    if not os.environ.get("NUMBA_CACHE_DIR"):
        trim_compiled_code(compiled_root(), compiled_folder())


class _InMemory(caching.NullCache):
    """No cache on disk; gives a warning when something is compiled."""

    def __init__(self, why: str) -> None:
        self.why = why

    def save_overload(self, sig: Any, data: Any) -> None:
        _warn_not_kept(self.why)


@cache
def _digest_with_imports(file: str) -> str:
    """SHA-256 of a source file and of all files of the package that it imports, directly or not.

    Their functions and constants are compiled into it, so the cache is invalid if any of them changes.
    """
    texts: dict[str, str] = {}
    todo = [file]
    while todo:
        name = todo.pop()
        texts[name] = Path(name).read_text(encoding="utf-8")
        modules = {sys.modules.get(m) for m in _IMPORTED.findall(texts[name]) if m != __name__}
        todo += {str(m.__file__) for m in modules if m} - texts.keys()
    return hashlib.sha256("\0".join(sorted(texts.values())).encode()).hexdigest()[:40]


class _BySource(caching.UserProvidedCacheLocator):
    """Cache named by a digest of the source, shared by all copies of the package."""

    def __init__(self, function: Any, file: str) -> None:
        super().__init__(function, file)
        self._cache_path = str(compiled_folder() / f"{function.__module__}-{_digest_with_imports(file)}")


class _ChosenFolder(caching.CompileResultCacheImpl):
    _locator_classes: list[type[object]] = [_BySource]  # noqa: RUF012 - never beside the source


class _OnDisk(caching.FunctionCache):
    """Cache of a function on disk. Unreadable code is compiled again; unwritable code is not cached."""

    _impl_class = _ChosenFolder

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # unpickling a damaged file may raise anything
            with contextlib.suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except OSError as error:
            _warn_not_kept(error.strerror or str(error))
        else:
            _trim_once()


def _cache_of(function: Callable[..., Any]) -> Any:
    if unwritable():
        return _InMemory(unwritable())
    config: Any = numba.config
    before = config.CACHE_DIR
    config.CACHE_DIR = str(compiled_folder())  # do not change that of other packages
    try:
        return _OnDisk(function)
    except RuntimeError:  # numba found no folder for it
        return _InMemory("it cannot be written")
    finally:
        config.CACHE_DIR = before


def njit(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """``numba.njit`` with a cache in :func:`compiled_folder`, if that is writable.

    Parameters
    ----------
    function : callable, optional
        Decorated function of ``@njit`` without parentheses.
    **options
        Options of ``numba.njit`` except ``cache``.
    """
    if function is None:
        return lambda decorated: njit(decorated, **options)
    options.setdefault("no_cfunc_wrapper", True)  # for calls from C
    made = numba.njit(**options)(function)
    if hasattr(made, "enable_caching"):  # with NUMBA_DISABLE_JIT it is the function itself
        made._cache = _cache_of(function)
    return made


def callee(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Decorator of a function that only kernels call: without wrapper for Python and file, which take time to compile.

    Called from Python, its source runs. Options are those of ``numba.njit`` except ``cache``.
    """
    return register_jitable(**options, no_cfunc_wrapper=True)(function) if function else partial(callee, **options)
