"""Record sources of front ends: a complete log, or one that is still being recorded."""

from __future__ import annotations

from graphslam.core.geometry import Array
from graphslam.core.log import SensorLog
from graphslam.core.records import Stream


class RecordSource:
    """The records of a complete log.

    A growing log is a :class:`graphslam.io.growing_log.GrowingLog`. The output of a front end depends only on the
    records, not on the portions in which they arrive.

    Attributes
    ----------
    places : (times (q,), lever (2,)) or None
        Times and antenna lever of additional path measurements: control and check points.
    """

    places: tuple[Array, Array] | None = None

    def __init__(self, log: SensorLog) -> None:
        self._log = log

    @property
    def name(self) -> str:
        """Name of the log."""
        return self._log.name

    @property
    def ended(self) -> bool:
        """Whether no more records will come."""
        return True

    @property
    def log(self) -> SensorLog:
        """The log; a growing log has none before its end."""
        return self._log

    def names(self, kind: type) -> list[str]:
        """Names of the streams of that record type so far."""
        return [name for name, stream in self._log.streams.items() if isinstance(stream, kind)]

    def of_type(self, kind: type) -> str | None:
        """Name of the first stream of that record type, or None."""
        return next(iter(self.names(kind)), None)

    def count(self, stream: str) -> int:
        """Number of records of a stream so far."""
        return len(self._log[stream].times)

    def until(self, stream: str) -> float:
        """Stamp of the last record of a stream so far [s]; -inf if there is none."""
        times = self._log[stream].times
        return float(times[-1]) if len(times) else -float("inf")

    def part(self, stream: str, first: int = 0, last: int | None = None) -> Stream:
        """Records ``first … last - 1`` of a stream; default: to the last one so far."""
        whole: Stream = self._log[stream]
        return whole if first == 0 and last is None else whole.take(slice(first, last))

    def discard_before(self, stream: str, before: int) -> None:
        """Allow dropping records before ``before``: they are not needed again before the end of the log."""
