"""A stream of 3-D lidar scans whose points are decoded lazily.

A recording has 10⁷ points or more, and often only its stamps are needed. The stream therefore has a *source*, which
gives the points of one scan at a time, and an index into it, so that slicing a log copies no points.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError, GeometryError
from graphslam.core.geometry import Array
from graphslam.core.reading import finite_mask
from graphslam.core.records import RowStream, check_offsets, check_times


class CloudSource(Protocol):
    """Source of the points of :class:`PointClouds`."""

    @property
    def counts(self) -> npt.NDArray[np.int64]:
        """Number of stored points of every scan ``(n,)``, including missing returns; without decoding."""
        ...

    def cloud(self, k: int) -> Array:
        """Points ``(m, 3)`` of scan ``k`` [m], sensor frame, all finite; m may be less than ``counts[k]``."""
        ...

    def ages(self, k: int) -> Array | None:
        """Time from each point of ``cloud(k)`` to the stamp of its scan ``(m,)`` [s]; negative: measured later.

        None if points have no own stamps: all have that of the scan.
        """
        ...

    def packed(self) -> bytes:
        """Bytes that identify these points, without decoding them."""
        ...


@dataclass(frozen=True, slots=True)
class ArrayClouds:
    """Points in memory.

    Parameters
    ----------
    points : (q, 3)
        Metres, sensor frame, all finite.
    offsets : (n + 1,) int64
        Points of scan k are rows ``offsets[k]:offsets[k + 1]``.
    before : (q,), optional
        Time from each point to the stamp of its scan [s]; negative: measured later.
    """

    points: Array
    offsets: npt.NDArray[np.int64]
    before: Array | None = None

    def __post_init__(self) -> None:
        points = np.ascontiguousarray(self.points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3:
            raise GeometryError("points have the wrong shape", got=points.shape, wanted="(q, 3)")
        if not np.all(finite_mask(points)):
            k = int(np.argwhere(~finite_mask(points))[0][0])
            raise DataError(f"point {k} is not finite", got=points[k], wanted="finite numbers")
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "offsets", check_offsets(self.offsets, len(points)))
        if self.before is not None:
            before = np.ascontiguousarray(self.before, dtype=np.float64)
            if before.shape != (len(points),) or not np.all(finite_mask(before)):
                raise DataError("times of points are impossible", got=before.shape, wanted=f"({len(points)},), finite")
            object.__setattr__(self, "before", before)

    @property
    def counts(self) -> npt.NDArray[np.int64]:
        """See :class:`CloudSource`."""
        return np.diff(self.offsets)

    def cloud(self, k: int) -> Array:
        """See :class:`CloudSource`."""
        return self.points[self.offsets[k] : self.offsets[k + 1]]

    def ages(self, k: int) -> Array | None:
        """See :class:`CloudSource`."""
        return None if self.before is None else self.before[self.offsets[k] : self.offsets[k + 1]]

    def packed(self) -> bytes:
        """See :class:`CloudSource`."""
        return self.points.tobytes() + (b"" if self.before is None else self.before.tobytes())


@dataclass(frozen=True, slots=True, kw_only=True)
class PointClouds(RowStream):
    """Scans of a 3-D lidar.

    Parameters
    ----------
    times : (n,) [s]
    source : CloudSource
    index : (n,) int64, optional
        Scan of the source for each record; default: all in order.
    origin : (3,)
        Origin of the beams of a scan, in the frame of its points [m].
    T_base_sensor : (7,)
        Frame of the points in the base.

    Examples
    --------
    >>> clouds = gs.PointClouds.from_arrays([0.0, 0.1], np.ones((5, 3)), [0, 2, 5])  # two scans, of 2 and 3 points
    >>> len(clouds.times)
    2
    """

    ROWS = ("times", "index")
    times: Array
    source: CloudSource
    index: npt.NDArray[np.int64] | None = None
    origin: Array = field(default_factory=lambda: np.zeros(3))
    T_base_sensor: Array = field(default_factory=lambda: np.array([0.0, 0, 0, 0, 0, 0, 1]))

    def __post_init__(self) -> None:
        known = len(self.source.counts)
        index = np.arange(known) if self.index is None else np.asarray(self.index)
        if index.ndim != 1 or (len(index) and (index.min() < 0 or index.max() >= known)):
            raise DataError("index names scans that the source has not", got=index.shape, wanted=f"0 … {known - 1}")
        object.__setattr__(self, "index", np.ascontiguousarray(index, dtype=np.int64))
        object.__setattr__(self, "times", check_times(self.times, len(index)))
        for name, n in (("origin", 3), ("T_base_sensor", 7)):
            a = np.ascontiguousarray(getattr(self, name), dtype=np.float64)
            if a.shape != (n,) or not np.all(finite_mask(a)):
                raise GeometryError(f"{name} is impossible", got=a, wanted=f"{n} finite numbers")
            object.__setattr__(self, name, a)

    @classmethod
    def from_arrays(cls, times: Any, points: Any, offsets: Any, before: Any = None, **rest: Any) -> PointClouds:
        """Scans in memory; see :class:`ArrayClouds` for the arguments."""
        return cls(times=times, source=ArrayClouds(points, offsets, before), **rest)

    def __len__(self) -> int:
        return len(self.times)

    @property
    def counts(self) -> npt.NDArray[np.int64]:
        """Number of stored points of every scan ``(n,)``."""
        return self.source.counts[self.index]

    def cloud(self, k: int) -> Array:
        """Points ``(m, 3)`` of record ``k`` [m], sensor frame; decoded if needed."""
        assert self.index is not None
        return self.source.cloud(int(self.index[k]))

    def ages(self, k: int) -> Array | None:
        """Time from each point of record ``k`` to its stamp ``(m,)`` [s]; None: points have no own stamps."""
        assert self.index is not None
        return self.source.ages(int(self.index[k]))

    def __iter__(self) -> Iterator[Array]:
        return (self.cloud(k) for k in range(len(self)))
