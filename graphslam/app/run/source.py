"""A log, whatever names it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from graphslam.core.errors import MissingDataError
from graphslam.core.log import SensorLog
from graphslam.io.catalog import load


def load_log_source(source: str | Path | SensorLog, **options: Any) -> SensorLog:
    """A log from a card name, a folder on disk, or itself; ``options`` are for the reader."""
    if isinstance(source, SensorLog):
        return source
    log = load(source, **options)
    if not isinstance(log, SensorLog):
        raise MissingDataError(
            f"{source} holds no sensor log", got=type(log).__name__, wanted="a log of sensor streams"
        )
    return log
