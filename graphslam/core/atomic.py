"""Atomic writing of files, and checked reading of npz archives and JSON."""

from __future__ import annotations

import glob
import json
import os
import re
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import FormatError, OutputError
from graphslam.core.interrupt import defer_interrupts
from graphslam.core.json_file import check_json, parse_json
from graphslam.core.npz import Field, check_arrays, read_arrays
from graphslam.core.reading import read_text

_PART = re.compile(r"\.(?P<target>.+)\.(?P<process>\d+)-[0-9a-f]{8}\.part(\.[a-z]+)?")


def part_path(target: Path, ending: str = "") -> Path:
    """A unique temporary name in the folder of ``target``; ``ending`` is for writers that depend on it (``.npz``)."""
    return target.with_name(f".{target.name}.{os.getpid()}-{secrets.token_hex(4)}.part{ending}")


def is_part(name: str) -> bool:
    """Whether it is a name from :func:`part_path`."""
    return _PART.fullmatch(name) is not None


def sweep_parts(folder: str | os.PathLike[str]) -> None:
    """Remove the temporary files that a killed process left directly in a folder.

    The caller must ensure that no other process is writing to the folder.
    """
    if Path(folder).is_dir():
        for path in Path(folder).iterdir():
            if is_part(path.name) and (path.is_symlink() or path.is_file()):
                path.unlink(missing_ok=True)


def sync_to_disk(path: str | os.PathLike[str]) -> None:
    """Flush a file, or the entries of a folder, to the disk."""
    try:
        handle = os.open(path, os.O_RDONLY)
    except PermissionError:  # a folder, on systems that cannot open one
        return
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def check_file_target(path: str | os.PathLike[str]) -> Path:
    """Check that a file can be written, before the work for it; temporary files of killed writers of it are removed.

    Raises
    ------
    OutputError
        The path names no file, or a folder, pipe, socket or device, or a file in a folder that is missing or read-only.
    """
    target = _file_target(path)
    if not os.access(target.parent, os.W_OK | os.X_OK):
        raise OutputError(f"{target}: the folder {target.parent} cannot be written; name a file in another folder")
    for stray in target.parent.glob(f".{glob.escape(target.name)}.*.part*"):
        parts = _PART.fullmatch(stray.name)
        if parts is not None and parts["target"] == target.name and not _runs(int(parts["process"])):
            stray.unlink(missing_ok=True)
    return target


def _file_target(path: str | os.PathLike[str]) -> Path:
    target = Path(path)
    if target.name in ("", ".."):
        raise OutputError(f"{os.fspath(path)!r} names no file; wanted the name of a file")
    if target.is_dir():
        raise OutputError(f"{target}: is a folder; wanted the name of a file")
    if target.exists() and not target.is_file():
        raise OutputError(f"{target}: is a pipe, socket or device; wanted a regular file")
    if not target.parent.is_dir():
        raise OutputError(f"{target}: there is no folder {target.parent}; make it first, or name another file")
    return target


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # of another user
        pass
    return True


@contextmanager
def atomic_open(path: str | os.PathLike[str], mode: Literal["wb", "w"] = "wb") -> Iterator[IO[Any]]:
    """Write to a temporary name in the same folder; rename on success, remove on failure.

    A reader sees the old file or the new one, never a partial one, even if the process is killed. Only regular files
    are replaced. Errors of the system name the file, not the temporary one.
    """
    target = _file_target(path)
    temporary = part_path(target)
    text = {} if mode == "wb" else {"encoding": "utf-8", "newline": "\n"}
    try:
        with open(temporary, mode, **text) as stream:  # type: ignore[call-overload]
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(target)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        if error.errno is not None and error.filename in (None, str(temporary)):
            raise OSError(error.errno, error.strerror, str(target)) from None
        raise
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_npz(path: str | os.PathLike[str], arrays: Mapping[str, Any]) -> None:
    """Write arrays as a compressed npz, atomically. The same arrays give the same bytes."""
    for name, value in arrays.items():
        if np.asarray(value).dtype.hasobject:
            raise FormatError(f"array {name!r} holds Python objects", where=str(path), wanted="numbers or strings")
    # a Ctrl-C inside would appear as an error of the partial archive
    with defer_interrupts(), atomic_open(path) as stream:
        np.savez_compressed(stream, **{k: np.asarray(v) for k, v in arrays.items()})  # type: ignore[arg-type]


def read_npz(
    path: str | os.PathLike[str], *, fmt: str, fields: Mapping[str, Field] | None = None
) -> dict[str, npt.NDArray[Any]]:
    """Read the arrays of an npz whose array ``format`` is ``fmt``; never unpickles.

    Parameters
    ----------
    fields : mapping of str to Field, optional
        Declaration of the arrays; only these are checked and returned. Without it all are returned unchecked.
    """
    where = str(path)
    arrays = read_arrays(path)
    check_format(str(arrays.get("format", "none")), fmt, where=where)
    return arrays if fields is None else check_arrays(arrays, fields, where)


def write_json(path: str | os.PathLike[str], value: Any) -> None:
    """Write JSON atomically; NaN and infinities are refused, because JSON does not have them."""
    try:
        text = json.dumps(value, indent=1, sort_keys=False, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise FormatError(f"cannot be written as JSON ({error})", where=str(path)) from None
    with atomic_open(path, "w") as stream:
        stream.write(text + "\n")


def read_json(path: str | os.PathLike[str], *, fmt: str, shape: Any = None) -> dict[str, Any]:
    """Read a JSON object whose key ``format`` is ``fmt``, and check its shape (:func:`reading.check_json`)."""
    where = str(path)
    value: Any = parse_json(read_text(path), where)
    if not isinstance(value, dict):
        raise FormatError("not a JSON object", where=where, got=type(value).__name__)
    check_format(str(value.get("format", "none")), fmt, where=where)
    return value if shape is None else check_json(value, shape, where)  # type: ignore[no-any-return]


def check_format(got: str, wanted: str, *, where: str) -> None:
    """Refuse a file of another format or version."""
    if got != wanted:
        raise FormatError("unknown format", where=where, got=repr(got[:80]), wanted=repr(wanted))
