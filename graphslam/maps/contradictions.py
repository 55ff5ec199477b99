"""Do submaps that lie on each other show the same? Solid points of one where another one saw nothing.

Scans of two passes may agree at every point that is compared, along the walls of a corridor, while the walls across it
stand twice in the map. What a wrong map cannot hide is space: a wall of the second pass in the middle of a room that
the first one looked through. So all solid voxels of a submap are looked for in the grids of those that came to the same
place by another way.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.geometry import Array, arc_length
from graphslam.core.poses import group_of
from graphslam.evidence.beams import BeamModel
from graphslam.evidence.layout import BRICK_EDGE, UNKNOWN
from graphslam.maps.pieces import Piece, PieceId

POINTS, PAIRS = 1500, 400
"""Points of a submap and pairs of submaps that are looked at, at most; of more, some spread evenly."""
BESIDE = 2
"""All voxels so far beside a point must deny it: what the path is off is no contradiction."""
SURE = 0.9
"""Share of the surest log-odds of free space from which a voxel denies: what came back from no wall (glass, far rooms)
is taken for free by some settings, and a few such beams say little."""
FEW = 50
"""Points of a pair below which nothing is said of it."""
LOOK = 0.02
"""Share of contradicted points of a map from which it is worth a look; right maps of recordings have up to 0.013."""
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
    def share(self) -> float | None:
        """Share of denied points; none where too few were told of."""
        return float(self.denied.sum()) / self.points if self.points >= FEW else None

    @property
    def contradicted_submaps(self) -> npt.NDArray[np.int64]:
        """Rows of the pairs that contradict each other, the worst first."""
        n = self.seen + self.denied
        share = self.denied / np.maximum(n, 1)
        rows = np.flatnonzero((n >= FEW) & (share > DOUBTED))
        return rows[np.argsort(-share[rows], kind="stable")]

    @property
    def is_contradictory(self) -> bool:
        """Do passes deny each other, so that another graph may show one place where this one shows two?"""
        return (self.share is not None and self.share > LOOK) or len(self.contradicted_submaps) > 1

    def agrees_better(self, other: Contradictions) -> bool:
        """Is a smaller share denied here, of at least half as many points that were told of?"""
        known = self.share is not None and other.share is not None
        return known and self.share < other.share and 2 * self.points >= other.points  # type: ignore[operator]

    def facts(self) -> dict[str, Any]:
        """JSON-serialisable."""
        return {
            "pairs": len(self.pairs),
            "points": self.points,
            "share": self.share,
            "doubted": self.pairs[self.contradicted_submaps].tolist(),
        }


NOTHING = Contradictions(np.zeros((0, 2), np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64))
"""No submap came to the place of another."""


def find_contradictions(
    pieces: Mapping[PieceId, Piece], at: Mapping[PieceId, Array], model: BeamModel | None = None
) -> Contradictions:
    """Look for the solid voxels of every piece in those that came to the same place by another way.

    Parameters
    ----------
    pieces : by name
        In the order of the way; names begin with the key of the submap. Each holds what it saw itself: a segment that
        entered an older map has left what it took over from there.
    at : by name
        ``T_world_node``.
    model : BeamModel, optional
        Of the voxels.
    """
    names = [n for n, p in pieces.items() if p.known]
    if not names:
        return NOTHING
    model = BeamModel() if model is None else model
    some = [pieces[n] for n in names]
    nodes = np.array([at[n] for n in names])
    g = group_of(nodes)
    bases = g.compose(nodes, g.inverse(np.array([p.T_base_node for p in some])))
    clouds = [_solid(p, model.threshold_step) for p in some]
    middles = [c.mean(axis=0) if len(c) else np.zeros(g.dim) for c in clouds]
    centres = g.transform(bases, np.array(middles))
    sizes = np.array(
        [np.quantile(np.linalg.norm(c - m, axis=1), 0.9) if len(c) else 0 for c, m in zip(clouds, middles)]
    )
    way = arc_length(nodes[:, : g.dim])
    found = []
    for i, j in product(range(len(some)), repeat=2):
        near = sizes[i] + sizes[j]
        another = abs(i - j) > 1 and abs(way[i] - way[j]) > near
        if another and len(clouds[i]) and len(clouds[j]) and np.linalg.norm(centres[i] - centres[j]) < near:
            found.append((i, j))
    if len(found) > PAIRS:
        found = [found[k * len(found) // PAIRS] for k in range(PAIRS)]
    rows = [_compared(clouds[i], g.between(bases[j], bases[i]), some[j], model) for i, j in found]
    keys = np.array([(names[i][0], names[j][0]) for i, j in found], dtype=np.int64).reshape(-1, 2)  # type: ignore[index]
    told = np.array(rows, dtype=np.int64).reshape(-1, 2)
    return Contradictions(keys, told[:, 0], told[:, 1])


def _solid(piece: Piece, threshold: int) -> Array:
    """Centres of solid voxels ``(k, dim)`` in the base [m], not too many."""
    brick, voxel = np.nonzero(piece.values >= threshold)
    keep = np.arange(min(len(brick), POINTS)) * len(brick) // max(min(len(brick), POINTS), 1)
    brick, voxel = brick[keep], voxel[keep]
    inside = np.column_stack([voxel & 7, voxel >> 3 & 7, voxel >> 6])
    centres = (BRICK_EDGE * piece.coordinates[brick] + inside + 0.5) * piece.voxel_size
    return np.asarray(centres[:, : piece.dim])


def _values(piece: Piece, voxels: npt.NDArray[np.int64]) -> npt.NDArray[np.int16]:
    """Of voxels ``(k, 3)`` of the base's lattice."""
    at = (voxels >> 3) - piece.first
    inside = np.all((at >= 0) & (at < piece.table.shape[::-1]), axis=1)
    at = np.where(inside[:, None], at, 0)
    row = np.where(inside, piece.table[at[:, 2], at[:, 1], at[:, 0]], 0)
    v = voxels & 7
    return np.asarray(piece.lookup[row, v[:, 2] << 6 | v[:, 1] << 3 | v[:, 0]])


def _compared(cloud: Array, T: Array, piece: Piece, model: BeamModel) -> tuple[int, int]:
    """How many points of a cloud at ``T_base_cloud`` a piece has, and how many it denies."""
    points = group_of(T[None]).transform(np.broadcast_to(T, (len(cloud), len(T))), cloud)
    voxels = np.zeros((len(points), 3), np.int64)
    voxels[:, : piece.dim] = np.floor(points / piece.voxel_size)
    voxels = voxels[_values(piece, voxels) != UNKNOWN]
    beside = np.zeros(((2 * BESIDE + 1) ** piece.dim, 3), np.int64)
    beside[:, : piece.dim] = list(product(range(-BESIDE, BESIDE + 1), repeat=piece.dim))
    values = _values(piece, (voxels[:, None] + beside).reshape(-1, 3)).reshape(len(voxels), len(beside))
    top, low = values.max(axis=1), values.min(axis=1)
    free = (top <= SURE * model.clamp_steps[0]) & (low != UNKNOWN)
    return int(np.sum(top >= model.threshold_step)), int(np.sum(free))
