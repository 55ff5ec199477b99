"""The folder of a run: complete after a crash up to the last finished submap, resumable from there.

``config.toml`` (effective) and ``submaps/`` are written while the run goes on; everything else is one state, written by
:mod:`graphslam.app.run.outputs` and replaced as a whole (:mod:`graphslam.app.folders.generations`).
"""

from __future__ import annotations

import logging
import os
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from graphslam.app.folders.generations import check_links, is_empty, outputs, sweep
from graphslam.app.folders.lock import locked, make_folder
from graphslam.core.atomic import atomic_open
from graphslam.core.config import dump_toml, read_toml
from graphslam.core.errors import ConfigError, RunFolderError
from graphslam.io.submap_store import GridLoader, SubmapStore

logger = logging.getLogger(__name__)
CONFIG = "config.toml"


class RunFolder:
    """Creates and reopens a run folder.

    Parameters
    ----------
    path : path
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)

    @classmethod
    @contextmanager
    def start(cls, path: str | os.PathLike[str], config: Mapping[str, Any], *, resume: bool) -> Iterator[RunFolder]:
        """Make a new folder, or reopen one whose configuration and log are the same; no other process writes into it
        until the block ends.

        A folder in which a run left no finished submap is begun anew.

        Raises
        ------
        RunFolderError
            The folder holds something else, another configuration, or a run of another log; it is being written by
            another process, or cannot be written.
        FormatError
            A link in it leads out of it.
        """
        folder = cls(path)
        make_folder(folder.path)
        if not (folder.path / CONFIG).is_file() and not is_empty(folder.path):  # before a lock is put there
            raise RunFolderError(f"{folder.path}: not empty and not a run folder; choose another --out")
        with locked(folder.path):
            check_links(folder.path)
            old = folder.path / CONFIG
            if folder._begun():
                if not resume:
                    raise RunFolderError(
                        f"{folder.path}: holds a run already; --resume goes on with it, or choose another --out"
                    )
                folder._check_same(old, config)
            else:
                folder.describe(config)
            sweep(folder.path)
            yield folder

    def describe(self, config: Mapping[str, Any]) -> None:
        """Write the configuration anew, with what is known of the log at its end."""
        with atomic_open(self.path / CONFIG, "w") as stream:
            stream.write(dump_toml(config))

    def _begun(self) -> bool:
        """Is there a run with anything to lose?"""
        if not (self.path / CONFIG).is_file():
            return False
        return (outputs(self.path) / "run.json").is_file() or len(self.submaps) > 0

    def _check_same(self, old: Path, config: Mapping[str, Any]) -> None:
        """A resumed run must be the run that was stopped."""
        try:
            before = read_toml(old)
        except ConfigError as error:
            raise RunFolderError(f"{self.path}: damaged ({error})") from None
        now = tomllib.loads(dump_toml(config))
        if isinstance(before.get("run"), dict) and "log" not in before["run"]:
            logger.warning("%s: an older version did not note which log it read; it is taken to be this one", self.path)
            now["run"].pop("log", None)
        for key, a, b in _differences(before, now):
            what = "the log is another one: " if key.startswith("run.log.") else ""
            raise RunFolderError(f"{self.path}: cannot resume, {what}{key} was {a!r} and is {b!r} now")

    @property
    def submaps(self) -> SubmapStore:
        """Store of the finished submaps."""
        return self.submaps_with(None)

    def submaps_with(self, load_grid: GridLoader | None) -> SubmapStore:
        """Store of the finished submaps, whose grids are read too where a reader is given."""
        return SubmapStore(self.path / "submaps", load_grid=load_grid)


def _differences(a: Mapping[str, Any], b: Mapping[str, Any], where: str = "") -> Iterable[tuple[str, Any, Any]]:
    for key in sorted({*a, *b}):
        name = f"{where}.{key}" if where else key
        x, y = a.get(key), b.get(key)
        if isinstance(x, Mapping) and isinstance(y, Mapping):
            yield from _differences(x, y, name)
        elif x != y:
            yield name, x, y
