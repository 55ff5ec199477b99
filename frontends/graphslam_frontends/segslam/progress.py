"""Progress of a SegSLAM run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphslam.core.geometry import Array
from graphslam_frontends.segslam.segmap import SegMap
from graphslam_frontends.segslam.submaps import common_ancestor_chain, segment_base


@dataclass(frozen=True, slots=True)
class SegSlamProgress:
    """State of a run. Valid until the next step only, because the SegMap changes.

    Parameters
    ----------
    step, steps : int
        Steps done, and their total number.
    length : float
        Driven so far, by the odometry [m].
    last : int
        The last closed segment of the best particle; -1 before the first.
    """

    step: int
    steps: int
    length: float
    segmap: SegMap
    last: int

    @property
    def segments(self) -> int:
        """Number of closed segments in the chain of the best particle."""
        return 0 if self.last < 0 else len(common_ancestor_chain(self.segmap, self.last))

    def paths(self) -> list[Array]:
        """Paths ``(n, 7|3)`` of the closed segments of the best particle's chain, in the frame of the first base.

        Composed along the end poses, without loop closures.
        """
        if self.last < 0:
            return []
        g, out = self.segmap.group, []
        base = g.identity
        for i in common_ancestor_chain(self.segmap, self.last).tolist():
            s = self.segmap[i]
            entry = segment_base(self.segmap, s.T_entry)
            local = g.compose(np.broadcast_to(g.inverse(entry), s.path.shape), s.path)
            out.append(g.compose(np.broadcast_to(base, local.shape), local))
            base = g.compose(base, g.between(entry, segment_base(self.segmap, s.T_exit)))
        return out
