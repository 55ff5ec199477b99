"""Ranking of map candidates (pieces and poses) by their entropy.

SegSLAM selects the map sample of least entropy. Here each candidate (an optimised sample, or a set of loops) is fused
from pieces. To save time, a map is made from that of a similar candidate by moving, adding and removing the pieces that
differ. The results are bitwise equal to those of maps made from scratch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphslam.core.errors import ConfigError, DataError
from graphslam.core.geometry import Array
from graphslam.core.poses import SE2, SE3
from graphslam.core.progress import Bar
from graphslam.evidence.beams import BeamModel
from graphslam.maps.entropy import MapEntropy, grid_placements, mean_map_entropy
from graphslam.maps.fuse import FusedMap, fuse_pieces
from graphslam.maps.pieces import Piece, PieceId, checked_poses


@dataclass(frozen=True, slots=True)
class MapHypothesis:
    """A map candidate.

    Parameters
    ----------
    pieces : mapping of name to Piece
        Candidates share pieces as identical objects.
    poses : mapping of name to (7,) or (3,)
        ``T_world_node`` of all of them. Candidates with the same gauge (first base fixed) share more, and the position
        of the lattice does not add differences.
    """

    pieces: Mapping[PieceId, Piece]
    poses: Mapping[PieceId, Any]
    name: str = ""


@dataclass(frozen=True, slots=True)
class RankedMap:
    """Metrics of a candidate.

    Parameters
    ----------
    index : int
        Index of the candidate in the input.
    clarity : MapEntropy
        Its entropy, which gives the order, and known volume.
    changed : int
        Pieces that were moved, added or removed, over all placements.
    summed : int
        Bricks that were summed again, over all placements.
    """

    index: int
    name: str
    clarity: MapEntropy
    changed: int
    summed: int


@dataclass(frozen=True, slots=True)
class EntropyRanking:
    """Candidates in the order of their entropy.

    Parameters
    ----------
    order : tuple of RankedMap
        Least entropy first; equal ones in input order.
    best : FusedMap
        The map of the first.
    """

    order: tuple[RankedMap, ...]
    best: FusedMap


def rank_by_entropy(
    candidates: Sequence[MapHypothesis],
    *,
    model: BeamModel | None = None,
    count: int = 1,
    progress: bool = False,
) -> EntropyRanking:
    """Fuse every candidate, and sort by entropy.

    Parameters
    ----------
    count : int
        Placements of the lattice; the entropy is the mean over them (`entropy.grid_placements`).
    progress : bool
        Show a progress bar.
    """
    if not candidates:
        raise DataError("there are no candidates to choose the clearest of", wanted="one at least")
    if count < 1:
        raise ConfigError(f"entropy over {count} placements; wanted ≥ 1")
    for k, c in enumerate(candidates):
        missing = [name for name in c.pieces if name not in c.poses]
        if not c.pieces or missing:
            raise DataError(f"candidate {k} {c.name!r} has no pieces, or pieces without a pose", got=missing)
    dim = next(iter(candidates[0].pieces.values())).dim
    size = next(iter(candidates[0].pieces.values())).voxel_size
    poses = [{n: checked_poses(c.poses[n], dim) for n in c.pieces} for c in candidates]
    sequence = visiting_order([_signature(c, p) for c, p in zip(candidates, poses)])
    stands = grid_placements(count, size, dim)
    entropies, volumes = np.zeros((len(candidates), count)), np.zeros((len(candidates), count))
    work = np.zeros((len(candidates), 2), np.int64)
    best: tuple[float, int] | None = None
    best_map: FusedMap | None = None
    with Bar(total=count * len(sequence), name="entropy of candidates", unit="map", shown=progress) as bar:
        for s, T in enumerate(stands):
            fused: FusedMap | None = None
            for k in sequence:
                fused = _follow(fused, candidates[k], _placed(poses[k], T, dim, count), model, work[k])
                found = mean_map_entropy([fused])
                entropies[k, s], volumes[k, s] = found.entropy, found.volume
                if count == 1 and (best is None or (found.entropy, k) < best):
                    best, best_map = (found.entropy, k), fused.copy()
                bar.update()
    means = entropies.mean(axis=1)
    ranked = sorted(range(len(candidates)), key=lambda k: (means[k], k))
    order = tuple(
        RankedMap(
            k,
            candidates[k].name,
            MapEntropy(float(means[k]), float(volumes[k].mean())),
            int(work[k, 0]),
            int(work[k, 1]),
        )
        for k in ranked
    )
    if best_map is None:
        best_map = fuse_pieces(candidates[ranked[0]].pieces, poses[ranked[0]], model=model)
    return EntropyRanking(order, best_map)


def visiting_order(signatures: Sequence[frozenset[Any]]) -> list[int]:
    """Greedy order of sets: the next is always that with the fewest differences."""
    left = list(range(1, len(signatures)))
    visited = [0]
    while left:
        here = signatures[visited[-1]]
        visited.append(min(left, key=lambda k: (len(here ^ signatures[k]), k)))
        left.remove(visited[-1])
    return visited


def _signature(c: MapHypothesis, poses: Mapping[PieceId, Array]) -> frozenset[Any]:
    return frozenset((name, id(piece), poses[name].tobytes()) for name, piece in c.pieces.items())


def _placed(poses: Mapping[PieceId, Array], T: Array, dim: int, count: int) -> Mapping[PieceId, Array]:
    """Poses in another placement of the lattice; unchanged if there is only one."""
    group = SE3 if dim == 3 else SE2
    return poses if count == 1 else {name: group.compose(T, pose) for name, pose in poses.items()}


def _follow(
    fused: FusedMap | None, c: MapHypothesis, poses: Mapping[PieceId, Array], model: BeamModel | None, work: Any
) -> FusedMap:
    """Map of a candidate, made by changing that of another."""
    if fused is None:
        piece = next(iter(c.pieces.values()))
        fused = FusedMap(piece.voxel_size, dim=piece.dim, model=model)
    here = fused.pieces
    removed = [n for n, p in here.items() if c.pieces.get(n) is not p]
    new = {n: p for n, p in c.pieces.items() if n not in here or here[n] is not p}
    change = fused.update(add=new, remove=removed, poses=poses, tolerance=0.0)
    work += [change.added + change.removed + change.moved, change.summed]
    return fused
