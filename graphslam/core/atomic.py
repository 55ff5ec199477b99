"""Files that are either whole or not there, and npz archives that are either read fully or refused."""

from __future__ import annotations

import json
import os
import secrets
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np

from graphslam.core.errors import FormatError, MissingDataError
from graphslam.core.interrupt import deferred_interrupts


@contextmanager
def atomic_open(path: str | os.PathLike[str], mode: Literal["wb", "w"] = "wb") -> Iterator[IO[Any]]:
    """Write to a temporary name in the same folder; rename on success, remove on failure.

    A reader, or a run that was killed, sees the old file or the new one, never half of one.
    """
    target = Path(path)
    temporary = target.with_name(f".{target.name}.{os.getpid()}-{secrets.token_hex(4)}.part")
    text = {} if mode == "wb" else {"encoding": "utf-8", "newline": "\n"}
    try:
        with open(temporary, mode, **text) as stream:  # type: ignore[call-overload]
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_npz(path: str | os.PathLike[str], arrays: Mapping[str, Any]) -> None:
    """Write arrays as a compressed npz, atomically. The same arrays give the same bytes."""
    for name, value in arrays.items():
        if np.asarray(value).dtype.hasobject:
            raise FormatError(f"array {name!r} holds Python objects", where=str(path), wanted="numbers or strings")
    # a Ctrl-C inside would surface as an error of the half-written archive, and not as what it is
    with deferred_interrupts(), atomic_open(path) as stream:
        np.savez_compressed(stream, **{k: np.asarray(v) for k, v in arrays.items()})  # type: ignore[arg-type]


def read_npz(path: str | os.PathLike[str], *, fmt: str) -> dict[str, np.ndarray]:
    """Read all arrays of an npz whose array ``format`` says ``fmt``; never unpickles.

    Raises
    ------
    MissingDataError
        No such file.
    FormatError
        Truncated, corrupt, holding pickled objects, or of another format.
    """
    where = str(path)
    if not Path(path).is_file():
        raise MissingDataError("no such file", where=where)
    try:
        _check_sizes(where)
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (zipfile.BadZipFile, zlib.error, ValueError, EOFError, OSError, KeyError, NotImplementedError) as error:
        raise FormatError(f"archive is truncated or corrupt ({error})", where=where) from None
    except (AttributeError, TypeError):  # np.load gives a bare array for a .npy, and that is no archive
        raise FormatError("not an npz archive", where=where) from None
    check_format(str(arrays.get("format", "none")), fmt, where=where)
    return arrays


def _check_sizes(path: str) -> None:
    """Refuse an archive whose headers claim more than its bytes can hold, before anything is allocated for it.

    zlib packs a byte into no less than 1/1032 byte (zlib.net, Technical Details); a header is free to lie.
    """
    with open(path, "rb") as stream:
        if stream.read(2) != b"PK":
            return  # np.load says what it is instead
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            if member.file_size > 1032 * member.compress_size + 1024:
                raise ValueError(f"{member.filename} claims {member.file_size} bytes in {member.compress_size}")
            with archive.open(member) as data:
                version = np.lib.format.read_magic(data)
                read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
                shape, _, dtype = read(data)
                claimed = dtype.itemsize
                for n in shape:
                    claimed *= n
                if not dtype.hasobject and claimed != member.file_size - data.tell():
                    raise ValueError(f"{member.filename} has the shape {shape} in {member.file_size} bytes")


def write_json(path: str | os.PathLike[str], value: Any) -> None:
    """Write JSON atomically; NaN and infinities are refused, because JSON has none."""
    try:
        text = json.dumps(value, indent=1, sort_keys=False, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise FormatError(f"cannot be written as JSON ({error})", where=str(path)) from None
    with atomic_open(path, "w") as stream:
        stream.write(text + "\n")


def read_json(path: str | os.PathLike[str], *, fmt: str) -> dict[str, Any]:
    """Read a JSON object whose key ``format`` says ``fmt``.

    Raises
    ------
    MissingDataError, FormatError
    """
    where = str(path)
    try:
        value = json.loads(Path(path).read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        raise MissingDataError("no such file", where=where) from None
    except (ValueError, RecursionError) as error:
        raise FormatError(f"not JSON, or truncated ({error})", where=where) from None
    if not isinstance(value, dict):
        raise FormatError("not a JSON object", where=where, got=type(value).__name__)
    check_format(str(value.get("format", "none")), fmt, where=where)
    return value


def check_format(got: str, wanted: str, *, where: str) -> None:
    """Refuse a file of another format or version."""
    if got != wanted:
        raise FormatError("unknown format", where=where, got=repr(got), wanted=repr(wanted))
