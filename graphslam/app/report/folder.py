"""Data of a report, read from a folder; missing or damaged parts are recorded and are not fatal."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

from graphslam.app.run.files import (
    read_events,
    read_ledger,
    read_map,
    read_merge_report,
    read_metrics,
    read_options,
    read_report,
)
from graphslam.core.atomic import read_json
from graphslam.core.errors import FormatError, GraphSlamError, MissingDataError, RunFolderError
from graphslam.core.npz import read_arrays
from graphslam.core.reading import check_regular
from graphslam.io.submap_store import SubmapStore
from graphslam.loops.ledger import LoopLedger, ledger_of_events

Kind = Literal["run", "interrupted", "merged"]
T = TypeVar("T")
_PNG_HEAD, _PNG_TAIL = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
RESULT = ("run.json", "merge.json", "metrics.json", "map.npz", "merged.npz", "submaps/index.json", "submaps")
"""Parts without which a finished run is damaged."""
MOST_BYTES = 8_000_000
"""A larger picture is not included in the page [bytes]."""


@dataclass
class ReportFolder:
    """All data of a report from one state of a folder.

    Parameters
    ----------
    path : Path
        Folder with the files of the current state.
    home : Path
        The folder itself: configuration, submaps.
    kind : {"run", "interrupted", "merged"}
        A finished run, one without ``run.json``, or merged runs.
    """

    path: Path
    home: Path
    kind: Kind
    config: dict[str, Any] = field(default_factory=dict)
    """``config.toml``."""
    report: dict[str, Any] = field(default_factory=dict)
    """``run.json`` or ``merge.json``."""
    metrics: list[dict[str, Any]] = field(default_factory=list)
    events: list[dict[str, Any]] | None = None
    loops: LoopLedger | None = None
    loop_rows: list[dict[str, Any]] = field(default_factory=list)
    """The rows of ``graphslam loops``, with all gates."""
    ledger: list[dict[str, Any]] | None = None
    submaps: list[dict[str, Any]] = field(default_factory=list)
    """Index of the store."""
    clearest: dict[str, Any] | None = None
    """Other choices of matches, if requested."""
    problems: dict[str, str] = field(default_factory=dict)
    """Part of the folder → why it is not in the report."""

    def damage(self) -> str:
        """What is wrong with the result of a finished run; empty if nothing is."""
        return "; ".join(f"{n} {self.problems[n]}" for n in RESULT if n in self.problems and self.kind != "interrupted")

    @property
    def name(self) -> str:
        """Source of the run, or names of the merged sessions."""
        if self.kind == "merged":
            return " + ".join(str(s.get("name", "?")) for s in self.sessions) or "merged runs"
        run = self.config.get("run", {})
        return str(self.report.get("source", run.get("source", "unknown") if isinstance(run, dict) else "unknown"))

    @property
    def sessions(self) -> list[dict[str, Any]]:
        """Sessions of a merged folder."""
        found = self.report.get("sessions", [])
        return [s for s in found if isinstance(s, dict)] if isinstance(found, list) else []

    def values(self) -> dict[str, float]:
        """Metrics by key; those without a number are omitted."""
        return {
            str(r.get("key")): float(r["value"])
            for r in self.metrics
            if isinstance(r.get("value"), (int, float)) and not isinstance(r["value"], bool)
        }

    def part(self, name: str) -> dict[str, Any]:
        """A mapping inside the report; empty if it is missing or of another type."""
        found = self.report.get(name)
        return found if isinstance(found, dict) else {}

    def figures(self) -> list[tuple[str, bytes]]:
        """Name and bytes of every picture, sorted by name."""
        out = []
        for file in sorted((self.path / "figures").glob("*.png")):
            if file.name.startswith("."):
                continue
            try:
                check_regular(file)
                data = file.read_bytes()
            except (OSError, FormatError) as error:
                why = error.what if isinstance(error, FormatError) else f"cannot be read ({error.strerror})"
                self.problems[f"figures/{file.name}"] = why
                continue
            if not (data.startswith(_PNG_HEAD) and data.endswith(_PNG_TAIL)):
                self.problems[f"figures/{file.name}"] = "is no whole PNG file"
            elif len(data) > MOST_BYTES:
                self.problems[f"figures/{file.name}"] = f"is too large for the page ({len(data) / 1e6:.1f} MB)"
            else:
                out.append((file.name, data))
        return out


def read_folder(path: str | Path, root: Path) -> ReportFolder:
    """Read all existing parts of one state of the folder, whose files are in ``root``."""
    home = Path(path)
    if (root / "merge.json").is_file():
        kind: Kind = "merged"
    elif (root / "run.json").is_file():
        kind = "run"
    elif (home / "config.toml").is_file():
        kind = "interrupted"
    else:
        raise RunFolderError(
            f"{home}: not a run folder (neither config.toml nor merge.json); give the folder of a run, demo or merge"
        )
    out = ReportFolder(root, home, kind)

    def attempt(name: str, read: Callable[[], T], otherwise: T) -> T:
        try:
            return read()
        except (GraphSlamError, OSError) as error:
            known = " ".join(str(error).replace(f"{root}/", "").replace(f"{home}/", "").split())
            out.problems[name] = known if (root / name).exists() or (home / name).exists() else "is not there"
            return otherwise

    if kind == "merged":
        out.report = attempt("merge.json", lambda: read_merge_report(root), {})
    else:
        out.config = attempt("config.toml", lambda: _options(home), {})
        out.submaps = attempt("submaps/index.json", lambda: _index(home), [])
    if kind == "run":
        out.report = attempt("run.json", lambda: read_report(root), {})
    if kind == "interrupted":
        for name in ("run.json", "metrics.json", "events.jsonl", "ledger.csv"):
            out.problems[name] = "is missing; it is written when a run is finished"
        return out
    attempt("map.npz" if kind == "run" else "merged.npz", lambda: _result(root, kind), None)
    if kind == "run":
        attempt("submaps", lambda: _submap_files(home, out.submaps), None)
    out.metrics = attempt("metrics.json", lambda: _metrics(root, "metrics.json"), [])
    out.metrics += attempt("timings.json", lambda: _metrics(root, "timings.json"), [])
    out.events = attempt("events.jsonl", lambda: read_events(root), None)
    if out.events is not None:
        events = out.events
        nothing: tuple[LoopLedger | None, list[dict[str, Any]]] = (None, [])
        out.loops, out.loop_rows = attempt("events.jsonl", lambda: _loops(events), nothing)
    out.ledger = attempt("ledger.csv", lambda: read_ledger(root), None)
    if (root / "clearest.json").is_file():
        out.clearest = attempt(
            "clearest.json", lambda: read_json(root / "clearest.json", fmt="graphslam.clearest/1"), None
        )
    return out


def _options(root: Path) -> dict[str, Any]:
    if not (root / "config.toml").exists():
        raise MissingDataError("no such file", where="config.toml")
    return read_options(root)


def _result(root: Path, kind: Kind) -> None:
    if kind == "run":
        read_map(root)
    else:
        read_arrays(root / "merged.npz")


def _submap_files(home: Path, entries: list[dict[str, Any]]) -> None:
    """Refuse a store of which a file is missing or cut; what is in them is not read."""
    for entry in entries:
        file = home / "submaps" / str(entry.get("file"))
        check_regular(file)
        if not zipfile.is_zipfile(file):
            raise FormatError("is missing or cut", where=f"submaps/{file.name}")


def _metrics(root: Path, name: str) -> list[dict[str, Any]]:
    """Rows of the metrics; NaN becomes None."""
    return [r if r["value"] == r["value"] else {**r, "value": None} for r in read_metrics(root, name)]


def _index(root: Path) -> list[dict[str, Any]]:
    if not (root / "submaps" / "index.json").is_file():
        raise RunFolderError("no finished submap")
    return SubmapStore(root / "submaps").entries


def _loops(events: list[dict[str, Any]]) -> tuple[LoopLedger | None, list[dict[str, Any]]]:
    ledger = ledger_of_events(events, where="events.jsonl")
    rows = ledger.rows()
    for row, d in zip(rows, ledger.current()):
        row["gates"] = {k: v for k, v in (d.gates or {}).items() if v is not None and v == v}
    return ledger, rows
