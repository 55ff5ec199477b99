"""A sensor log: named streams on one clock, optional ground truth, counts of dropped records."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError, MissingDataError
from graphslam.core.geometry import Array
from graphslam.core.markup import html_element, html_table, item_list, join_parts
from graphslam.core.records import Stream, check_times
from graphslam.core.sketch import coverage_bar, plan_sketch
from graphslam.core.trajectory import Trajectory

FAR_FIX = "far from all other fixes"
"""Reason for a dropped fix, reported by a check of the log."""


@dataclass
class DropCounter:
    """Counts dropped records by reason."""

    counts: Counter[str] = field(default_factory=Counter)

    def drop(self, stream: str, reason: str, n: int = 1) -> None:
        """Count ``n`` records of ``stream`` dropped for ``reason``."""
        if n:
            self.counts[f"{stream}: {reason}"] += int(n)


@dataclass(frozen=True, slots=True)
class BeamLabels:
    """Labels of the moving objects that the beams of a stream hit.

    Parameters
    ----------
    times : (n,)
        Stamps of the records.
    labels : (n, m) int16
        Number of the object; -1: nothing, or a static object.
    """

    times: Array
    labels: npt.NDArray[np.int16]

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", check_times(self.times))
        labels = np.asarray(self.labels)
        if labels.ndim != 2 or len(labels) != len(self.times) or labels.dtype.kind not in "iu":
            raise DataError("labels do not fit the records", got=labels.shape, wanted=f"({len(self.times)}, m), whole")
        object.__setattr__(self, "labels", np.ascontiguousarray(labels, dtype=np.int16))

    def of(self, times: Array) -> npt.NDArray[np.int16]:
        """Labels ``(k, m)`` of the records with these stamps ``(k,)``, e.g. of a part of the log."""
        k = np.clip(np.searchsorted(self.times, times), 0, max(len(self.times) - 1, 0))
        if len(times) and (not len(self.times) or np.any(self.times[k] != times)):
            raise DataError("a stamp that no labelled record has", got=len(times), wanted="stamps of the stream")
        return self.labels[k]


@dataclass(frozen=True, slots=True, repr=False)
class Truth:
    """Ground truth from a simulator or a survey.

    Parameters
    ----------
    trajectory : Trajectory
        True base poses, in the frame of the first base.
    landmark_ids : (n,) int64
    landmarks : (n, dim)
        True positions in the same frame.
    moving : mapping of str to BeamLabels
        By stream: labels of beams that hit moving objects.
    """

    trajectory: Trajectory
    landmark_ids: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    landmarks: Array = field(default_factory=lambda: np.zeros((0, 2)))
    moving: Mapping[str, BeamLabels] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"Truth({self.trajectory!r}, {len(self.landmarks)} landmarks)"


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorLog:
    """Named sensor streams on one clock.

    Parameters
    ----------
    name : str
    streams : mapping of str to Stream
    truth : Truth or None
    read, dropped : mapping of str to int
        Records read per stream, and records dropped per "stream: reason".
    meta : mapping
        Additional entries for a report (source, noise, seed …); JSON-serialisable.

    Examples
    --------
    >>> log["landmarks"].times[:3]
    array([0.2, 0.4, 0.6])
    >>> log.slice(0.0, 10.0)
    SensorLog('landmark-field': controls (401), landmarks (50); truth known)
    """

    name: str
    streams: Mapping[str, Stream]
    truth: Truth | None = None
    read: Mapping[str, int] = field(default_factory=dict)
    dropped: Mapping[str, int] = field(default_factory=dict)
    meta: Mapping[str, Any] = field(default_factory=dict)

    def __getitem__(self, stream: str) -> Any:
        try:
            return self.streams[stream]
        except KeyError:
            raise MissingDataError(
                f"log has no stream {stream!r}", where=self.name, wanted=", ".join(self.streams)
            ) from None

    def __contains__(self, stream: str) -> bool:
        return stream in self.streams

    def of_type(self, kind: type) -> str | None:
        """Name of the first stream of that record type, or None."""
        return next((name for name, s in self.streams.items() if isinstance(s, kind)), None)

    @property
    def interval(self) -> tuple[float, float]:
        """First and last stamp over all streams [s]."""
        spans = [(s.times[0], s.times[-1]) for s in self.streams.values() if len(s.times)]
        if not spans:
            raise MissingDataError("log is empty", where=self.name)
        return float(min(a for a, _ in spans)), float(max(b for _, b in spans))

    @property
    def duration(self) -> float:
        """Seconds from first to last stamp."""
        a, b = self.interval
        return b - a

    def slice(self, t_start: float, t_end: float) -> SensorLog:
        """Records with ``t_start <= t <= t_end`` [s]."""
        cut = {}
        for name, s in self.streams.items():
            i, j = np.searchsorted(s.times, t_start, "left"), np.searchsorted(s.times, t_end, "right")
            cut[name] = s.take(slice(int(i), int(j)))
        return replace(self, streams=cut, read={})  # the counts are those of the whole log

    def events(self) -> Iterator[tuple[float, str, int]]:
        """Merge the streams in time order: yields (time, stream, record index); equal times by stream name."""
        names = sorted(self.streams)
        times = np.concatenate([self.streams[n].times for n in names])
        which = np.concatenate([np.full(len(self.streams[n].times), k) for k, n in enumerate(names)])
        index = np.concatenate([np.arange(len(self.streams[n].times)) for n in names])
        for k in np.lexsort((which, times)):
            yield float(times[k]), names[which[k]], int(index[k])

    def __repr__(self) -> str:
        streams = ", ".join(f"{n} ({len(s.times)})" for n, s in self.streams.items())
        return f"SensorLog({self.name!r}: {streams}; truth {'known' if self.truth else 'unknown'})"

    def _repr_html_(self) -> str:
        rows: list[dict[str, object]] = []
        ends = [float(t) for s in self.streams.values() if len(s.times) for t in (s.times[0], s.times[-1])]
        for name, s in self.streams.items():
            first, last = (f"{s.times[0]:.2f}", f"{s.times[-1]:.2f}") if len(s.times) else (None, None)
            kind, n = type(s).__name__, len(s.times)
            bar = coverage_bar(s.times, min(ends), max(ends)) if len(s.times) else None
            rows.append({"stream": name, "kind": kind, "records": n, "from s": first, "to s": last, "when": bar})
        span = f"{self.duration:.1f} s" if any(len(s.times) for s in self.streams.values()) else "empty"
        lost = sum(self.dropped.values())
        parts: list[str | None] = [
            html_element("b", f"SensorLog {self.name}"),
            f": {span}, {len(rows)} streams, {lost} records dropped, truth {'known' if self.truth else 'unknown'}",
            None if self.truth is None else plan_sketch([self.truth.trajectory.positions], points=self.truth.landmarks),
            html_table(rows, ["stream", "kind", "records", "from s", "to s", "when"]),
        ]
        if self.dropped:
            parts += ["dropped:", item_list(f"{k}: {v}" for k, v in self.dropped.items())]
        return join_parts(parts)
