"""How clear a fused map is, and whether two pieces say the same of what both saw.

Entropy is SegSLAM's (A11, eq. 20–22): of observed voxels only, times their volume; `FusedMap.entropy` follows it while
pieces move. A map that is folded onto itself knows less of the world, and has less entropy for that: known volume
always stands beside it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphslam.core.errors import ConfigError, DataError, GridError
from graphslam.core.geometry import Array
from graphslam.core.poses import SE2, SE3
from graphslam.evidence.beams import BeamModel
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.layout import BRICK_EDGE, STEP
from graphslam.evidence.scan import pose_row
from graphslam.maps.compare_kernels import compare_pieces
from graphslam.maps.fuse import FusedMap, fuse_pieces
from graphslam.maps.pieces import Piece, PieceId, checked_poses


@dataclass(frozen=True, slots=True)
class MapEntropy:
    """How clear a map is.

    Parameters
    ----------
    entropy : float
        Mean over the placements [nat m³].
    volume : float
        Volume of what was observed, likewise [m³]: a map that is folded onto itself knows less of the world, and has
        less entropy for that.
    """

    entropy: float
    volume: float

    @property
    def per_volume(self) -> float:
        """Entropy of what was observed [nat], NaN of an empty map."""
        return self.entropy / self.volume if self.volume > 0 else float("nan")


def mean_map_entropy(maps: Iterable[EvidenceGrid | FusedMap]) -> MapEntropy:
    """Mean entropy and known volume of some maps."""
    found = [(m.entropy(), m.known_volume()) for m in maps]
    if not found:
        raise DataError("there is no map whose entropy could be taken", wanted="one at least")
    entropy, volume = np.mean(found, axis=0)
    return MapEntropy(entropy=float(entropy), volume=float(volume))


def grid_placements(count: int, voxel_size: float, dim: int) -> Array:
    """Poses ``(count, 7)`` or ``(count, 3)`` of a path's frame in a grid, none of them favoured.

    Headings over a quarter turn, and positions, heights foremost, over a voxel, both spread evenly. A single one is the
    identity.
    """
    group = SE3 if dim == 3 else SE2
    tangents = np.zeros((count, group.dof))
    if count > 1:
        share = (np.arange(count) + 0.5) / count
        tangents[:, group.heading] = 0.5 * np.pi * share
    poses = group.exp(tangents)
    if count > 1:
        # of a golden section the multiples fill a voxel evenly, whatever their number
        golden = 0.5 * (np.sqrt(5.0) - 1.0)
        shares = np.stack([golden * np.arange(1, count + 1) % 1.0, golden**2 * np.arange(1, count + 1) % 1.0, share], 1)
        poses[:, :dim] = voxel_size * shares[:, :dim]
    return poses


def map_entropy(
    pieces: Mapping[PieceId, Piece], poses: Mapping[PieceId, Any], *, model: BeamModel | None = None, count: int = 1
) -> MapEntropy:
    """Entropy of pieces fused at ``T_world_node``, in grids that stand in ``count`` different ways.

    Where the voxels lie counts: a floor in the middle of its layer is clear, one between two layers is not.
    """
    if not pieces:
        raise DataError("the entropy of no pieces", wanted="one at least")
    first = next(iter(pieces.values()))
    group = SE3 if first.dim == 3 else SE2
    fused = fuse_pieces(pieces, poses, model=model, tolerance=0.0)
    at = {name: checked_poses(poses[name], first.dim) for name in pieces}
    found = []
    for T in grid_placements(count, first.voxel_size, first.dim):
        if count > 1:
            fused.move({name: group.compose(T, pose) for name, pose in at.items()})
        found.append(mean_map_entropy([fused]))
    return MapEntropy(float(np.mean([c.entropy for c in found])), float(np.mean([c.volume for c in found])))


@dataclass(frozen=True, slots=True)
class Disagreement:
    """What two pieces say of the same places, each looked up in the other.

    Parameters
    ----------
    overlap : int
        Voxels of either that the other knows too.
    agreeing : int
        Occupied voxels of either where the other has something occupied, or beside.
    contradicting : int
        Occupied voxels of either where the other is free, with nothing occupied beside.
    free : int
        Free voxels of either that are free in the other.
    sure : int
        Voxels of either that are occupied or free beyond doubt, whether the other knows them or not.
    """

    overlap: int
    agreeing: int
    contradicting: int
    free: int
    sure: int

    @property
    def share(self) -> float:
        """Share of the occupied voxels that both speak of which are free in the other; NaN where there are none.

        0 of two pieces that agree; of a wrong loop, the share of surfaces that stand in the other's free space.
        """
        spoken = self.agreeing + self.contradicting
        return self.contradicting / spoken if spoken else float("nan")

    @property
    def share_of_overlap(self) -> float:
        """Contradictions as a share of all voxels that both know, free ones included; NaN where there are none."""
        return self.contradicting / self.overlap if self.overlap else float("nan")


def measure_disagreement(
    piece_a: Piece,
    T_a: Any,
    piece_b: Piece,
    T_b: Any,
    *,
    model: BeamModel | None = None,
    doubt: float = 0.4,
    slack: int = 1,
) -> Disagreement:
    """Whether two overlapping pieces contradict each other: free against occupied.

    Parameters
    ----------
    T_a, T_b : (7,) or (3,)
        ``T_world_node`` of each.
    model : BeamModel, optional
        Whose threshold parts occupied from free.
    doubt : float
        Voxels of which the log-odds lie within this of the threshold count as neither: the default is one beam that
        passed.
    slack : int
        Surfaces that lie so many voxels apart along each axis agree: what rounding to two lattices does to one surface.
    """
    if piece_a.voxel_size != piece_b.voxel_size or piece_a.dim != piece_b.dim:
        raise GridError(
            "pieces of different voxel size or dimension cannot be compared",
            got=f"{piece_b.voxel_size} m, {piece_b.dim}-D",
            wanted=f"{piece_a.voxel_size} m, {piece_a.dim}-D",
        )
    if not (np.isfinite(doubt) and doubt >= 0) or not 0 <= slack <= BRICK_EDGE:
        raise ConfigError(f"disagreement: doubt {doubt}, slack {slack}; wanted ≥ 0, and 0 … {BRICK_EDGE} voxels")
    dim = piece_a.dim
    group = SE3 if dim == 3 else SE2
    base = [
        group.compose(checked_poses(T, dim), group.inverse(p.T_base_node)) for p, T in ((piece_a, T_a), (piece_b, T_b))
    ]
    threshold = (BeamModel() if model is None else model).threshold_step
    margin = round(doubt / STEP)
    occupied, free = threshold + margin, threshold - max(margin, 1)
    counts = np.zeros(5, np.int64)
    for one, other, T in (
        (piece_a, piece_b, group.between(base[1], base[0])),
        (piece_b, piece_a, group.between(base[0], base[1])),
    ):
        into = pose_row(T, dim).copy()  # T_other_one
        into[9:] = into[9:] / one.voxel_size - BRICK_EDGE * other.first
        mine, theirs = (one.coordinates, one.values), (other.table, other.lookup)
        compare_pieces(mine, into, dim == 2, theirs, (occupied, free), int(slack), counts)
    return Disagreement(*counts.tolist())
