"""Folders whose files are rewritten together: one writer at a time, each state committed by one rename.

::

    RUN/generations/000002/…        the files of one state
    RUN/current -> generations/000002
    RUN/run.json -> current/run.json
    RUN/figures/map.png -> ../current/figures/map.png

A verb writes a new generation beside the present one and brings it to the disk. Then ``current`` is replaced by one
rename: whoever looks at the plain paths sees the old state or the new one. Links to new names are made before that,
and lead nowhere until then; links to names that are gone are removed after it, then the generation before. A kill
anywhere leaves one of both states, and remains that the next writer sweeps.

Readers resolve ``current`` once (:func:`read_consistently`) and read everything from that folder. A folder of plain
files was copied without its links, was written by an older version, or lies where there are no symbolic links: its
readers hold the ids inside the files against each other (:func:`check_same`), and the first writer turns it into
generations.
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

from graphslam.app.folders.lock import LOCK, is_lock, lock_folder
from graphslam.app.folders.output_files import OutputFiles
from graphslam.core.atomic import is_part, part_path, sweep_parts, sync_to_disk
from graphslam.core.errors import FormatError, GraphSlamError

GENERATIONS, CURRENT = "generations", "current"
OWNED = (
    *("run.json", "merge.json", "metrics.json", "timings.json", "events.jsonl", "ledger.csv", "landmarks.csv"),
    *("map.npz", "merged.npz", "association.npz", "graph.g2o", "graph.npz"),
    *("trajectory.tum", "trajectory_*.tum", "nodes.tum"),
    *("truth.npz", "truth.tum", "dead_reckoning.tum", "gps_*.npz", "fixes.npz", "taken.npz", "scans.npz"),
    *("inputs/*.npz", "inputs/log.json", "fused_map.json", "map.ply", "map.bt", "cloud.ply", "map.pgm", "map.yaml"),
    *("map-*.pgm", "map-*.yaml"),
    *("map.grid.npz", "map.kml", "map.geojson", "clearest.*", "clearest-*", "alternatives/*.tum", "alternatives/*.g2o"),
    *("report.html", "report.md", "table.csv", "timings.csv", "figures/*.png", "refined/*.npz", "refined/index.json"),
)
"""Files that verbs write, in folders of plain files, where nothing else says which are ours."""
NOT_OWNED = ("figures/progress.png",)
"""Written while a run goes on, and of no generation."""
_PARTS = ("figures", "alternatives", "inputs", "refined")
"""Folders of a state."""
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
"""Names, as shell patterns, that our readers follow and our writers write to."""
_NUMBER = re.compile(r"\d{6,}")
T = TypeVar("T")


class FolderTransaction(OutputFiles):
    """A state that is being written.

    Parameters
    ----------
    path : path
        Its folder inside ``generations``.
    home : path
        The folder that it is a state of.
    before : path or None
        The files of the present state.
    """

    def __init__(self, path: Path, home: Path, before: Path | None) -> None:
        super().__init__(path)
        self.home, self.before = home, before

    def adopt(self, *, only: str = "*", drop: Iterable[str] = ()) -> None:
        """Take over what the present state has and this one has not: names like ``only``, none like ``drop`` (shell
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
    """Where the files of the present state of a folder are: its generation, or itself where it has none."""
    home = Path(folder)
    target = _current(home)
    if target is None:
        return home
    if not (home / target).is_dir():
        raise FormatError("refers to a missing generation", where=str(home / CURRENT), got=target)
    return home / target


def read_consistently(folder: str | os.PathLike[str], read: Callable[[Path], T]) -> T:
    """Read files of one state: ``read`` gets the folder that holds them, again if another state was committed
    meanwhile."""
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
    """Refuse a folder in which a name of ours is a link that leads out of it: a folder that somebody else made chooses
    neither which other files are read, nor where is written. Links of other names are left alone.
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
            continue  # found in the folder that holds it
        for at, folders, files in os.walk(top):
            yield from (p for n in (*folders, *files) if (p := Path(at, n)).is_symlink())
            if not name:
                break


def check_same(first: tuple[Path, Any], *others: tuple[Path, Any]) -> None:
    """Hold ids of generations inside files against each other; files of older versions have none (None)."""
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
    """Write a new state of a folder that is ours; it is committed when the block ends, and dropped if that raises.

    Parameters
    ----------
    folder : path
        The caller has looked whether it is one of ours.
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
        (_commit if linked else _replace_plainly)(home, staged, names)


def _commit(home: Path, staged: Path, names: list[str]) -> None:
    for name in names:
        _point(home, name)
    _symlink(f"{GENERATIONS}/{staged.name}", home / CURRENT)  # the new state, from here on
    sync_to_disk(home)
    remove_stale_files(home)


def _replace_plainly(home: Path, staged: Path, names: list[str]) -> None:
    """Without links: file by file, the one that says "finished" last; ids inside tell a mixture from a state."""
    last = [n for n in names if n in ("run.json", "merge.json")]
    gone = set(_names(home, everything=False)) - set(names)
    for name in [*(n for n in names if n not in last), *last]:
        (home / name).parent.mkdir(parents=True, exist_ok=True)
        (staged / name).replace(home / name)
    for name in gone:
        (home / name).unlink(missing_ok=True)
    shutil.rmtree(staged.parent, ignore_errors=True)
    sync_to_disk(home)


def remove_stale_files(folder: str | os.PathLike[str]) -> None:
    """Remove what killed writers left in a folder that is ours: halves of files, states that were never committed or
    are superseded, and links to files that are gone. The caller holds the lock."""
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
    """Name of a file directly in a folder, which is then one of its present state; None for a file elsewhere."""
    path = Path(file)
    return path.name if os.path.realpath(path.parent) == os.path.realpath(folder) else None


def is_empty(folder: str | os.PathLike[str]) -> bool:
    """Is there nothing in a folder but what a killed writer of ours may have left?"""
    home = Path(folder)
    ours = is_lock(home / LOCK)
    for path in home.iterdir():
        if path.name == LOCK:
            if not ours and path.stat().st_size > 0:  # made, and not yet written
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
    """What ``current`` names; None where it is no link of ours."""
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
    """Files below a folder, or those of them that are ours where it holds others too."""
    if everything:
        found = [p for p in root.rglob("*") if p.is_file() and not is_part(p.name)]
        return sorted(p.relative_to(root).as_posix() for p in found)
    names: set[str] = set()
    for pattern in OWNED:
        names |= {p.relative_to(root).as_posix() for p in root.glob(pattern) if p.is_file()}
    return sorted(names - set(NOT_OWNED))


def _into_generations(home: Path) -> None:
    """Turn a folder of plain files into one with a generation; at every moment the paths hold what they held."""
    target = _current(home)
    if target is None:
        names = [n for n in _names(home, everything=False) if not (home / n).is_symlink()]
        if not names:
            return
        (home / GENERATIONS).mkdir(exist_ok=True)
        number = 1 + max([0, *(int(n) for n in _numbers(home))])
        copied = home / CURRENT
        if copied.is_dir() and not copied.is_symlink():  # of a copy that followed the links
            copied.rename(home / GENERATIONS / f"{number:06d}")
            number += 1
        target = f"{GENERATIONS}/{number:06d}"
        for name in names:
            (home / target / name).parent.mkdir(parents=True, exist_ok=True)
            _link(home / name, home / target / name)
            sync_to_disk(home / target / name)
        sync_to_disk(home / target)
        _symlink(target, home / CURRENT)
    for name in _names(home / target, everything=True):  # all of them plain, or some after a kill just here
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
    """Is a link one that :func:`_point` makes?"""
    name = path.relative_to(home).as_posix()
    return path.name != CURRENT and os.readlink(path) == "../" * name.count("/") + f"{CURRENT}/{name}"


def _link(source: Path, target: Path) -> None:
    """The same file under another name; a copy where the system has no such links."""
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
