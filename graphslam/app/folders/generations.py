"""Folders whose files are rewritten together: one writer at a time, each state committed by one rename.

::

    RUN/generations/000002/…        the files of one state
    RUN/current -> generations/000002
    RUN/run.json -> current/run.json
    RUN/figures/map.png -> ../current/figures/map.png

A command writes a new generation next to the current one and syncs it to disk. Then ``current`` is replaced by one
rename, so readers of the plain paths see the old state or the new one. Links to new names are made before that and are
dangling until then; links to removed names are deleted after it, then the old generation. After a kill at any time one
of the two states remains, and stale files that the next writer removes.

Readers resolve ``current`` once (:func:`read_consistently`) and read everything from that folder. A folder of plain
files was copied without its links, was written by an older version, or is on a file system without symbolic links. Its
readers compare the ids inside the files (:func:`check_same`), and the first writer converts it to generations.
"""

from __future__ import annotations

import contextlib
import filecmp
import fnmatch
import os
import re
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from graphslam.app.folders.output_files import OutputFiles
from graphslam.core.atomic import is_part, part_path, sweep_parts, sync_to_disk
from graphslam.core.errors import FormatError, GraphSlamError
from graphslam.core.interrupt import defer_interrupts
from graphslam.core.lock import LOCK, is_lock, lock_folder

GENERATIONS, CURRENT = "generations", "current"
OWNED = (
    *("run.json", "merge.json", "metrics.json", "timings.json", "events.jsonl", "ledger.csv", "landmarks.csv"),
    *("map.npz", "merged.npz", "association.npz", "graph.g2o", "graph.npz"),
    *("trajectory.tum", "trajectory_*.tum", "nodes.tum"),
    *("truth.npz", "truth.tum", "dead_reckoning.tum", "gps_*.npz", "fixes.npz", "inputs.npz", "scans.npz"),
    *("inputs/*.npz", "inputs/log.json", "fused_map.json", "map.ply", "map.bt", "cloud.ply", "map.pgm", "map.yaml"),
    *("map-*.pgm", "map-*.yaml"),
    *("map.grid.npz", "map.kml", "map.geojson", "clearest.*", "clearest-*", "alternatives/*.tum", "alternatives/*.g2o"),
    *("report.html", "report.md", "table.csv", "timings.csv", "figures/*.png", "refined/*.npz", "refined/index.json"),
)
"""Files written by commands; used in folders of plain files, where other files may exist."""
NOT_OWNED = ("figures/progress.png",)
"""Written during a run; part of no generation."""
_PARTS = ("figures", "alternatives", "inputs", "refined")
"""Subfolders of a state."""
_FOLDERS = (GENERATIONS, "submaps", "submaps-*", "trials", *_PARTS)
_READ = (
    *OWNED,
    *NOT_OWNED,
    *_FOLDERS,
    *(f"{f}/*" for f in _FOLDERS[:4]),
    CURRENT,
    "config.toml",
    "draws.json",
    "study.json",
)
"""Names, as shell patterns, that graphslam reads from or writes to."""
_NUMBER = re.compile(r"\d{6,}")
T = TypeVar("T")


class FolderTransaction(OutputFiles):
    """A state that is being written.

    Parameters
    ----------
    path : path
        Its folder inside ``generations``.
    home : path
        The folder that has these states.
    before : path or None
        Folder with the files of the current state.
    """

    def __init__(self, path: Path, home: Path, before: Path | None) -> None:
        super().__init__(path)
        self.home, self.before = home, before

    def adopt(self, *, only: str = "*", drop: Iterable[str] = ()) -> None:
        """Link files of the current state that are missing in this one: names like ``only``, none like ``drop`` (shell
        patterns)."""
        if self.before is None:
            return
        dropped = tuple(drop)
        for name in _names(self.before, everything=self.before != self.home):
            target = self.path / name
            like = (fnmatch.fnmatchcase(name, p) for p in dropped)
            if target.exists() or not fnmatch.fnmatchcase(name, only) or any(like):
                continue
            target.parent.mkdir(parents=True, exist_ok=True)
            _link(self.before / name, target)


def current_outputs(folder: str | os.PathLike[str]) -> Path:
    """Folder with the files of the current state: its generation, or the folder itself if it has none."""
    home = Path(folder)
    target = _current(home)
    if target is None:
        return home
    if not (home / target).is_dir():
        raise FormatError("refers to a missing generation", where=str(home / CURRENT), got=target)
    return home / target


def read_consistently(folder: str | os.PathLike[str], read: Callable[[Path], T]) -> T:
    """Read files of one state with ``read(folder)``; repeated if another state was committed meanwhile."""
    while True:
        root = current_outputs(folder)
        try:
            check_links(folder)
            return read(root)
        except (GraphSlamError, OSError):
            with contextlib.suppress(FormatError):
                if current_outputs(folder) != root:
                    continue
            raise


def check_links(folder: str | os.PathLike[str]) -> None:
    """Refuse a folder in which a name from :data:`_READ` is a link to the outside, so that a folder from another person
    cannot redirect reading or writing. Links with other names are not checked.
    """
    home = Path(folder)
    real = os.path.realpath(home)
    for path in _links(home):
        name = path.relative_to(home).as_posix()
        leads = os.path.realpath(path)
        if not Path(leads).is_relative_to(real) and any(fnmatch.fnmatchcase(name, p) for p in _READ):
            raise FormatError(
                "file name leads out of its folder", where=str(path), got=leads, wanted="a file, or a link within it"
            )


def _links(home: Path) -> Iterator[Path]:
    for name in ("", *_FOLDERS):
        top = home / name
        if top.is_symlink() and name:
            continue  # found as an entry of its parent folder
        for at, folders, files in os.walk(top):
            yield from (p for n in (*folders, *files) if (p := Path(at, n)).is_symlink())
            if not name:
                break


def check_same(first: tuple[Path, Any], *others: tuple[Path, Any]) -> None:
    """Compare generation ids inside files; files of older versions have none (None)."""
    file, known = first
    for other, found in others:
        if found is not None and known is not None and str(found) != str(known):
            raise FormatError(
                f"does not belong to the same state as {file.name}: one of them was copied or changed alone",
                where=str(other),
                got=f"generation {found}",
                wanted=str(known),
            )


@contextmanager
def new_generation(folder: str | os.PathLike[str]) -> Iterator[FolderTransaction]:
    """Write a new state of a run folder; it is committed when the block ends, and dropped if that raises.

    Parameters
    ----------
    folder : path
        The caller has checked that it is a run folder, or empty.
    """
    home = Path(folder)
    with lock_folder(home):
        check_links(home)
        linked = _has_links(home)
        remove_stale_files(home)
        if linked:
            _into_generations(home)
            remove_stale_files(home)
        before = _current(home)
        number = 1 + max([0, *(int(n) for n in _numbers(home))])
        staged = home / GENERATIONS / f"{number:06d}"
        staged.mkdir(parents=True)
        present = home / before if before is not None else home if _names(home, everything=False) else None
        made = FolderTransaction(staged, home, present)
        try:
            yield made
        except BaseException:
            shutil.rmtree(staged, ignore_errors=True)
            raise
        names = _names(staged, everything=True)
        for name in names:
            sync_to_disk(staged / name)
        for part in (*{(staged / n).parent for n in names}, staged, staged.parent):
            sync_to_disk(part)
        with defer_interrupts():
            (_commit if linked else _replace_plainly)(home, staged, names)


def _commit(home: Path, staged: Path, names: list[str]) -> None:
    for name in names:
        _point(home, name)
    _symlink(f"{GENERATIONS}/{staged.name}", home / CURRENT)  # from here on the new state is current
    sync_to_disk(home)
    remove_stale_files(home)


def _replace_plainly(home: Path, staged: Path, names: list[str]) -> None:
    """Without links: replace file by file, ``run.json`` or ``merge.json`` last; the ids inside reveal mixed states."""
    last = [n for n in names if n in ("run.json", "merge.json")]
    obsolete = set(_names(home, everything=False)) - set(names)
    for name in [*(n for n in names if n not in last), *last]:
        (home / name).parent.mkdir(parents=True, exist_ok=True)
        (staged / name).replace(home / name)
    for name in obsolete:
        (home / name).unlink(missing_ok=True)
    shutil.rmtree(staged.parent, ignore_errors=True)
    sync_to_disk(home)


def remove_stale_files(folder: str | os.PathLike[str]) -> None:
    """Remove files of killed writers in a run folder: partial files, states that were never committed or are
    superseded, and dangling links. The caller has locked the folder."""
    home = Path(folder)
    target = _current(home)
    for name in _numbers(home):
        if target != f"{GENERATIONS}/{name}":
            shutil.rmtree(home / GENERATIONS / name, ignore_errors=True)
    for part in (home, *home.glob("submaps*"), *(home / p for p in _PARTS)):
        if part.is_symlink() or not part.is_dir():
            continue
        sweep_parts(part)
        for path in part.iterdir():
            if path.is_symlink() and _is_ours(home, path) and not path.exists():
                path.unlink()


def name_inside(folder: str | os.PathLike[str], file: str | os.PathLike[str]) -> str | None:
    """Name of a file directly in the folder, which is then part of its current state; None for other files."""
    path = Path(file)
    return path.name if os.path.realpath(path.parent) == os.path.realpath(folder) else None


def is_empty(folder: str | os.PathLike[str]) -> bool:
    """Is the folder empty, except for files that a killed writer may have left?"""
    home = Path(folder)
    ours = is_lock(home / LOCK)
    for path in home.iterdir():
        if path.name == LOCK:
            if not ours:
                return False
        elif path.name == GENERATIONS and ours and path.is_dir():
            if any(not _NUMBER.fullmatch(p.name) for p in path.iterdir()):
                return False
        elif path.is_dir() and not path.is_symlink() and path.name in (*_PARTS, "submaps"):
            inside = (p for p in path.iterdir() if f"{path.name}/{p.name}" not in NOT_OWNED)
            if any(not (is_part(p.name) or (p.is_symlink() and _is_ours(home, p) and not p.exists())) for p in inside):
                return False
        elif not (is_part(path.name) or (path.is_symlink() and _is_ours(home, path) and not path.exists())):
            return False
    return True


def _current(home: Path) -> str | None:
    """Target of the link ``current``; None if it is not a link to a generation."""
    try:
        target = os.readlink(home / CURRENT)
    except OSError:
        return None
    head, _, name = target.partition("/")
    return target if head == GENERATIONS and _NUMBER.fullmatch(name) else None


def _numbers(home: Path) -> list[str]:
    folder = home / GENERATIONS
    return sorted(p.name for p in folder.iterdir() if _NUMBER.fullmatch(p.name)) if folder.is_dir() else []


def _names(root: Path, *, everything: bool) -> list[str]:
    """All files below a folder, or only those that match :data:`OWNED`."""
    if everything:
        found = [p for p in root.rglob("*") if p.is_file() and not is_part(p.name)]
        return sorted(p.relative_to(root).as_posix() for p in found)
    names: set[str] = set()
    for pattern in OWNED:
        names |= {p.relative_to(root).as_posix() for p in root.glob(pattern) if p.is_file()}
    return sorted(names - set(NOT_OWNED))


def _into_generations(home: Path) -> None:
    """Convert a folder of plain files to one with a generation; at every moment the paths have the same content."""
    target = _current(home)
    if target is None:
        names = [n for n in _names(home, everything=False) if not (home / n).is_symlink()]
        if not names:
            return
        (home / GENERATIONS).mkdir(exist_ok=True)
        number = 1 + max([0, *(int(n) for n in _numbers(home))])
        copied = home / CURRENT
        if copied.is_dir() and not copied.is_symlink():  # a copy that followed the links
            copied.rename(home / GENERATIONS / f"{number:06d}")
            number += 1
        target = f"{GENERATIONS}/{number:06d}"
        for name in names:
            (home / target / name).parent.mkdir(parents=True, exist_ok=True)
            _link(home / name, home / target / name)
            sync_to_disk(home / target / name)
        sync_to_disk(home / target)
        _symlink(target, home / CURRENT)
    for name in _names(home / target, everything=True):  # all are plain files, or only some after a kill here
        path = home / name
        if path.is_file() and not path.is_symlink() and filecmp.cmp(path, home / target / name, shallow=False):
            _point(home, name)


def _point(home: Path, name: str) -> None:
    """Make a plain path a link into the current state."""
    path = home / name
    target = "../" * name.count("/") + f"{CURRENT}/{name}"
    if path.is_symlink() and os.readlink(path) == target:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    _symlink(target, path)


def _symlink(target: str, path: Path) -> None:
    temporary = part_path(path)
    temporary.symlink_to(target)
    temporary.replace(path)


def _is_ours(home: Path, path: Path) -> bool:
    """Is it a link made by :func:`_point`?"""
    name = path.relative_to(home).as_posix()
    return path.name != CURRENT and os.readlink(path) == "../" * name.count("/") + f"{CURRENT}/{name}"


def _link(source: Path, target: Path) -> None:
    """Hard link; a copy if the system has no hard links."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def _has_links(home: Path) -> bool:
    """Does the file system have symbolic links?"""
    probe = part_path(home / CURRENT)
    try:
        probe.symlink_to(GENERATIONS)
    except (OSError, NotImplementedError):
        return False
    probe.unlink()
    return True
