"""Likelihood field of a map for the correlative search."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import ConfigError, DataError
from graphslam.core.geometry import Array
from graphslam.core.points import finite_points
from graphslam.registration.search_kernels import splat

MOST_CELLS = 200_000_000
SLICE = 3_000_000
"""Cells that are written in one slice, some milliseconds."""


class SearchField:
    """Likelihood field around a map: a function of the distance to the nearest occupied cell.

    Parameters
    ----------
    points : (m, dim)
        Of the map, dim 2 or 3: a cloud, or the centres of a grid's occupied voxels [m]. Non-finite points are ignored
        and counted in ``dropped``.
    cell : float
        Edge of a cell [m].
    sigma : float
        The field is ``exp(-d² / 2σ²)`` at distance d [m] from the centre of the nearest occupied cell, in 255 steps,
        and 0 beyond 3 σ. At least half the steps of the search lattice, otherwise optima between them are missed.
    """

    def __init__(self, points: Any, *, cell: float = 0.2, sigma: float = 0.3) -> None:
        for _ in self._fill(points, cell, sigma):
            pass

    @classmethod
    def in_slices(cls, points: Any, *, cell: float, sigma: float) -> Generator[None, None, SearchField]:
        """The same field, in slices of bounded work."""
        field = cls.__new__(cls)
        yield from field._fill(points, cell, sigma)
        return field

    def _fill(self, points: Any, cell: float, sigma: float) -> Iterator[None]:
        if not (np.isfinite(cell) and cell > 0 and np.isfinite(sigma) and sigma > 0):
            raise ConfigError(f"search field: cell {cell}, sigma {sigma}; wanted positive numbers of metres")
        p = finite_points(points, what="points of the search field")
        self.dropped = len(points) - len(p)
        if not len(p):
            raise DataError("a search field needs points", got=f"{self.dropped} that are not finite, no other")
        self.dim, self.cell, self.sigma = p.shape[1], float(cell), float(sigma)
        reach = int(np.floor(3.0 * sigma / cell))
        low, high = np.floor(p.min(axis=0) / cell) - reach, np.floor(p.max(axis=0) / cell) + reach
        size = np.ones(3)
        size[: self.dim] = high - low + 1
        if not np.prod(size) <= MOST_CELLS:
            raise DataError(
                "the points of a search field are too far apart",
                got=f"{' × '.join(f'{n * cell:.0f}' for n in size)} m in cells of {cell} m",
                wanted=f"at most {MOST_CELLS} cells: leave out stray points, or choose larger cells",
            )
        self._low = np.zeros(3, dtype=np.int64)
        self._low[: self.dim] = low.astype(np.int64)
        shape = tuple(int(n) for n in size)
        flat = np.unique(np.ravel_multi_index(tuple(self._cells(p).T), shape))
        occupied = np.stack(np.unravel_index(flat, shape), -1).astype(np.int64)
        around = np.arange(-reach, reach + 1)
        offsets = np.stack(np.meshgrid(around, around, around if self.dim == 3 else [0], indexing="ij"), -1)
        offsets = offsets.reshape(-1, 3)
        d2 = np.sum(offsets**2, axis=1) * cell**2
        near = d2 <= (3.0 * sigma) ** 2
        values = np.rint(255.0 * np.exp(-0.5 * d2 / sigma**2)).astype(np.uint8)
        nx, ny, nz = size.astype(np.int64)
        self.values: npt.NDArray[np.uint8] = np.zeros((nz, ny, nx), np.uint8)
        self._phases: dict[tuple[int, int, int], npt.NDArray[np.uint8]] = {}
        size_of_slice = max(1, SLICE // int(near.sum()))
        for k in range(0, len(occupied), size_of_slice):
            yield
            splat(occupied[k : k + size_of_slice], offsets[near].astype(np.int64), values[near], self.values)

    @property
    def nbytes(self) -> int:
        """Memory of the field and its cached copies for lattices [bytes]."""
        return self.values.nbytes + sum(a.nbytes for a in self._phases.values())

    def _cells(self, points: Array) -> npt.NDArray[np.int64]:
        """Cells ``(m, 3)`` x, y, z of points, relative to the corner of the field."""
        out = np.zeros((len(points), 3), dtype=np.int64)
        out[:, : self.dim] = np.floor(points / self.cell).astype(np.int64)
        return out - self._low

    def _in_phases(self, steps: tuple[int, int, int]) -> npt.NDArray[np.uint8]:
        """The field as one array per phase of a lattice; see :func:`~.search_kernels.score_block`."""
        if steps not in self._phases:
            sx, sy, sz = steps
            nz, ny, nx = self.values.shape
            whole = np.pad(self.values, [(0, -nz % sz), (0, -ny % sy), (0, -nx % sx)])
            z, y, x = whole.shape
            split = whole.reshape(z // sz, sz, y // sy, sy, x // sx, sx)
            self._phases[steps] = np.ascontiguousarray(split.transpose(1, 3, 5, 0, 2, 4))
        return self._phases[steps]
