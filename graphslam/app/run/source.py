"""A log, whatever names it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from graphslam.core.errors import MissingDataError
from graphslam.core.log import SensorLog
from graphslam.io.catalog import load


def load_log_source(source: str | Path | SensorLog, *, reader: str | None = None, **options: Any) -> SensorLog:
    """A log from a card name, a file or folder on disk, or itself; ``options`` are for the reader."""
    if isinstance(source, SensorLog):
        return source
    log = load(source, reader=reader, **options)
    if not isinstance(log, SensorLog):
        verb = "solve" if isinstance(log, Path) else "join" if isinstance(log, list) else ""
        kind = {"solve": "a pose network", "join": "submaps"}.get(verb, type(log).__name__)
        wanted = "a log of sensor streams" + (f"; this is for `graphslam {verb} {source}`" if verb else "")
        raise MissingDataError(f"{source} holds no sensor log", got=kind, wanted=wanted)
    return log
