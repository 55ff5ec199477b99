"""Evidence that a segment added to an older map that it entered, so that no scan counts twice in a fused map.

In SegSLAM a segment that enters an older map starts with a copy of it. Without subtraction, the fused map would contain
the evidence of the older submap twice, and would move distant walls with nodes that never observed them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphslam.core.errors import GridError
from graphslam.core.poses import SE2, SE3
from graphslam.core.submap import Submap
from graphslam.evidence.batch import write_packed
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.layout import UNKNOWN
from graphslam.evidence.spilled_grid import spill_grid
from graphslam.evidence.views import dense_view
from graphslam.maps.increment_kernels import subtract_bricks

COPIED = 0.9
"""Share of an older map's voxels that a segment must know to count as a copy: 0.994 for a copy with known pose, 0.82
with a pose error of 0.2 m and half a degree (simulated garage). It is 1 only if one particle made both."""


@dataclass(frozen=True, slots=True)
class MapIncrement:
    """Difference of a grid and an earlier one.

    Parameters
    ----------
    grid : EvidenceGrid
        Log-odds that were added since, in the grid's frame; unknown if unchanged.
    known : int
        Known voxels of the difference.
    copied : int
        Voxels with the same value in both.
    shared : int
        Voxels known in both.
    """

    grid: EvidenceGrid
    known: int
    copied: int
    shared: int


def map_increment(
    grid: EvidenceGrid, earlier: EvidenceGrid, T_grid_earlier: Any = None, *, slack: int = 0
) -> MapIncrement:
    """The log-odds of ``grid`` minus those of ``earlier``; unchanged voxels are unknown.

    Evidence that was added to a saturated voxel is not in the difference; the earlier map contains it.

    Parameters
    ----------
    grid, earlier : EvidenceGrid
        Of the same voxel size and dimension.
    T_grid_earlier : (7,) or (3,), optional
        Pose at which the copy was made; default the identity.
    slack : {0, 1}
        1: a voxel known in both is unchanged if a neighbour in the earlier map has its value. For two maps that were
        each resampled from a third lattice, so that rounding differs.
    """
    if grid.voxel_size != earlier.voxel_size or grid.dim != earlier.dim:
        raise GridError(
            "grids of different voxel size or dimension",
            got=f"{earlier.voxel_size} m, {earlier.dim}-D",
            wanted=f"{grid.voxel_size} m, {grid.dim}-D",
        )
    if slack not in (0, 1):
        raise GridError("impossible slack of a difference of maps", got=slack, wanted="0 or 1 voxels")
    before = EvidenceGrid(grid.voxel_size, model=earlier.model, dim=grid.dim, pool=grid.pool)
    before.merge(earlier, T_grid_earlier)
    pool = grid.pool
    counts = np.zeros(3, np.int64)
    with pool.lock:
        rows = grid.packed_bricks()
        keys, new = np.ascontiguousarray(rows[:, 0]), pool.tree.bricks[rows[:, 1]]
        difference = np.empty_like(new)
        tree = before.root, pool.levels, pool.tree.children, pool.tree.bricks
        subtract_bricks(keys, new, tree, slack, grid.dim == 2, difference, counts)
    some = (difference != UNKNOWN).any(axis=1)
    out = grid.empty()
    write_packed(out, keys[some], difference[some])
    return MapIncrement(out, *counts.tolist())


def own_evidence(submaps: Sequence[Submap]) -> tuple[dict[int, EvidenceGrid], Mapping[int, int]]:
    """The grid of each submap without the copy of an older one that it entered.

    If a submap has matches, the target whose map it contains a copy of is used (`COPIED`); a submap that continues in
    the previous map contains a copy of that. If the SegSLAM run is available,
    :func:`graphslam.maps.segslam_evidence.own_evidence_of` is exact.

    Parameters
    ----------
    submaps : sequence of Submap
        A chain, with dense maps.

    Returns
    -------
    grids : by key
    entered : by key
        Key of the submap whose map was subtracted, for those with a copy.
    """
    whole = {s.key: evidence_grid_of(s) for s in submaps}
    grids, entered = dict(whole), {}
    before: Submap | None = None
    for s in submaps:
        group = SE3 if s.dim == 3 else SE2
        kind = s.report.get("entered", "match")
        older = [(m.target, m.T_target_here) for m in s.matches] if kind == "match" else []
        if kind == "same" and before is not None:
            older = [(before.key, before.exit_pose)]
        best = COPIED
        for target, T_target_here in older:
            if target not in whole or target == s.key:
                continue
            # each was resampled on the lattice of its own base
            found = map_increment(whole[s.key], whole[target], group.inverse(T_target_here), slack=1)
            share = found.shared / max(whole[target].voxel_counts().known, 1)
            if share >= best:
                best, grids[s.key], entered[s.key] = share, spill_grid(found.grid), target
        before = s
    return grids, entered


def evidence_grid_of(submap: Submap) -> EvidenceGrid:
    """Evidence grid of a submap's dense map."""
    grid: EvidenceGrid = dense_view(submap).evidence()
    return grid
