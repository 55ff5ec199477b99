"""The evidence ledger: which measurements each factor uses. No measurement is used twice.

Every factor has an entry for each stream and interval that it uses. Two entries of one stream with overlapping
intervals would be double counting and are refused, unless one of them is of a *declared* kind: an exception with a
reason, such as a laser scan that is part of a submap and also matches it to another one. Intervals are half open,
``[t_start, t_end)``; an instant (``t_start == t_end``) belongs to the interval that starts there.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from graphslam.core.errors import ConfigError, DataError, EvidenceReusedError
from graphslam.core.markup import html_table
from graphslam.core.tables import data_frame

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = ("factor_id", "factor", "stream", "t_start", "t_end", "kind", "note")
"""Columns of the ledger as a table."""
EXCLUSIVE = "measurement"
DECLARED = {
    "shared-scan": "a scan that made a submap also registers it to another one",
    "prior": "an assumption, not a measurement",
    "biases": "the factor of constant errors is the part of the likelihood that the submap Gaussian does not contain",
    "levelled": "each base was levelled by the same gravity measurement as the exit of the submap",
    "aid": "used for initial guesses of matches and for deskewing only; in no covariance of the path",
    "start": "initial guess of the refinement; in no factor of the refined path",
}


@dataclass(frozen=True, slots=True)
class EvidenceUse:
    """Measurements used by a factor.

    Parameters
    ----------
    streams : sequence of str
        Names of streams.
    interval : (float, float)
        Time interval ``[t_start, t_end)`` [s].
    kind : str
        ``"measurement"``: no other factor may use it; or a kind declared in the ledger (``"shared-scan"``).

    Examples
    --------
    >>> gs.EvidenceUse(["controls"], (0.0, 12.5)).kind
    'measurement'
    """

    streams: Sequence[str]
    interval: tuple[float, float]
    kind: str = EXCLUSIVE


@dataclass(frozen=True, slots=True, order=True)
class LedgerEntry:
    """Use of ``stream`` over ``[t_start, t_end)`` by a factor."""

    t_start: float
    t_end: float
    stream: str
    factor_id: int
    factor: str
    kind: str
    note: str = ""


class Ledger:
    """Measurements used by the factors of one graph.

    Examples
    --------
    >>> ledger = Ledger()
    >>> ledger.spend(0, "submap 0", ["laser", "odometry"], (0.0, 10.0))
    >>> ledger.spend(1, "between x0 x1", ["odometry"], (9.0, 11.0))
    Traceback (most recent call last):
    ...
    graphslam.core.errors.EvidenceReusedError: between x0 x1 would use stream 'odometry' over [9.000, 11.000) s a \
second time: submap 0 used it over [0.000, 10.000) s
    """

    def __init__(self) -> None:
        self._kinds = dict(DECLARED)
        self._exclusive: dict[str, list[LedgerEntry]] = {}  # stream -> entries sorted by start; they never overlap
        self._by_factor: dict[int, list[LedgerEntry]] = {}

    def declare(self, kind: str, reason: str) -> None:
        """Declare a kind of factor that may share measurements, with the reason."""
        if kind == EXCLUSIVE or not reason.strip():
            raise ConfigError(f"ledger kind {kind!r} needs a name of its own and a reason")
        self._kinds[kind] = reason

    @property
    def kinds(self) -> dict[str, str]:
        """Declared kinds and their reasons."""
        return dict(self._kinds)

    def conflict(self, stream: str, interval: tuple[float, float]) -> LedgerEntry | None:
        """The entry that already uses ``stream`` over an overlapping interval, or None."""
        t0, t1 = interval
        entries = self._exclusive.get(stream, [])
        i = bisect_right(entries, t0, key=lambda e: e.t_start)
        # the one that starts at or before t0, and the first that starts after it
        for e in entries[max(i - 1, 0) : i + 1]:
            if _overlap(e.t_start, e.t_end, t0, t1):
                return e
        return None

    def check(self, factor: str, streams: Iterable[str], interval: tuple[float, float], kind: str = EXCLUSIVE) -> None:
        """Raise the errors of :meth:`spend` without an entry."""
        t0, t1 = interval
        if not (np.isfinite(t0) and np.isfinite(t1) and t0 <= t1):
            raise DataError(f"interval of {factor} cannot be entered in the ledger", got=interval, wanted="t0 <= t1")
        if kind != EXCLUSIVE:
            if kind not in self._kinds:
                raise ConfigError(f"ledger kind {kind!r} is not declared; known: {EXCLUSIVE}, {', '.join(self._kinds)}")
            return
        for stream in streams:
            e = self.conflict(stream, interval)
            if e is not None:
                raise EvidenceReusedError(
                    f"{factor} would use stream {stream!r} over [{t0:.3f}, {t1:.3f}) s a second time: "
                    f"{e.factor} used it over [{e.t_start:.3f}, {e.t_end:.3f}) s"
                )

    def spend(
        self,
        factor_id: int,
        factor: str,
        streams: Iterable[str],
        interval: tuple[float, float],
        kind: str = EXCLUSIVE,
    ) -> None:
        """Add the entries of one factor; all streams or none (see :meth:`check` for the errors)."""
        names = sorted(set(streams))
        self.check(factor, names, interval, kind)
        note = self._kinds[kind] if kind != EXCLUSIVE else ""
        for stream in names:
            e = LedgerEntry(float(interval[0]), float(interval[1]), stream, factor_id, factor, kind, note)
            if kind == EXCLUSIVE:
                insort(self._exclusive.setdefault(stream, []), e)
            self._by_factor.setdefault(factor_id, []).append(e)

    def enter(self, factor_id: int, factor: str, evidence: EvidenceUse | str) -> str:
        """Add the use of one factor, or a declared kind without streams; returns the kind."""
        use = EvidenceUse((), (0.0, 0.0), evidence) if isinstance(evidence, str) else evidence
        if use.kind == EXCLUSIVE and not use.streams:
            raise ConfigError(f"{factor} must name the streams and the interval that it uses")
        self.spend(factor_id, factor, use.streams or ["-"], use.interval, use.kind)
        return use.kind

    def release(self, factor_id: int) -> None:
        """Remove the entries of a removed factor."""
        for e in self._by_factor.pop(factor_id, []):
            if e.kind == EXCLUSIVE:
                entries = self._exclusive[e.stream]
                del entries[bisect_left(entries, e)]

    def as_start(self) -> Ledger:
        """The same entries with kind ``start``, so that a refinement can use their streams again."""
        out = Ledger()
        for e in self.entries():
            out.spend(e.factor_id, e.factor, [e.stream], (e.t_start, e.t_end), "start")
        return out

    def entries(self) -> list[LedgerEntry]:
        """All entries sorted by time."""
        return sorted(e for es in self._by_factor.values() for e in es)

    def __len__(self) -> int:
        return sum(len(es) for es in self._by_factor.values())

    def rows(self) -> list[dict[str, Any]]:
        """One row per factor and stream, with :data:`COLUMNS`, sorted by time."""
        return [{c: getattr(e, c) for c in COLUMNS} for e in self.entries()]

    def table(self) -> pd.DataFrame:
        """The ledger as a table: one row per factor and stream."""
        return data_frame(self.rows(), COLUMNS)

    def _repr_html_(self) -> str:
        return html_table(self.rows(), COLUMNS)


def _overlap(a0: float, a1: float, b0: float, b1: float) -> bool:
    """Do two half-open intervals overlap? An empty one counts as an instant."""
    if a0 == a1 and b0 == b1:
        return a0 == b0
    if a0 == a1:
        return b0 <= a0 < b1
    if b0 == b1:
        return a0 <= b0 < a1
    return a0 < b1 and b0 < a1
