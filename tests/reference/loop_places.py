"""Places of a list of submaps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from graphslam.core.errors import DataError
from graphslam.core.geometry import arc_length
from graphslam.core.poses import group_of
from graphslam.core.submap import Submap
from graphslam.graph.inner_nodes import inner_rows
from graphslam.loops.places import Places, _places


def loop_places(submaps: Sequence[Submap], spacing: float = 3.0) -> Places:
    """Places about every ``spacing`` [m] of the paths of a chain of submaps; nodes are numbered as they come.

    The exit of a submap is the base of the next; that of the last is no place, for nothing was mapped there yet.
    """
    stretches = []
    for s in submaps:
        if s.trajectory is None or len(s.trajectory) == 0:
            raise DataError(f"submap {s.key} has no path to put places on", wanted="a trajectory")
        path = s.trajectory
        along = arc_length(path.positions)
        rows = np.concatenate([[0], inner_rows(path, spacing)])
        T = path.poses[rows].copy()
        T[0] = group_of(T).identity  # the base itself
        stretches.append((T, along[rows], path.times[rows], float(along[-1])))
    return _places(stretches)
