"""Cache that spills unused values to a file, to limit the memory of stored submaps.

A :class:`SpillCache` contains immutable values, each in a :class:`CacheEntry`. As long as they fit, all are in memory.
Otherwise the least recently used ones are written to a file, and read again when needed. The file has no name: it
disappears when the process ends in any way.
"""

from __future__ import annotations

import logging
import os
import tempfile
import threading
import weakref
from collections import OrderedDict, deque
from collections.abc import Callable
from typing import IO, Any, Generic, TypeAlias, TypeVar, cast

import numpy as np
import numpy.typing as npt

from graphslam.core.heap import trim_heap

logger = logging.getLogger(__name__)

Arrays: TypeAlias = list[npt.NDArray[Any]]
T = TypeVar("T")

ROOM = 128_000_000
"""Memory limit of :data:`SPILL_CACHE` [bytes]."""
GIVE_BACK = 32_000_000
"""Freed bytes after which the heap is returned to the system."""
_FINENESS = 8
"""Sizes of file slots per octave, so that freed slots fit new values."""


class _Place:
    """Location of arrays in the file."""

    __slots__ = ("at", "file", "parts", "size")

    def __init__(self, file: IO[bytes], at: int, size: int, parts: list[tuple[np.dtype[Any], tuple[int, ...]]]) -> None:
        self.file, self.at, self.size, self.parts = file, at, size, parts

    def read(self) -> Arrays:
        """All arrays."""
        out, at = Arrays(), self.at
        for dtype, shape in self.parts:
            a = np.empty(shape, dtype)
            _read(self.file, a, at)
            out.append(a)
            at += a.nbytes
        return out

    def rows(self, first: int, last: int) -> npt.NDArray[Any]:
        """Rows of the only array."""
        ((dtype, shape),) = self.parts
        a = np.empty((last - first, *shape[1:]), dtype)
        _read(self.file, a, self.at + first * (a.nbytes // max(last - first, 1)))
        return a


class CacheEntry(Generic[T]):
    """One value of a cache, made by :meth:`SpillCache.put`. It is removed with its last reference.

    Parameters
    ----------
    pack, unpack : callable
        From the value to arrays, and back.
    """

    __slots__ = ("__weakref__", "_key", "_pack", "_place", "_shelf", "_unpack", "_value", "_weak", "nbytes")

    def __init__(
        self, shelf: SpillCache, key: int, nbytes: int, pack: Callable[[T], Arrays], unpack: Callable[[Arrays], T]
    ) -> None:
        self._shelf, self._key, self.nbytes, self._pack, self._unpack = shelf, key, nbytes, pack, unpack
        self._value: T | None = None
        self._weak: weakref.ref[Any] | None = None
        self._place: _Place | None = None

    def get(self) -> T:
        """The value, from the file if needed. It stays valid as long as it is referenced."""
        return self._shelf._get(self)

    def rows(self, first: int, last: int) -> npt.NDArray[Any]:
        """Rows of a value that is a single array and packed unchanged; only these are read."""
        return self._shelf._rows(self, first, last)

    @property
    def resident(self) -> bool:
        """Whether the cache has the value in memory."""
        return self._value is not None

    def __del__(self) -> None:
        shelf = getattr(self, "_shelf", None)
        if shelf is not None:
            shelf._dead.append((self._key, self._place))  # atomic; the cache processes it later


class SpillCache:
    """Cache of values with a memory limit.

    Values referenced elsewhere do not count. Thread-safe.

    Parameters
    ----------
    room : int
        Memory limit [bytes].
    """

    def __init__(self, room: int = ROOM) -> None:
        self.room = room
        self._lock = threading.RLock()
        self._used: OrderedDict[int, weakref.ref[CacheEntry[Any]]] = OrderedDict()  # in memory, oldest use first
        self._sizes: dict[int, int] = {}
        self._bytes = 0
        self._next = 0
        self._dead: deque[tuple[int, _Place | None]] = deque()
        self._file: IO[bytes] | None = None
        self._owner = 0
        self._end = 0
        self._free: dict[int, list[int]] = {}
        self._full = False
        self._left = 0  # freed bytes since the heap was returned

    @property
    def nbytes(self) -> int:
        """Current memory of the values [bytes]."""
        with self._lock:
            self._collect()
            return self._bytes

    @property
    def filed(self) -> int:
        """Length of the file [bytes]."""
        return self._end

    def put(self, value: T, nbytes: int, pack: Callable[[T], Arrays], unpack: Callable[[Arrays], T]) -> CacheEntry[T]:
        """Add an immutable value.

        Parameters
        ----------
        value : object
        nbytes : int
            Its memory.
        pack, unpack : callable
            From the value to arrays, and back to an equivalent value.
        """
        with self._lock:
            self._next += 1
            slot = CacheEntry(self, self._next, nbytes, pack, unpack)
            self._keep(slot, value)
            return slot

    # --- inside ----------------------------------------------------------------------------------------------

    def _get(self, slot: CacheEntry[T]) -> T:
        with self._lock:
            value = slot._value
            if value is not None:
                self._used.move_to_end(slot._key)
                return value
            value = None if slot._weak is None else slot._weak()
            if value is None:
                assert slot._place is not None
                value = slot._unpack(slot._place.read())
            self._keep(slot, value)
            return value

    def _rows(self, slot: CacheEntry[Any], first: int, last: int) -> npt.NDArray[Any]:
        with self._lock:
            if slot._value is not None:
                return cast("npt.NDArray[Any]", slot._value[first:last])
            assert slot._place is not None
            return slot._place.rows(first, last)

    def _keep(self, slot: CacheEntry[Any], value: Any) -> None:
        """Keep it in memory, and evict others."""
        self._collect()
        slot._value = value
        self._used[slot._key] = weakref.ref(slot)
        self._sizes[slot._key] = slot.nbytes
        self._bytes += slot.nbytes
        while self._bytes > self.room and len(self._used) > 1 and not self._full:
            key, ref = next(iter(self._used.items()))
            oldest = ref()
            if oldest is not None and not self._file_away(oldest):
                return
            self._left += self._sizes[key]
            self._drop(key)
        if self._left > max(self.room // 2, GIVE_BACK):  # freed arrays of a few MB fragment the heap
            self._left = 0
            trim_heap()

    def _file_away(self, slot: CacheEntry[Any]) -> bool:
        if slot._place is None:
            try:
                slot._place = self._write(slot._pack(slot._value))
            except OSError as error:
                self._full = True
                logger.warning("no room on disk for what is not needed now, so it stays in memory: %s", error)
                return False
        try:
            slot._weak = weakref.ref(slot._value)
        except TypeError:
            slot._weak = None
        slot._value = None
        return True

    def _write(self, arrays: Arrays) -> _Place:
        if self._file is None or self._owner != os.getpid():  # a forked process gets its own file
            self._file, self._owner = tempfile.TemporaryFile(prefix="graphslam-"), os.getpid()  # noqa: SIM115
            self._end, self._free = 0, {}
        arrays = [np.ascontiguousarray(a) for a in arrays]
        size = _rounded(sum(a.nbytes for a in arrays))
        free = self._free.get(size)
        at = free.pop() if free else self._end
        place = _Place(self._file, at, size, [(a.dtype, a.shape) for a in arrays])
        self._end = max(self._end, at + size)
        for a in arrays:
            left = _bytes_of(a)
            while len(left):
                n = os.pwrite(self._file.fileno(), left, at)
                left, at = left[n:], at + n
        return place

    def _collect(self) -> None:
        """Free the memory and file slots of deleted entries."""
        while self._dead:
            key, place = self._dead.popleft()
            self._drop(key)
            if place is not None and place.file is self._file and self._owner == os.getpid():
                self._free.setdefault(place.size, []).append(place.at)

    def _drop(self, key: int) -> None:
        if self._used.pop(key, None) is not None:
            self._bytes -= self._sizes.pop(key)


def _rounded(size: int) -> int:
    step = 1 << max((max(size, 1) - 1).bit_length() - _FINENESS.bit_length() + 1, 9)
    return -(-size // step) * step


def _bytes_of(a: npt.NDArray[Any]) -> memoryview:
    return memoryview(cast(Any, a.reshape(-1).view(np.uint8))) if a.nbytes else memoryview(b"")


def _read(file: IO[bytes], into: npt.NDArray[Any], at: int) -> None:
    left = _bytes_of(into)
    while len(left):
        n = os.preadv(file.fileno(), [left], at)
        if n <= 0:
            raise OSError("the file of what was put aside is shorter than it was written")
        left, at = left[n:], at + n


def pack_array(a: npt.NDArray[Any]) -> Arrays:
    """Pack a single array."""
    return [a]


def unpack_array(arrays: Arrays) -> npt.NDArray[Any]:
    """Unpack it."""
    return arrays[0]


SPILL_CACHE = SpillCache()
"""The cache shared by submaps, map pieces and clouds of this process."""
