"""``graphslam data check``: check a source for errors before a run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from graphslam.app.run.choice import choose_front_end, reading_line
from graphslam.core.errors import GraphSlamError, MissingDataError, UnknownNameError
from graphslam.core.findings import Finding
from graphslam.core.log import SensorLog
from graphslam.core.records import LandmarkObservations
from graphslam.evaluate.log_checks import check_log
from graphslam.evaluate.stream_checks import StreamFinding
from graphslam.io.catalog import load_recording


def check_source(source: str | Path, *, reader: str | None = None, **options: Any) -> list[StreamFinding]:
    """Check a source for errors: its files, their content, and whether a front end can use it.

    Parameters
    ----------
    source : data set name, file or folder
    options
        For the reader.

    Returns
    -------
    list of StreamFinding
        The first line describes the log. An unreadable source is a line of level ``bad``.
    """
    try:
        log = load_recording(source, reader=reader, **options)
    except UnknownNameError:
        raise
    except GraphSlamError as error:
        return [StreamFinding("", Finding("bad", "unreadable", str(error)))]
    if not isinstance(log, SensorLog):
        text = f"{source}: not a sensor log — not checked. `graphslam solve` checks pose-graph files."
        return [StreamFinding("", Finding("", "read", text))]
    findings = [StreamFinding("", Finding("", "read", f"{reading_line(log) or log.name}."))]
    findings += [
        StreamFinding("", Finding("", "left-out", f"dropped by the reader: {n} {what}.")) for what, n in _lost(log)
    ]
    findings += check_log(log)
    if log.of_type(LandmarkObservations):
        text = "not tested: the clock of the observations against that of the odometry — `graphslam calibrate` does."
        findings.append(StreamFinding("", Finding("", "not-tested", text)))
    try:
        choice = choose_front_end(log)
        findings.append(StreamFinding("", Finding("", "front-end", f"front end: {choice.frontend} — {choice.why}.")))
    except MissingDataError as error:
        findings.append(StreamFinding("", Finding("look", "no-front-end", str(error))))
    return findings


def _lost(log: SensorLog) -> list[tuple[str, int]]:
    return [(what, n) for what, n in log.dropped.items() if not what.endswith("(kept)")]


def check_summary(found: list[StreamFinding]) -> str:
    """The last line: number of errors and warnings."""
    bad = sum(n.finding.level == "bad" for n in found)
    look = sum(n.finding.level == "look" for n in found)
    if bad:
        return f"{bad} error{'s' if bad > 1 else ''} found. Correct {'them' if bad > 1 else 'it'} before a run."
    if look:
        return f"No error; check {look} warning{'s' if look > 1 else ''}."
    return "No error found." if any(n.finding.code == "front-end" for n in found) else "Nothing was checked."
