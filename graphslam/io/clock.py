"""Stamps as they come from files: which records to keep, and how many may be lost before a file is refused.

The rule for every reader: an isolated bad record is dropped and counted with its reason; when more than
``MAX_DROPPED`` of a stream would go, the file is not what it should be and is refused.
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
"""Share of a stream's records that may be dropped."""
BLOCK = 20
"""So many records in a row whose stamps are out of order are no jitter:"""
CLOCK_SET_BACK = "stamp after the clock was set back"
"""… the clock was set back, or a second drive follows in the same recording."""
STALE, STALE_TIMES = 20.0, 100.0
"""A first record that all others follow after so long [s], and so many times what is usual between them, is an old one
that was handed out when the recording began (a latched message)."""


def longest_increasing(times: Array) -> Mask:
    """Mask ``(n,)`` of a longest strictly increasing subsequence of finite ``times`` ``(n,)``.

    One wild stamp then costs one record, whether it lies in the past or in the future. Of equal stamps the first is
    kept. (Patience sorting, O(n log n).)
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
    """Which records of a stream to keep; the others are counted in ``drops``.

    Parameters
    ----------
    times : (n,)
        Stamps as read.
    bad : dict of str to (n,) bool
        Reason → records that are bad for it. A record is counted once, for its first reason.
    stream, where : str
        Name of the stream in the counter, and file.
    limit : float
        Greatest share of dropped records.

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
