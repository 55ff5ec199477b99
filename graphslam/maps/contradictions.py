"""Do submaps that lie on each other show the same? Solid points of one where another one saw nothing.

Scans of two passes may agree at every point that is compared, along the walls of a corridor, while the walls across it
stand twice in the map. What a wrong map cannot hide is space: a wall of the second pass in the middle of a room that
the first one looked through. So all solid voxels of a submap are looked for in the grids of those that came to the same
place by another way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.geometry import Array, arc_length
from graphslam.core.poses import group_of
from graphslam.core.submap import Submap
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.layout import UNKNOWN

POINTS, PAIRS = 1500, 400
"""Points of a submap and pairs of submaps that are looked at, at most; of more, some spread evenly."""
BESIDE = 2
"""All voxels so far beside a point must deny it: what the path is off is no contradiction."""
FEW = 50
"""Points of a pair below which nothing is said of it."""
DOUBTED = 0.2
"""Share of contradicted points from which a pair is counted."""


@dataclass(frozen=True, slots=True)
class Contradictions:
    """What the passes of a map say of each other.

    Parameters
    ----------
    pairs : (n, 2) int
        Keys of the submaps that came to a place by two ways; both orders.
    seen, denied : (n,) int
        Solid points of the first that the second has, too; that lie where it saw nothing solid far around.
    """

    pairs: npt.NDArray[np.int64]
    seen: npt.NDArray[np.int64]
    denied: npt.NDArray[np.int64]

    @property
    def points(self) -> int:
        """Points that were told of."""
        return int(self.seen.sum() + self.denied.sum())

    @property
    def share(self) -> float:
        """Share of denied points; 0 where too few were told of."""
        return float(self.denied.sum()) / self.points if self.points >= FEW else 0.0

    @property
    def doubted(self) -> npt.NDArray[np.int64]:
        """Rows of the pairs that contradict each other, the worst first."""
        n = self.seen + self.denied
        share = self.denied / np.maximum(n, 1)
        rows = np.flatnonzero((n >= FEW) & (share > DOUBTED))
        return rows[np.argsort(-share[rows], kind="stable")]

    def facts(self) -> dict[str, Any]:
        """JSON-serialisable."""
        return {
            "pairs": len(self.pairs),
            "points": self.points,
            "share": self.share,
            "doubted": self.pairs[self.doubted].tolist(),
        }


NOTHING = Contradictions(np.zeros((0, 2), np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64))
"""No submap came to the place of another."""


def contradictions(submaps: Sequence[Submap], bases: Array) -> Contradictions:
    """Look for the solid points of every submap in those that came to the same place by another way.

    Parameters
    ----------
    submaps : sequence of Submap
        Those without a grid are left out.
    bases : (n, 3|7)
        Where the map has them.
    """
    g, found = group_of(bases), []
    clouds = [_solid(s) for s in submaps]
    middles = [c.mean(axis=0) if len(c) else np.zeros(g.dim) for c in clouds]
    centres = g.transform(bases, np.array(middles))
    sizes = np.array([np.quantile(np.linalg.norm(c - c.mean(axis=0), axis=1), 0.9) if len(c) else 0.0 for c in clouds])
    way = arc_length(np.asarray(bases[:, : g.dim]))
    for i, j in product(range(len(submaps)), repeat=2):
        near = sizes[i] + sizes[j]
        another = abs(i - j) > 1 and abs(way[i] - way[j]) > near
        if another and len(clouds[i]) and len(clouds[j]) and np.linalg.norm(centres[i] - centres[j]) < near:
            found.append((i, j))
    if len(found) > PAIRS:
        found = [found[k * len(found) // PAIRS] for k in range(PAIRS)]
    rows = [_compared(clouds[i], g.between(bases[j], bases[i]), submaps[j].grid) for i, j in found]
    keys = np.array([(submaps[i].key, submaps[j].key) for i, j in found], dtype=np.int64).reshape(-1, 2)
    told = np.array(rows, dtype=np.int64).reshape(-1, 2)
    return Contradictions(keys, told[:, 0], told[:, 1])


def _solid(s: Submap) -> Array:
    if not isinstance(s.grid, EvidenceGrid):
        return np.zeros((0, s.dim))
    cloud = np.asarray(s.grid.occupied_cloud())
    return cloud[np.arange(min(len(cloud), POINTS)) * len(cloud) // max(min(len(cloud), POINTS), 1)]


def _compared(cloud: Array, T: Array, grid: Any) -> tuple[int, int]:
    """How many points of a cloud at ``T_grid_cloud`` a grid has, and how many it denies."""
    points = group_of(T[None]).transform(np.broadcast_to(T, (len(cloud), len(T))), cloud)
    points = points[grid.values_at(points) != UNKNOWN]
    top, low = np.full(len(points), UNKNOWN, np.int16), np.full(len(points), 32767, np.int16)
    for beside in product(range(-BESIDE, BESIDE + 1), repeat=grid.dim):
        values = grid.values_at(points + np.array(beside) * grid.voxel_size)
        top, low = np.maximum(top, values), np.minimum(low, values)
    clear = grid.model.miss_step
    return int(np.sum(top >= grid.model.threshold_step)), int(np.sum((top <= clear) & (low != UNKNOWN)))
