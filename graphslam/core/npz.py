"""Checked reading of array archives (npz): names, types, shapes, finite numbers."""

from __future__ import annotations

import math
import os
import re
import struct
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import FormatError, MissingDataError
from graphslam.core.reading import LARGEST, check_regular, check_size, finite_mask

MOST_HEADER = 1 << 16
"""Most bytes of an array header."""

_KINDS = {"float": "fiu", "int": "iu", "bool": "b", "text": "U"}
_HEADER = re.compile(
    r"\{'descr': '([<>|=]?[biufU][0-9]{1,6})', 'fortran_order': (True|False), 'shape': \(([0-9, ]*)\), \} *\n"
)


@dataclass(frozen=True, slots=True)
class Field:
    """Declaration of an array in a file.

    Parameters
    ----------
    kind : {"float", "int", "bool", "text"}
    shape : tuple of int or str
        Lengths. Equal names are equal lengths; ``"n+1"`` is one more.
    optional : bool
        Whether it may be missing.
    finite : bool or None
        False: NaN and infinities have a meaning. None: any number is allowed, because it is used only for statistics.
    """

    kind: Literal["float", "int", "bool", "text"]
    shape: tuple[int | str, ...] = ()
    optional: bool = False
    finite: bool | None = True


def floats(*shape: int | str, optional: bool = False, finite: bool | None = True) -> Field:
    """Declaration of floating-point numbers."""
    return Field("float", shape, optional, finite)


def ints(*shape: int | str, optional: bool = False) -> Field:
    """Declaration of integers."""
    return Field("int", shape, optional)


def flags(*shape: int | str, optional: bool = False) -> Field:
    """Declaration of booleans."""
    return Field("bool", shape, optional)


def texts(*shape: int | str, optional: bool = False) -> Field:
    """Declaration of texts."""
    return Field("text", shape, optional)


def read_arrays(path: str | os.PathLike[str]) -> dict[str, npt.NDArray[Any]]:
    """All arrays of an npz archive. Nothing is unpickled, and at most the size limit is read."""
    where = str(path)
    check_regular(path)
    if not Path(path).is_file():
        raise MissingDataError("no such file", where=where)
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            names: set[str] = set()
            for m in members:
                name = m.filename.removesuffix(".npy")
                if name == m.filename or name in names:
                    raise ValueError(f"{m.filename!r} is no array, or stands in it twice")
                if m.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or m.flag_bits & 1:
                    raise ValueError(f"{m.filename} is packed in another way than NumPy does")
                # zlib packs a byte into no less than 1/1032 byte (zlib.net, Technical Details); a header can be wrong
                if m.file_size > 1032 * m.compress_size + 1024:
                    raise ValueError(f"{m.filename} claims {m.file_size} bytes in {m.compress_size}")
                names.add(name)
            check_size(sum(m.file_size for m in members), where)
            arrays: dict[str, npt.NDArray[Any]] = {}
            for m in members:
                with archive.open(m) as stream:
                    arrays[m.filename.removesuffix(".npy")] = read_npy(stream, m.file_size, m.filename)
            return arrays
    except PermissionError as error:
        raise MissingDataError(f"cannot be read ({error.strerror})", where=where) from None
    except (zipfile.BadZipFile, zlib.error, struct.error, NotImplementedError, RuntimeError) as error:
        raise FormatError(f"archive is truncated or corrupt ({error})", where=where) from None
    except (ValueError, EOFError, OSError, OverflowError, LookupError) as error:
        raise FormatError(f"archive is truncated or corrupt ({error})", where=where) from None


def read_npy(stream: IO[bytes], size: int, name: str) -> npt.NDArray[Any]:
    """The array of a stream of ``size`` bytes in NumPy's format: numbers, booleans or texts."""
    shape, fortran, dtype, begin = npy_header(stream, name)
    claimed = dtype.itemsize * math.prod(shape)
    if claimed != size - begin:
        raise ValueError(f"{name} has the shape {shape} of {dtype} in {size - begin} bytes")
    buffer = bytearray(claimed)
    view = memoryview(buffer)
    while view:
        got = stream.readinto(view)  # type: ignore[attr-defined]
        if not got:
            raise EOFError(f"{name} ends too early")
        view = view[got:]
    if stream.read(1):  # the checksum is verified at the end of a member
        raise ValueError(f"{name} goes on after its array")
    if dtype.kind == "b" and claimed and max(buffer) > 1:
        raise ValueError(f"{name} holds truth values that are neither true nor false")
    array = np.frombuffer(buffer, dtype).reshape(shape, order="F" if fortran else "C")
    if dtype.kind == "U":
        points = np.frombuffer(buffer, "<u4" if dtype.str[0] == "<" else ">u4")
        if points.size and (points.max() > 0x10FFFF or np.any((points >= 0xD800) & (points <= 0xDFFF))):
            raise ValueError(f"{name} holds what is no text")
    return array if dtype.isnative else array.astype(dtype.newbyteorder("="))


def npy_begin(head: bytes) -> int:
    """Offset of the data of an array in NumPy's format, from its first 12 bytes."""
    width = 2 if head[6:7] == b"\x01" else 4
    return 8 + width + min(int.from_bytes(head[8 : 8 + width], "little"), MOST_HEADER)


def npy_header(stream: IO[bytes], name: str) -> tuple[tuple[int, ...], bool, np.dtype[Any], int]:
    """Shape, order, type and length of the header of an array in NumPy's format."""
    head = stream.read(8)
    if len(head) < 8 or head[:6] != b"\x93NUMPY" or head[6] not in (1, 2, 3):
        raise ValueError(f"{name} is no array of NumPy")
    width = 2 if head[6] == 1 else 4
    length = int.from_bytes(stream.read(width), "little")
    if length > MOST_HEADER - 12:
        raise ValueError(f"{name} has a header of {length} bytes")
    match = _HEADER.fullmatch(stream.read(length).decode("latin-1"))
    if match is None:
        raise ValueError(f"{name} has a header that says no plain array")
    try:
        dtype = np.dtype(match[1])
        shape = tuple(int(n) for n in match[3].split(",") if n.strip())
    except (TypeError, ValueError):
        raise ValueError(f"{name} has an impossible type or shape") from None
    if len(shape) > 8:
        raise ValueError(f"{name} has {len(shape)} dimensions")
    return shape, match[2] == "True", dtype, 8 + width + length


def check_arrays(
    arrays: Mapping[str, npt.NDArray[Any]], fields: Mapping[str, Field], where: str
) -> dict[str, npt.NDArray[Any]]:
    """The declared arrays, integers as int64, others unchanged; undeclared arrays are ignored."""
    lengths: dict[str, int] = {}
    found = {}
    for name, field in fields.items():
        if name not in arrays:
            if field.optional:
                continue
            raise FormatError(f"array {name!r} is missing", where=where, got=sorted(arrays)[:20])
        a = arrays[name]
        if a.size == 0 and a.dtype.kind in "fiu" and field.kind in ("float", "int"):
            a = a.astype(np.float64 if field.kind == "float" else np.int64)  # an empty list has no type
        if a.dtype.kind not in _KINDS[field.kind] or not _fits(a.shape, field.shape, lengths):
            wanted = ", ".join(f"{n} = {lengths[n]}" if n in lengths else str(n) for n in field.shape)
            raise FormatError(
                f"array {name!r} has the wrong shape or type",
                where=where,
                got=f"{a.dtype} {a.shape}",
                wanted=f"{field.kind} ({wanted})",
            )
        if field.kind == "float":
            bad = ~finite_mask(a) if field.finite else ~(finite_mask(a) | ~np.isfinite(a))
            if field.finite is not None and np.any(bad):
                at = tuple(int(i) for i in np.argwhere(bad)[0])
                raise FormatError(
                    f"array {name!r} is not finite, or too large, at {list(at)}",
                    where=where,
                    got=a[at],
                    wanted=f"finite numbers, at most {LARGEST:g}",
                )
            a = a if a.dtype.kind == "f" else a.astype(np.float64)
        if field.kind == "int":
            if a.dtype.kind == "u" and a.size and int(a.max()) >= 2**63:
                raise FormatError(f"array {name!r} holds a number that is too large", where=where, got=a.max())
            a = a.astype(np.int64)
        found[name] = a
    return found


def _fits(shape: tuple[int, ...], wanted: tuple[int | str, ...], lengths: dict[str, int]) -> bool:
    if len(shape) != len(wanted):
        return False
    for n, w in zip(shape, wanted, strict=True):
        if isinstance(w, int):
            if n != w:
                return False
            continue
        name, more = (w[:-2], 1) if w.endswith("+1") else (w, 0)
        if n - more < 0 or lengths.setdefault(name, n - more) != n - more:
            return False
    return True
