"""Scratch memory of one thread's marks (:mod:`update_kernels`)."""

from __future__ import annotations

import numpy as np

from graphslam.evidence.aligned import aligned_zeros
from graphslam.evidence.layout import BRICK_VOXELS

WINDOW = 64**3


class Scratch:
    """Window, slots and marks; between scans the window is all -1 and the marks are all 0.

    What no scan has touched yet is not in the machine's memory.
    """

    def __init__(self, slots: int = 16384) -> None:
        self.window = np.full((WINDOW, 2), -1, np.int64)
        self.resize(slots)

    def resize(self, slots: int) -> None:
        """Room for so many bricks touched by a scan."""
        marks = aligned_zeros((slots, BRICK_VOXELS), np.uint8)  # first: it alone can fail for want of memory
        self.slot_key = np.zeros(slots, np.int64)
        self.slot_next = np.zeros(slots, np.int32)
        self.work = np.zeros((slots, 5), np.int32)
        self.marks = marks
        self.marks64 = marks.view(np.uint64)

    def reset(self) -> None:
        """Forget marks that will not be applied."""
        self.window[:] = -1
        self.marks[:] = 0

    def __len__(self) -> int:
        return len(self.slot_key)
