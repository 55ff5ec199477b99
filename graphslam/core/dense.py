"""Dense maps of submaps (evidence grid, cloud, or both), and their common interface.

Registration, loops and fused maps use only a :class:`DenseMapView`; `graphslam.evidence.views.dense_view` makes that of
a submap.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import GeometryError
from graphslam.core.geometry import Array
from graphslam.core.points import FARTHEST
from graphslam.core.spill_cache import SPILL_CACHE, CacheEntry, pack_array, unpack_array

Ints = npt.NDArray[np.int64]


class DensePayload(Protocol):
    """Interface of an evidence grid, which core does not import."""

    def save(self, path: Any) -> None: ...


class CloudMap:
    """Surface points around a submap, in the frame of its base. Immutable; its points are in the spill cache
    (:mod:`graphslam.core.spill_cache`), which limits the memory of long runs.

    Parameters
    ----------
    points : (m, dim)
        [m]
    origins : (s, dim), optional
        Sensor positions of the scans [m]. They define free space; without them points can be matched, but
        contradictions are not detected.
    scan : (m,) int64, optional
        Row of ``origins`` of each point; required with ``origins``.
    cell : float
        Edge of the cells for downsampling before matching, and of the voxels of observed space [m].
    """

    __slots__ = ("_points", "_scan", "_shape", "cell", "origins")

    def __init__(self, *, points: Any, origins: Any = None, scan: Any = None, cell: float = 0.2) -> None:
        points = _rows(points, "points of a cloud")
        if not (np.isfinite(cell) and cell > 0):
            raise GeometryError("impossible cell of a cloud", got=cell, wanted="> 0 m")
        if (origins is None) != (scan is None):
            raise GeometryError("origins and scans of a cloud go together", wanted="both, or neither")
        self.cell = cell
        self.origins: Array | None = None
        self._scan: CacheEntry[Ints] | None = None
        if origins is not None:
            origins, scan = _rows(origins, "origins of a cloud"), np.ascontiguousarray(scan, dtype=np.int64)
            if origins.shape[1] != points.shape[1] or scan.shape != (len(points),):
                raise GeometryError(
                    "origins and scans do not fit the points of a cloud",
                    got=(origins.shape, scan.shape),
                    wanted=((len(origins), points.shape[1]), (len(points),)),
                )
            if len(scan) and not (scan.min() >= 0 and scan.max() < len(origins)):
                raise GeometryError(
                    "a point of a cloud names a scan that is not there",
                    got=int(scan.max()),
                    wanted=f"0 … {len(origins)}",
                )
            self.origins, self._scan = origins, SPILL_CACHE.put(scan, scan.nbytes, pack_array, unpack_array)
        self._shape = points.shape
        self._points: CacheEntry[Array] = SPILL_CACHE.put(points, points.nbytes, pack_array, unpack_array)

    @property
    def points(self) -> Array:
        """``(m, dim)`` [m]."""
        return self._points.get()

    @property
    def scan(self) -> Ints | None:
        """Row of ``origins`` of each point ``(m,)``; None without these."""
        return None if self._scan is None else self._scan.get()

    @property
    def dim(self) -> int:
        """2 or 3."""
        return int(self._shape[1])

    def __len__(self) -> int:
        return int(self._shape[0])

    def __repr__(self) -> str:
        free = "free space unknown" if self.origins is None else f"seen from {len(self.origins)} places"
        return f"CloudMap({len(self)} points, {self.dim}-D, {free})"


def _rows(values: Any, what: str) -> Array:
    a = np.ascontiguousarray(values, dtype=np.float64)
    if a.ndim != 2 or a.shape[1] not in (2, 3):
        raise GeometryError(f"{what} have the wrong shape", got=a.shape, wanted="(m, 2) or (m, 3)")
    good = (np.abs(a) < FARTHEST).all(axis=1)  # also excludes NaN
    if not good.all():
        raise GeometryError(f"{what} are impossible", got=a[~good][0].tolist(), wanted="finite, < 1000 km")
    return a


class DenseMapView(Protocol):
    """Interface of a submap's dense map, in the frame of its base."""

    @property
    def dim(self) -> int:
        """2 or 3."""
        ...

    @property
    def knows_space(self) -> bool:
        """Whether free space is distinguished from unknown space."""
        ...

    @property
    def cloud(self) -> CloudMap | None:
        """The original points, if they are stored."""
        ...

    def points(self, level: int = 0) -> Array:
        """Surface points ``(m, dim)`` [m], averaged in cells of ``2**level`` times the cell size."""
        ...

    def known_at(self, points: Any) -> npt.NDArray[np.bool_]:
        """Whether points ``(n, dim)`` [m] are in known space, free or occupied."""
        ...

    def log_odds_at(self, points: Any) -> npt.NDArray[np.float32]:
        """Log-odds ``(n,)`` that points ``(n, dim)`` [m] are occupied; NaN if unknown."""
        ...

    def evidence(self) -> Any:
        """The map as an ``EvidenceGrid``, for fused maps."""
        ...
