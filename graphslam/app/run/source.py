"""Load a log from a name, file or folder, or the log of a run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from graphslam.core.errors import DataError, GraphSlamError, MissingDataError
from graphslam.core.log import SensorLog
from graphslam.io.catalog import load_recording
from graphslam.io.log_digest import log_digest


def load(source: str | Path | SensorLog, *, reader: str | None = None, **options: Any) -> SensorLog:
    """Load a sensor log by data set name, or from a file or folder.

    Parameters
    ----------
    source : str, path or SensorLog
        Name of a data set (``graphslam data list``), or a file or folder in a known format. A log is not changed.
    reader : str, optional
        Name of the reader (``graphslam data readers``). Default: the one that recognises the source.
    **options
        For the reader.

    Returns
    -------
    SensorLog

    Raises
    ------
    UnknownNameError, MissingDataError, FormatError

    Examples
    --------
    >>> again = gs.load("logs/field")
    >>> again.slice(0.0, 10.0).duration <= 10.0
    True
    """
    if isinstance(source, SensorLog):
        return source
    log = load_recording(source, reader=reader, **options)
    if not isinstance(log, SensorLog):
        verb = "solve" if isinstance(log, Path) else "join" if isinstance(log, list) else ""
        kind = {"solve": "a pose network", "join": "submaps"}.get(verb, type(log).__name__)
        wanted = "a log of sensor streams" + (f"; this is for `graphslam {verb} {source}`" if verb else "")
        raise MissingDataError(f"{source} holds no sensor log", got=kind, wanted=wanted)
    return log


def log_of_run(settings: Mapping[str, Any], log: str | Path | SensorLog | None = None) -> SensorLog:
    """Read the log of a run once more.

    Parameters
    ----------
    settings : mapping
        Table ``run`` of the run's ``config.toml``: ``source`` as given by the user, and the digest ``log``.
    log : str, path or SensorLog, optional
        Where the log is now. Default: its original location; a relative path starts at the working directory.
    """
    try:
        source = load(settings["source"] if log is None else log)
    except GraphSlamError as error:
        if log is not None or Path(settings["source"]).exists():
            raise
        raise MissingDataError(
            "the log of the run cannot be read from this folder",
            where=settings["source"],
            got="no data set or path of this name",
            wanted="the folder in which the run was started, or where the log is now (--log, log=…)",
        ) from error
    digest = log_digest(source)
    if settings.get("log", digest) != digest:
        raise DataError("this is not the log of the run", where=source.name, got=digest, wanted=settings["log"])
    return source
