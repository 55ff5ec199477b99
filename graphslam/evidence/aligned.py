"""Arrays that begin where a line of the cache begins.

Voxels are worked on in lines of 64 bytes. Large arrays as NumPy makes them begin 16 bytes into a page, so that every
line of voxels would lie in two lines of the cache: twice the traffic, and with many maps traffic is what costs.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

LINE = 64  # bytes


def aligned_zeros(shape: tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """Zeros; what was never touched takes no memory yet."""
    return _aligned(np.zeros, shape, np.dtype(dtype))


def aligned_empty(shape: tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """Values of no meaning; what was never touched takes no memory yet."""
    return _aligned(np.empty, shape, np.dtype(dtype))


def _aligned(make: Any, shape: tuple[int, ...], dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    size = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
    room = make(size + LINE, np.uint8)
    start = -room.ctypes.data % LINE
    return room[start : start + size].view(dtype).reshape(shape)
