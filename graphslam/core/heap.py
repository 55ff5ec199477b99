"""Return of freed heap memory to the system."""

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
    """Return freed heap to the system, if the C library supports it.

    glibc keeps freed arrays of up to 32 MB. Between the stages of a long run that is as much as the largest stage uses.
    """
    trim = _trim()
    if trim is not None:
        trim(0)
