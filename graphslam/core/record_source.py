"""Where a front end takes its records from: a log that is whole, or one that is still being recorded."""

from __future__ import annotations

from graphslam.core.geometry import Array
from graphslam.core.log import SensorLog
from graphslam.core.records import Stream


class RecordSource:
    """The records of a log that is whole.

    One that grows is a :class:`graphslam.io.growing_log.GrowingLog`. What a front end makes of a feed depends on its
    records alone, never on the portions in which they came.

    Attributes
    ----------
    places : (times (q,), lever (2,)) or None
        Where the path will be measured besides by fixes: control and check points.
    """

    places: tuple[Array, Array] | None = None

    def __init__(self, log: SensorLog) -> None:
        self._log = log

    @property
    def name(self) -> str:
        """Of the log."""
        return self._log.name

    @property
    def ended(self) -> bool:
        """Will no more records come?"""
        return True

    @property
    def log(self) -> SensorLog:
        """The log; of one that grows there is none before it has ended."""
        return self._log

    def names(self, kind: type) -> list[str]:
        """Names of the streams of that record type, those that have come."""
        return [name for name, stream in self._log.streams.items() if isinstance(stream, kind)]

    def of_type(self, kind: type) -> str | None:
        """Name of the first stream of that record type, or None."""
        return next(iter(self.names(kind)), None)

    def count(self, stream: str) -> int:
        """Records of a stream that have come."""
        return len(self._log[stream].times)

    def until(self, stream: str) -> float:
        """Stamp of the last record of a stream that has come [s]; -inf where none has."""
        times = self._log[stream].times
        return float(times[-1]) if len(times) else -float("inf")

    def part(self, stream: str, first: int = 0, last: int | None = None) -> Stream:
        """Records ``first … last - 1`` of a stream, by default to the last that has come."""
        whole: Stream = self._log[stream]
        return whole if first == 0 and last is None else whole.take(slice(first, last))

    def discard_before(self, stream: str, before: int) -> None:
        """Say that records before ``before`` will not be asked for again before the log has ended."""
