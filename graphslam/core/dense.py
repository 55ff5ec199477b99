"""What a submap knows densely: an evidence grid, a cloud, or both, and the one view that everybody asks.

Registration, loops and fused maps ask a :class:`DenseMapView` and nothing else; `graphslam.evidence.views.dense_view`
makes that of a submap.
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
    """An evidence grid, seen from here: core knows no grid."""

    def save(self, path: Any) -> None: ...


class CloudMap:
    """Points on the surfaces around a submap, in the frame of its base. A value that does not change; its points lie on
    the shelf of the process (:mod:`graphslam.core.spill_cache`), so that those of a long run do not fill the memory.

    Parameters
    ----------
    points : (m, dim)
        [m]
    origins : (s, dim), optional
        Where the sensor was when it took its scans [m]. With them it is known which space is free; without, points can
        be matched, but nothing tells that a place is *not* where they fit.
    scan : (m,) int64, optional
        Row of ``origins`` from which each point was seen; with ``origins`` only, and then needed.
    cell : float
        Edge of the cells in which the points are thinned to be matched, and of the voxels of the space they saw [m].
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
    good = (np.abs(a) < FARTHEST).all(axis=1)  # NaN is not
    if not good.all():
        raise GeometryError(f"{what} are impossible", got=a[~good][0].tolist(), wanted="finite, < 1000 km")
    return a


class DenseMapView(Protocol):
    """What a submap knows of its surroundings, in the frame of its base."""

    @property
    def dim(self) -> int:
        """2 or 3."""
        ...

    @property
    def knows_space(self) -> bool:
        """Whether it tells free space from what nobody saw."""
        ...

    @property
    def cloud(self) -> CloudMap | None:
        """Points as they were measured, where they were kept."""
        ...

    def points(self, level: int = 0) -> Array:
        """Points on surfaces ``(m, dim)`` [m], gathered in cells of ``2**level`` times its own."""
        ...

    def known_at(self, points: Any) -> npt.NDArray[np.bool_]:
        """Whether points ``(n, dim)`` [m] lie where something is known, be it that the place is free."""
        ...

    def log_odds_at(self, points: Any) -> npt.NDArray[np.float32]:
        """Log-odds ``(n,)`` that points ``(n, dim)`` [m] are occupied; NaN where nothing is known."""
        ...

    def evidence(self) -> Any:
        """An ``EvidenceGrid`` of all that: what fused maps are made of."""
        ...
