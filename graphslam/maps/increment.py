"""What a segment added to a map that it entered again: so that no scan counts twice in a fused map.

SegSLAM's segment that enters an older map begins with a copy of it and goes on in that. Fused beside the older submap,
its grid would say everything of that submap a second time, and would carry far walls along with nodes that never saw
them.
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
"""A segment began with a copy of a map if it knows this share of what that map knows: 0.994 of a copy whose pose is
known, 0.82 where it was 0.2 m and half a degree off (a simulated garage). All of it only if one particle made both."""


@dataclass(frozen=True, slots=True)
class MapIncrement:
    """What is left of a grid without what it had from another.

    Parameters
    ----------
    grid : EvidenceGrid
        Log-odds that came in since, in the grid's own frame; unknown where none did.
    known : int
        Voxels in it.
    copied : int
        Voxels of which both say exactly the same.
    shared : int
        Voxels that both know.
    """

    grid: EvidenceGrid
    known: int
    copied: int
    shared: int


def map_increment(
    grid: EvidenceGrid, earlier: EvidenceGrid, T_grid_earlier: Any = None, *, slack: int = 0
) -> MapIncrement:
    """The log-odds of ``grid`` less those of ``earlier``; voxels that did not change are unknown.

    What came in while a voxel was saturated cannot be seen in the difference, and is lost: the earlier map has it.

    Parameters
    ----------
    grid, earlier : EvidenceGrid
        Of one voxel size and dimension.
    T_grid_earlier : (7,) or (3,), optional
        As it was when the copy was put on the grid's lattice; default the identity.
    slack : {0, 1}
        1: a voxel that both know did not change if one beside it has its value in the earlier map. For maps that were
        put on lattices of their own, each, from a third one: rounding twice is not rounding once.
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
        keys, new = np.ascontiguousarray(rows[:, 0]), pool.bricks[rows[:, 1]]
        difference = np.empty_like(new)
        tree = before.root, pool.levels, pool.children, pool.bricks
        subtract_bricks(keys, new, tree, slack, grid.dim == 2, difference, counts)
    some = (difference != UNKNOWN).any(axis=1)
    out = grid.empty()
    write_packed(out, keys[some], difference[some])
    return MapIncrement(out, *counts.tolist())


def own_evidence(submaps: Sequence[Submap]) -> tuple[dict[int, EvidenceGrid], Mapping[int, int]]:
    """The grid of each submap without what it took over from an older one that it entered.

    Of the matches of a submap that was entered by one, that is taken whose map it holds a copy of (`COPIED`); a submap
    that goes on in the map of the one before holds a copy of that. Where the run that made them is at hand,
    :func:`graphslam.maps.segslam_evidence.own_evidence_of` is exact.

    Parameters
    ----------
    submaps : sequence of Submap
        A chain, with dense maps.

    Returns
    -------
    grids : by key
    entered : by key
        Key of the submap whose map was taken out, of those that had one.
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
            # each was put on the lattice of its own base
            found = map_increment(whole[s.key], whole[target], group.inverse(T_target_here), slack=1)
            share = found.shared / max(whole[target].voxel_counts().known, 1)
            if share >= best:
                best, grids[s.key], entered[s.key] = share, spill_grid(found.grid), target
        before = s
    return grids, entered


def evidence_grid_of(submap: Submap) -> EvidenceGrid:
    """The evidence of a submap's dense map."""
    grid: EvidenceGrid = dense_view(submap).evidence()
    return grid
