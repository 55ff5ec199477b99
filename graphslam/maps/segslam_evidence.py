"""Exact own evidence of each segment of a SegSLAM run, while its segment map is in memory.

A segment's map and the map that it started from share one lattice in the run, so their difference is exact. Output
submaps are resampled on the lattices of their bases; for these `increment.own_evidence` is approximate.
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
    """Grids of a chain of submaps without the copies of older maps, by key, in the frames of their bases.

    If the older map was deleted, :func:`own_evidence` is used.

    Parameters
    ----------
    chain : sequence of int
        The segments, as passed to `submaps_of_segments`.
    submaps : sequence of Submap
        As returned by it, with grids.
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
        if not t.alive[source]:
            unknown = True
            continue
        found = map_increment(segmap.map_of(i), segmap.map_of(source))
        moved = found.grid.empty()
        moved.merge(found.grid, g.inverse(segment_base(segmap, segmap[i].T_entry)))
        out[s.key] = moved
    if unknown:
        rest, _ = own_evidence(submaps)
        out |= {key: grid for key, grid in rest.items() if key not in out}
    return {s.key: out[s.key] for s in submaps}
