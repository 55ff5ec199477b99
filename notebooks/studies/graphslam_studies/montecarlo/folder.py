"""Folder of a study: one file a finished trial, written whole or not at all, and tables that are made from them.

``study.json``, ``trials/<world>/000012.npz``, ``table.csv``, ``timings.csv``, ``report.md``, ``figures/``. The folder
only grows: the tables hold every finished trial in it, whichever call made it, so they do not depend on how often the
study was stopped, nor on what ran the trials. Tables, report and figures are one state, replaced as a whole
(:mod:`graphslam.app.folders.generations`).
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from graphslam.app.folders.generations import check_links, is_empty, remove_stale_files
from graphslam.core.atomic import read_json, read_npz, sweep_parts, write_json, write_npz
from graphslam.core.errors import FormatError, MissingDataError, RunFolderError
from graphslam.core.lock import lock_folder, make_folder
from graphslam.core.npz import flags, floats, ints, texts
from graphslam_studies.montecarlo.trials import Measurement

logger = logging.getLogger(__name__)

STUDY_FORMAT = "graphslam.study/1"
TRIAL_FORMAT = "graphslam.trial/1"
_IDENTITY = {"name": str, "seed": int, "quick": bool, "worlds": {str: str}, "versions": {str: str}}
_TRIAL = {
    **dict.fromkeys(("world", "error", "details", "source"), texts()),
    **dict.fromkeys(("run", "seed"), ints()),
    "algorithms": texts("a"),
    "quantities": texts("q"),
    **dict.fromkeys(("algorithm", "quantity", "submap"), ints("n")),
    "value": floats("n", finite=None),
    "timing": flags("n"),
}
SAME_BYTES = ("study.json", "table.csv")
"""Files of a study that are the same bytes however often it was stopped; trials, timings and what is made of them hold
times."""
TABLE_COLUMNS = ("world", "run", "algorithm", "submap", "quantity", "value")


@dataclass(frozen=True)
class TrialRecord:
    """A finished trial as it lies on disk.

    Parameters
    ----------
    error : str or None
        Why it failed; then it has no figures.
    details : str or None
        Traceback of the error.
    source : str
        Digest of the code that ran it.
    figures, timings : DataFrame
        ``algorithm, submap, quantity, value``.
    """

    world: str
    run: int
    seed: int
    error: str | None
    details: str | None
    source: str
    figures: pd.DataFrame
    timings: pd.DataFrame


@dataclass(frozen=True)
class Collected:
    """All finished trials of a folder.

    Parameters
    ----------
    table, timings : DataFrame
        ``world, run, algorithm, submap, quantity, value``.
    failures : DataFrame
        ``world, run, seed, error``.
    sources : frozenset of str
        Digests of the code that ran the trials; more than one where the code was changed in between.
    """

    table: pd.DataFrame
    timings: pd.DataFrame
    failures: pd.DataFrame
    sources: frozenset[str]


class StudyFolder:
    """Starts, reopens, fills and reads the folder of one study."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)

    @classmethod
    @contextmanager
    def start(cls, path: str | os.PathLike[str], identity: Mapping[str, Any]) -> Iterator[StudyFolder]:
        """Make a new folder, or go on with one of the same study; no other process writes into it until the block ends.

        Parameters
        ----------
        identity : mapping
            What must be the same for trials to belong together (JSON values): name, seed, configuration, versions.
        """
        folder = cls(path)
        make_folder(folder.path)
        marker = folder.path / "study.json"
        if not marker.is_file() and not is_empty(folder.path):  # before a lock is put there
            raise RunFolderError(f"{folder.path}: not empty and not a study; choose another --out")
        with lock_folder(folder.path):
            if marker.is_file():
                folder._check_same(identity)
            else:
                check_links(folder.path)
                write_json(marker, {"format": STUDY_FORMAT, **identity})
            remove_stale_files(folder.path)
            for trials in (folder.path / "trials").glob("*"):
                sweep_parts(trials)
            yield folder

    def identity(self) -> dict[str, Any]:
        """What the folder's ``study.json`` says."""
        check_links(self.path)
        value = read_json(self.path / "study.json", fmt=STUDY_FORMAT, shape=_IDENTITY)
        value.pop("format")
        return value

    def _check_same(self, identity: Mapping[str, Any]) -> None:
        """Trials of two studies, or of one study under two versions of a library, make no table."""
        before = _flat(self.identity())
        now = _flat(identity)
        for key in sorted({*before, *now}):
            if before.get(key) != now.get(key):
                raise RunFolderError(
                    f"{self.path}: holds another study: {key} was {before.get(key)!r} and is {now.get(key)!r} now; "
                    "choose another --out"
                )

    def trial_path(self, world: str, run: int) -> Path:
        """File of one trial."""
        return self.path / "trials" / world / f"{run:06d}.npz"

    def write_trial(
        self,
        world: str,
        run: int,
        seed: int,
        values: Iterable[Measurement] = (),
        error: str | None = None,
        details: str | None = None,
        source: str = "",
    ) -> None:
        """Write one finished trial: its figures, or why it failed; and the digest of the code that ran it."""
        measured = list(values)
        algorithms = sorted({m.algorithm for m in measured})
        quantities = sorted({m.quantity for m in measured})
        of_algorithm = {name: k for k, name in enumerate(algorithms)}
        of_quantity = {name: k for k, name in enumerate(quantities)}
        path = self.trial_path(world, run)
        path.parent.mkdir(parents=True, exist_ok=True)
        arrays = {
            "format": TRIAL_FORMAT,
            "world": world,
            "run": np.int64(run),
            "seed": np.int64(seed),
            "error": error or "",
            "details": details or "",
            "source": source,
            "algorithms": np.array(algorithms, dtype=np.str_),
            "quantities": np.array(quantities, dtype=np.str_),
            "algorithm": np.array([of_algorithm[m.algorithm] for m in measured], dtype=np.int64),
            "quantity": np.array([of_quantity[m.quantity] for m in measured], dtype=np.int64),
            "submap": np.array([m.submap for m in measured], dtype=np.int64),
            "value": np.array([m.value for m in measured], dtype=np.float64),
            "timing": np.array([m.timing for m in measured], dtype=np.bool_),
        }
        write_npz(path, arrays)

    def read_trial(self, path: Path) -> TrialRecord:
        """Read one trial."""
        a = read_npz(path, fmt=TRIAL_FORMAT, fields=_TRIAL)
        world, run = str(a["world"]), int(a["run"])
        for name, names in (("algorithm", "algorithms"), ("quantity", "quantities")):
            if len(a[name]) and (a[name].min() < 0 or a[name].max() >= len(a[names])):
                raise FormatError(f"array {name!r} names none of {names!r}", where=str(path), got=a[name].max())
        frame = pd.DataFrame(
            {
                "algorithm": a["algorithms"].astype(object)[a["algorithm"]],
                "submap": a["submap"],
                "quantity": a["quantities"].astype(object)[a["quantity"]],
                "value": a["value"],
            }
        )
        timing, seed = a["timing"], int(a["seed"])
        error, details, source = (str(a[name]) for name in ("error", "details", "source"))
        if path != self.trial_path(world, run):
            raise FormatError("trial of another place", where=str(path), got=f"{world}/{run:06d}")
        return TrialRecord(
            world=world,
            run=run,
            seed=seed,
            error=error or None,
            details=details or None,
            source=source,
            figures=frame[~timing],
            timings=frame[timing],
        )

    def trials(self) -> Iterator[TrialRecord]:
        """All readable trials, in order of world and run; a damaged one is logged and passed over."""
        for path in sorted((self.path / "trials").glob("*/*.npz")):
            if not re.fullmatch(r"\d{6,}", path.stem):
                continue
            try:
                yield self.read_trial(path)
            except (FormatError, MissingDataError) as error:
                logger.warning("%s: passed over, and run again by the next call", error)

    def finished(self) -> dict[tuple[str, int], bool]:
        """Trials that are there, ``(world, run)`` → did it succeed?"""
        return {(t.world, t.run): t.error is None for t in self.trials()}

    def collect(self) -> Collected:
        """Everything that the finished trials found; rows are sorted, so the same trials give the same tables."""
        figures: list[pd.DataFrame] = []
        timings: list[pd.DataFrame] = []
        failures = []
        sources = set()
        for t in self.trials():
            sources.add(t.source)
            for rows, frame in ((figures, t.figures), (timings, t.timings)):
                rows.append(frame.assign(world=t.world, run=t.run)[list(TABLE_COLUMNS)])
            if t.error is not None:
                failures.append((t.world, t.run, t.seed, t.error))
        return Collected(
            table=_tidy(figures),
            timings=_tidy(timings),
            failures=pd.DataFrame(failures, columns=["world", "run", "seed", "error"]),
            sources=frozenset(sources),
        )


def _tidy(frames: list[pd.DataFrame]) -> pd.DataFrame:
    """One sorted table of many; with its columns and types also when empty."""
    full = [f for f in frames if len(f)]
    table = pd.concat(full, ignore_index=True) if full else pd.DataFrame(columns=list(TABLE_COLUMNS))
    table = table.astype({"run": "int64", "submap": "int64", "value": "float64"})
    return table.sort_values(["world", "run", "algorithm", "quantity", "submap"], kind="stable", ignore_index=True)


def _flat(value: Mapping[str, Any], where: str = "") -> dict[str, Any]:
    """Nested mapping as one level of dotted keys."""
    found: dict[str, Any] = {}
    for key, v in value.items():
        name = f"{where}.{key}" if where else str(key)
        found |= _flat(v, name) if isinstance(v, Mapping) else {name: v}
    return found
