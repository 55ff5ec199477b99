"""Contradictions between overlapping submaps: occupied voxels of one in free space of another.

Two traversals of a corridor can match perfectly along its walls although the cross walls are doubled in the map. Free
space reveals the error: a wall of the second traversal lies in space that the first one observed as free. Therefore all
occupied voxels of a submap are compared with the grids of submaps that reached the same place along another path.
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
"""Most points per submap and pairs of submaps; of more, an even selection is used."""
BESIDE = 2
"""All voxels within this distance of a point [voxels] must be free to contradict it, so that small pose errors do not
count."""
FREE_SHARE = 0.9
"""Share of the lowest log-odds below which a voxel counts as free. Some settings treat beams without return (glass, far
walls) as free; a few such beams are not enough."""
FEW = 50
"""Least number of compared points for a result."""
LOOK = 0.02
"""Share of contradicted points of a map above which it is reported; correct maps of recordings have up to 0.013."""
DOUBTED = 0.2
"""Share of contradicted points above which a pair is contradictory."""


@dataclass(frozen=True, slots=True)
class Contradictions:
    """Agreement of the traversals of a map with each other.

    Parameters
    ----------
    pairs : (n, 2) int
        Keys of submaps that reached a place along different paths; both orders.
    seen, contradicted : (n,) int
        Occupied points of the first that are occupied in the second, and that are in its free space.
    """

    pairs: npt.NDArray[np.int64]
    seen: npt.NDArray[np.int64]
    contradicted: npt.NDArray[np.int64]

    @property
    def points(self) -> int:
        """Number of points that were confirmed or contradicted."""
        return int(self.seen.sum() + self.contradicted.sum())

    @property
    def share(self) -> float | None:
        """Share of contradicted points; None below :data:`FEW` points."""
        return float(self.contradicted.sum()) / self.points if self.points >= FEW else None

    @property
    def contradicted_submaps(self) -> npt.NDArray[np.int64]:
        """Rows of ``pairs`` that are contradictory, the worst first."""
        n = self.seen + self.contradicted
        share = self.contradicted / np.maximum(n, 1)
        rows = np.flatnonzero((n >= FEW) & (share > DOUBTED))
        return rows[np.argsort(-share[rows], kind="stable")]

    @property
    def is_contradictory(self) -> bool:
        """Whether traversals contradict each other, so that the graph may have missed or false loops."""
        return (self.share is not None and self.share > LOOK) or len(self.contradicted_submaps) > 1

    def agrees_better(self, other: Contradictions) -> bool:
        """Whether the share is smaller here, with at least half as many compared points."""
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
"""No overlapping submaps."""


def find_contradictions(
    pieces: Mapping[PieceId, Piece], at: Mapping[PieceId, Array], model: BeamModel | None = None
) -> Contradictions:
    """Compare the occupied voxels of every piece with pieces that reached the same place along another path.

    Parameters
    ----------
    pieces : by name
        In path order; names begin with the key of the submap. Each must contain its own observations only, without the
        copy of an older map that its segment entered.
    at : by name
        ``T_world_node``.
    model : BeamModel, optional
        Sensor model of the voxels.
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
    along = arc_length(nodes[:, : g.dim])
    found = []
    for i, j in product(range(len(some)), repeat=2):
        near = sizes[i] + sizes[j]
        another = abs(i - j) > 1 and abs(along[i] - along[j]) > near
        if another and len(clouds[i]) and len(clouds[j]) and np.linalg.norm(centres[i] - centres[j]) < near:
            found.append((i, j))
    if len(found) > PAIRS:
        found = [found[k * len(found) // PAIRS] for k in range(PAIRS)]
    rows = [_compared(clouds[i], g.between(bases[j], bases[i]), some[j], model) for i, j in found]
    keys = np.array([(names[i][0], names[j][0]) for i, j in found], dtype=np.int64).reshape(-1, 2)  # type: ignore[index]
    pairs = np.array(rows, dtype=np.int64).reshape(-1, 2)
    return Contradictions(keys, pairs[:, 0], pairs[:, 1])


def _solid(piece: Piece, threshold: int) -> Array:
    """Centres of occupied voxels ``(k, dim)`` in the base frame [m], at most :data:`POINTS`."""
    brick, voxel = np.nonzero(piece.values >= threshold)
    keep = np.arange(min(len(brick), POINTS)) * len(brick) // max(min(len(brick), POINTS), 1)
    brick, voxel = brick[keep], voxel[keep]
    inside = np.column_stack([voxel & 7, voxel >> 3 & 7, voxel >> 6])
    centres = (BRICK_EDGE * piece.coordinates[brick] + inside + 0.5) * piece.voxel_size
    return np.asarray(centres[:, : piece.dim])


def _values(piece: Piece, voxels: npt.NDArray[np.int64]) -> npt.NDArray[np.int16]:
    """Values of voxels ``(k, 3)`` of the base's lattice."""
    at = (voxels >> 3) - piece.first
    inside = np.all((at >= 0) & (at < piece.table.shape[::-1]), axis=1)
    at = np.where(inside[:, None], at, 0)
    row = np.where(inside, piece.table[at[:, 2], at[:, 1], at[:, 0]], 0)
    v = voxels & 7
    return np.asarray(piece.lookup[row, v[:, 2] << 6 | v[:, 1] << 3 | v[:, 0]])


def _compared(cloud: Array, T: Array, piece: Piece, model: BeamModel) -> tuple[int, int]:
    """Number of points of a cloud at ``T_base_cloud`` that are occupied in a piece, and that are in its free space."""
    points = group_of(T[None]).transform(np.broadcast_to(T, (len(cloud), len(T))), cloud)
    voxels = np.zeros((len(points), 3), np.int64)
    voxels[:, : piece.dim] = np.floor(points / piece.voxel_size)
    voxels = voxels[_values(piece, voxels) != UNKNOWN]
    beside = np.zeros(((2 * BESIDE + 1) ** piece.dim, 3), np.int64)
    beside[:, : piece.dim] = list(product(range(-BESIDE, BESIDE + 1), repeat=piece.dim))
    values = _values(piece, (voxels[:, None] + beside).reshape(-1, 3)).reshape(len(voxels), len(beside))
    top, low = values.max(axis=1), values.min(axis=1)
    free = (top <= FREE_SHARE * model.clamp_steps[0]) & (low != UNKNOWN)
    return int(np.sum(top >= model.threshold_step)), int(np.sum(free))
