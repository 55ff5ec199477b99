"""Scratch memory of one thread for marking and applying scans (:mod:`mark_kernels`, :mod:`update_kernels`)."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.evidence.layout import BRICK_VOXELS

WINDOW = 64**3
MADE = 32768
"""Maximum number of new bricks of one update that later grids can share; further bricks are not shared."""


class Scratch:
    """Window, slots and marks; between scans the window is all -1 and the marks are all 0.

    Parts that no scan has written to take no physical memory.
    """

    def __init__(self, slots: int = 16384) -> None:
        self.window = np.full((WINDOW, 2), -1, np.int64)
        self.table = np.full(2 * MADE, -1, np.int32)
        self.made = np.zeros((MADE, 4), np.int64)
        self.made[0, 0] = 1
        self.made_marks = np.zeros((MADE + 1, 16), np.uint64)
        self.left = np.zeros(4096, np.int64)
        self.resize(slots)

    def resize(self, slots: int) -> None:
        """Allocate for this number of bricks per scan."""
        marks = aligned_zeros((slots, BRICK_VOXELS), np.uint8)  # first: the largest, may raise MemoryError
        self.slot_key = np.zeros(slots, np.int64)
        self.slot_next = np.zeros(slots, np.int32)
        self.work = np.zeros((slots, 5), np.int32)
        self.marks = marks
        self.marks64 = marks.view(np.uint64)

    def reserve_left(self, more: int) -> None:
        """Ensure capacity for this number of further sources."""
        if self.left[0] + 1 + more > len(self.left):
            longer = np.zeros(2 * (int(self.left[0]) + 1 + more), np.int64)
            longer[: len(self.left)] = self.left
            self.left = longer

    def forget_made(self) -> None:
        """Clear the list of new bricks at the start of an update; they are shared within one update only."""
        self.table[self.made[1 : self.made[0, 0], 3]] = -1
        self.made[0, 0] = 1

    def reset(self) -> None:
        """Clear marks that will not be applied."""
        self.window[:] = -1
        self.marks[:] = 0

    def __len__(self) -> int:
        return len(self.slot_key)


LINE = 64  # bytes


def aligned_zeros(shape: tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """Zeros, aligned to cache lines; pages never written take no physical memory."""
    return _aligned(np.zeros, shape, np.dtype(dtype))


def aligned_empty(shape: tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """Uninitialised array, aligned to cache lines; pages never written take no physical memory."""
    return _aligned(np.empty, shape, np.dtype(dtype))


def _aligned(make: Any, shape: tuple[int, ...], dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    size = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
    room = make(size + LINE, np.uint8)
    start = -room.ctypes.data % LINE
    return room[start : start + size].view(dtype).reshape(shape)
