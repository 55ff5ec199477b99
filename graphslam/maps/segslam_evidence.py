"""What each segment of a SegSLAM run saw itself, exactly: while the run that made it is at hand.

A segment's map and the map that it began as a copy of share one lattice in the run. Submaps that were handed over stand
on the lattices of their own bases, each rounded once; of these `added.own_evidence` takes the difference as well as it
can be told.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError
from graphslam.core.submap import Submap
from graphslam.evidence.grid import EvidenceGrid
from graphslam.maps.increment import evidence_grid_of, map_increment, own_evidence
from graphslam_frontends.segslam.segmap import NEW, SegMap
from graphslam_frontends.segslam.submaps import segment_base


def own_evidence_of(
    segmap: SegMap, chain: Sequence[int] | npt.NDArray[Any], submaps: Sequence[Submap]
) -> dict[int, EvidenceGrid]:
    """Grids of a chain of submaps without what their segments took over, by key, in the frames of their bases.

    A segment whose older map is gone, or was moved to another lattice by a merge, is treated as if the run were not at
    hand.

    Parameters
    ----------
    chain : sequence of int
        The segments, as `settle` got them.
    submaps : sequence of Submap
        As `settle` gave them, with grids.
    """
    if len(chain) != len(submaps):
        raise DataError("segments and submaps differ in number", got=len(submaps), wanted=len(chain))
    t, g = segmap.table, segmap.group
    out, unknown = {}, False
    for i, s in zip(np.asarray(chain, dtype=np.int64).tolist(), submaps):
        source = int(t.source[i])
        if t.kind[i] == NEW:
            out[s.key] = evidence_grid_of(s)
            continue
        if not t.alive[source] or not np.array_equal(t.T_map[i], t.T_map[source]):
            unknown = True
            continue
        grid, T_map = segmap.map_of(i)
        found = map_increment(grid, segmap.map_of(source)[0])
        T_base_map = g.inverse(g.compose(T_map, segment_base(segmap, segmap[i].T_entry)))
        moved = grid.empty()
        moved.merge(found.grid, T_base_map)
        out[s.key] = moved
    if unknown:
        rest, _ = own_evidence(submaps)
        out |= {key: grid for key, grid in rest.items() if key not in out}
    return {s.key: out[s.key] for s in submaps}
