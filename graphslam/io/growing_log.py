"""A log during recording: records are added one by one, and used scans are freed from memory and kept on disk."""

from __future__ import annotations

import os
from bisect import bisect_left, bisect_right
from collections.abc import Mapping
from itertools import accumulate
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from graphslam.core.errors import DataError, MissingDataError
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.point_clouds import PointClouds
from graphslam.core.range_scans import RangeScans
from graphslam.core.record_source import RecordSource
from graphslam.core.records import LaserScans, Stream
from graphslam.io.log_kinds import StreamKind, kind_name, stream_kinds

BEAMS = (LaserScans, RangeScans, PointClouds)
"""Streams whose records are freed from memory; others are small and needed for the metrics at the end."""
ROWS = ("n", "q")
"""Symbols of array lengths that grow with the records."""


class GrowingLog(RecordSource):
    """A log to which records are added one by one, or in portions.

    A portion is a stream with one or more records. Constants of the sensor (mounting, limits, noise) must be the same
    in all portions. Scans (:data:`BEAMS`) are written to disk at once and stay in memory until the front end has used
    them; after the end of the log they are read from disk on access. All other streams stay in memory.

    Parameters
    ----------
    folder : path
        Folder for the scans; must exist as long as the log is used.
    meta : mapping, optional
        See :class:`~graphslam.core.log.SensorLog`.
    """

    def __init__(self, name: str, folder: str | os.PathLike[str], meta: Mapping[str, Any] | None = None) -> None:
        self._name, self._folder, self._meta = name, Path(folder), dict(meta or {})
        self._held: dict[str, _Held] = {}
        self.drops = DropCounter()
        """Records that were not added."""
        self._whole: SensorLog | None = None

    def add(self, stream: str, records: Stream) -> None:
        """Append records. Those that are not later than the stream so far (late, or given twice) are dropped, and
        counted in `SensorLog.dropped`."""
        if self.ended:
            raise DataError("records after the end of the log", where=f"{self._name}/{stream}")
        if not len(records.times):
            return
        if stream not in self._held:
            self._held[stream] = _Held(f"{self._name}/{stream}", records, self._folder / f"{len(self._held):03d}")
        held = self._held[stream]
        late = (
            0 if type(records) is not held.kind.cls else int(np.searchsorted(records.times, held.until, side="right"))
        )
        if late:
            self.drops.drop(stream, "records that came late or twice", late)
            records = records.take(slice(late, None))
        if len(records.times):
            held.add(records)

    def end(self) -> None:
        """End the log; no record can be added afterwards."""
        if self._whole is None:
            streams = {name: held.whole() for name, held in self._held.items()}
            self._whole = SensorLog(name=self._name, streams=streams, meta=self._meta, dropped=self.drops.counts)

    @property
    def name(self) -> str:
        """See :class:`~graphslam.core.record_source.RecordSource`."""
        return self._name

    @property
    def ended(self) -> bool:
        """See :class:`~graphslam.core.record_source.RecordSource`."""
        return self._whole is not None

    @property
    def log(self) -> SensorLog:
        """See :class:`~graphslam.core.record_source.RecordSource`."""
        if self._whole is None:
            raise DataError("the log has not ended", where=self._name)
        return self._whole

    def names(self, kind: type) -> list[str]:
        """See :class:`~graphslam.core.record_source.RecordSource`."""
        return [name for name, held in self._held.items() if issubclass(held.kind.cls, kind)]

    def count(self, stream: str) -> int:
        """See :class:`~graphslam.core.record_source.RecordSource`."""
        return self._of(stream).ends[-1] if self.ended or stream in self._held else 0

    def until(self, stream: str) -> float:
        """See :class:`~graphslam.core.record_source.RecordSource`."""
        return self._of(stream).until if self.ended or stream in self._held else -np.inf

    def part(self, stream: str, first: int = 0, last: int | None = None) -> Stream:
        """See :class:`~graphslam.core.record_source.RecordSource`."""
        if self._whole is not None:
            whole: Stream = self._whole[stream]
            return whole.take(slice(first, last))
        held = self._of(stream)
        return held.part(first, held.ends[-1] if last is None else min(last, held.ends[-1]))

    def discard_before(self, stream: str, before: int) -> None:
        """See :class:`~graphslam.core.record_source.RecordSource`; frees scans from memory."""
        if self._whole is None:
            self._of(stream).discard_before(before)

    @property
    def held_records(self) -> dict[str, int]:
        """Number of records in memory, by stream."""
        return {name: held.ends[-1] - held.ends[0] for name, held in self._held.items()}

    def _of(self, stream: str) -> _Held:
        if stream not in self._held:
            raise MissingDataError(f"no record of stream {stream!r} has come", where=self._name)
        return self._held[stream]


class _Held:
    """One stream: its portions in memory and, of beams, all of it on disk."""

    def __init__(self, where: str, first: Stream, folder: Path) -> None:
        found = stream_kinds()[kind_name(first, where)]
        self.where, self.kind = where, found
        self.until = -np.inf
        self.parts: list[Stream] = []
        self.ends = [0]  # first record in memory, then where each portion ends
        arrays = found.arrays(first)
        self.names, self.constants = set(arrays), _constants(found, arrays)
        self.spool = _Spool(found, folder) if found.cls in BEAMS else None

    def add(self, records: Stream) -> None:
        if type(records) is not self.kind.cls:
            raise DataError(
                "records of another kind", where=self.where, got=type(records).__name__, wanted=self.kind.cls.__name__
            )
        arrays = self.kind.arrays(records)
        if set(arrays) != self.names:
            odd = ", ".join(sorted(set(arrays) ^ self.names))
            raise DataError("some records have what others lack", where=self.where, got=odd, wanted="all or none")
        other = _constants(self.kind, arrays)
        for name in other:
            a, b = self.constants[name], other[name]
            if not np.array_equal(a, b):
                raise DataError(
                    f"{name} is not that of the records before", where=self.where, got=b, wanted=f"{a}: one sensor"
                )
        if self.spool is not None:
            self.spool.append(arrays)
        self.parts.append(records)
        self.ends.append(self.ends[-1] + len(records.times))
        self.until = float(records.times[-1])
        while self.spool is None and len(self.parts) > 1 and 2 * self.ends[-2] <= self.ends[-1] + self.ends[-3]:
            self.parts[-2:] = [join_portions(self.kind, self.parts[-2:])]  # so there are only a few portions
            del self.ends[-2]

    def part(self, first: int, last: int) -> Stream:
        if first < self.ends[0]:
            raise DataError("records that were already freed", where=self.where, got=first, wanted=f"≥ {self.ends[0]}")
        if first == self.ends[0] and last == self.ends[-1] and len(self.parts) > 1:
            self.parts, self.ends = [join_portions(self.kind, self.parts)], [first, last]  # merged once for later calls
        a = min(bisect_right(self.ends, first), len(self.parts)) - 1
        b = max(bisect_left(self.ends, last), a + 1)
        here = [p.take(slice(max(first - e, 0), last - e)) for p, e in zip(self.parts[a:b], self.ends[a:b])]
        return here[0] if len(here) == 1 else join_portions(self.kind, here)

    def discard_before(self, before: int) -> None:
        if self.spool is None:
            return
        k = bisect_right(self.ends, before) - 1
        self.parts, self.ends = self.parts[k:], self.ends[k:]

    def whole(self) -> Stream:
        if self.spool is None:
            return self.part(0, self.ends[-1])
        self.parts, self.ends = [], self.ends[-1:]
        stream: Stream = self.kind.stream({**self.constants, **self.spool.arrays()}, self.where)
        return stream


class _Spool:
    """Growing arrays on disk: raw numbers, one file per array."""

    def __init__(self, kind: StreamKind, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.kind, self.folder = kind, folder
        self.files: dict[str, BinaryIO] = {}
        self.like: dict[str, Any] = {}
        self.rows: dict[str, int] = {}
        self.sizes: dict[str, list[int]] = {}  # for offsets (length "n+1"): rows of each record

    def append(self, arrays: Mapping[str, Any]) -> None:
        for name in self._growing() & set(arrays):
            a = np.ascontiguousarray(arrays[name])
            if name not in self.files:
                self.files[name] = (self.folder / name).open("wb")
                self.like[name], self.rows[name] = a[:0], 0
            if a.dtype != self.like[name].dtype or a.shape[1:] != self.like[name].shape[1:]:
                raise DataError(
                    f"{name} of another type or shape", where=str(self.folder), got=f"{a.dtype} {a.shape[1:]}"
                )
            a.tofile(self.files[name])
            self.rows[name] += len(a)
        for name in self._offsets() & set(arrays):
            self.sizes.setdefault(name, []).extend(np.diff(arrays[name]).tolist())

    def arrays(self) -> dict[str, Any]:
        """All arrays as memory maps."""
        out: dict[str, Any] = {}
        for name, file in self.files.items():
            file.close()
            like, shape = self.like[name], (self.rows[name], *self.like[name].shape[1:])
            empty = 0 in shape
            path = self.folder / name
            out[name] = np.zeros(shape, like.dtype) if empty else np.memmap(path, like.dtype, "r", shape=shape)
        return out | {n: np.array([0, *accumulate(s)], dtype=np.int64) for n, s in self.sizes.items()}

    def _growing(self) -> set[str]:
        return {n for n, f in {**self.kind.fields, **self.kind.more}.items() if f.shape and f.shape[0] in ROWS}

    def _offsets(self) -> set[str]:
        return {n for n, f in {**self.kind.fields, **self.kind.more}.items() if f.shape and f.shape[0] == "n+1"}


def join_portions(kind: StreamKind, parts: list[Stream]) -> Any:
    """Concatenate portions of one stream."""
    arrays = [kind.arrays(p) for p in parts]
    out = dict(arrays[0])
    for name, f in {**kind.fields, **kind.more}.items():
        if not f.shape or name not in out:
            continue
        if f.shape[0] in ROWS:
            out[name] = np.concatenate([a[name] for a in arrays])
        elif f.shape[0] == "n+1":
            sizes = np.concatenate([np.diff(a[name]) for a in arrays])
            out[name] = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    return kind.stream(out, "records")


def _constants(kind: StreamKind, arrays: Mapping[str, Any]) -> dict[str, Any]:
    """Arrays that are the same for all records."""
    shapes = {n: f.shape for n, f in {**kind.fields, **kind.more}.items()}
    return {n: a for n, a in arrays.items() if not (shapes.get(n) and shapes[n][0] in (*ROWS, "n+1"))}
