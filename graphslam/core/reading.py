"""Common functions of file readers: size limits, checked numbers, and file names inside their folder.

Files are untrusted. They are read up to a size limit that the user can change, numbers must be finite, arrays
(:mod:`graphslam.core.npz`) and JSON (:mod:`graphslam.core.json_file`) must have the declared shapes. Otherwise a
:class:`~graphslam.core.errors.FormatError` names the file, the place in it, and the found and expected values.
"""

from __future__ import annotations

import bz2
import lzma
import os
import re
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import ConfigError, FormatError, MissingDataError

LARGEST = 1e30
"""Largest allowed number in a file: squares, products and 6×6 determinants of such numbers are still finite."""

MAX_SIZE = 2_000_000_000
"""Default limit of bytes per file, after decompression."""

_CHUNK = 1 << 20
_XZ_MEMORY = 1 << 28  # limit of the dictionary, for which a header can claim 4 GB
_limit: ContextVar[int] = ContextVar("size_limit", default=MAX_SIZE)


# --- how much is read ---------------------------------------------------------------------------------------------


@contextmanager
def size_limit(max_size: int | None) -> Iterator[None]:
    """Read at most ``max_size`` bytes of each file, counted after decompression; None does not change the limit."""
    if max_size is not None and max_size <= 0:
        raise ConfigError(f"max_size = {max_size}; wanted a number of bytes above 0")
    token = None if max_size is None else _limit.set(int(max_size))
    try:
        yield
    finally:
        if token is not None:
            _limit.reset(token)


def set_size_limit(max_size: int) -> None:
    """Set the limit for the rest of this process (used by the command line)."""
    _limit.set(int(max_size))


def most_bytes() -> int:
    """The current limit."""
    return _limit.get()


def check_size(size: int, where: str) -> None:
    """Raise if ``size`` exceeds the limit."""
    limit = _limit.get()
    if size > limit:
        raise FormatError(
            "more data than is read of one file",
            where=where,
            got=f"more than {limit:,} bytes after decompression",
            wanted="a smaller file, or a higher limit: --max-size on the command line, max_size in Python",
        )


def check_regular(path: str | os.PathLike[str]) -> None:
    """Refuse a pipe, socket or device, on which reading may wait for ever."""
    if os.path.exists(path) and not (os.path.isfile(path) or os.path.isdir(path)):
        raise FormatError("is a pipe, socket or device", where=str(path), wanted="a regular file")


def read_bytes(path: str | os.PathLike[str], *, first: int | None = None) -> bytes:
    """Bytes of a file, decompressed if it starts like xz, gzip or bzip2; at most the limit is kept in memory.

    Parameters
    ----------
    first : int, optional
        Approximate number of bytes to read.
    """
    where = str(path)
    check_regular(path)
    try:
        with open(path, "rb") as stream:
            head = stream.read(6)
            stream.seek(0)
            opened = next((make for magic, make in _MAGIC if head.startswith(magic)), None)
            parts, size = [], 0
            step = _CHUNK if first is None else first
            for part in _plain(stream, step) if opened is None else _unpacked(stream, opened, where, step):
                size += len(part)
                check_size(size, where)
                parts.append(part)
                if first is not None and size >= first:
                    break
            return b"".join(parts)
    except (FileNotFoundError, NotADirectoryError):
        raise MissingDataError("no such file", where=where) from None
    except OSError as error:
        raise MissingDataError(f"cannot be read ({error.strerror})", where=where) from None


def _plain(stream: IO[bytes], step: int) -> Iterator[bytes]:
    while part := stream.read(step):
        yield part


class _Gunzip:
    """A gzip stream with the interface of the decompressors of bz2 and lzma."""

    def __init__(self) -> None:
        self._inner = zlib.decompressobj(wbits=31)

    @property
    def eof(self) -> bool:
        return self._inner.eof

    @property
    def unused_data(self) -> bytes:
        return self._inner.unused_data

    @property
    def needs_input(self) -> bool:
        return not self._inner.unconsumed_tail

    def decompress(self, data: bytes, max_length: int) -> bytes:
        return self._inner.decompress(self._inner.unconsumed_tail or data, max_length)


_MAGIC: tuple[tuple[bytes, Callable[[], Any]], ...] = (
    (b"\xfd7zXZ\x00", lambda: lzma.LZMADecompressor(memlimit=_XZ_MEMORY)),
    (b"\x1f\x8b", _Gunzip),
    (b"BZh", bz2.BZ2Decompressor),
)


def _unpacked(stream: IO[bytes], make: Callable[[], Any], where: str, step: int) -> Iterator[bytes]:
    """Parts of the content of a compressed file, which can contain several concatenated streams."""
    try:
        data = stream.read(_CHUNK)
        while data:
            inner = make()
            while not inner.eof:
                part = inner.decompress(data, step)
                if part:
                    yield part
                data = b""
                if inner.needs_input and not inner.eof:
                    data = stream.read(_CHUNK)
                    if not data:
                        raise EOFError("it ends too early")
            data = inner.unused_data.lstrip(b"\0") or stream.read(_CHUNK).lstrip(b"\0")
    except (OSError, EOFError, lzma.LZMAError, zlib.error, ValueError) as error:
        raise FormatError(f"compressed data is truncated or corrupt ({error})", where=where) from None


def read_text(path: str | os.PathLike[str]) -> str:
    """Text of a file in UTF-8, decompressed as :func:`read_bytes` does; without a byte order mark."""
    raw = read_bytes(path)
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise FormatError(
            f"not a text file (line {line}, byte {error.start})", where=str(path), wanted="text in UTF-8"
        ) from None


# --- numbers ------------------------------------------------------------------------------------------------------


def finite_mask(values: npt.ArrayLike) -> Any:
    """Mask of numbers that are finite and at most :data:`LARGEST`, of the same shape, or one boolean."""
    return np.abs(np.asarray(values, dtype=np.float64)) <= LARGEST


def integer_mask(values: npt.ArrayLike) -> Any:
    """Mask of integers in the exact range of float64: identities and counts in tables."""
    v = np.asarray(values, dtype=np.float64)
    return (np.abs(v) <= 2.0**53) & (v == np.round(v))


# --- names of files ---


def safe_name(name: str, where: str) -> str:
    """Return the name if it is a plain file name without a path."""
    if not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9_.+-]{0,200}", name):
        raise FormatError("file name leads out of its folder", where=where, got=repr(name[:80]), wanted="a file name")
    return name


def resolve_inside(folder: Path, name: str, where: str) -> Path:
    """Path of the file ``name`` in ``folder``; a symbolic link that leads out of the folder is refused."""
    path = folder / safe_name(name, where)
    if path.is_symlink():
        leads = Path(os.path.realpath(path))
        if not leads.is_relative_to(os.path.realpath(folder)):
            raise FormatError("file name leads out of its folder", where=where, got=f"{name} → {leads}")
    return path
