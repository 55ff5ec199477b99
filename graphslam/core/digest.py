"""Digests of arrays, equal on every machine for equal numbers."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np


class Digest:
    """BLAKE2b over named arrays, bytes and text.

    Parameters
    ----------
    size : int
        Bytes of the digest; its text has twice as many characters.
    """

    def __init__(self, size: int = 16) -> None:
        self._state = hashlib.blake2b(digest_size=size)

    def add(self, name: str, value: Any) -> None:
        """Add an array, number, text, bytes or None under a name; name, type and shape are included."""
        if isinstance(value, bytes):
            kind, data = "bytes", memoryview(value)
        elif value is None:
            kind, data = "none", memoryview(b"")
        else:
            a = np.ascontiguousarray(value)
            a = a.astype(a.dtype.newbyteorder("<"), copy=False)
            kind, data = f"{a.dtype.kind}{a.dtype.itemsize}{np.shape(value)}", memoryview(a.tobytes())
        head = f"{len(name)}:{name}:{kind}:{len(data)}:"
        self._state.update(head.encode())
        self._state.update(data)

    def add_all(self, values: Mapping[str, Any]) -> None:
        """Add every value under its name, in the order of the names."""
        for name in sorted(values):
            self.add(name, values[name])

    def text(self) -> str:
        """Hexadecimal digits of everything added so far."""
        return self._state.hexdigest()
