"""Storage of a SegMap: a table of segments in growing arrays, and the maps that segments share."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.poses import Group, heading_of
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
                "headings", "link", "T_map")  # fmt: skip

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
        self.link: Array = np.zeros((n, size))  # T_segment_source between the frames, for segments with a source
        self.T_map: Array = np.zeros((n, size))  # T_map_segment
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
        link: Array,
        T_map: Array,
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
        self.entry[i], self.exit[i], self.link[i], self.T_map[i] = entered.T_entry, path[-1], link, T_map
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

    def __init__(self, group: Group) -> None:
        self.group = group
        self.grids: list[EvidenceGrid | None] = []
        self.users: list[int] = []
        self.locked: list[bool] = []
        self.entered: list[int] = []
        self.scans: list[Scans] = []

    def add(self, grid: EvidenceGrid, scans: Scans, locked: bool) -> int:
        """Add a map with one user; returns its number. The grid is not copied: the caller must not keep it."""
        if locked:
            grid.lock()
        self.grids.append(grid)
        self.users.append(1)
        self.locked.append(locked)
        self.entered.append(0)
        self.scans.append(scans)
        return len(self.grids) - 1

    def drop(self, m: int, users: int = 1) -> None:
        """Remove users; the grid is released with the last one."""
        self.users[m] -= users
        if self.users[m] == 0:
            cast(EvidenceGrid, self.grids[m]).release()
            self.grids[m] = None

    def lock(self, m: int) -> None:
        """Use the map for localisation only."""
        cast(EvidenceGrid, self.grids[m]).lock()
        self.locked[m] = True

    def merge(self, table: SegmentTable, a: int, b: int, T_a_b: Array) -> int:
        """Merge two maps; all users of one are moved to the other. See `SegMap.merge`."""
        if a == b:
            return a
        if self.scans[a] < self.scans[b]:  # b continued a: its map already contains a
            return self._move(table, a, b, self.group.inverse(T_a_b))
        if not self.scans[b] <= self.scans[a]:
            for s, e in sorted(self.scans[a]):
                both = sorted((x, y) for x, y in self.scans[b] if x < e and s < y)
                if both:
                    raise DataError("the maps share scans, which would count twice", got=f"steps {both[0]}")
            grid_b = cast(EvidenceGrid, self.grids[b])
            cast(EvidenceGrid, self.grids[a]).merge(grid_b, T_a_b)
            self.scans[a] |= self.scans[b]
        return self._move(table, b, a, T_a_b)

    def _move(self, table: SegmentTable, old: int, to: int, T_to_old: Array) -> int:
        moved = np.flatnonzero((table.map == old) & table.alive)
        table.map[moved] = to
        table.T_map[moved] = self.group.compose(np.broadcast_to(T_to_old, table.T_map[moved].shape), table.T_map[moved])
        self.users[to] += len(moved)
        self.entered[to] += self.entered[old]
        if self.locked[old] and not self.locked[to]:
            self.lock(to)
        self.drop(old, len(moved))
        return to
