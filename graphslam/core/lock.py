"""Lock a folder so that only one process writes into it."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from graphslam.core.errors import RunFolderError

try:
    import fcntl
except ImportError:  # not on this system; writers are not locked there
    fcntl = None  # type: ignore[assignment]

LOCK = ".lock"
_HEAD = "graphslam: this folder is written by process"
_NO_LINK = getattr(os, "O_NOFOLLOW", 0)
"""The lock file is written to, so it must not be a link to another file."""
_NO_WAIT = getattr(os, "O_NONBLOCK", 0)
"""A named pipe in its place must not stop the reader."""
_guard = threading.Lock()
_held: dict[str, int] = {}


def make_folder(folder: str | os.PathLike[str]) -> Path:
    """Make a folder with its parents, unless it exists."""
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunFolderError(f"{path}: cannot be made ({error.strerror})") from None
    return path


@contextmanager
def lock_folder(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Lock a folder against writing by other processes; it is created if missing.

    The system releases the lock whenever the process ends. A thread may lock a folder again that it has locked.
    """
    home = make_folder(folder)
    real = os.path.realpath(home)
    me = threading.get_ident()
    with _guard:
        if real in _held:
            if _held[real] != me:
                raise RunFolderError(f"{home}: process {os.getpid()}, this one, is writing into it in another thread")
            handle = None
        else:
            handle = _take(home)
            _held[real] = me
    try:
        yield
    finally:
        if handle is not None:
            with _guard:
                del _held[real]
                handle.close()


def _take(home: Path) -> Any:
    try:
        handle = os.fdopen(os.open(home / LOCK, os.O_RDWR | os.O_CREAT | _NO_LINK, 0o666), "r+", encoding="utf-8")
    except OSError as error:
        raise RunFolderError(f"{home}: cannot be written ({error.strerror})") from None
    try:
        if fcntl is not None:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lines = handle.read().splitlines()
        handle.close()
        owner = lines[0].removeprefix(_HEAD).strip() if lines else "unknown"
        raise RunFolderError(f"{home}: process {owner} is writing into it; wait until it has ended") from None
    except OSError:  # a file system without locks
        pass
    handle.write(f"{_HEAD} {os.getpid()} on {socket.gethostname()}\n")
    handle.truncate()
    handle.flush()
    return handle


def is_lock(file: Path) -> bool:
    """Is it a lock file of :func:`lock_folder`, perhaps one that was not written because of a full disk or a kill?"""
    with contextlib.suppress(OSError), open(os.open(file, os.O_RDONLY | _NO_WAIT), "rb") as stream:
        return file.is_file() and _HEAD.encode().startswith(stream.read(len(_HEAD)))
    return False
