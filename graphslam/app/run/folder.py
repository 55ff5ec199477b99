"""The folder of a run: complete after a crash up to the last finished submap, resumable from there.

``config.toml`` (effective) and ``submaps/`` are written during the run; everything else is one state, written by
:mod:`graphslam.app.run.outputs` and replaced as a whole (:mod:`graphslam.app.folders.generations`).
"""

from __future__ import annotations

import logging
import os
import re
import shutil
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from graphslam.app.folders.generations import check_links, current_outputs, is_empty, remove_stale_files
from graphslam.app.run.files import removed_loops_of_run
from graphslam.core.atomic import atomic_open, read_json, write_json
from graphslam.core.config import dump_toml, read_toml
from graphslam.core.errors import ConfigError, RunFolderError
from graphslam.core.lock import lock_folder, make_folder
from graphslam.core.reading import resolve_inside
from graphslam.io.submap_store import GridLoader, SubmapStore
from graphslam.loops.ledger import LoopDecision

logger = logging.getLogger(__name__)
CONFIG, SUBMAPS, DRAWS = "config.toml", "submaps", "draws.json"
_DRAWS_FORMAT = "graphslam.draws/1"
_BEATEN = "submaps-beaten"
_ANOTHER = re.compile(r"submaps-(beaten|\d)")


@dataclass(frozen=True, slots=True)
class SeedChoice:
    """Random draw of the submaps in a folder, if several were made.

    Parameters
    ----------
    draw : int
        0 is the first one.
    attempts : list of dict
        Rows of the rejected draws: loops, and contradictions in their maps.
    """

    draw: int
    attempts: list[dict[str, Any]]


class RunFolder:
    """Creates and reopens a run folder."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)

    @classmethod
    @contextmanager
    def start(
        cls, path: str | os.PathLike[str] | None, config: Mapping[str, Any], *, resume: bool
    ) -> Iterator[RunFolder | None]:
        """Make a new folder, or reopen one with the same configuration and log. It is locked for other processes until
        the block ends. Without a path there is no folder.

        A folder without a finished submap is started anew.
        """
        if path is None:
            yield None
            return
        cls.check(path, resume=resume)
        folder = cls(path)
        make_folder(folder.path)
        with lock_folder(folder.path):
            check_links(folder.path)
            old = folder.path / CONFIG
            if folder._begun():
                folder._refuse_second(resume)
                folder._check_same(old, config)
            else:
                folder.describe(config)
            folder._undo_draw()
            remove_stale_files(folder.path)
            yield folder

    @classmethod
    def check(cls, path: str | os.PathLike[str] | None, *, resume: bool) -> None:
        """Check that a run can be written into a folder, before the work for it."""
        if path is None:
            return
        folder = cls(path)
        place = next(p for p in (folder.path, *folder.path.absolute().parents) if os.path.lexists(p))
        if not place.is_dir():
            raise RunFolderError(f"{folder.path}: cannot be made: {place} is no folder; choose another --out")
        if not os.access(place, os.W_OK | os.X_OK):
            raise RunFolderError(f"{folder.path}: {place} cannot be written; choose another --out")
        if not folder.path.is_dir():
            return
        if not (folder.path / CONFIG).is_file() and not is_empty(folder.path):  # before a lock file is created
            raise RunFolderError(f"{folder.path}: not empty and not a run folder; choose another --out")
        if folder._begun():
            folder._refuse_second(resume)

    def _refuse_second(self, resume: bool) -> None:
        if not resume:
            raise RunFolderError(f"{self.path}: holds a run already; resume it with --resume, or choose another --out")

    def describe(self, config: Mapping[str, Any]) -> None:
        """Write the configuration again, with the digest of the complete log."""
        with atomic_open(self.path / CONFIG, "w") as stream:
            stream.write(dump_toml(config))

    def removed_loops(self) -> list[LoopDecision]:
        """Loops that were removed from the run by hand."""
        return removed_loops_of_run(self.path)

    def _begun(self) -> bool:
        """Is there a finished result or a finished submap?"""
        if not (self.path / CONFIG).is_file():
            return False
        return (current_outputs(self.path) / "run.json").is_file() or len(self.submaps) > 0

    def _check_same(self, old: Path, config: Mapping[str, Any]) -> None:
        """A resumed run must have the configuration and the log of the interrupted run."""
        try:
            before = read_toml(old)
        except ConfigError as error:
            raise RunFolderError(f"{self.path}: damaged ({error})") from None
        now = tomllib.loads(dump_toml(config))
        for key, a, b in _differences(before, now):
            what = "another log is given: " if key.startswith("run.log.") else ""
            raise RunFolderError(f"{self.path}: cannot resume, {what}{key} was {a!r} and is {b!r} now")

    @property
    def submaps(self) -> SubmapStore:
        """Store of the finished submaps."""
        return self.submaps_with(None)

    def submaps_with(self, load_grid: GridLoader | None, draw: int | None = None) -> SubmapStore:
        """Store of the finished submaps; with ``load_grid`` their grids are read too.

        A draw that is being made, other than the one in the folder, has its own store.
        """
        return SubmapStore(self.path / (SUBMAPS if draw is None else f"{SUBMAPS}-{draw}"), load_grid=load_grid)

    def seed_choice(self) -> SeedChoice | None:
        """Draw of the submaps, if several were made and one was chosen."""
        file = resolve_inside(self.path, DRAWS, str(self.path))
        if not file.exists():
            return None
        stored = read_json(file, fmt=_DRAWS_FORMAT, shape={"draw": int, "attempts": [{}]})
        return SeedChoice(stored["draw"], stored["attempts"])

    def keep_draw(self, draw: int, attempts: list[dict[str, Any]]) -> None:
        """Keep the submaps of one draw as those of the run, and delete the others.

        If the process is killed before ``draws.json`` is written, :meth:`_undo_draw` restores the earlier state.
        """
        if draw:
            (self.path / SUBMAPS).rename(self.path / _BEATEN)
            (self.path / f"{SUBMAPS}-{draw}").rename(self.path / SUBMAPS)
        write_json(self.path / DRAWS, {"format": _DRAWS_FORMAT, "draw": draw, "attempts": attempts})
        self._drop_beaten()

    def _drop_beaten(self) -> None:
        for old in self.path.glob(f"{SUBMAPS}-*"):
            if old.is_dir() and not old.is_symlink() and _ANOTHER.fullmatch(old.name):
                shutil.rmtree(old, ignore_errors=True)

    def _undo_draw(self) -> None:
        """After a kill: restore the first draw if ``draws.json`` was not written, otherwise delete the other draws."""
        if (self.path / DRAWS).is_file():
            self._drop_beaten()
        elif (self.path / _BEATEN).is_dir():
            if (self.path / SUBMAPS).is_dir():  # the chosen draw is made again
                shutil.rmtree(self.path / SUBMAPS)
            (self.path / _BEATEN).rename(self.path / SUBMAPS)


def _differences(a: Mapping[str, Any], b: Mapping[str, Any], where: str = "") -> Iterable[tuple[str, Any, Any]]:
    for key in sorted({*a, *b}):
        name = f"{where}.{key}" if where else key
        x, y = a.get(key), b.get(key)
        if isinstance(x, Mapping) and isinstance(y, Mapping):
            yield from _differences(x, y, name)
        elif x != y:
            yield name, x, y
