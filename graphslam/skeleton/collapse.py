"""Collapse of measurements into landmarks: corresponding measurements are one landmark (C3)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError
from graphslam.skeleton import collapse_kernels as kernels

Labels = npt.NDArray[np.int32]


class Collapse:
    """Streaming union-find over measurements.

    Correspondences come in blocks of any size and order and are not stored: memory is four bytes per measurement.

    Parameters
    ----------
    measurements : int
        Number of measurements; below 2³¹.

    Attributes
    ----------
    pairs : int
        Number of correspondences so far.
    joined : int
        Number of them that joined two sets.

    Examples
    --------
    >>> collapse = gs.Collapse(5)
    >>> collapse.add([0, 3], [2, 4])
    >>> collapse.landmarks()
    (array([0, 1, 0, 2, 2], dtype=int32), 3)
    """

    def __init__(self, measurements: int) -> None:
        if not 0 < measurements < 2**31:
            raise DataError("number of measurements", got=measurements, wanted="between 1 and 2³¹ - 1")
        self._parent: Labels | None = np.arange(measurements, dtype=np.int32)
        self.pairs = 0
        self.joined = 0

    def add(self, a: npt.ArrayLike, b: npt.ArrayLike) -> None:
        """Add correspondences: measurements ``a[k]`` and ``b[k]`` are of one landmark.

        Parameters
        ----------
        a, b : (n,)
            Indices of measurements.
        """
        parent = self._open()
        left, right = np.asarray(a), np.asarray(b)
        if left.shape != right.shape or left.ndim != 1:
            raise DataError("correspondences of different shapes", got=(left.shape, right.shape), wanted="two of (n,)")
        if not left.size:
            return
        if left.dtype.kind not in "iu" or right.dtype.kind not in "iu":
            raise DataError("correspondences are no integers", got=(left.dtype, right.dtype))
        low, high = min(left.min(), right.min()), max(left.max(), right.max())
        if low < 0 or high >= len(parent):
            raise DataError(
                "correspondence of a measurement that is not there",
                where=f"block after {self.pairs} pairs",
                got=int(low if low < 0 else high),
                wanted=f"0 … {len(parent) - 1}",
            )
        self.joined += int(kernels.join_pairs(parent, left.astype(np.int32), right.astype(np.int32)))
        self.pairs += len(left)

    def landmarks(self) -> tuple[Labels, int]:
        """Landmark of every measurement ``(M,)``, numbered by first observation, and their number.

        The numbers overwrite the sets, so nothing can be added afterwards.
        """
        label = self._open()
        self._parent = None
        return label, int(kernels.number_sets(label))

    def _open(self) -> Labels:
        if self._parent is None:
            raise DataError("the collapse is finished: its landmarks were taken", wanted="a new Collapse")
        return self._parent


def number_by_first_observation(landmark: npt.ArrayLike) -> tuple[Labels, int]:
    """Number landmarks of measurements in pose order ``(M,)`` by first observation; any integer labels ≥ 0."""
    label = np.array(landmark, dtype=np.int32)
    table = np.full(int(label.max(initial=-1)) + 1, -1, dtype=np.int32)
    return label, int(kernels.renumber(label, table))
