"""How clear a fused map is.

Entropy is SegSLAM's (A11, eq. 20–22): of observed voxels only, times their volume; `FusedMap.entropy` follows it while
pieces move. A map that is folded onto itself knows less of the world, and has less entropy for that: known volume
always stands beside it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.poses import SE2, SE3
from graphslam.evidence.grid import EvidenceGrid
from graphslam.maps.fuse import FusedMap


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
