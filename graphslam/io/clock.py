"""Check of the stamps in a file: which records are kept, and how many may be dropped before the file is rejected.

The rule for every reader: an isolated bad record is dropped and counted with its reason; if more than the fraction
``MAX_DROPPED`` of a stream would be dropped, the file is rejected with an error.
"""

from __future__ import annotations

from bisect import bisect_left

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.log import DropCounter

Mask = npt.NDArray[np.bool_]
MAX_DROPPED = 0.05
"""Maximal fraction of dropped records of a stream."""
BLOCK = 20
"""At least this many consecutive records with stamps out of order are not jitter:"""
CLOCK_SET_BACK = "stamp after the clock was set back"
"""… the clock was set back, or a second drive follows in the same recording."""
STALE, STALE_TIMES = 20.0, 100.0
"""The first record is dropped as an old (latched) message if the gap to the second one is longer than STALE [s] and
than STALE_TIMES the median time between the others."""


def longest_increasing(times: Array) -> Mask:
    """Mask ``(n,)`` of a longest strictly increasing subsequence of finite ``times`` ``(n,)``.

    So one wrong stamp removes one record, whether it is too early or too late. Of equal stamps one is kept. (Patience
    sorting, O(n log n).)
    """
    if np.all(np.diff(times) > 0):
        return np.ones(len(times), dtype=np.bool_)
    tails: list[float] = []
    tail_index: list[int] = []
    before = np.full(len(times), -1, dtype=np.int64)
    for k, t in enumerate(times.tolist()):
        p = bisect_left(tails, t)
        if p < len(tails) and tails[p] == t:
            continue
        before[k] = tail_index[p - 1] if p else -1
        if p == len(tails):
            tails.append(t)
            tail_index.append(k)
        else:
            tails[p], tail_index[p] = t, k
    keep = np.zeros(len(times), dtype=np.bool_)
    k = tail_index[-1] if tail_index else -1
    while k >= 0:
        keep[k] = True
        k = int(before[k])
    return keep


def usable_records(
    times: Array, bad: dict[str, Mask], *, stream: str, where: str, drops: DropCounter, limit: float = MAX_DROPPED
) -> Mask:
    """Mask of the records of a stream to keep; the others are counted in ``drops``.

    Parameters
    ----------
    times : (n,)
        Stamps as read.
    bad : dict of str to (n,) bool
        Reason → mask of the records to drop. A record is counted once, for its first reason.
    stream, where : str
        Name of the stream in the counter, and file.
    limit : float
        Maximal fraction of dropped records; above it, :class:`DataError`.

    Returns
    -------
    (n,) bool
    """
    n = len(times)
    if n == 0:
        raise DataError("holds no record", where=where, wanted="at least one")
    keep = np.ones(n, dtype=np.bool_)
    lost: dict[str, Mask] = {}
    for reason, mask in {"stamp is not finite": ~np.isfinite(times), **bad}.items():
        lost[reason] = keep & mask
        keep &= ~mask
    index = np.flatnonzero(keep)
    ordered = longest_increasing(times[index])
    out = index[~ordered]
    if len(out):
        kept_times = times[index[ordered]]
        repeated = np.isin(times[out], kept_times)
        late = out[~repeated]
        blocks = np.split(late, np.flatnonzero(np.diff(late) > 1) + 1)
        back = np.concatenate([b for b in blocks if len(b) >= BLOCK] or [late[:0]])
        for reason, rows in (
            ("repeated stamp", out[repeated]),
            ("stamp out of order", np.setdiff1d(late, back)),
            (CLOCK_SET_BACK, back),
        ):
            lost[reason] = np.zeros(n, dtype=np.bool_)
            lost[reason][rows] = True
        keep[out] = False
    some = times[keep]
    if len(some) > 3 and some[1] - some[0] > max(STALE, STALE_TIMES * float(np.median(np.diff(some[1:])))):
        lost["first record, long before all others"] = np.zeros(n, dtype=np.bool_)
        lost["first record, long before all others"][np.flatnonzero(keep)[0]] = True
        keep[np.flatnonzero(keep)[0]] = False
    if (~keep).sum() > limit * n:
        reason = max(lost, key=lambda r: int(lost[r].sum()))
        first = int(np.flatnonzero(lost[reason])[0])
        raise DataError(
            f"{int((~keep).sum())} of {n} records are unusable, {int(lost[reason].sum())} of them because: {reason}",
            where=f"{where}, first at record {first}",
            wanted=f"at most {limit:.0%} of bad records",
        )
    for reason, mask in lost.items():
        drops.drop(stream, reason, int(mask.sum()))
    return keep
