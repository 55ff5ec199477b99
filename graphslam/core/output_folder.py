"""Folders of outputs outside a run: a log, a joined map, tiles, floor plans.

A folder is new, empty, or written by the same command before. New files are written in a folder inside it, then moved
to their places; a list of the files (:data:`LISTED`) tells the next writer which ones it may replace. All others stay.
The files that make an output readable (an index) are removed first and moved last: a reader finds the old output, the
new one, or after a kill between both an unfinished one that it refuses.
"""

from __future__ import annotations

import fnmatch
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from graphslam.core.atomic import check_file_target, is_part, read_json, write_json
from graphslam.core.errors import FormatError, OutputError
from graphslam.core.interrupt import defer_interrupts
from graphslam.core.lock import LOCK, is_lock, lock_folder
from graphslam.core.reading import safe_name

LISTED = ".graphslam-output.json"
"""Kind and file names of an output."""
STAGED = ".graphslam-new"
_FORMAT = "graphslam.output/1"


def check_folder_target(path: str | os.PathLike[str], kind: str) -> Path:
    """Check that an output can be written into a folder, before the work for it.

    Parameters
    ----------
    kind : str
        What is written, such as ``log``; an earlier output of the same kind is replaced.

    Raises
    ------
    OutputError
        The path is a file, or a folder that cannot be written, or one with other files.
    """
    home = Path(path)
    if home.is_symlink() or home.exists():
        if not home.is_dir():
            raise OutputError(f"{home}: is a file, pipe or device; wanted a folder")
        _listed(home, kind)
    place = next(p for p in (home, *home.absolute().parents) if p.exists())
    if not (place.is_dir() and os.access(place, os.W_OK | os.X_OK)):
        raise OutputError(f"{home}: {place} is no folder that can be written; choose another one")
    return home


def _listed(home: Path, kind: str) -> list[str]:
    """Files of the earlier output in the folder."""
    if (home / LISTED).is_file():
        stored = read_json(home / LISTED, fmt=_FORMAT, shape={"kind": str, "files": [str]})
        if stored["kind"] == kind:
            return [_checked(home, name) for name in stored["files"]]
        raise OutputError(f"{home}: holds a {stored['kind'][:80]}; wanted a new or empty folder for the {kind}")
    others = (n for n in os.listdir(home) if n not in (LOCK, STAGED) and not is_part(n))
    found = next(others, "a lock" if (home / LOCK).exists() and not is_lock(home / LOCK) else None)
    if found is not None:
        raise OutputError(f"{home}: holds other files, such as {found}; wanted a new or empty folder for the {kind}")
    return []


def _checked(home: Path, name: str) -> str:
    """The name, if it is that of a file within the folder."""
    where = str(home / LISTED)
    for part in PurePosixPath(name).parts or ("",):
        safe_name(part, where)
    if not Path(os.path.realpath((home / name).parent)).is_relative_to(os.path.realpath(home)):
        raise FormatError("file name leads out of its folder", where=where, got=name[:80])
    return name


@contextmanager
def output_folder(path: str | os.PathLike[str], kind: str, *, last: Sequence[str]) -> Iterator[Path]:
    """Write an output: yields an empty folder for its files, which replace those of the earlier one at the end.

    Parameters
    ----------
    kind : str
        See :func:`check_folder_target`.
    last : sequence of str
        Names (shell patterns) of the files without which a reader refuses the folder.
    """
    home = check_folder_target(path, kind)
    made = not home.exists()
    with lock_folder(home):
        try:
            before = _listed(home, kind)
            check_file_target(home / LISTED)  # removes what a killed writer left beside it
            staged = home / STAGED
            shutil.rmtree(staged, ignore_errors=True)
            staged.mkdir()
            try:
                yield staged
                with defer_interrupts():
                    _move(home, staged, kind, before, last)
            finally:
                shutil.rmtree(staged, ignore_errors=True)
        except BaseException:  # only with the lock: another process may have begun to write
            if made and home.is_dir() and os.listdir(home) == [LOCK]:
                (home / LOCK).unlink()
                home.rmdir()
            raise


def _move(home: Path, staged: Path, kind: str, before: list[str], last: Sequence[str]) -> None:
    names = sorted(p.relative_to(staged).as_posix() for p in staged.rglob("*") if p.is_file())
    if strange := [n for n in names if n not in before and os.path.lexists(home / n)]:
        raise OutputError(
            f"{home / strange[0]}: was not written by graphslam and is not replaced; choose another folder"
        )
    index = [n for n in {*names, *before} if any(fnmatch.fnmatchcase(n, p) for p in last)]
    for folder in {(home / n).parent for n in names}:
        folder.mkdir(parents=True, exist_ok=True)
    write_json(home / LISTED, {"format": _FORMAT, "kind": kind, "files": sorted({*before, *names})})
    for name in [*index, *before]:  # the index first
        if name in index or name not in names:
            (home / name).unlink(missing_ok=True)
    for name in sorted(names, key=lambda n: n in index):
        (staged / name).replace(home / name)
    write_json(home / LISTED, {"format": _FORMAT, "kind": kind, "files": names})
