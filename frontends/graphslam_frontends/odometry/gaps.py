"""Gaps in the records of a stream: found, and bridged up to a limit."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.log import DropCounter

OPTION = "frontend.steps.longest_record"
"""Full name of the option that limits gaps of steps."""


@dataclass(frozen=True, slots=True)
class Gaps:
    """Intervals without records."""

    begin: Array = field(default_factory=lambda: np.zeros(0))
    end: Array = field(default_factory=lambda: np.zeros(0))

    def length_at(self, times: Array) -> Array:
        """Length of the gap at each of ``times``, 0 outside gaps [s]."""
        out = np.zeros(len(times))
        for a, b in zip(self.begin, self.end):
            out[(times > a) & (times < b)] = b - a
        return out


def find_gaps(stamps: Array, begin: float, end: float, limit: float, *, where: str, drops: DropCounter | None) -> Gaps:
    """Gaps of a stream inside ``[begin, end]``: longer than 3 times the median interval and than 50 ms.

    Parameters
    ----------
    stamps : (n,)
    limit : float
        Longest gap that is bridged [s].
    where : str
        Name of the stream.
    drops : DropCounter or None
        Counts each gap.
    """
    known = np.append(stamps, end) if len(stamps) and end > stamps[-1] else stamps
    spacing = np.diff(known)
    usual = float(np.median(np.diff(stamps))) if len(stamps) > 1 else limit
    k = np.flatnonzero((spacing > max(3.0 * usual, 0.05)) & (known[1:] > begin) & (known[:-1] < end))
    refuse_long_gaps(known, k, limit, where)
    if drops is not None:
        drops.drop(where, "gap bridged", len(k))
    return Gaps(known[k], known[k + 1])


def refuse_long_gaps(
    stamps: Array, gaps: npt.NDArray[np.int64], limit: float, where: str, option: str = OPTION, got: str = ""
) -> None:
    """Raise if a gap, given by the record before it, is longer than ``limit`` seconds; ``option`` sets the limit."""
    spacing = np.diff(stamps)
    if len(gaps) and spacing[gaps].max() > limit:
        worst = int(gaps[np.argmax(spacing[gaps])])
        raise DataError(
            f"gap without records: {spacing[worst]:.3f} s after record {worst}",
            where=where,
            got=f"{stamps[worst]:.3f} to {stamps[worst + 1]:.3f} s{got}",
            wanted=f"gaps of at most {limit:g} s ({option}), or a log that is cut there",
        )
