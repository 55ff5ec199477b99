"""Memory that was freed and is still held."""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable


@functools.cache
def _trim() -> Callable[[int], int] | None:
    try:
        found: Callable[[int], int] = ctypes.CDLL(None).malloc_trim
    except (OSError, AttributeError):  # another C library
        return None
    return found


def trim_heap() -> None:
    """Hand freed heap back to the system, where the C library can.

    glibc keeps arrays of up to 32 MB after they are freed. Between the stages of a long run that is as much as the
    largest stage uses; given back, the next stage takes what it needs.
    """
    trim = _trim()
    if trim is not None:
        trim(0)
