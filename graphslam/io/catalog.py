"""Recorded data by name: find, check and load them.

Files are searched in the folders of the environment variable ``GRAPHSLAM_DATA``, then in the cache
(``GRAPHSLAM_CACHE``, or the platform's cache folder for graphslam), to which
:func:`graphslam.io.fetch.fetch_dataset` downloads.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from graphslam.core.errors import DataError, MissingDataError, UnknownNameError
from graphslam.core.log import SensorLog
from graphslam.io.cards import Card, CardFile, find_card, list_cards
from graphslam.io.readers import find_reader as find_reader
from graphslam.io.readers import recognise

DATA_VARIABLE = "GRAPHSLAM_DATA"
CACHE_VARIABLE = "GRAPHSLAM_CACHE"
State = Literal["ok", "missing", "differs"]


def cache_folder() -> Path:
    """Folder of downloads: ``GRAPHSLAM_CACHE``, or the platform's cache folder."""
    value = os.environ.get(CACHE_VARIABLE)
    if value:
        return Path(value)
    import pooch

    return Path(pooch.os_cache("graphslam"))


def data_roots() -> list[Path]:
    """Folders that are searched, in order: those of ``GRAPHSLAM_DATA``, then the cache."""
    value = os.environ.get(DATA_VARIABLE, "")
    return [*(Path(p) for p in value.split(os.pathsep) if p), cache_folder()]


def find_file(folder: Path, file: CardFile) -> Path | None:
    """The file below ``folder``, or its uncompressed form, or None."""
    names = (file.path, file.plain_path)
    return next((folder / n for n in names if n and (folder / n).is_file()), None)


def locate(data: Card | str) -> Path:
    """First folder that contains all required files of a data set; otherwise :class:`MissingDataError`."""
    c = find_card(data) if isinstance(data, str) else data
    needed = [f for f in c.files if not f.optional]
    roots = data_roots()
    fewest: list[CardFile] = needed
    for root in roots:
        absent = [f for f in needed if find_file(root / c.folder, f) is None]
        if not absent:
            return root / c.folder
        fewest = min(fewest, absent, key=len)
    raise MissingDataError(
        f"{len(fewest)} of {len(needed)} files of data set {c.name!r} are missing, first {fewest[0].path}",
        where=os.pathsep.join(str(r / c.folder) for r in roots),
        wanted=f"run `graphslam data fetch {c.name}`"
        if c.fetchable
        else f"a copy from {c.source} (no direct download) in {c.folder}/ below a folder of {DATA_VARIABLE}",
    )


@dataclass(frozen=True, slots=True)
class FileCheck:
    """Result of :func:`check_file`."""

    file: CardFile
    state: State
    path: Path | None


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, in hex."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def check_file(folder: Path, file: CardFile) -> FileCheck:
    """Compare one file (or its uncompressed form) below ``folder`` with its size and checksum."""
    path = find_file(folder, file)
    if path is None:
        return FileCheck(file, "missing", None)
    packed = path == folder / file.path
    size, digest = (file.bytes, file.sha256) if packed else (file.content_bytes, file.content_sha256)
    same = path.stat().st_size == size and sha256_of(path) == digest
    return FileCheck(file, "ok" if same else "differs", path)


def check_files(data: Card | str) -> list[FileCheck]:
    """Compare every file with its size and checksum, in the first root that contains any of them."""
    c = find_card(data) if isinstance(data, str) else data
    folders = [root / c.folder for root in data_roots()]
    folder = next((d for d in folders if any(find_file(d, f) for f in c.files)), folders[-1])
    return [check_file(folder, f) for f in c.files]


def load_recording(source: str | os.PathLike[str], *, reader: str | None = None, **options: Any) -> Any:
    """Load recorded data by data set name, or from a path.

    Parameters
    ----------
    source : str or path
        Name of a data set; ``name/file`` for one file of it (the ending may be left out, as ``posegraphs/intel``);
        ``name/part`` if a data set has several logs (``mrclam-dataset7/robot1``); or an existing file or folder.
    reader : str, optional
        Name of the reader (:func:`graphslam.io.readers.list_readers`). Default: that of the data set, or the first one
        that recognises the content of the path.
    options
        Options of the reader.

    Returns
    -------
    SensorLog, list of Submap, LandmarkObservations, TucLog, PoseNetwork or Path
        The type depends on the reader. For a pose network of g2o, TORO or iSAM, it is the path of its file, for
        :func:`graphslam.io.network_file.read_network`. ``meta["reader"]`` of a log has the name and options of the
        reader.
    """
    text = os.fspath(source)
    known = {c.name for c in list_cards()}
    if text in known:
        c = find_card(text)
        if c.reader == "pose-network":
            return _only_file(c)
        if c.reader is None and reader is None:
            raise DataError(f"there is no reader for data set {c.name!r}", where=str(locate(c)), got=c.kind)
        name = reader or str(c.reader)
        find_reader(name)  # an unknown reader is reported before missing files
        return _read(name, locate(c), f"data set {c.name}", {"name": c.name}, {**c.options, **options})
    name, slash, part = text.partition("/")
    if slash and name in known and not Path(text).exists():
        c = find_card(name)
        parts = {} if c.reader is None else find_reader(c.reader).parts
        if not parts:
            return _named_file(c, part)
        if part not in parts:
            raise UnknownNameError(f"part of data set {name!r}", part, parts)
        given = {**c.options, **parts[part], **options}
        return _read(str(c.reader), locate(c), f"data set {c.name}", {"name": c.name}, given)
    path = Path(text)
    if not path.exists():
        raise UnknownNameError("data set or path", text, known)
    if reader is not None:
        return _read(reader, path, "as asked for", {}, options)
    found = recognise(path)
    return _read(found.name, path, found.found, {}, options, found.also)


def _read(
    name: str, path: Path, found: str, named: Mapping[str, Any], options: Mapping[str, Any], also: Sequence[str] = ()
) -> Any:
    """Result of a reader; for a log, with the reader in ``meta``."""
    r = find_reader(name)
    value = r(path, **(named if r.takes_name() else {}), **options)
    if not isinstance(value, SensorLog):
        return value
    if not r.takes_name():
        value = replace(value, **named)
    used = {"name": name, "found": found, "options": {k: _plain(v) for k, v in options.items()}, "also": list(also)}
    return replace(value, meta={**value.meta, "reader": used})


def _plain(value: Any) -> Any:
    """Convert to types of JSON; other types become text."""
    if isinstance(value, str | bool | int | float) or value is None:
        return value
    return [_plain(v) for v in value] if isinstance(value, list | tuple) else str(value)


def _only_file(c: Card) -> Path:
    if len(c.files) > 1:
        names = ", ".join(f"{c.name}/{_stem(f)}" for f in c.files)
        raise DataError(f"data set {c.name!r} holds {len(c.files)} files: name one", wanted=names)
    return _present(c, c.files[0])


def _named_file(c: Card, name: str) -> Path:
    for f in c.files:
        if name in (f.path, f.plain_path, _stem(f)):
            return _present(c, f)
    raise UnknownNameError(f"file of data set {c.name!r}", name, [_stem(f) for f in c.files])


def _present(c: Card, file: CardFile) -> Path:
    for root in data_roots():
        path = find_file(root / c.folder, file)
        if path is not None:
            return path
    locate(c)  # raises an error with instructions, unless only this optional file is missing
    raise MissingDataError("no such file", where=file.path, wanted=f"data set {c.name!r} complete")


def _stem(file: CardFile) -> str:
    """Path without its last two endings: ``intel.g2o.xz`` → ``intel``."""
    p = Path(file.plain_path or file.path)
    return p.with_suffix("").as_posix()
