"""Storage of a SegMap: a table of segments in growing arrays, and the maps that segments share."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import numpy.typing as npt

from graphslam.core.geometry import Array
from graphslam.core.poses import heading_of
from graphslam.evidence.grid import EvidenceGrid
from graphslam_frontends.segslam.segment import KINDS, SegmentEntry

Ints = npt.NDArray[np.int64]
Scans = frozenset[tuple[int, int]]


class SegmentTable:
    """Segments as columns; rows beyond :attr:`count` are unused, and not alive.

    Parameters
    ----------
    size : int
        Number of elements of a pose.
    """

    _COLUMNS = ("start", "end", "kind", "source", "previous", "map", "weight", "fitness", "alive", "entry", "exit",
                "headings")  # fmt: skip

    def __init__(self, size: int) -> None:
        self.count = 0
        n = 16
        self.start: Ints = np.zeros(n, np.int64)
        self.end: Ints = np.full(n, -1, np.int64)
        self.kind: Ints = np.zeros(n, np.int64)
        self.source: Ints = np.full(n, -1, np.int64)
        self.previous: Ints = np.full(n, -1, np.int64)
        self.map: Ints = np.zeros(n, np.int64)
        self.weight: Array = np.zeros(n)
        self.fitness: Array = np.full(n, np.nan)
        self.alive: npt.NDArray[np.bool_] = np.zeros(n, bool)
        self.entry: Array = np.zeros((n, size))
        self.exit: Array = np.zeros((n, size))
        self.headings: Array = np.zeros((n, 2))  # at entry and exit [rad]
        self.paths: list[Array | None] = []
        self.covariances: list[Array | None] = []
        self._fitting: tuple[dict[int, Ints], dict[int, Ints], dict[int, Ints]] | None = None

    def append(
        self,
        interval: tuple[int, int],
        entered: SegmentEntry,
        previous: int,
        path: Array,
        map: int,
    ) -> int:
        """Append a segment with zero weight; returns its index."""
        i = self.count
        if i == len(self.alive):
            for name in self._COLUMNS:
                old = getattr(self, name)
                setattr(self, name, np.concatenate([old, np.zeros_like(old)]))
        self.start[i], self.end[i] = interval
        self.kind[i], self.source[i], self.previous[i], self.map[i] = entered.kind, entered.source, previous, map
        self.weight[i], self.fitness[i], self.alive[i] = 0.0, entered.fitness, True
        self.entry[i], self.exit[i] = entered.T_entry, path[-1]
        self.headings[i] = heading_of(np.stack([entered.T_entry, path[-1]]))
        self._fitting = None
        self.paths.append(path)
        self.covariances.append(entered.covariance)
        self.count += 1
        return i

    def kill(self, i: int) -> None:
        """Mark a segment as not viable."""
        self.alive[i] = False
        self.paths[i] = None
        self._fitting = None

    @property
    def fitting(self) -> tuple[dict[int, Ints], dict[int, Ints], dict[int, Ints]]:
        """Viable segments by their first step, by their last step, and by the segment whose map they entered, each
        ascending."""
        if self._fitting is None:
            alive = np.flatnonzero(self.alive).astype(np.int64)
            entered = alive[self.source[alive] >= 0]
            self._fitting = (
                _by_value(self.start, alive), _by_value(self.end, alive), _by_value(self.source, entered)
            )  # fmt: skip
        return self._fitting

    def row(self, i: int, times: Array) -> dict[str, Any]:
        """Data of a segment, ready for JSON; ``times (n,)`` of the steps [s]."""
        return {
            "index": i,
            "interval": [int(self.start[i]), int(self.end[i])],
            "seconds": [float(times[self.start[i]]), float(times[self.end[i]])],
            "kind": KINDS[self.kind[i]],
            "source": int(self.source[i]),
            "previous": int(self.previous[i]),
            "entry": self.entry[i].tolist(),
            "exit": self.exit[i].tolist(),
            "weight": float(self.weight[i]),
            "fitness": None if np.isnan(self.fitness[i]) else float(self.fitness[i]),
            "map": int(self.map[i]),
        }


def _by_value(column: Ints, rows: Ints) -> dict[int, Ints]:
    order = rows[np.argsort(column[rows], kind="stable")]
    order.flags.writeable = False  # callers get this array
    values, first = np.unique(column[order], return_index=True)
    return dict(zip(values.tolist(), np.split(order, first[1:])))


class SegmentMaps:
    """Evidence grids of segments, reference-counted."""

    def __init__(self) -> None:
        self.grids: list[EvidenceGrid | None] = []
        self.users: list[int] = []
        self.scans: list[Scans] = []

    def add(self, grid: EvidenceGrid, scans: Scans) -> int:
        """Add a map with one user; returns its number. The grid is not copied: the caller must not keep it."""
        self.grids.append(grid)
        self.users.append(1)
        self.scans.append(scans)
        return len(self.grids) - 1

    def drop(self, m: int, users: int = 1) -> None:
        """Remove users; the grid is released with the last one."""
        self.users[m] -= users
        if self.users[m] == 0:
            cast(EvidenceGrid, self.grids[m]).release()
            self.grids[m] = None
