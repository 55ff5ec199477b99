"""Entropy and known volume of a fused map.

The entropy is that of SegSLAM (A11, eq. 20–22): over observed voxels only, times their volume. A map that is folded
onto itself has less known volume, and therefore less entropy: always compare the known volume, too.
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
    """Entropy and known volume of a map.

    Parameters
    ----------
    entropy : float
        Mean over the placements [nat m³].
    volume : float
        Observed volume, mean over the placements [m³].
    """

    entropy: float
    volume: float


def mean_map_entropy(maps: Iterable[EvidenceGrid | FusedMap]) -> MapEntropy:
    """Mean entropy and known volume of several maps."""
    found = [(m.entropy(), m.known_volume()) for m in maps]
    if not found:
        raise DataError("there is no map whose entropy could be taken", wanted="one at least")
    entropy, volume = np.mean(found, axis=0)
    return MapEntropy(entropy=float(entropy), volume=float(volume))


def grid_placements(count: int, voxel_size: float, dim: int) -> Array:
    """Evenly distributed poses ``(count, 7)`` or ``(count, 3)`` of a path's frame in a grid.

    Headings over a quarter turn, positions over one voxel. A single pose is the identity.
    """
    group = SE3 if dim == 3 else SE2
    tangents = np.zeros((count, group.dof))
    if count > 1:
        share = (np.arange(count) + 0.5) / count
        tangents[:, group.heading] = 0.5 * np.pi * share
    poses = group.exp(tangents)
    if count > 1:
        # multiples of the golden ratio cover a voxel evenly for any count
        golden = 0.5 * (np.sqrt(5.0) - 1.0)
        shares = np.stack([golden * np.arange(1, count + 1) % 1.0, golden**2 * np.arange(1, count + 1) % 1.0, share], 1)
        poses[:, :dim] = voxel_size * shares[:, :dim]
    return poses
