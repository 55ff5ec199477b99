"""Numeric arrays of MATLAB ``.mat`` files (versions 5 to 7), by name.

The format is that of "MAT-File Format" (The MathWorks, 2019), chapter 1: a header of 128 bytes, then elements of a tag
(type, bytes) and data, each of which is an array or a zlib stream with one array in it.
"""

from __future__ import annotations

import math
import os
import struct
import zlib
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import FormatError
from graphslam.core.geometry import Array
from graphslam.core.reading import LARGEST, check_size, finite_mask, most_bytes, read_bytes

_HEADER = 128
_MATRIX, _COMPRESSED = 14, 15
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_NUMERIC = range(6, 16)
"""Classes of arrays: double, single, and integers of 8 to 64 bits."""
_COMPLEX = 0x0800


def read_mat(path: str | os.PathLike[str], *names: str) -> tuple[Array, ...]:
    """The real arrays ``names`` of a ``.mat`` file, as float64; a number may be infinite or NaN, but not too large."""
    where = str(path)
    raw = read_bytes(path)
    found: dict[str, npt.NDArray[np.generic] | None] = {}
    try:
        order = {b"IM": "<", b"MI": ">"}.get(raw[126:128])
        if order is None or struct.unpack(f"{order}H", raw[124:126])[0] != 0x0100:
            raise ValueError("it has no header of version 5")
        for body in _matrices(memoryview(raw)[_HEADER:], order, where):
            name, array = _matrix(body, order, names, where)
            if name in names:
                found[name] = array
    except (ValueError, struct.error, zlib.error) as error:
        raise FormatError(f"not a MATLAB file, or truncated ({error})", where=where) from None
    out = []
    for name in names:
        value = found.get(name)
        if value is None:
            raise FormatError(
                f"holds no numeric array {name!r}",
                where=where,
                got="something else" if name in found else "nothing",
                wanted=", ".join(names),
            )
        numbers = np.ascontiguousarray(value, dtype=np.float64)
        if np.any(bad := np.isfinite(numbers) & ~finite_mask(numbers)):
            wanted = f"at most {LARGEST:g}"
            raise FormatError(
                f"array {name!r} holds a number too large", where=where, got=numbers[bad][0], wanted=wanted
            )
        out.append(numbers)
    return tuple(out)


def _elements(data: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Type and data of each element; all but compressed ones fill up to 8 bytes."""
    at = 0
    while at < len(data):
        kind, size = struct.unpack_from(f"{order}II", data, at)
        begin = at + 8
        if kind >> 16:  # both in one word, and up to four bytes of data behind it
            kind, size, begin = kind & 0xFFFF, kind >> 16, at + 4
            if size > 4:
                raise ValueError(f"a small element of {size} bytes")
            at += 8
        else:
            at = begin + size + (0 if kind == _COMPRESSED else -size % 8)
        if begin + size > len(data):
            raise ValueError(f"an element of {size} bytes in {len(data) - begin}")
        yield kind, data[begin : begin + size]


def _matrices(data: memoryview, order: str, where: str) -> Iterator[memoryview]:
    """Content of every array of the file."""
    unpacked = 0
    for kind, body in _elements(data, order):
        if kind == _MATRIX:
            yield body
        elif kind == _COMPRESSED:
            inner = zlib.decompressobj()
            plain = inner.decompress(body, most_bytes() - unpacked + 1)
            unpacked += len(plain)
            check_size(unpacked, where)
            if not inner.eof:
                raise ValueError("a compressed element ends too early")
            yield from (b for k, b in _elements(memoryview(plain), order) if k == _MATRIX)
        else:
            raise ValueError(f"an element of type {kind} where an array is wanted")


def _matrix(
    body: memoryview, order: str, names: tuple[str, ...], where: str
) -> tuple[str, npt.NDArray[np.generic] | None]:
    """Name of an array, and its numbers: None if it holds something else, or is none of the ``names``."""
    parts = _elements(body, order)
    (_, flags), (_, dims), (_, label) = (next(parts, (0, memoryview(b""))) for _ in range(3))
    name = bytes(label).decode("latin-1")
    word = struct.unpack_from(f"{order}I", flags)[0]
    if name not in names or word & 0xFF not in _NUMERIC or word & _COMPLEX:
        return name, None
    shape = struct.unpack(f"{order}{len(dims) // 4}i", dims)
    kind, data = next(parts, (0, memoryview(b"")))
    if kind not in _TYPES:
        raise ValueError(f"{name} has numbers of type {kind}")
    numbers = np.frombuffer(data, f"{order}{_TYPES[kind]}")
    check_size(8 * len(numbers), where)
    if not 2 <= len(shape) <= 8 or min(shape) < 0 or math.prod(shape) != len(numbers):
        raise ValueError(f"{name} has the shape {shape} and {len(numbers)} numbers")
    return name, numbers.reshape(shape, order="F")
